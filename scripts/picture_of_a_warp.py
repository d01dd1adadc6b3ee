"""Draw the README's picture from the kept pictures of a run of `quick`.

python scripts/picture_of_a_warp.py runs/demo docs/pictures/warp.jpg
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from matplotlib import pyplot
from matplotlib.image import imread

from attnwarp_eval.study import Store

VARIANTS = ("bounds only", "corrected")
"""Rows of the picture: the bounds test of the paper, and the rules that truth supports."""


def pictures_of(run: Path, scene: str, variant: str, view: str) -> dict[str, Path]:
    """Files of a view's pictures under one variant, by what they show."""
    for cell in json.loads((run / "study.json").read_text())["cells"]:
        if (cell["scene"], cell["probe"]) == (scene, "warp") and variant in cell["variants"]:
            record = Store(run).read(cell["id"])
            return {p["what"]: run / p["path"] for p in record["pictures"] if p["view"] == view}
    raise SystemExit(f"{run}: no warp of {scene!r} under {variant!r}; make the run with: make demo")


def draw(run: Path, out: Path, scene: str, view: str) -> None:
    """One row a variant: source, target, the source warped into the target, the mask."""
    columns = {
        "source": "source view",
        "target": "target view",
        "warped": "source, warped",
        "mask": "mask against truth",
    }
    figure, axes = pyplot.subplots(len(VARIANTS), len(columns), figsize=(11, 5.8), dpi=110)
    for axis, title in zip(axes[0], columns.values(), strict=True):
        axis.set_title(title)
    for row, variant in zip(axes, VARIANTS, strict=True):
        files = pictures_of(run, scene, variant, view)
        for axis, what in zip(row, columns, strict=True):
            axis.imshow(imread(files[what]))
            axis.set(xticks=[], yticks=[])
        row[0].set_ylabel(variant)
    figure.tight_layout(pad=0.4)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, pil_kwargs={"quality": 88})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scene", default="bear")
    parser.add_argument("--view", default="yaw030")
    options = parser.parse_args()
    draw(options.run, options.out, options.scene, options.view)
