"""Figures of an encoder about parts: surfaces by name, edits by direction, on held-out worlds."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from attnwarp.encoders.base import TextImageEncoder
from attnwarp_eval.drawn.assemblies import KINDS
from training.assess.figures import Figure, as_float, figure, unit
from training.encoders.clip_parts import surface_choices, surface_number
from training.worlds.assemblies import WHOLE_NOUNS
from training.worlds.draw import draw_look
from training.worlds.part_captions import (
    Caption,
    Surface,
    part_words,
    said,
    sentence,
    true_of,
    with_article,
)
from training.worlds.part_pictures import PARTS, PartPictures

Array = npt.NDArray[np.float64]

LEAST_SHARE = 0.02
"""Least share of a picture that a part covers where it is asked about."""


def part_figures(encoder: TextImageEncoder, pictures: PartPictures) -> list[Figure]:
    """Naming of wholes and of parts' surfaces, and the direction of an edit of a part."""
    embedded = unit(encoder.images(as_float(pictures.images)))
    return [
        _wholes(encoder, embedded, pictures),
        _surfaces(encoder, embedded, pictures),
        _directions(encoder, embedded, pictures),
    ]


def _wholes(encoder: TextImageEncoder, images: Array, pictures: PartPictures) -> Figure:
    words = np.stack([
        unit(encoder.texts([f"a photo of {with_article(n)}" for n in WHOLE_NOUNS[k]])).mean(axis=0) for k in KINDS
    ])  # fmt: skip
    guess = (images @ unit(words).T).argmax(axis=1)
    return figure(
        "name the thing with parts, new shapes",
        guess == pictures.kind,
        pictures.world,
        chance=1 / len(KINDS),
    )


def _surfaces(encoder: TextImageEncoder, images: Array, pictures: PartPictures) -> Figure:
    """Choice of a part's surface among 17 colours and materials, by the picture as a whole."""
    choices = surface_choices()
    numbers = surface_number(pictures.surfaces)
    right, worlds = [], []
    words = {
        p: unit(encoder.texts([f"a photo of {part_words(p, s, np.random.default_rng(4))}" for s in choices]))
        for p in range(len(PARTS))
    }  # fmt: skip
    for row in range(len(pictures)):
        shares = pictures.shares[pictures.place[row]]
        for p in np.flatnonzero((shares >= LEAST_SHARE) & (numbers[row] >= 0)):
            guess = int((words[int(p)] @ images[row]).argmax())
            right.append(guess == numbers[row, p])
            worlds.append(int(pictures.world[row]))
    return figure(
        "name a part's colour or material, new shapes", right, worlds, chance=1 / len(choices)
    )


def _directions(encoder: TextImageEncoder, images: Array, pictures: PartPictures) -> Figure:
    """Choice of the edit that was made among 8 of parts of one picture, by directional similarity.

    The seven others give a surface to a part of it too: the same part or another that is seen.
    """
    rng = np.random.default_rng(6)
    right, worlds = [], []
    for before in np.flatnonzero(pictures.look == 0):
        shares = pictures.shares[pictures.place[before]]
        for look in (1, 2):
            after = before + look
            old, new = pictures.surfaces[before], pictures.surfaces[after]
            (p,) = np.flatnonzero((old != new).any(axis=1))
            if (
                shares[p] < LEAST_SHARE
                or not (pictures.images[before] != pictures.images[after]).any()
            ):
                continue
            kind = int(pictures.kind[before])
            seen = np.flatnonzero(shares >= LEAST_SHARE)
            edits: list[tuple[int, Surface]] = [(int(p), said(new[p], rng))]
            while len(edits) < 8:
                other = draw_look(0, rng, pairs="any")
                q = int(p) if rng.uniform() < 0.5 else int(rng.choice(seen))
                edit = (q, said((other.finish, other.color, other.second), rng))
                false = not true_of(
                    [Caption(kind, None, (edit,))], pictures, np.array([before, after])
                ).any()
                if false and edit not in edits:
                    edits.append(edit)
            seed = int(rng.integers(2**31))
            pairs = [
                [
                    sentence(Caption(kind, None, ((q, s),)), np.random.default_rng(seed))
                    for s in (said(old[q], rng), surface)
                ]
                for q, surface in edits
            ]
            texts = unit(encoder.texts([t for pair in pairs for t in pair])).reshape(
                len(edits), 2, -1
            )
            likeness = unit(texts[:, 1] - texts[:, 0]) @ unit(images[after] - images[before])
            right.append(bool(likeness[0] > likeness[1:].max()))  # a tie is no find
            worlds.append(int(pictures.world[before]))
    return figure(
        "the edit of a part among 8, by directional similarity", right, worlds, chance=1 / 8
    )
