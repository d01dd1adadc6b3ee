"""A sheet of what a bundled editor does: eight worlds that it has never seen, six instructions or descriptions each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import PIL.Image
from PIL import ImageDraw

from attnwarp.editing.editor import Image
from attnwarp_eval.drawn.worlds import NOUNS, OBJECTS
from training.assess.judge import Answer
from training.assess.pictures import Pictures, Row
from training.editors.depth import Prompts
from training.worlds.editing_pairs import GROUPS, SIZE, Worlds

INSTRUCTIONS = (
    "make it red",
    "paint it blue",
    "turn it into gold",
    "make it out of wood",
    "put it in the snow",
    "show it at sunset",
)

DESCRIPTIONS = (
    "a red {} on grass",
    "a blue {} on sand",
    "a golden {} on tiles",
    "a wooden {} in the snow",
    "a white {} at night",
    "a green {} at sunset",
)

DepthAnswer = Callable[[Prompts, Row, str, int], Image]
"""The picture of a row's depth map, a description and a seed."""

ROWS = 8
SCALE = 2
"""Pixels of the sheet to one of a picture."""


def sheet(
    answer: Answer, worlds: Worlds, *, size: int, instructions: Sequence[str] = INSTRUCTIONS
) -> PIL.Image.Image:
    """A picture with a row a world: before, then the answer to each instruction.

    Args:
        worlds: of a test split; spread evenly over it.
        instructions: one a column.
    """
    pairs = Pictures(worlds, size)
    rows = []
    for row in _spread(pairs):
        before = pairs.shown(row, row.source)
        rows.append([before, *(answer(before, text, row.world) for text in instructions)])
    return _arranged(rows, ["before", *instructions])


def depth_sheet(
    draw: DepthAnswer, worlds: Worlds, *, size: int, descriptions: Sequence[str] = DESCRIPTIONS
) -> PIL.Image.Image:
    """A picture with a row a world: its depth map, nearer is brighter, then what each description gives.

    Args:
        draw: the editor: the picture of a row of prompts, a description and a seed.
        worlds: of a test split; spread evenly over it.
        descriptions: one a column; braces stand for the thing.
    """
    prompts = Prompts(worlds, size)
    rows = []
    for row in _spread(prompts):
        noun = NOUNS[OBJECTS[int(worlds.things[row.world])]][0]
        drawn = [draw(prompts, row, d.format(noun), row.world) for d in descriptions]
        rows.append([prompts.control(row), *drawn])
    return _arranged(rows, ["depth", *(d.format("...") for d in descriptions)])


def _spread(pairs: Pictures) -> Iterator[Row]:
    """Pictures of :data:`ROWS` worlds, spread evenly over a split, each in its first colour."""
    worlds, size = pairs.worlds, pairs.size
    for world in np.linspace(0, len(worlds) - 1, ROWS).astype(int).tolist():
        rng = np.random.default_rng([world, 6])
        color = next(k for k in GROUPS["color"] if worlds.valid[world, k])
        corner = pairs.corner(world, 0, rng) if size < SIZE else (0, 0, 1)
        yield Row(world, 0, color, color, corner)


def _arranged(rows: Sequence[Sequence[Image]], titles: Sequence[str]) -> PIL.Image.Image:
    side, head = rows[0][0].shape[0] * SCALE, 14
    picture = PIL.Image.new("RGB", (side * len(titles), head + side * len(rows)), "white")
    draw = ImageDraw.Draw(picture)
    for column, title in enumerate(titles):
        draw.text((column * side + 3, 1), title, fill="black")
    for y, row in enumerate(rows):
        for x, image in enumerate(row):
            tile = PIL.Image.fromarray(np.rint(255 * image).astype(np.uint8))
            tile = tile.resize((side, side), PIL.Image.Resampling.NEAREST)
            picture.paste(tile, (x * side, head + y * side))
    return picture


def write_sheet(picture: PIL.Image.Image, path: Path) -> Path:
    """Write a sheet as PNG; its folder is made if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path, optimize=True)
    return path
