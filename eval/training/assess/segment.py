"""Overlap of masks by words with exact masks: python -m training.assess.segment, from the folder eval/."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from attnwarp.editing.segment import ClipSegmenter, Image, Mask, NoDetectionError, Segmenter
from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS, WHOLE_NOUNS
from attnwarp_eval.drawn.worlds import NOUNS, OBJECTS, one_of
from training.assess.figures import Figure, figure
from training.editors.__main__ import CACHE
from training.encoders.clip_parts import CLUTTER
from training.worlds.editing_pairs import THING, Worlds, load_pairs
from training.worlds.part_pictures import PARTS, PartPictures, load

SCENES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("bear", "bear", ("bear",)),
    ("dinosaur", "dinosaur", ("dinosaur", "plates")),
    ("dinosaur", "plates", ("plates",)),
    ("face", "bust of a man", ("skin", "hair", "jacket")),
    ("face", "hair", ("hair",)),
    ("garden", "table", ("table",)),
    ("garden", "pot", ("pot",)),
    ("garden", "plant", ("plant", "blossom")),
    ("person", "person", ("skin", "hair", "jacket", "trousers", "shoes")),
    ("person", "jacket", ("jacket",)),
    ("person", "trousers", ("trousers",)),
    ("stump", "tree stump", ("stump", "cut")),
    ("stump", "mushrooms", ("mushrooms",)),
)
"""Scene, words, and the objects whose pixels they name: what the scenes' edits speak of."""

LEAST_PART = 0.02
"""Share of a picture that a part covers where it is asked for."""

SCENE_SIZE = 256
SCENE_SAMPLES = 32
REPORT = Path(__file__).parents[3] / "reports" / "editor" / "segments.md"


def overlap(mask: Mask, truth: Mask) -> float:
    """Intersection over union.

    Example:
        >>> overlap(np.array([[True, True, False]]), np.array([[False, True, True]]))
        0.3333333333333333
    """
    return float((mask & truth).sum() / (mask | truth).sum())


def pictures(worlds: Worlds) -> Iterator[tuple[Image, Mask, str, str]]:
    """Yield of each world a picture in a random look, the exact mask of its thing, the word for it,
    and the word for a thing that is absent.
    """
    for world in range(len(worlds)):
        rng = np.random.default_rng([5, world])
        view, look = int(rng.integers(2)), int(rng.choice(np.flatnonzero(worlds.valid[world])))
        thing = int(worlds.things[world])
        other = int(rng.choice([k for k in range(len(OBJECTS)) if k != thing]))
        image = worlds.images[world, view, look].astype(np.float32) / 255
        words = (NOUNS[OBJECTS[k]][0] for k in (thing, other))
        yield image, worlds.ids[world, view] == THING, *words


def part_pictures(pictures: PartPictures) -> Iterator[tuple[Image, Mask, str, str]]:
    """Yield of each world a picture, the exact mask of one of its parts or of all, the words, and a
    part that no such thing has.
    """
    for row in np.flatnonzero(pictures.look == 0):
        world = int(pictures.world[row])
        if int(pictures.view[row]) != world % 2:
            continue
        rng = np.random.default_rng([6, world])
        ids = pictures.ids[pictures.place[row]]
        parts = np.flatnonzero(pictures.shares[pictures.place[row]] >= LEAST_PART)
        own = pictures.surfaces[row, :, 0] >= 0
        if rng.uniform() < 0.3 or not len(parts):
            words, mask = one_of(WHOLE_NOUNS[KINDS[int(pictures.kind[row])]], rng), ids < len(PARTS)
        else:
            part = PARTS[int(rng.choice(parts))]
            words = one_of(PART_NOUNS[part], rng)
            called = [p for p in np.flatnonzero(own) if words in PART_NOUNS[PARTS[p]]]
            mask = np.isin(ids, called)
        names = {n for p in np.flatnonzero(own) for n in PART_NOUNS[PARTS[p]]}
        names |= set(WHOLE_NOUNS[KINDS[int(pictures.kind[row])]])
        absent = [
            p
            for p in PARTS
            if not names & set(PART_NOUNS[p]) and not set(CLUTTER) & set(PART_NOUNS[p])
        ]
        other = one_of(PART_NOUNS[absent[int(rng.integers(len(absent)))]], rng)
        yield pictures.images[row].astype(np.float32) / 255, mask, words, other


def assess(segmenter: Segmenter, asked: Iterable[tuple[Image, Mask, str, str]]) -> list[Figure]:
    """Overlap, a picture without a detection counting 0, and shares of detections."""
    overlaps, detections, mistakes, everything = [], [], [], []
    for image, truth, word, other in asked:
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
        figure("share where it is detected", detections, groups),
        figure("share where something that is not there is detected", mistakes, groups),
    ]


def scene_overlaps(segmenter: Segmenter) -> list[tuple[str, str, float | None, float]]:
    """Row for each scene's source view: name, words, overlap (None without a detection), the mask's
    share of the picture.
    """
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.world import World

    rows = []
    worlds = {name: World(load_scene(name), SCENE_SIZE) for name, _, _ in SCENES}
    for name, words, objects in SCENES:
        world = worlds[name]
        names = world.scene.object_names
        hits = world.geometry.trace(world.source)
        truth = np.isin(hits.object_id, [names.index(each) for each in objects])
        mask = _mask(segmenter, world.image(world.source.name, SCENE_SAMPLES), words)
        rows.append(
            (name, words, None if mask is None else overlap(mask, truth), float(truth.mean()))
        )
    return rows


def _mask(segmenter: Segmenter, image: Image, words: str) -> Mask | None:
    try:
        return segmenter.segment(image, words)
    except NoDetectionError:
        return None


def report(
    figures: dict[str, list[Figure]], scenes: Sequence[tuple[str, str, float | None, float]]
) -> str:
    """Report in Markdown."""
    lines = [
        "# Masks by words: overlap with exact masks", "",
        "`ClipSegmenter` with clip-parts. Made by `python -m training.assess.segment`, from the folder eval/.",
        "Its constants were chosen on training worlds that are not among those below, nor among those that clip-parts learned from.",
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
    by_scene = {s: [v or 0.0 for n, _, v, _ in scenes if n == s] for s, *_ in scenes}
    mean = float(np.mean([np.mean(values) for values in by_scene.values()]))
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
    """Assess clip-parts' masks on held-out worlds and on scenes."""
    segmenter = ClipSegmenter.bundled()
    asked = {
        "Held-out things of one piece": pictures(load_pairs(data, "edit-test", count=worlds)),
        "Held-out things with parts: a part, or the whole in three of ten": part_pictures(
            load(data, "parts-test")
        ),
    }
    figures = {title: assess(segmenter, each) for title, each in asked.items()}
    text = report(figures, scene_overlaps(segmenter))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    typer.echo(text)


if __name__ == "__main__":
    typer.run(main)
