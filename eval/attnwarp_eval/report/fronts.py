"""What accuracy costs in time: error against seconds, taken in turn where the study asked for
that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from attnwarp_eval.document import figures
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.metrics.registry import metric as metric_of
from attnwarp_eval.report.results import Results
from attnwarp_eval.report.words import number, spread
from attnwarp_eval.statistics.intervals import Interval, Ratio, interval, time_ratio

STAGES = {"depth": "render", "warp": "pair"}
"""Which of the timing probe's stages is the cost of which probe's figures."""


def fronts(results: Results, root: Path) -> list[Section]:
    """The section of fronts, with its figures written below ``root``; nothing where the study names
    none.

    Args:
        results: of the run.
        root: the run's folder.
    """
    section = Section("What accuracy costs in time")
    section.text = _text(results)
    for index, wanted in enumerate(results.study["fronts"]):
        metric = wanted["metric"].format(layer=results.layer)
        points, rows = _points(results, wanted, metric)
        if not points:
            continue
        path = root / "figures" / f"front-{index}.svg"
        label = f"{metric} ({metric_of(metric).unit})"
        with figures.drawing(path) as (axes,):
            kept = figures.cost_front(
                axes, points, x="seconds a view", y=label, title=wanted["title"]
            )
        section.figures.append(Picture(f"figures/{path.name}", wanted["title"]))
        columns = ["variant", label, "ms a view", "time, ratio", "verdict", "on the front"]
        marked = [
            [*row, ("yes" if row[0] in kept else "no") if row[0] in points else "–"] for row in rows
        ]
        section.tables.append(Table(columns, marked, wanted["title"]))
    return [section] if section.tables else []


def _text(results: Results) -> list[str]:
    what = (
        "Seconds are those of the method alone: a render of the target for depth; render,"
        " correspondence, mask and feature grids for a warp. The source's render serves all targets"
        " and is not in them, nor are set-up and checks. A point is on the front when nothing"
        " cheaper is as good, by the means: look at the intervals before believing a close one."
    )
    timed = next(
        (c["record"] for c in results.cells if c["probe"] == "timing" and c["record"]), None
    )
    if timed is None:
        return [
            what,
            (
                "These seconds come from one pass over the views, each variant at another time, and"
                " are for orientation: a study with a `timing` probe takes them in turn."
            ),
        ]
    spec, threads = timed["spec"], timed["cost"]["threads"]
    return [
        what,
        (
            f"All contestants ran in turn in one process, {spec['rounds']} rounds in an order drawn"
            f" anew each round, on view {spec['views'][0]} of each scene with {threads} renderer"
            f" thread{'s' if threads != 1 else ''}; a ratio is the median over rounds of the ratio"
            " to the first contestant within a round, with a bootstrap interval over rounds. The"
            " row `again` is the first contestant against itself: what noise alone does on this"
            " machine. Inside that band nothing is called faster or slower."
        ),
    ]


def _points(
    results: Results, wanted: dict[str, Any], metric: str
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
        values = results.views(probe, name, metric)
        quality = interval({scene: list(views.values()) for scene, views in values.items()})
        taken = results.rounds(stage, name) if first else []
        if noise and not taken:
            # Seconds of another kind have no place on the same axis.
            rows.append([name, spread(quality), "–", "not timed", "–"])
            continue
        if noise:
            ratio = time_ratio(taken, first)
            seconds = _seconds(base, ratio)
            text = "1" if name == baseline else _ratio(ratio)
            judged = "baseline" if name == baseline else _judge(ratio, noise)
        else:
            once = results.cost(probe, name, "steady")
            if not once:
                continue
            seconds, text, judged = (
                interval({scene: [v] for scene, v in once.items()}),
                "one pass",
                "–",
            )
        points[name] = (seconds, quality)
        rows.append([name, spread(quality), number(1000 * seconds.mean), text, judged])
    if noise:
        rows.append(["again", "–", number(1000 * base * noise.ratio), _ratio(noise), "–"])
    return points, rows


def _seconds(base: float, ratio: Ratio) -> Interval:
    nan = float("nan")
    return Interval(base * ratio.ratio, base * ratio.low, base * ratio.high, 1, 1, 0, nan, nan)


def _ratio(ratio: Ratio) -> str:
    return f"{number(ratio.ratio)} [{number(ratio.low)}, {number(ratio.high)}]"


def _judge(ratio: Ratio, noise: Ratio) -> str:
    """Faster or slower only outside the band that the baseline against itself spans."""
    band = max(noise.high, 1 / noise.low, 1.0)
    if ratio.low > band:
        return "slower"
    if ratio.high < 1 / band:
        return "faster"
    return "can't tell"
