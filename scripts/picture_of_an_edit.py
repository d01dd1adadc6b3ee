"""Draw the README's picture of an edit: views edited alone, and by attention that is warped.

python scripts/picture_of_an_edit.py docs/pictures/edit.jpg
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot

from attnwarp.cli.edit import FEWER_STEPS
from attnwarp.editing.small import load_editor
from attnwarp.methods import ByViewSettings, attention_warping, by_view, preset
from attnwarp_eval.world import splats, world

VIEWS = ("yaw030", "yaw060", "yaw090", "yaw120")
SIZE = 128
"""Side of the pictures."""


def draw(out: Path, scene: str, thing: str, instruction: str, seed: int) -> None:
    """Rows: before the edit; each view edited alone and attention warped, with noise of each view's
    own; each view alone with noise that sticks to the surface, and with it the preset `extended`,
    the default. Columns: the source view and targets. Nothing changes outside the thing's exact
    mask.
    """
    truth = world(scene, SIZE)
    cameras = [truth.source, *(truth.targets[view] for view in VIEWS)]
    before = [np.clip(truth.image(camera.name, 8), 0, 1) for camera in cameras]
    number = truth.scene.object_names.index(thing)
    segments = [truth.geometry.trace(camera).object_id == number for camera in cameras]
    model = splats(scene, SIZE, 0, kind="2d", count=20_000, position_noise=0.1, normal_noise=3.0)
    given = (model, cameras, before, load_editor("small-parts"), instruction)
    # The row shows edited views, so the splats need no tuning.
    few: dict[str, Any] = {"iterations": 1, "seed": seed, "steps": FEWER_STEPS}
    rows: dict[str, Mapping[int, Any]] = {
        "before": dict(enumerate(before)),
        "each view alone": by_view(
            *given, ByViewSettings(**few, noise="fresh"), segments=segments
        ).edited,
    }
    few |= {"stages": 1, "views_per_stage": len(VIEWS)}
    alone = {"a0": 0.0, "unseen": "free"}
    for title, settings in (
        ("attention warped", preset("attention_warping", "corrected", noise="fresh", **few)),
        ("alone, surface noise", preset("attention_warping", "extended", **few, **alone)),
        ("the default", preset("attention_warping", "extended", **few)),
    ):
        rows[title] = attention_warping(*given, settings, segments=segments).edited
    figure, axes = pyplot.subplots(len(rows), len(cameras), figsize=(11, 11.2), dpi=80)
    for axis, title in zip(axes[0], ("source view", *VIEWS), strict=True):
        axis.set_title(title)
    for row, (title, pictures) in zip(axes, rows.items(), strict=True):
        for number, axis in enumerate(row):
            axis.imshow(pictures[number], interpolation="nearest")
            axis.set(xticks=[], yticks=[])
        row[0].set_ylabel(title)
    figure.tight_layout(pad=0.4)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, pil_kwargs={"quality": 88})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--scene", default="bear")
    parser.add_argument("--thing", default="bear")
    parser.add_argument("--instruction", default="make each part another color")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    draw(options.out, options.scene, options.thing, options.instruction, options.seed)
