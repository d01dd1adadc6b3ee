"""Error of pictures against a converged one, by samples a pixel, plan and Mitsuba's variant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.cost import in_turn
from attnwarp_eval.experiments.accuracy.panel import Contestant, Panel
from attnwarp_eval.scene.scene import Scene

SAMPLES = (1, 4, 16, 64)


def pictures(
    scene: Scene,
    *,
    size: int = 96,
    samples: Sequence[int] = SAMPLES,
    rounds: int = 7,
    reference: tuple[int, int] = (16, 256),
    report: Reporter = SILENT,
) -> Panel:
    """Error of the source's picture against a converged one, by samples a pixel, plan and Mitsuba's
    variant.

    Args:
        size: size of the square picture.
        samples: numbers of samples a pixel.
        rounds: number of pictures of each contestant.
        reference: number of pictures, and their samples a pixel, in the mean of the converged
            picture. Its noise is estimated from their spread and subtracted from the errors.
    """
    from attnwarp_eval.truth.llvm import LLVM, SCALAR, variant
    from attnwarp_eval.truth.mitsuba import render_plan, use
    from attnwarp_eval.truth.plan import everything_on, plan

    small = scene.with_size(size, size)
    best = variant()
    contestants = [(f"plan, {spp} spp", plan(small, spp), best) for spp in samples]
    contestants += [
        (f"everything on, {spp} spp", everything_on(small, spp), best) for spp in samples[-2:]
    ]
    if best == LLVM:
        contestants += [(f"plan, {spp} spp, scalar", plan(small, spp), SCALAR) for spp in samples]
    # The baseline is the plan at the second largest number of samples.
    contestants.insert(0, contestants.pop(len(samples) - 2))

    report.step(0, 0, f"{scene.name}: converged picture")
    count, spp = reference
    made = np.stack(
        [
            render_plan(small, small.source, plan(small, spp), 50_000 + k, made_by=best)
            for k in range(count)
        ]
    )
    truth = made.mean(0, dtype=np.float64)
    floor = float(made.var(0, ddof=1, dtype=np.float64).mean()) / count

    def work(k: int) -> Callable[[int], Any]:
        _, planned, by = contestants[k]
        return lambda turn: render_plan(small, small.source, planned, 100 + turn, made_by=by)

    report.step(0, 0, f"{scene.name}: {len(contestants)} kinds of pictures, {rounds} rounds")
    turns = in_turn(
        [work(k) for k in range(len(contestants))], rounds, before=lambda k: use(contestants[k][2])
    )
    scale = float(truth.mean())
    out, squares = [], []
    draws = np.random.default_rng(0).integers(rounds, size=(1000, rounds))
    for (name, _, _), got, took in zip(contestants, turns.results, turns.seconds, strict=True):
        stack = np.array(got, dtype=np.float64)
        square = ((stack - truth) ** 2).mean((1, 2, 3)) - floor
        drawn = np.sqrt(np.clip(square[draws].mean(1), 0, None)) / scale
        error = float(np.sqrt(max(square.mean(), 0.0))) / scale
        low, high = np.quantile(drawn, [0.025, 0.975])
        means = stack.mean((1, 2, 3)) / scale - 1
        more = {
            "bias": float(means.mean()),
            "bias_error": float(means.std(ddof=1) / np.sqrt(rounds)),
        }
        out.append(Contestant(name, (error, float(low), float(high)), tuple(took), more))
        squares.append(tuple(np.clip(square, 1e-300, None).tolist()))
    unit = "RMS error of a pixel, share of the picture's mean"
    return Panel("pictures", scene.name, unit, tuple(out), tuple(turns.again), tuple(squares))
