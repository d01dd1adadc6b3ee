"""What accuracy costs in time: error against seconds, taken in turn where a probe has done so."""

from __future__ import annotations

import numpy as np

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.statistics.intervals import Interval, Ratio, interval, time_ratio
from attnwarp_eval.study.probes import probe, probes
from attnwarp_eval.study.probes.base import InTurn, Layout
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Front


def fronts(results: Results, layout: Layout) -> list[Section]:
    """The section of fronts, with its figures; none where the study names no front.

    Args:
        results: of the run.
        layout: of the report.
    """
    turns = [
        turn
        for cell in results.cells
        if cell.record is not None
        and (turn := probe(cell.probe).in_turn(cell, cell.record)) is not None
    ]
    section = Section("What accuracy costs in time")
    section.text = _text(results, turns)
    for index, front in enumerate(results.study.fronts):
        metric = front.metric.format(layer=results.layer)
        points, rows = _points(results, turns, front, metric)
        if not points:
            continue
        path = layout.figure(f"front-{index}.svg")
        own = probe(front.probe)
        label = f"{metric} ({own.metric(metric).unit})"
        with charts.drawing(path) as (axes,):
            on_front = charts.cost_front(
                axes,
                points,
                x=f"seconds {own.cost_of}",
                y=label,
                title=front.title,
                # A difference of colours above a floor may be negative.
                log=own.metric(metric).unit != "dE00",
            )
        section.figures.append(Picture(f"figures/{path.name}", front.title))
        columns = ["variant", label, f"ms {own.cost_of}", "time, ratio", "verdict", "on the front"]
        marked = [
            [*row, ("yes" if row[0] in on_front else "no") if row[0] in points else "–"]
            for row in rows
        ]
        section.tables.append(Table(columns, marked, front.title))
    return [section] if section.tables else []


def _text(results: Results, turns: list[InTurn]) -> list[str]:
    contents = dict.fromkeys(probe(front.probe).cost_text for front in results.study.fronts)
    text = (
        f"{' '.join(contents)} A point is on the front when nothing"
        " cheaper is as good, by the means: look at the intervals before believing a close one."
    )
    if not turns:
        names = " or ".join(f"`{p.name}`" for p in probes() if p.times_in_turn)
        return [
            text,
            (
                "These seconds come from one pass over the views, each variant at another time, and"
                f" are for orientation: a study with a {names} probe takes them in turn."
            ),
        ]
    first = turns[0]
    return [
        text,
        (
            f"All contestants ran in turn in one process, {first.rounds} rounds in an order drawn"
            f" anew each round, on view {first.view} of each scene with {first.threads} renderer"
            f" thread{'s' if first.threads != 1 else ''}; a ratio is the median over rounds of the"
            " ratio to the first contestant within a round, with a bootstrap interval over rounds."
            " The row `again` is the first contestant against itself: what noise alone does on this"
            " machine. Inside that band nothing is called faster or slower."
        ),
    ]


def _rounds(turns: list[InTurn], stage: str, name: str | None) -> list[list[float]]:
    """Seconds of a contestant: a list of rounds for each cell that has it; the baseline's second
    run for None.
    """
    return [
        turn.seconds[stage][-1 if name is None else turn.names.index(name)]
        for turn in turns
        if name is None or name in turn.names
    ]


def _points(
    results: Results, turns: list[InTurn], front: Front, metric: str
) -> tuple[dict[str, tuple[Interval, Interval]], list[list[str]]]:
    """Seconds and quality of each variant, and the rows of the table but for their last column."""
    stage = probe(front.probe).stage
    baseline = turns[0].names[0] if turns else None
    first = _rounds(turns, stage, baseline) if baseline and stage else []
    noise = time_ratio(_rounds(turns, stage, None), first) if first else None
    base = float(np.median(np.concatenate(first))) if first else float("nan")
    points: dict[str, tuple[Interval, Interval]] = {}
    rows = []
    for name in front.variants:
        quality = results.mean(front.probe, name, metric)
        taken = _rounds(turns, stage, name) if first else []
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
            once = results.seconds(front.probe, name, probe(front.probe).cost)
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
