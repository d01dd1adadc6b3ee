"""Figures of an editor that answers in parts, on worlds that it has never seen: whether its parts differ and follow their
noise, and where its answer lives: what carried features bring, by kind, by a true warp, and by one that reads mirrored places.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from skimage.color import deltaE_ciede2000, rgb2lab
from torch import Tensor
from torch.nn import functional

from attnwarp.camera import Camera
from attnwarp.editing.editor import Image, edit
from attnwarp.editing.latents import BLOCK
from attnwarp.editing.layers import Kind
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.io.file import write_atomically
from attnwarp.methods.algorithms.attention_warping import AttentionWarpingSettings, a_t, inject
from attnwarp.methods.noise import carried as carried_order
from attnwarp.warp import EXACT_DEPTH_TOLERANCE, Surface, WarpSettings, warp_surfaces
from attnwarp_eval.colors import to_linear, to_srgb
from training.editors.parts import SENTENCES, PartsPool
from training.worlds import recolors

SIZE, STEPS, BATCH = 64, 20, 16

LEAST_PIXELS = 32
"""Smaller parts are not judged."""

DIFFER = 10.0
"""CIEDE2000 from which two colours differ."""

KINDS: tuple[Kind, ...] = ("self", "cross")

LINEAR, LATE, BY_KIND = (
    AttentionWarpingSettings(), AttentionWarpingSettings(a0=1.0, decay="late"),
    AttentionWarpingSettings(a0=1.0, decay="by_kind"),
)  # fmt: skip
"""Weights as published, of both kinds alike, and of an edit's default."""

EXACT = WarpSettings(opaque=None, normal_test="none", depth_relative=EXACT_DEPTH_TOLERANCE)

Marks = dict[str, list[tuple[float, int]]]
"""Values and the worlds that they are of."""


@dataclass(frozen=True)
class Figure:
    """A share of right answers.

    Attributes:
        what: the question.
        value: the share.
        low, high: 95 % interval, bootstrapped over worlds: answers of one world are not independent. Where all
            answers are right or all wrong, the binomial interval of as many answers as worlds (Clopper-Pearson).
        count: answers.
    """

    what: str
    value: float
    low: float
    high: float
    count: int

    def __str__(self) -> str:
        return f"{100 * self.value:.0f} % ({100 * self.low:.0f} to {100 * self.high:.0f})"


def figure(what: str, right: npt.ArrayLike, worlds: npt.ArrayLike) -> Figure:
    """A figure from one answer a question, grouped by world."""
    values, groups = np.asarray(right, dtype=np.float64), np.asarray(worlds)
    table = np.array([(values[groups == g].sum(), (groups == g).sum()) for g in np.unique(groups)])
    drawn = table[redrawn(len(table))].sum(axis=1)
    low, high = np.quantile(drawn[:, 0] / drawn[:, 1], [0.025, 0.975])
    tail = 0.025 ** (1 / len(table))
    if (values == 0).all():
        high = 1 - tail
    elif (values == 1).all():
        low = tail
    return Figure(what, float(values.mean()), float(low), float(high), len(values))


def redrawn(count: int) -> npt.NDArray[np.int64]:
    """(2000, count) worlds of each bootstrap sample."""
    return np.random.default_rng(0).integers(count, size=(2000, count))


def share_of_gain(marks: Marks, control: str, arm: str, alone: str) -> Figure:
    """Gain of a control over views alone, as a share of an arm's gain over them on the same parts."""
    worlds = np.array([w for _, w in marks[alone]])
    sums = np.array([[v for v, _ in marks[key]] for key in (control, arm, alone)])
    table = np.array([sums[:, worlds == w].sum(axis=1) for w in np.unique(worlds)])
    drawn = table[redrawn(len(table))].sum(axis=1)
    shares = (drawn[:, 0] - drawn[:, 2]) / (drawn[:, 1] - drawn[:, 2])
    low, high = np.quantile(shares, [0.025, 0.975])
    whole = table.sum(axis=0)
    value = (whole[0] - whole[2]) / (whole[1] - whole[2])
    what = "share of that gain which mirrored features have"
    return Figure(what, float(value), float(low), float(high), len(worlds))


class Kept:
    """Results of a long measurement in a file, by name: one that was stopped goes on where it was."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.results: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}

    def get(self, name: str, compute: Callable[[], Any]) -> Any:
        """The result of that name, computed and written if it is not there; it comes as JSON gives it back."""
        if name not in self.results:
            self.results[name] = json.loads(json.dumps(compute()))
            text = json.dumps(self.results)
            write_atomically(self.path, lambda stream: stream.write(text.encode()))
        return self.results[name]


class Mirrored:
    """A warp that reads each place's mirror image."""

    def __init__(self, warp: Any) -> None:
        self.warp = warp

    def at(self, size: tuple[int, int], *, source_size: tuple[int, int] | None = None) -> Any:
        """The mirrored warp of a grid."""
        warp = self.warp.at(size, source_size=source_size)
        return _MirroredTokens(warp, size)


class _MirroredTokens:
    def __init__(self, warp: Any, size: tuple[int, int]) -> None:
        self.warp, self.size, self.weight = warp, size, warp.weight

    def warp_tokens(self, source: Tensor) -> Tensor:
        grid = source.unflatten(1, self.size).flip(2)
        return self.warp.warp_tokens(grid.flatten(1, 2).contiguous())


class Cases:
    """Full pictures of test worlds with colours before, and the judgement of their parts."""

    def __init__(
        self, table: Mapping[str, npt.NDArray[Any]], pool: PartsPool, seed: int = 5
    ) -> None:
        self.table, self.pool = table, pool
        count, generator = len(pool.light), torch.Generator().manual_seed(seed)
        self.worlds = np.arange(count) // recolors.VIEWS
        colors = pool.before(count // 2, generator).repeat_interleave(recolors.VIEWS, dim=0)
        division = (torch.arange(count) // recolors.VIEWS // 2) % 2
        self.cuts = [
            (pool.light[k].float(), pool.parts[k, division[k]].long()) for k in range(count)
        ]
        self.latents = pool.colored(self.cuts, colors, SIZE)
        self.before = [self.picture(z) for z in self.latents]
        self.shares = pool.shares(self.cuts, SIZE // BLOCK)
        step = recolors.SIZE // SIZE
        self.masks, self.true = [], []
        for (light, parts), color in zip(self.cuts, colors, strict=True):
            one = functional.one_hot(parts, len(pool.bank) + 1).permute(2, 0, 1).float()
            self.masks.append((functional.avg_pool2d(one, step) > 0.99).numpy())
            mean = torch.stack(
                [light[parts == p].mean(dim=0) for p in range(1, len(pool.bank) + 1)]
            )
            answers = torch.cat(
                [pool.palette.expand(len(mean), -1, -1), color[:, None]], dim=1
            )  # the last is before
            self.true.append(
                rgb2lab(to_srgb((mean[:, None] * answers).nan_to_num().numpy().astype(float)))
            )
        self.large = [
            [p for p in range(1, len(m)) if m[p].sum() >= LEAST_PIXELS] for m in self.masks
        ]

    def picture(self, latents: Tensor) -> Image:
        """(S, S, 3) in [0, 1]."""
        decoded = self.pool.coder.decode(latents[None], return_dict=False)[0][0]
        return ((decoded + 1) / 2).clamp(0, 1).permute(1, 2, 0).numpy().astype(np.float32)

    def lab(self, image: Image, case: int, part: int) -> npt.NDArray[np.float64]:
        """CIELAB of a part's mean colour."""
        mean = to_linear(image[self.masks[case][part]].astype(float)).mean(axis=0)
        return np.asarray(rgb2lab(to_srgb(mean)[None, None])[0, 0])

    def answer(self, image: Image, case: int, part: int) -> int:
        """The answer that a part is nearest to; the last is the picture before."""
        true = self.true[case][part - 1]
        own = np.broadcast_to(self.lab(image, case, part), true.shape)
        return int(deltaE_ciede2000(own, true).argmin())

    def drawn(self, unet: Any, case: int, noise: Tensor) -> list[int]:
        """Return the answer that the noise selects for each part."""
        with torch.no_grad():
            evidence = unet.evidence(noise[None], self.latents[case : case + 1])
        return list(self.pool.answers(evidence, self.shares[case : case + 1])[0].tolist())

    def touching(self, case: int) -> list[tuple[int, int]]:
        """Pairs of judged parts that touch."""
        parts = self.cuts[case][1].numpy()
        beside = ((parts[1:], parts[:-1]), (parts[:, 1:], parts[:, :-1]))
        pairs = {frozenset(p) for a, b in beside for p in zip(a.ravel(), b.ravel(), strict=True)}
        return [p for p in itertools.combinations(self.large[case], 2) if frozenset(p) in pairs]

    def warp(self, target: int) -> Any:
        """The exact warp to a view from the other one of its world."""
        world, view = divmod(target, 2)
        cameras = [
            Camera(
                self.table["K"][world, v],
                self.table["world_to_camera"][world, v],
                recolors.SIZE,
                recolors.SIZE,
            )
            for v in (0, 1)
        ]
        surfaces = [Surface(self.table["depth"][world, v].astype(np.float64)) for v in (0, 1)]
        return warp_surfaces(
            cameras[1 - view],
            cameras[view],
            surfaces[view],
            surfaces[1 - view],
            EXACT,
            warn_empty=False,
        )


def noise_of(cases: list[int], number: int) -> Tensor:
    """(B, 48, 16, 16) white noise, one a case and a number."""
    shape = (48, SIZE // BLOCK, SIZE // BLOCK)
    return torch.stack(
        [
            torch.randn(shape, generator=torch.Generator().manual_seed(1000 * c + number))
            for c in cases
        ]
    )


def tied_to(noise: Tensor, warp: Any) -> Tensor:
    """(48, h, w) noise of a target that has the source's noise where both see the surface."""
    seen = warp.at(tuple(noise.shape[1:]))
    order = carried_order(seen.correspondence.xy, seen.mask)
    return noise.flatten(1)[:, order.flatten()].view_as(noise)


def part_marks(editor: Any, cases: Cases, worlds: list[int], *, carried: bool = True) -> Marks:
    """All marks on some worlds: of a first view alone, of its features in runs from other noise, and of them in the second view."""
    marks: Marks = {}

    def mark(key: str, value: Any, case: int) -> None:
        marks.setdefault(key, []).append((float(value), int(cases.worlds[case])))

    def run(views: list[int], noise: Tensor) -> list[Image]:
        guides = [cases.before[c] for c in views]
        return edit(editor, guides, SENTENCES[0], steps=STEPS, noise=noise).images

    sources, targets = [2 * w for w in worlds], [2 * w + 1 for w in worlds]
    noise_a, noise_b, noise_t = noise_of(sources, 1), noise_of(sources, 2), noise_of(targets, 3)
    plan = RecordingPlan(
        editor.layers(),
        (SIZE // BLOCK,) * 2,
        tuple(b for b in editor.branches if b in editor.carries),
        STEPS,
        len(sources),
    )
    with record(editor, plan) as recording:
        run_a = run(sources, noise_a)
    mixed, kept = noise_b.clone(), []
    for k, c in enumerate(
        sources
    ):  # the largest part has the first run's noise, all else the second's
        kept.append(max(cases.large[c], key=lambda p: int(cases.masks[c][p].sum()), default=0))
        inside = (cases.shares[c, :, kept[k]] > 0).view(SIZE // BLOCK, -1)
        mixed[k] = torch.where(inside, noise_a[k], noise_b[k])
    run_b, run_m = run(sources, noise_b), run(sources, mixed)
    same: dict[str, list[Image]] = {}
    other: dict[str, list[Image]] = {}
    if carried:
        for kind in ("self", "cross", "both"):
            kinds = KINDS if kind == "both" else (kind,)
            chosen = replace(
                recording,
                plan=replace(plan, layers=tuple(one for one in plan.layers if one.kind in kinds)),
            )
            with inject(editor, chosen, warps=[None] * len(sources), weight=partial(a_t, s=LATE)):
                same[kind] = run(sources, noise_b)
        warps = [cases.warp(c) for c in targets]
        mirrored = [Mirrored(w) for w in warps]
        tied = torch.stack([tied_to(n, w) for n, w in zip(noise_a, warps, strict=True)])
        other["alone"] = run(targets, noise_t)
        other["alone, noise on the surface"] = run(targets, tied)
        for key, used, settings, noise in (
            ("both linear", warps, LINEAR, noise_t), ("both late", warps, LATE, noise_t),
            ("by kind", warps, BY_KIND, noise_t), ("mirrored", mirrored, BY_KIND, noise_t),
            ("by kind, noise on the surface", warps, BY_KIND, tied),
        ):  # fmt: skip
            with ExitStack() as stack:
                for kind in KINDS:
                    layers = [one for one in plan.layers if one.kind == kind]
                    weight = partial(a_t, s=settings, kind=kind)
                    stack.enter_context(
                        inject(editor, recording, warps=used, weight=weight, layers=layers)
                    )
                other[key] = run(targets, noise)
    for k, c in enumerate(sources):
        outside = cases.masks[c][0]
        psnr = -10 * np.log10(
            max(float(np.square(run_a[k] - cases.before[c])[outside].mean()), 1e-10)
        )
        mark("outside kept (26 dB)", psnr >= 26, c)
        drawn = cases.drawn(editor.network, c, noise_a[k])
        for a, b in cases.touching(c):
            mark(
                "touching parts differ",
                deltaE_ciede2000(cases.lab(run_a[k], c, a), cases.lab(run_a[k], c, b)) > DIFFER,
                c,
            )
        for p in cases.large[c]:
            changed = (
                deltaE_ciede2000(cases.lab(run_a[k], c, p), cases.lab(cases.before[c], c, p))
                > DIFFER
            )
            first, second = cases.answer(run_a[k], c, p), cases.answer(run_b[k], c, p)
            mark("parts changed", changed, c)
            mark("a part's noise foretells its answer", first == drawn[p - 1], c)
            mark("other noise foretells it (control)", second == drawn[p - 1], c)
            if p == kept[k] and len(cases.large[c]) > 1:
                mark(
                    "a part that keeps its noise, all else new, keeps its answer",
                    cases.answer(run_m[k], c, p) == first,
                    c,
                )
            for kind, images in same.items():
                if first != second:
                    mark(
                        f"same view, {kind}: the source's answer",
                        cases.answer(images[k], c, p) == first,
                        c,
                    )
            for key, images in other.items():
                if p in cases.large[targets[k]]:
                    mark(
                        f"other view, {key}: the source's answer",
                        cases.answer(images[k], targets[k], p) == first,
                        c,
                    )
    return marks


def part_figures(
    editor: Any, cases: Cases, *, batch: int = BATCH, carried: bool = True, kept: Kept | None = None
) -> list[Figure]:
    """Figures of all cases; of features brought to the other view beside them the share of the gain that mirrored ones have.

    Args:
        kept: results of batches, so that a stopped measurement goes on.
    """
    marks: Marks = {}
    worlds = list(range(len(cases.cuts) // 2))
    for first in range(0, len(worlds), batch):
        compute = partial(part_marks, editor, cases, worlds[first : first + batch], carried=carried)
        for key, values in (
            compute() if kept is None else kept.get(f"parts {batch} {first}", compute)
        ).items():
            marks.setdefault(key, []).extend(tuple(v) for v in values)
    found = [
        figure(key, [bool(v) for v, _ in rows], [w for _, w in rows]) for key, rows in marks.items()
    ]
    if carried:
        keys = (
            f"other view, {arm}: the source's answer" for arm in ("mirrored", "by kind", "alone")
        )
        found.append(share_of_gain(marks, *keys))
    return found
