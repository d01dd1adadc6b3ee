"""Sentences about pictures of things with parts, and which pictures each is true of.

A caption names the thing, up to two of its parts with their surfaces, the ground and the time, or some of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS
from attnwarp_eval.drawn.worlds import (
    COLORS,
    FINISHES,
    GROUNDS,
    HOURS,
    PLACES,
    STATUES,
    TIMES,
    TWO_COLORED,
)
from training.worlds.assemblies import WHOLE_NOUNS
from training.worlds.draw import draw_look
from training.worlds.part_pictures import PARTS, PartPictures
from training.worlds.words import FILLERS, HUES, OPENINGS, one_of, surface_words

Surface = tuple[int, int, int]
"""Finish, color, second; -1 where nothing is said. A colour without a finish is true of plain and shiny ones."""

SAID = -1

WORN = ("jacket", "trousers", "skirt", "shoes", "hat", "shirt")
"""Parts that a thing is "in" rather than "with"."""

PLURAL = ("trousers", "pants", "jeans", "shoes", "boots", "clothes", "leaves", "flowers", "blossoms", "plates", "dishes", "mushrooms",
          "mushroom caps", "toadstools", "stems", "walls", "windows", "wheels", "tyres", "apples", "bananas", "lips", "eyes")  # fmt: skip
UNCOUNTED = ("hair", "foliage", "skin", "fur", "wood", "bark", "cloth", "fruit")

SOME_HUES = {
    "yellow hair": ("blond",),
    "yellow beard": ("blond",),
    "orange leaves": ("orange autumn",),
}
"""Words for a colour that only some parts have, beside the usual ones."""


@dataclass(frozen=True)
class Caption:
    """Content of a sentence.

    Attributes:
        kind: index into :data:`attnwarp_eval.drawn.assemblies.KINDS`, or -1.
        whole: surface that all parts have, or None.
        parts: (part's number, surface) of each part that is named.
        ground, time: or -1.
    """

    kind: int
    whole: Surface | None = None
    parts: tuple[tuple[int, Surface], ...] = ()
    ground: int = -1
    time: int = -1


def said(surface: Sequence[int], rng: np.random.Generator) -> Surface:
    """Choose what a caption says of a surface: plain is never said, shiny seldom."""
    finish, color, second = (int(v) for v in surface)
    kind = FINISHES[finish]
    if kind == "plain" or (kind == "shiny" and rng.uniform() < 0.5):
        finish = SAID
    return finish, color, second


def caption_of(
    pictures: PartPictures, row: int, shares: npt.NDArray[np.float64], rng: np.random.Generator
) -> Caption:
    """A caption that is true of a picture.

    Args:
        shares: (P,) share of what is shown that each part covers; parts below a hundredth are not named.
    """
    surfaces = pictures.surfaces[row]
    own = np.flatnonzero(surfaces[:, 0] >= 0)
    visible = own[shares[own] >= 0.01]
    kind = int(pictures.kind[row])
    ground = int(pictures.ground[row]) if rng.uniform() < 0.4 else -1
    time = int(pictures.time[row]) if rng.uniform() < 0.4 else -1
    alike = bool((surfaces[own] == surfaces[own[0]]).all())
    if alike and rng.uniform() < 0.7:
        return Caption(kind, said(surfaces[own[0]], rng), (), ground, time)
    if not len(visible) or rng.uniform() < 0.12:
        return Caption(kind, None, (), ground, time)
    weights = np.sqrt(shares[visible])
    count = min(len(visible), 1 if rng.uniform() < 0.6 else 2)
    chosen = rng.choice(visible, count, replace=False, p=weights / weights.sum())
    parts = tuple((int(p), said(surfaces[p], rng)) for p in chosen)
    if rng.uniform() < 0.35:
        kind = -1
    return Caption(kind, None, parts, ground, time)


def wrong(caption: Caption, rng: np.random.Generator) -> Caption:
    """The caption with one thing changed; of two parts, at times their surfaces are exchanged."""
    ways = ["kind"] if caption.kind >= 0 else []
    ways += (
        ["ground"] * (caption.ground >= 0)
        + ["time"] * (caption.time >= 0)
        + ["whole"] * 2 * (caption.whole is not None)
    )
    ways += ["part"] * 3 * bool(caption.parts) + ["swap"] * 2 * (len(caption.parts) == 2)
    while True:
        changed = _changed(caption, ways[int(rng.integers(len(ways)))], rng)
        if changed != caption:
            return changed


def _changed(caption: Caption, way: str, rng: np.random.Generator) -> Caption:
    other = draw_look(0, rng, pairs="any")
    surface = said((other.finish, other.color, other.second), rng)
    match way:
        case "kind":
            return replace(caption, kind=int(rng.integers(len(KINDS))))
        case "ground":
            return replace(caption, ground=other.ground)
        case "time":
            return replace(caption, time=other.time)
        case "whole":
            return replace(caption, whole=surface)
        case "swap":
            (p, first), (q, second) = caption.parts
            return replace(caption, parts=((p, second), (q, first)))
    k = int(rng.integers(len(caption.parts)))
    parts = list(caption.parts)
    if rng.uniform() < 0.2:
        parts[k] = (int(rng.integers(len(PARTS))), parts[k][1])
    else:
        parts[k] = (parts[k][0], surface)
    return replace(caption, parts=tuple(parts))


def matches(surface: Surface, shown: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """(...,) whether surfaces (..., 3) are what is said; colours of a pair have no order."""
    finish, color, second = surface
    same = (shown[..., 1] == color) & (shown[..., 2] == second)
    swapped = (shown[..., 1] == second) & (shown[..., 2] == color) & (second >= 0)
    if finish == SAID:
        one = np.isin(shown[..., 0], [FINISHES.index("plain"), FINISHES.index("shiny")])
        return one & (shown[..., 1] == color)
    return (shown[..., 0] == finish) & (same | swapped)


def true_of(
    captions: Sequence[Caption], pictures: PartPictures, rows: npt.NDArray[np.int64]
) -> npt.NDArray[np.bool_]:
    """(N pictures, M captions) whether each caption is true of each picture.

    A part that has several names ("shirt", "jacket") counts by what it is called.
    """
    result = np.ones((len(rows), len(captions)), dtype=bool)
    surfaces = pictures.surfaces[rows]
    own = surfaces[:, :, 0] >= 0
    for m, caption in enumerate(captions):
        if caption.kind >= 0:
            result[:, m] &= pictures.kind[rows] == caption.kind
        if caption.ground >= 0:
            result[:, m] &= pictures.ground[rows] == caption.ground
        if caption.time >= 0:
            result[:, m] &= pictures.time[rows] == caption.time
        if caption.whole is not None:
            result[:, m] &= (matches(caption.whole, surfaces) | ~own).all(axis=1)
        for part, surface in caption.parts:
            called = [
                q
                for q in range(len(PARTS))
                if set(PART_NOUNS[PARTS[q]]) & set(PART_NOUNS[PARTS[part]])
            ]
            result[:, m] &= (own[:, called] & matches(surface, surfaces[:, called])).any(axis=1)
    return result


def part_words(part: int, surface: Surface, rng: np.random.Generator) -> str:
    """A part and its surface, with an article where it takes one: "a red jacket", "brown hair"."""
    noun = one_of(PART_NOUNS[PARTS[part]], rng)
    return with_article(noun, surface_text(surface, rng, part=PARTS[part]))


def surface_text(surface: Surface, rng: np.random.Generator, *, part: str = "") -> str:
    """The adjective of a surface."""
    finish, color, second = surface
    if finish == SAID:
        more = SOME_HUES.get(f"{COLORS[color]} {part}", ())
        return one_of((*HUES[COLORS[color]], *more), rng)
    words, _ = surface_words(finish, color, second, rng)
    if FINISHES[finish] in TWO_COLORED and rng.uniform() < 0.25:
        return words.split()[-1]  # "checked", without its colours
    return words


def with_article(noun: str, adjective: str = "") -> str:
    """A noun with an adjective, and an article where it takes one."""
    words = f"{adjective} {noun}".strip()
    if noun in PLURAL or noun in UNCOUNTED:
        return words
    return f"{'an' if words[0] in 'aeiou' else 'a'} {words}"


def sentence(caption: Caption, rng: np.random.Generator, *, fillers: bool = False) -> str:
    """The caption in words.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> jacket = (PARTS.index("jacket"), (-1, COLORS.index("red"), -1))
        >>> sentence(Caption(KINDS.index("person"), None, (jacket,)), rng)
        'a rendering of a human figure in a crimson shirt'
    """
    tail = [one_of(PLACES[GROUNDS[caption.ground]], rng)] if caption.ground >= 0 else []
    if caption.time >= 0:
        tail.append(one_of(HOURS[TIMES[caption.time]], rng))
    named = [part_words(p, s, rng) for p, s in caption.parts]
    if caption.kind < 0:
        described = " and ".join(named)
    else:
        described = _whole(caption, rng, fillers)
        if named:
            worn = PARTS[caption.parts[0][0]] in WORN
            joined = " and ".join(named)
            if rng.uniform() < 0.15:
                described = (
                    f"{joined} of {described}"
                    if rng.uniform() < 0.5
                    else f"{joined} beside {described}"
                )
            else:
                described = (
                    f"{described} {'in' if worn and rng.uniform() < 0.7 else 'with'} {joined}"
                )
    return " ".join(" ".join([one_of(OPENINGS, rng), described, *tail]).split())


def _whole(caption: Caption, rng: np.random.Generator, fillers: bool) -> str:
    noun = one_of(WHOLE_NOUNS[KINDS[caption.kind]], rng)
    adjective = surface_text(caption.whole, rng) if caption.whole is not None else ""
    if (
        caption.whole is not None
        and caption.whole[0] >= 0
        and FINISHES[caption.whole[0]] in STATUES
        and rng.uniform() < 0.5
    ):
        return f"{with_article(one_of(('statue', 'sculpture'), rng), adjective)} of {with_article(noun)}"
    if fillers and rng.uniform() < 0.25:
        adjective = f"{one_of(FILLERS, rng)} {adjective}".strip()
    return with_article(noun, adjective)
