"""Test of whether an editor's attention carries the answer, and where: swapped features on worlds
that it has never seen.

Run A of an open instruction answers one colour, run B of the same picture from other noise another. A's features go
into B, and the figures say whose colour B then has: everywhere, in a half, from another picture, along a true warp.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.editing.editor import Image, edit
from attnwarp.editing.injection import Identity, Weight
from attnwarp.editing.recording import Recording, RecordingPlan, record
from attnwarp.methods.algorithms.attention_warping import CORRECTED, a_t, inject
from attnwarp.warp import resize_mask
from training.assess.card_sections import Kept, asked_for, percent, short_of
from training.assess.editors import SEED
from training.assess.figures import Figure, figure
from training.assess.judge import nearest
from training.assess.pictures import Pictures, Row
from training.worlds.editing_pairs import GROUPS, SIZE, VIEWS, Worlds
from training.worlds.view_warps import view_warp

INSTRUCTION = "change its color"
"""One sentence for all pictures of a batch; which colour comes out is the noise's choice."""

STEPS = 20
BATCH = 16

PAIRS = 200
MOST_ROUNDS = 20
"""Largest number of rounds of pictures; an editor that seldom answers two colours would never come
to an end.
"""

LEAST_SHARE = 0.03
"""Least share of the picture: a smaller thing in it, or in a half, is not judged."""

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Case:
    """A picture with its true answers.

    Attributes:
        world, view: world and view of the test split.
        before: (S, S, 3).
        answers: the colours that it may get, the picture before first.
        thing: (S, S) bool.
    """

    world: int
    view: int
    before: Image
    answers: list[Image]
    thing: Mask

    def answer(self, image: Image, where: Mask | None = None) -> int:
        """Index of the answer that a picture is nearest to in the thing, or in a part of it."""
        return nearest(image, self.answers, self.thing if where is None else self.thing & where)


def cases_of(worlds: Worlds, size: int, number: int = 0) -> list[Case]:
    """Both whole views of every world whose thing is large enough."""
    pairs = Pictures(worlds, size)
    further = [number] if number else []
    cases = []
    for world in range(len(worlds)):
        rng = np.random.default_rng([SEED, world, 5, *further])
        colors = [k for k in GROUPS["color"] if worlds.valid[world, k]]
        source = int(rng.choice(colors))
        for view in range(VIEWS):
            row = Row(world, view, source, source, (0, 0, SIZE // size))
            thing = pairs.mask(row)
            if thing.mean() < LEAST_SHARE:
                continue
            images = [pairs.shown(row, k) for k in [source, *(k for k in colors if k != source)]]
            cases.append(Case(world, view, images[0], images, thing))
    return cases


class Swap:
    """Runs of an editor on batches of pictures, recorded and injected."""

    def __init__(self, editor: Any) -> None:
        self.editor = editor

    def noise(self, seeds: Sequence[int], before: Image) -> Tensor:
        """(B, C, h, w) white noise, one seed a picture."""
        shape = self.editor.noise_shape(before.shape[:2])
        return torch.stack(
            [torch.randn(shape, generator=torch.Generator().manual_seed(s)) for s in seeds]
        )

    def run(self, cases: Sequence[Case], noise: Tensor) -> list[Image]:
        """The edited pictures, whose answers the noise draws over their things, as in a scene."""
        guides, things = [case.before for case in cases], [case.thing for case in cases]
        return edit(
            self.editor, guides, INSTRUCTION, steps=STEPS, noise=noise, regions=things
        ).images

    def recorded(self, cases: Sequence[Case], noise: Tensor) -> tuple[list[Image], Recording]:
        """The edited pictures and their features."""
        keep = tuple(b for b in self.editor.branches if b in self.editor.carries)
        size = (noise.shape[2], noise.shape[3])
        plan = RecordingPlan(self.editor.layers(), size, keep, STEPS, len(cases))
        with record(self.editor, plan) as recording:
            images = self.run(cases, noise)
        return images, recording

    def injected(
        self, recording: Recording, cases: Sequence[Case], noise: Tensor, *,
        warp: Any = None, weight: Weight = a_t,
    ) -> list[Image]:  # fmt: skip
        """The edited pictures with features of a recording, along one warp, as a scene's edit injects them."""
        with inject(self.editor, recording, warps=[warp] * len(cases), weight=weight):
            return self.run(cases, noise)


HELD = replace(CORRECTED, decay="constant")
"""Settings of a weight that does not fall."""

QUESTIONS: dict[str, tuple[str, dict[str, float]]] = {
    "same": ("features of the same picture make it their colour", {"asked": 0.8}),
    "held": (f"... with a constant weight of {HELD.a0:g}", {}),
    "follows": ("injected in the left half, that half follows", {"asked": 0.75}),
    "keeps": ("... and the other half keeps its own", {"asked": 0.75}),
    "other": ("features of another picture make it their colour", {"at_most": 0.15}),
}

Marks = dict[str, list[tuple[bool, int]]]
"""Marks of answers: right or not, and the world, by a key of :data:`QUESTIONS`."""


def swap_figures(
    editor: Any, worlds: Worlds, *, size: int, pairs: int = PAIRS, kept: Kept | None = None
) -> list[Figure]:
    """Figures of features swapped within a picture, from another picture, and in a half.

    Rounds of other pictures and noises go on until every question has as many answers as were asked for.

    Args:
        worlds: worlds of the test split.
        pairs: answers asked of every question; after :data:`MOST_ROUNDS` rounds it is as many as were had.
        kept: results of batches, so that a stopped measurement goes on.
    """
    swap = Swap(editor)
    marks: Marks = {key: [] for key in QUESTIONS}
    number = 0
    while number < MOST_ROUNDS and min(len(values) for values in marks.values()) < pairs:
        cases = cases_of(worlds, size, number)
        for first in range(0, len(cases), BATCH):
            batch = cases[first : first + BATCH]
            compute = partial(_swapped, swap, batch, 1000 * first, number)
            name = f"swap over things {len(worlds)} {number} {first}"
            found = compute() if kept is None else kept.get(name, compute)
            for key, values in found.items():
                marks[key] += values
        number += 1
    return [
        figure(what, [r for r, _ in marks[key]], [w for _, w in marks[key]], **asked)
        for key, (what, asked) in QUESTIONS.items()
        if marks[key]
    ]


def _swapped(swap: Swap, batch: Sequence[Case], seed: int, number: int) -> Marks:
    """The answers of a batch of pictures.

    Args:
        batch: the pictures, those of a world one after the other.
        seed: seed of the first picture's noise.
        number: number of the round: it chooses the noises, and whose features another picture gets.
    """
    marks: Marks = {key: [] for key in QUESTIONS}
    first = batch[0].before
    size = len(first)
    left = np.zeros((size, size), dtype=bool)
    left[:, : size // 2] = True
    seeds = [seed + 1000 * k + 2 * number for k in range(len(batch))]
    noise_a = swap.noise(seeds, first)
    noise_b = swap.noise([s + 1 for s in seeds], first)
    run_a, recording = swap.recorded(batch, noise_a)
    run_b = swap.run(batch, noise_b)
    # Two pictures on, since the next one is often the same world's other view; further in later rounds.
    shift = 1 + (number + 1) % max(1, len(batch) - 1)
    order = [(k + shift) % len(batch) for k in range(len(batch))]
    strange = swap.injected(recording, [batch[k] for k in order], noise_b[order])
    whole = swap.injected(recording, batch, noise_b)
    constantly = swap.injected(recording, batch, noise_b, weight=partial(a_t, s=HELD))
    half = swap.injected(recording, batch, noise_b, warp=Within(left))
    for k, case in enumerate(batch):
        a, b = case.answer(run_a[k]), case.answer(run_b[k])
        if 0 in (a, b) or a == b:
            continue
        marks["same"].append((case.answer(whole[k]) == a, case.world))
        marks["held"].append((case.answer(constantly[k]) == a, case.world))
        both = (case.thing & left).mean(), (case.thing & ~left).mean()
        if min(both) >= LEAST_SHARE and case.answer(run_a[k], left) == a:
            marks["follows"].append((case.answer(half[k], left) == a, case.world))
            marks["keeps"].append((case.answer(half[k], ~left) == b, case.world))
    for giving, (k, image) in enumerate(zip(order, strange, strict=True)):
        # The colour that the other picture's run answered, as this picture has it.
        giver, case = batch[giving], batch[k]
        a, b = giver.answer(run_a[giving]), case.answer(run_b[k])
        if giver.world == case.world or 0 in (a, b):
            continue
        wanted = _same_color(giver.answers[a], giver.thing, case)
        if wanted not in (0, b):
            marks["other"].append((case.answer(image) == wanted, case.world))
    return marks


def _same_color(image: Image, mask: Mask, case: Case) -> int:
    """The case's answer whose colour is nearest to another picture's."""
    from skimage.color import deltaE_ciede2000

    from training.assess.judge import mean_lab

    own = mean_lab(image, mask)
    return int(np.argmin([deltaE_ciede2000(own, mean_lab(a, case.thing)) for a in case.answers]))


class Within(Identity):
    """The identity, with features inside a mask alone.

    Args:
        mask: (H, W).
    """

    def __init__(self, mask: Mask) -> None:
        self.mask = torch.from_numpy(mask)

    def at(self, size: tuple[int, int], *, source_size: tuple[int, int] | None = None) -> Within:
        """The identity of a grid, with the mask resized to it."""
        super().at(size, source_size=source_size)
        self.weight = resize_mask(self.mask, size).reshape(-1, 1).float()
        return self


class Displaced:
    """A warp that reads an eighth of the picture beside the place it should.

    Args:
        warp: the true one, as :func:`attnwarp.warp.warp_surfaces` gives it.
    """

    def __init__(self, warp: Any) -> None:
        self.warp = warp

    def at(self, size: tuple[int, int], *, source_size: tuple[int, int] | None = None) -> Any:
        """The displaced warp of a grid; features of the row are turned around its end."""
        return _Rolled(self.warp.at(size, source_size=source_size), size)


class _Rolled:
    def __init__(self, warp: Any, size: tuple[int, int]) -> None:
        self.warp, self.size, self.weight = warp, size, warp.weight

    def warp_tokens(self, source: Tensor) -> Tensor:
        h, w = self.size
        grid = source.view(len(source), h, w, -1).roll(w // 8, dims=2)
        return self.warp.warp_tokens(grid.flatten(1, 2).contiguous())


def warped_figure(
    editor: Any, worlds: Worlds, *, size: int, count: int = 20, noises: int = 8
) -> Figure:
    """Share of worlds in which a true warp between two views beats the same warp displaced by an
    eighth.

    For each noise the target's colours at points that the source sees are compared with the source's
    (CIEDE2000). A world counts where the difference's 95 % interval over noises (Student's t) is above 0.
    """
    from scipy import stats

    swap, cases = Swap(editor), cases_of(worlds, size)
    pairs = [(a, b) for a, b in itertools.pairwise(cases) if a.world == b.world][:count]
    clear = []
    for source, target in pairs:
        view = view_warp(worlds, target.world, target.view)
        grid = view.at((size, size))
        sources, targets = [source] * noises, [target] * noises
        seeds = [90_000 + 100 * source.world + k for k in range(noises)]
        run_a, recording = swap.recorded(sources, swap.noise(seeds, source.before))
        noise_b = swap.noise([s + 50 for s in seeds], source.before)
        right = swap.injected(recording, targets, noise_b, warp=view)
        wrong = swap.injected(recording, targets, noise_b, warp=Displaced(view))
        gain = np.array(
            [
                _disagreement(w, a, grid) - _disagreement(r, a, grid)
                for a, r, w in zip(run_a, right, wrong, strict=True)
            ]
        )
        margin = stats.t.ppf(0.975, noises - 1) * gain.std(ddof=1) / noises**0.5
        clear.append(bool(gain.mean() > margin))
    return figure(
        "the true warp is clearly better than one displaced by an eighth",
        clear,
        [a.world for a, _ in pairs],
        asked=0.8,
    )


def _disagreement(target: Image, source: Image, grid: Any) -> float:
    """Mean CIEDE2000 between a target and a source at the points that both see."""
    from skimage.color import deltaE_ciede2000, rgb2lab

    pixels = torch.from_numpy(source).permute(2, 0, 1)[None].double()
    warped = grid.warp(pixels)[0].permute(1, 2, 0).numpy()
    mask = grid.mask.numpy()
    return float(
        deltaE_ciede2000(
            rgb2lab(warped[mask].clip(0, 1)), rgb2lab(target[mask].astype(np.float64))
        ).mean()
    )


def carries(
    editor: Any, worlds: Worlds, *, size: int, pairs: int = PAIRS, kept: Kept | None = None
) -> list[Figure]:
    """All figures of this module; arguments as of :func:`swap_figures`."""
    return [
        *swap_figures(editor, worlds, size=size, pairs=pairs, kept=kept),
        warped_figure(editor, worlds, size=size),
    ]


def carried_section(carried: Sequence[Figure], pairs: int) -> str:
    """A card's section of these figures."""
    lines = [
        "## Whether its attention carries the answer, and where", "",
        "Features of a run that answered one colour go into a run from other noise that alone answers another, by the paper's decay"
        f" (`training/assess/carries.py`). At least {pairs} swaps a question were asked for; the last column says how many were had.", "",
        "| question | share | asked for | answers |", "|---|---|---|---|",
    ]  # fmt: skip
    for f in carried:
        lines.append(f"| {f.what} | {percent(f)} | {asked_for(f)} | {f.count} |")
    return "\n".join(lines + short_of(carried))
