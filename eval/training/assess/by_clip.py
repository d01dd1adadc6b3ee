"""Finish, ground and time of day of edited pictures, judged by clip-small in place of the nearest mean colour.

Of the kind's answers the one has to be found that was asked for, by directional similarity: the change of the picture
against the change of the words. The same question, put about the true edited picture, says how far the judge can be
trusted. It never saw these worlds: they have shapes and seeds of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from attnwarp.encoders.base import TextImageEncoder
from attnwarp_eval.drawn.worlds import ATTRIBUTES, sentence
from training.assess.card_sections import Kept, percent, short_of
from training.assess.editors import SEED, draw_row
from training.assess.figures import Figure, figure
from training.assess.judge import Answer, nearest
from training.assess.pictures import Pictures
from training.editors.depth import attributes_of
from training.worlds.editing_pairs import GROUPS, Worlds, instruction

JUDGED = {"material": "finish", "ground": "ground", "time": "time of day"}
"""Kinds of edits, and the attribute's name in the card."""

PHRASES = 4
"""Sentences of each description, whose mean embedding stands for it."""

ASKED = 0.85


@dataclass(frozen=True)
class Judgement:
    """Figures of a kind of edit.

    Attributes:
        editor: share that clip-small finds in the editor's pictures.
        true: in the true edited pictures.
        color: share of the editor's pictures whose nearest mean colour is the right one.
    """

    editor: Figure
    true: Figure
    color: Figure


def description(
    attributes: npt.NDArray[np.int64], kind: str, encoder: TextImageEncoder
) -> npt.NDArray[np.float64]:
    """(D,) mean embedding of sentences that name the thing and what a kind of edit changes.

    Args:
        attributes: (6,) of the look.
        kind: a key of :data:`JUDGED`.
    """
    named = {"ground": ("ground",), "time": ("time",), "material": ("finish", "color", "second")}
    values = tuple(
        int(value) if name in ("object", *named[kind]) else -1
        for name, value in zip(ATTRIBUTES, attributes, strict=True)
    )
    texts = [sentence(values, np.random.default_rng(k)) for k in range(PHRASES)]
    rows = np.asarray(encoder.texts(texts), dtype=np.float64)
    mean: npt.NDArray[np.float64] = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).mean(0)
    return mean


def judgements(
    answer: Answer, worlds: Worlds, encoder: TextImageEncoder, kept: Kept, *, size: int, draws: int
) -> list[Judgement]:
    """Edit pictures of every world and put the question about each.

    Args:
        encoder: the judge.
        kept: answers of every kind and draw.
        draws: pictures and looks of each world; the first are those of :func:`training.assess.editors.assess`.
    """
    results = []
    for kind, name in JUDGED.items():
        rows = []
        for draw in range(draws):
            compute = partial(_drawn, answer, worlds, encoder, kind, draw, size)
            rows += kept.get(f"clip {kind} {len(worlds)} {draw}", compute)
        editor, true, color, choices = np.array(rows).T
        ids = np.tile(np.arange(len(worlds)), draws)
        chance = float((1 / choices).mean())
        results.append(
            Judgement(
                figure(name, editor, ids, chance=chance, asked=ASKED),
                figure(name, true, ids, chance=chance),
                figure(name, color, ids),
            )
        )
    return results


Found = tuple[bool, bool, bool, int]
"""Verdict on a picture, see :func:`_judged`."""


def _drawn(
    answer: Answer, worlds: Worlds, encoder: TextImageEncoder, kind: str, draw: int, size: int
) -> list[Found]:
    """One picture of every world."""
    return [
        _judged(answer, worlds, encoder, kind, world, draw, size) for world in range(len(worlds))
    ]


def _judged(
    answer: Answer, worlds: Worlds, encoder: TextImageEncoder, kind: str, world: int, draw: int, size: int
) -> Found:  # fmt: skip
    """Tell whether the judge finds the look in the editor's and in the true picture, whether its
    mean colour is right, and how many looks there were to choose from.
    """
    from attnwarp_eval.metrics import directional_similarity

    pairs = Pictures(worlds, size)
    further = [draw] if draw else []
    rng = np.random.default_rng([SEED, world, list(GROUPS).index(kind), *further])
    row = draw_row(pairs, world, kind, rng)
    before, after = (pairs.shown(row, k) for k in (row.source, row.target))
    text = instruction(kind, int(worlds.things[world]), worlds.looks[world, row.target], rng)
    image = answer(before, text, world + len(worlds) * draw)
    looks = [k for k in GROUPS[kind] if worlds.valid[world, k]]
    # Words that change nothing have no direction.
    choices = [k for k in looks if k != row.source]
    attributes = attributes_of(worlds, world)
    words = np.stack([description(attributes[k], kind, encoder) for k in choices])
    source = description(attributes[row.source], kind, encoder)
    pictures = [np.asarray(p, dtype=np.float32) for p in (before, image, after)]
    start, *ends = np.asarray(encoder.images(pictures))
    shape = (len(choices), len(start))

    def found(end: npt.NDArray[np.float32]) -> bool:
        """Return True if the words that were asked for are nearest; an unchanged picture has no
        nearest.
        """
        values = directional_similarity(
            np.broadcast_to(start, shape), np.broadcast_to(end, shape), source, words
        ).values
        return not np.isnan(values).any() and choices[int(np.argmax(values))] == row.target

    thing = pairs.mask(row)
    mask = thing if kind == "material" else ~thing
    color = looks[nearest(image, [pairs.shown(row, k) for k in looks], mask)] == row.target
    return found(ends[0]), found(ends[1]), color, len(choices)


def by_clip_section(results: Sequence[Judgement], *, worlds: int, draws: int) -> str:
    """A card's section with a row a kind."""
    lines = [
        "## Finish, ground and time of day by clip-small", "",
        f"{worlds} worlds, {draws} pictures each. `clip-small`, trained on none of these worlds or shapes, finds the answer by directional similarity."
        " Its own limit is its share on the true edited pictures. Beside it: the nearest mean colour of the same pictures"
        " (`training/assess/by_clip.py`).", "",
        "| attribute | editor | true pictures | nearest mean colour | chance | asked for | answers |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for r in results:
        lines.append(
            f"| {r.editor.what} | {percent(r.editor)} | {percent(r.true)} | {percent(r.color)} | {100 * (r.editor.chance or 0):.0f} %"
            f" | {100 * ASKED:.0f} % | {r.editor.count} |"
        )
    return "\n".join(lines + short_of([r.editor for r in results]))
