"""Test of whether another guidance would edit better, on worlds that are neither trained nor
reported on.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np

from training.assess.card_sections import Kept, percent
from training.assess.editors import answers_of, assess
from training.assess.figures import Figure
from training.worlds.editing_pairs import THING, Worlds

GUIDANCES = ((1.5, 1.0), (2.5, 1.0), (4.0, 1.0), (1.5, 1.5), (2.5, 1.5))
"""Weights of text and picture."""

KINDS = ("color", "material")

LEAST_PIXELS = 250
"""Least pixels of the thing in each view of 128 x 128 px; worlds that show less of it are left
out.
"""


def shown(worlds: Worlds) -> Worlds:
    """Those of the worlds whose thing every view shows."""
    pixels = (worlds.ids == THING).sum(axis=(2, 3)).min(axis=1)
    kept = np.flatnonzero(pixels >= LEAST_PIXELS)
    return replace(worlds, **{f.name: getattr(worlds, f.name)[kept] for f in fields(worlds)})


def figures_of(editor: Any, worlds: Worlds, kept: Kept, *, size: int) -> list[list[Figure]]:
    """Figures of an editor at each of :data:`GUIDANCES`.

    Args:
        worlds: see :func:`shown`.
        kept: figures that were computed before.
    """
    rows = []
    for text, picture in GUIDANCES:

        def compute(text: float = text, picture: float = picture) -> list[dict[str, Any]]:
            other = copy.copy(editor)
            other.text_guidance, other.image_guidance = text, picture
            found = assess(answers_of(other), worlds, size=size, noises=0, kinds=KINDS)
            return [asdict(figure) for figure in found]

        rows.append(
            [Figure(**f) for f in kept.get(f"guidance {text:g} {picture:g} {len(worlds)}", compute)]
        )
    return rows


def guidance_report(results: Mapping[str, Sequence[Sequence[Figure]]], *, worlds: int) -> str:
    """The report in Markdown, of several editors' :func:`figures_of` by name."""
    lines = [
        "# Would another guidance make the bundled editors better?", "",
        f"{worlds} worlds with new shapes and all colours, on which nothing is reported elsewhere (`training/assess/guidance.py`). One edit each of the colour and"
        " of the material, 64 px, 20 steps, one noise. 95 % intervals are bootstrapped over worlds. The editors' own guidance is the first row of each.",
        "",
        "| editor | text, picture | right colour | right material | at least 26 dB outside the thing |",
        "|---|---|---|---|---|",
    ]  # fmt: skip
    for name, rows in results.items():
        for (text, picture), row in zip(GUIDANCES, rows, strict=True):
            cells = " | ".join(map(percent, row))
            lines.append(f"| `{name}` | {text:g}, {picture:g} | {cells} |")
    return "\n".join([*lines, ""])
