"""Spread of an editor's answers to one open instruction over its noises."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.editing.editor import Image, edit
from attnwarp_eval.drawn.worlds import COLORS, GROUNDS, STATUES
from training.assess.card_sections import Kept
from training.assess.editors import SEED, draw_row
from training.assess.judge import nearest
from training.assess.pictures import Pictures
from training.worlds.editing_pairs import GROUPS, Worlds, ambiguous_instruction

NAMES = {"color": COLORS, "material": STATUES, "ground": GROUNDS}
"""Words of the kinds' answers. Three times of day beside a picture's own are too few to be judged."""

KINDS = ("color", "color", "material", "ground")
"""Kinds of the instructions, each put to another world."""

STEPS = 20
BATCH = 20
"""Noises at a time."""

LEAST_SHARE = 0.08
LEAST_ANSWERS = 4

LEAST_THING = 0.03
"""Least share of the picture: a smaller thing is not asked about."""

NONE = "none"


@dataclass(frozen=True, eq=False)
class Question:
    """An open instruction about a picture.

    Attributes:
        kind: of the edit.
        world: of the test split.
        text: the instruction.
        before: (S, S, 3).
        answers: the pictures that are right, by name.
        mask: (S, S) bool, where they differ.
    """

    kind: str
    world: int
    text: str
    before: Image
    answers: dict[str, Image]
    mask: npt.NDArray[np.bool_]

    def answer(self, image: Image) -> str:
        """The name of the right answer that is nearest, :data:`NONE` where the picture before is nearer."""
        found = nearest(image, [self.before, *self.answers.values()], self.mask)
        return NONE if found == 0 else list(self.answers)[found - 1]


def questions(worlds: Worlds, size: int, kinds: Sequence[str] = KINDS) -> list[Question]:
    """One question a kind, their worlds spread evenly over the split."""
    pairs = Pictures(worlds, size)
    result = []
    for number, kind in enumerate(kinds):
        start = number * len(worlds) // len(kinds)
        for world in range(start, len(worlds)):
            rng = np.random.default_rng([SEED, world, 99])
            row = draw_row(pairs, world, kind, rng)
            thing = pairs.mask(row)
            if thing.mean() >= LEAST_THING:
                break
        else:
            raise ValueError(f"worlds: got none from {start} on whose thing covers {LEAST_THING:.0%} of the picture")  # fmt: skip
        choices = [k for k in GROUPS[kind] if k != row.source and worlds.valid[world, k]]
        text = ambiguous_instruction(kind, int(worlds.things[world]), rng)
        names = {NAMES[kind][k - GROUPS[kind][0]]: pairs.shown(row, k) for k in choices}
        before = pairs.shown(row, row.source)
        mask = ~thing if kind == "ground" else thing
        result.append(Question(kind, world, text, before, names, mask))
    return result


def answered(
    editor: Any, question: Question, noises: int, kept: Kept, *, steps: int = STEPS
) -> Counter[str]:
    """Count how often each answer comes out, with :data:`NONE` among them.

    Args:
        noises: each of a seed of its own, from 0.
    """
    counts: Counter[str] = Counter()
    h, w = (side // editor.factor for side in question.before.shape[:2])
    shape = (editor.vae.config.latent_channels, h, w)

    def batch(seeds: range) -> list[str]:
        noise = torch.stack(
            [torch.randn(shape, generator=torch.Generator().manual_seed(s)) for s in seeds]
        )
        guides = [question.before] * len(seeds)
        images = edit(editor, guides, question.text, steps=steps, noise=noise).images
        return [question.answer(image) for image in images]

    for first in range(0, noises, BATCH):
        seeds = range(first, min(first + BATCH, noises))
        name = f"{question.kind} {question.world} {steps} {seeds.start}-{seeds.stop}"
        counts.update(kept.get(name, partial(batch, seeds)))
    return counts


def spread_section(
    asked: Sequence[Question], counts: Sequence[Counter[str]], *, size: int, steps: int = STEPS
) -> str:
    """A card's section: a row a question, the shares of its answers, and how many are frequent."""
    noises = {sum(count.values()) for count in counts}
    lines = [
        "## Which answers an open instruction gets", "",
        f"{' or '.join(str(n) for n in sorted(noises))} noises a picture of {size} x {size} px, {steps} steps. An answer is the true one whose mean colour is nearest (CIEDE2000);"
        f" none: the picture before is nearer. Asked for: at least {LEAST_ANSWERS} answers, each in at least {100 * LEAST_SHARE:.0f} %"
        " (`training/assess/spread.py`). The noise's mean draws the answer: over the whole picture, or over the mask where one is given. So"
        " pictures that share noise tend to share the answer, the more so the more their masks overlap.", "",
        f"| instruction (world) | answers | none | answers with at least {100 * LEAST_SHARE:.0f} % | at least {LEAST_ANSWERS} |",
        "|---|---|---|---|---|",
    ]  # fmt: skip
    for question, count in zip(asked, counts, strict=True):
        total = sum(count.values())
        shares = {name: count[name] / total for name in question.answers}
        ordered = sorted(shares, key=lambda name: -shares[name])
        frequent = sum(share >= LEAST_SHARE for share in shares.values())
        told = ", ".join(f"{name} {100 * shares[name]:.1f} %" for name in ordered)
        lines.append(
            f'| "{question.text}" ({question.world}) | {told} | {100 * count[NONE] / total:.1f} % | {frequent}'
            f" | {'yes' if frequent >= LEAST_ANSWERS else 'no'} |"
        )
    return "\n".join(lines)
