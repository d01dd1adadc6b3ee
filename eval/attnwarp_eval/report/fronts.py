"""What accuracy costs in time: error against seconds, taken in turn where the study asked for that."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp_eval.checks import metric as metric_of
from attnwarp_eval.report import figures
from attnwarp_eval.report.model import Picture, Section, Table
from attnwarp_eval.report.results import Results
from attnwarp_eval.statistics import Interval, Ratio, interval, time_ratio

STAGES = {"depth": "render", "warp": "pair"}
"""Which of the timing probe's stages is the cost of which probe's figures."""

Format = Callable[[Interval], str]
Number = Callable[[float], str]


def fronts(results: Results, root: Path, number: Number, spread: Format) -> list[Section]:
    """The section of fronts, with its figures written below ``root``; nothing where the study names none.

    Args:
        results: of the run.
        root: the run's folder.
        number, spread: how a number, and a mean with its interval, are written.
    """
    section = Section("What accuracy costs in time")
    section.text = [
        "Seconds are those of the method alone: a render of the target for depth; render, correspondence, mask and "
        "feature grids for a warp. Set-up and checks are not in them. All contestants ran in turn in one process, in "
        "an order drawn anew each round; a ratio is the median over rounds of the ratio to the first contestant within "
        "a round, with a bootstrap interval over rounds. The row `again` is the first contestant against itself: what "
        "noise alone does on this machine. Inside that band nothing is called faster or slower. A point is on the "
        "front when nothing cheaper is as good.",
    ]
    for index, wanted in enumerate(results.study["fronts"]):
        points, rows = _points(results, wanted, number, spread)
        if not points:
            continue
        path = root / "figures" / f"front-{index}.svg"
        label = f"{wanted['metric']} ({metric_of(wanted['metric']).unit})"
        with figures.drawing(path) as (axes,):
            kept = figures.cost_front(axes, points, x="seconds a view", y=label, title=wanted["title"])
        section.figures.append(Picture(f"figures/{path.name}", wanted["title"]))
        columns = ["variant", label, "ms a view", "time, ratio", "verdict", "on the front"]
        marked = [[*row, "yes" if row[0] in kept else "–" if row[0] == "again" else "no"] for row in rows]
        section.tables.append(Table(columns, marked, wanted["title"]))
    return [section] if section.tables else []


def _points(
    results: Results, wanted: dict[str, Any], number: Number, spread: Format
) -> tuple[dict[str, tuple[Interval, Interval]], list[list[str]]]:
    """Seconds and quality of each variant, and the rows of the table but for their last column."""
    probe, stage = wanted["probe"], STAGES.get(wanted["probe"], "")
    baseline = results.timing_baseline
    first = results.rounds(stage, baseline) if baseline and stage else []
    noise = time_ratio(results.rounds(stage, None), first) if first else None
    base = float(np.median(np.concatenate(first))) if first else float("nan")
    points: dict[str, tuple[Interval, Interval]] = {}
    rows = []
    for name in wanted["variants"]:
        values = results.views(probe, name, wanted["metric"])
        quality = interval({scene: list(views.values()) for scene, views in values.items()})
        taken = results.rounds(stage, name) if first else []
        if taken and noise:
            ratio = time_ratio(taken, first)
            seconds = _seconds(base, ratio)
            text = "1" if name == baseline else _text(ratio, number)
            judged = "baseline" if name == baseline else _judge(ratio, noise)
        else:
            once = results.cost(probe, name, "steady")
            if not once:
                continue
            seconds, text, judged = interval({scene: [v] for scene, v in once.items()}), "not in turn", "–"
        points[name] = (seconds, quality)
        rows.append([name, spread(quality), number(1000 * seconds.mean), text, judged])
    if noise:
        rows.append(["again", "–", number(1000 * base * noise.ratio), _text(noise, number), "–"])
    return points, rows


def _seconds(base: float, ratio: Ratio) -> Interval:
    nan = float("nan")
    return Interval(base * ratio.ratio, base * ratio.low, base * ratio.high, 1, 1, 0, nan, nan)


def _text(ratio: Ratio, number: Number) -> str:
    return f"{number(ratio.ratio)} [{number(ratio.low)}, {number(ratio.high)}]"


def _judge(ratio: Ratio, noise: Ratio) -> str:
    """Faster or slower only outside the band that the baseline against itself spans."""
    band = max(noise.high, 1 / noise.low, 1.0)
    if ratio.low > band:
        return "slower"
    if ratio.high < 1 / band:
        return "faster"
    return "can't tell"
