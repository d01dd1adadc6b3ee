"""Overlap of masks by words with exact masks: python -m training.segment_assess, from the folder eval/."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from attnwarp.editing.segment import ClipSegmenter, Image, Mask, NoDetectionError
from training.assess import Figure, figure
from training.edit import CACHE
from training.editing_pairs import THING, Worlds, load_pairs
from training.worlds import NOUNS, OBJECTS

SCENES: dict[str, tuple[str, tuple[str, ...]]] = {
    "bear": ("bear", ("bear",)),
    "dinosaur": ("dinosaur", ("dinosaur", "plates")),
    "person": ("person", ("skin", "hair", "jacket", "trousers", "shoes")),
    "stump": ("tree stump", ("stump", "cut")),
}
"""Scene -> the words and the objects whose pixels they name."""

SCENE_SIZE = 256
SCENE_SAMPLES = 32
REPORT = Path(__file__).parents[2] / "reports" / "editor" / "segments.md"


def overlap(mask: Mask, truth: Mask) -> float:
    """Intersection over union.

    Example:
        >>> overlap(np.array([[True, True, False]]), np.array([[False, True, True]]))
        0.3333333333333333
    """
    return float((mask & truth).sum() / (mask | truth).sum())


def pictures(worlds: Worlds) -> Iterator[tuple[Image, Mask, str, str]]:
    """Of each world a picture in a random look, the exact mask of its thing, the word for it, and the word for a thing that is absent."""
    for world in range(len(worlds)):
        rng = np.random.default_rng([5, world])
        view, look = int(rng.integers(2)), int(rng.choice(np.flatnonzero(worlds.valid[world])))
        thing = int(worlds.things[world])
        other = int(rng.choice([k for k in range(len(OBJECTS)) if k != thing]))
        image = worlds.images[world, view, look].astype(np.float32) / 255
        words = (NOUNS[OBJECTS[k]][0] for k in (thing, other))
        yield image, worlds.ids[world, view] == THING, *words


def assess(segmenter: ClipSegmenter, worlds: Worlds) -> list[Figure]:
    """Overlap, a picture without a detection counting 0, and shares of detections."""
    overlaps, detections, mistakes, everything = [], [], [], []
    for image, truth, word, other in pictures(worlds):
        mask = _mask(segmenter, image, word)
        detections.append(mask is not None)
        overlaps.append(0.0 if mask is None else overlap(mask, truth))
        mistakes.append(_mask(segmenter, image, other) is not None)
        everything.append(overlap(np.ones_like(truth), truth))
    groups = np.arange(len(overlaps))
    return [
        figure("intersection over union with the exact mask", overlaps, groups),
        figure("the same of a mask of the whole picture, as control", everything, groups),
        figure("share of pictures with overlap of at least 0.5", np.array(overlaps) >= 0.5, groups),
        figure("share where the thing is detected", detections, groups),
        figure("share where a thing that is not there is detected", mistakes, groups),
    ]


def scene_overlaps(segmenter: ClipSegmenter) -> list[tuple[str, str, float | None, float]]:
    """Of each scene's source view: name, words, overlap (None without a detection), the mask's share of the picture."""
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.world import World

    rows = []
    for name, (words, objects) in SCENES.items():
        world = World(load_scene(name), SCENE_SIZE)
        names = world.scene.object_names
        hits = world.geometry.trace(world.source)
        truth = np.isin(hits.object_id, [names.index(each) for each in objects])
        mask = _mask(segmenter, world.image(world.source.name, SCENE_SAMPLES), words)
        rows.append(
            (name, words, None if mask is None else overlap(mask, truth), float(truth.mean()))
        )
    return rows


def _mask(segmenter: ClipSegmenter, image: Image, words: str) -> Mask | None:
    try:
        return segmenter.segment(image, words)
    except NoDetectionError:
        return None


def report(
    figures: dict[str, list[Figure]], scenes: Sequence[tuple[str, str, float | None, float]]
) -> str:
    """In Markdown."""
    lines = [
        "# Masks by words: overlap with exact masks", "",
        "`ClipSegmenter` with clip-small. Made by `python -m training.segment_assess`, from the folder eval/.",
        "Its constants were chosen on 25 of the training worlds, which are not among those below.",
        "Brackets hold 95 % intervals, bootstrapped over worlds.",
    ]  # fmt: skip
    for title, rows in figures.items():
        lines += ["", f"## {title}", "", "| figure | value | pictures |", "|---|---|---|"]
        lines += [
            f"| {f.what} | {f.value:.2f} ({f.low:.2f} to {f.high:.2f}) | {f.count} |" for f in rows
        ]
    lines += [
        "", "## Source views of bundled scenes", "",
        f"{SCENE_SIZE} x {SCENE_SIZE} px, {SCENE_SAMPLES} samples a pixel. No constant was chosen on them.", "",
        "| scene | words | intersection over union | share of the picture |", "|---|---|---|---|",
    ]  # fmt: skip
    for name, words, value, share in scenes:
        result = "no detection" if value is None else f"{value:.2f}"
        lines.append(f"| {name} | {words} | {result} | {share:.2f} |")
    mean = float(np.mean([value or 0.0 for _, _, value, _ in scenes]))
    lines += ["", f"Mean over scenes, no detection counting 0: {mean:.2f}."]
    weak = [title for title, rows in figures.items() if rows[0].value < 0.4]
    weak += ["source views of bundled scenes"] if mean < 0.4 else []
    if weak:
        lines += ["", f"**Poor**: a mean below 0.4 on {', '.join(weak)}."]
    return "\n".join([*lines, ""])


def main(
    data: Annotated[Path, typer.Option(help="Folder of the pictures.")] = CACHE / "data",
    out: Annotated[Path, typer.Option(help="Markdown file.")] = REPORT,
    worlds: Annotated[int, typer.Option(min=2, help="First worlds of the test split.")] = 20,
) -> None:
    """Assess clip-small's masks on held-out worlds and on scenes."""
    segmenter = ClipSegmenter.bundled()
    tests = load_pairs(data, "edit-test", count=worlds)
    text = report({"Held-out worlds": assess(segmenter, tests)}, scene_overlaps(segmenter))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    typer.echo(text)


if __name__ == "__main__":
    typer.run(main)
