"""Accuracy with which an editor of depth maps rebuilds a picture from its DDIM inversion, on worlds
that it has never seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from attnwarp.editing.editor import edit, guided
from attnwarp.editing.inversion import invert_view
from attnwarp.losses import psnr_of_mse
from training.assess.card_sections import Kept
from training.assess.depth import depth_of, prompt_of
from training.assess.editors import SEED
from training.assess.figures import Figure, figure
from training.assess.pictures import Row
from training.editors.depth import Prompts
from training.worlds.editing_pairs import GROUPS

STEPS = (20, 50, 100)

ASKED = 30.0
"""dB."""


@dataclass(frozen=True)
class Rebuilt:
    """PSNR in dB to the pictures.

    Attributes:
        steps: of denoising.
        inverted: of the pictures rebuilt from their inversion.
        control: of those drawn from other latents by the same prompt and depth map.
        enough: how many of the first reach :data:`ASKED`.
    """

    steps: int
    inverted: Figure
    control: Figure
    enough: int


def rebuild(editor: Any, prompts: Prompts, world: int, steps: int) -> tuple[float, float]:
    """PSNR of a world's picture rebuilt from its inversion, and of one drawn from other latents."""
    rng = np.random.default_rng([SEED, world, 6])
    look = int(rng.choice([k for k in GROUPS["color"] if prompts.worlds.valid[world, k]]))
    row = Row(world, 0, look, look, prompts.corner(world, 0, rng))
    text, depth = prompt_of(editor, prompts, row, rng), depth_of(prompts, row)
    picture = prompts.shown(row, look)
    latents = invert_view(editor, depth, picture, text, steps=steps)
    with guided(editor, 1.0):  # what was inverted without guidance is rebuilt without
        again = edit(editor, [depth], text, steps=steps, latents=latents).images[0]
        other = edit(editor, [depth], text, steps=steps, seed=world).images[0]
    errors = (np.square(image.astype(np.float64) - picture).mean() for image in (again, other))
    inverted, control = (psnr_of_mse(float(error)) for error in errors)
    return inverted, control


def inverts(
    editor: Any, prompts: Prompts, kept: Kept, steps: Sequence[int] = STEPS
) -> list[Rebuilt]:
    """Rebuild one picture of every world, with several numbers of steps.

    Args:
        editor: a :class:`attnwarp.editing.controlnet.DepthControlNet`.
        prompts: of test worlds.
        kept: results by world.
    """
    worlds = np.arange(len(prompts.worlds))
    result = []
    for count in steps:
        pairs = [
            kept.get(f"{count} {world}", partial(rebuild, editor, prompts, world, count))
            for world in worlds.tolist()
        ]
        own, control = np.asarray(pairs).T
        result.append(
            Rebuilt(
                count,
                figure("rebuilt", own, worlds),
                figure("other latents", control, worlds),
                int((own >= ASKED).sum()),
            )
        )
    return result


def inverts_section(rebuilt: Sequence[Rebuilt], *, size: int) -> str:
    """A card's section: a row a number of steps."""
    count = rebuilt[0].inverted.count
    lines = [
        "## A picture from its DDIM inversion", "",
        f"One picture of {size} x {size} px of each of {count} worlds, inverted and rebuilt with its own prompt and depth map, without guidance."
        " PSNR to the picture, the mean of the worlds' decibels with its 95 % interval over worlds. The control draws from other latents by the same prompt and depth map."
        f" Asked for: at least {ASKED:g} dB (`training/assess/inverts.py`).", "",
        f"| steps | rebuilt | control | at least {ASKED:g} dB |", "|---|---|---|---|",
    ]  # fmt: skip
    for row in rebuilt:
        own, other = (f"{f.value:.1f} ({f.low:.1f} to {f.high:.1f})" for f in (row.inverted, row.control))  # fmt: skip
        lines.append(f"| {row.steps} | **{own.replace(' (', '** (')} | {other} | {row.enough} of {count} |")  # fmt: skip
    return "\n".join(lines)
