"""Cost of accuracy in time: error against seconds, timed in turn if a probe did so."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number, ratio_text, spread
from attnwarp_eval.statistics.intervals import RATIO_INTERVAL, Interval, interval
from attnwarp_eval.study.probe import probes
from attnwarp_eval.study.probe_report import Layout, ProbeReport, report_of
from attnwarp_eval.study.results import Results, Shared
from attnwarp_eval.study.schema import Front
from attnwarp_eval.study.turns import Timed, timed_in_turn

DRAWS = 1000
"""Number of resamples of scenes and rounds."""


def fronts(results: Results, layout: Layout) -> list[Section]:
    """The section of fronts, with its figures; none if the study has no front."""
    reports = {front.probe: report_of(front.probe) for front in results.study.fronts}
    in_turn = {own.stage: timed_in_turn(results, own.stage) for own in reports.values()}
    text = _text(reports.values(), in_turn)
    section, ranges = Section("What accuracy costs in time", list(text)), list[str]()
    for index, front in enumerate(results.study.fronts):
        metric = front.metric.format(layer=results.layer)
        shared = results.shared(front.probe, front.variants, metric)
        if results.finished(front.probe) and not any(map(any, shared.tables.values())):
            section.text.append(f"{front.title}: no view has a value of `{metric}`.")
            continue
        own = reports[front.probe]
        timed = in_turn[own.stage]
        points, rows = _points(results, front, shared, own.cost, timed)
        if not points:
            continue
        ranges += shared.text(front.title)
        path = layout.figure(f"front-{index}.svg")
        specification = own.probe.metric(metric)
        label = f"{metric} ({specification.unit})"
        once = "" if timed else ", one pass"
        with charts.drawing(path) as (axes,):
            on_front = charts.cost_front(
                axes,
                points,
                x=f"seconds {own.cost_of}{once}",
                y=f"{specification.description}, {specification.unit}",
                title=front.title,
                # A difference of colours above a floor may be negative.
                log=specification.unit != "dE00",
            )
        section.figures.append(Picture(f"figures/{path.name}", f"{front.title}{once}"))
        time = f"ms {own.cost_of}{once}"
        columns = ["variant", label, time, "time, ratio", "verdict", "on the front"]
        if timed is None:
            marked = [[*row, "by one pass" if row[0] in on_front else "–"] for row in rows]
        else:
            marked = [
                [*row, ("yes" if row[0] in on_front else "no") if row[0] in points else "–"]
                for row in rows
            ]
        section.tables.append(Table(columns, marked, front.title, folded=True))
    section.text += [" ".join(ranges)] if ranges else []
    return [section] if section.tables or len(section.text) > len(text) else []


def _text(reports: Collection[ProbeReport], in_turn: Mapping[str, Timed | None]) -> list[str]:
    contents = dict.fromkeys(own.cost_text for own in reports)
    text = [
        f"{' '.join(contents)} A point is on the front when nothing"
        " cheaper is as good, by the means."
    ]
    for stage, timed in in_turn.items():
        text.append(_once(stage) if timed is None else _in_turn(timed))
    return list(dict.fromkeys(text))


def _once(stage: str) -> str:
    able = " or ".join(f"`{p.name}`" for p in probes() if stage in p.times_in_turn)
    advice = f": a study with a {able} probe takes them in turn" if able else ""
    return (
        "These seconds come from one pass over the views, each variant at another time, as the"
        f" median over scenes, and are for orientation{advice}. So a front is of that one pass."
    )


def _in_turn(timed: Timed) -> str:
    first = timed.turns[0]
    of = ", ".join(dict.fromkeys(turn.of for turn in timed.turns))
    return (
        f"All contestants ran in turn in one process, {first.rounds} rounds in an order drawn"
        f" anew each round, on {of} with {first.threads} renderer"
        f" thread{'s' if first.threads != 1 else ''}; a ratio is the median over rounds of the"
        f" ratio to the first contestant within a round; {RATIO_INTERVAL}"
        " The row `again` is the first contestant against itself: what noise alone does on this"
        " machine. Inside that band, or its mirror image about 1, nothing is called faster or"
        " slower."
    )


def _points(
    results: Results, front: Front, shared: Shared, cost: str, timed: Timed | None
) -> tuple[dict[str, tuple[Interval, Interval]], list[list[str]]]:
    """Seconds and quality of each comparable variant, and the rows without their last column."""
    points: dict[str, tuple[Interval, Interval]] = {}
    rows = []
    for name in front.variants:
        quality = shared.mean(name)
        shown = spread(quality, len(results.study.scenes))
        if name in shared.apart and quality.views:
            shown += ", own views"
        if timed is not None and name not in timed.names:
            # Seconds of different kinds cannot share an axis.
            rows.append([name, shown, "–", "not timed", "–"])
            continue
        if timed is not None:
            base, ratio = name == timed.baseline, timed.ratio(name)
            seconds = timed.seconds(name)
            text = "1" if base else ratio_text(ratio)
            judged = "baseline" if base else timed.judge(ratio)
        else:
            once = results.usual_seconds(front.probe, name, cost)
            if not math.isfinite(once):
                continue
            seconds, text, judged = interval({"all": [once]}), "one pass", "–"
        if name not in shared.apart:
            points[name] = (seconds, quality)
        rows.append([name, shown, number(1000 * seconds.mean), text, judged])
    if timed is not None:
        noise = timed.noise
        again = number(1000 * timed.base * noise.ratio)
        rows.append(["again", "–", again, ratio_text(noise), "–"])
    return points, rows
