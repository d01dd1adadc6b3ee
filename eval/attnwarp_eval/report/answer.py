"""Answer of a run, in words and one table: the opening of its report."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, number
from attnwarp_eval.metrics.registry import Metric
from attnwarp_eval.report.compared import in_words, unit_in_words, without_unit
from attnwarp_eval.report.controls import control_share, share_text
from attnwarp_eval.statistics.intervals import Interval, over_scenes
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import report_of, side_by_side
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import FIGURE, Answer, AnswerColumn
from attnwarp_eval.study.turns import timed_in_turn

TITLE = "Answer"


def answer(results: Results, timings: bool = True, pictures: bool = True) -> Section | None:
    """The answer to a study's question; None for a study without one."""
    asked = results.study.answer
    if asked is None:
        return None
    section = Section(TITLE, [f"**{asked.question}**"])
    filled = (_filled(results, asked, sentence) for sentence in asked.sentences)
    section.text += [sentence for sentence in filled if sentence]
    table, leaders = _table(results, asked, timings)
    told = [_advice(results, asked, leaders), _how_sure(results)]
    if timings:
        told[1:1] = _costs(results, asked, leaders)
    section.text.append(" ".join(told))
    meanings = (f"- `{name}`: {words}" for name, words in asked.variants.items())
    section.text.append("\n".join(meanings))
    section.tables.append(table)
    if pictures:
        grids = (
            side_by_side(
                results, one.probe, one.variants, one.content, one.scene, one.caption, one.first
            )
            for one in asked.pictures
        )
        section.grids = [grid for grid in grids if grid is not None]
    return section


def measured_in_words(results: Results) -> str:
    """Summary of a run's measurements, for a report that answers no question."""
    study = results.study
    things = dict.fromkeys(
        "seconds taken in turn" if probe(name).times_in_turn else report_of(name).measures or name
        for name in study.probes
    )
    variants = {name for names in study.probes.values() for name in names}
    of = f"For {len(variants)} variants, this" if len(variants) > 1 else "This"
    where = study.sampled or ", ".join(study.scene_names)
    scenes = "" if study.sampled else f"scene{'s' if len(study.scenes) > 1 else ''} "
    size = f" At {study.size} x {study.size} px, in {scenes}{where}." if study.scenes else ""
    return f"{of} run measured {'; '.join(things)}.{size}"


def _figure(results: Results, column: AnswerColumn, variant: str) -> tuple[Interval, str]:
    """Mean over scenes, and the figure's full name."""
    key = column.metric.format(layer=results.layer)
    table = results.views(column.probe, variant, key, column.yaw)
    return over_scenes(table), key


def _filled(results: Results, asked: Answer, sentence: str) -> str:
    """Fill ``{column|variant}`` in a sentence with the run's figures; empty if the run lacks
    a figure.
    """

    columns = {**asked.figures, **asked.columns}
    for title, variant in FIGURE.findall(sentence):
        if not results.records(columns[title].probe, variant):
            return ""

    def figure(match: re.Match[str]) -> str:
        column = columns[match[1]]
        if column.control:
            three = (match[2], column.control, column.alone)
            tables = (results.views(column.probe, n, column.metric, column.yaw) for n in three)
            sign = -1 if probe(column.probe).metric(column.metric).direction == "lower" else 1
            return share_text(control_share(*tables, sign=sign))
        value, key = _figure(results, column, match[2])
        return in_words(value.mean, probe(column.probe).metric(key), key)

    return FIGURE.sub(figure, sentence)


def _table(results: Results, asked: Answer, timings: bool) -> tuple[Table, list[str]]:
    """The table, and the best variants in the deciding column."""
    rows = {name: [f"`{name}`"] for name in asked.variants}
    columns, decided = ["variant"], list[str]()
    for title, column in asked.columns.items():
        figures = {name: _figure(results, column, name) for name in rows}
        key = column.metric.format(layer=results.layer)
        metric = probe(column.probe).metric(key)
        leaders = _leaders({name: value.mean for name, (value, _) in figures.items()}, metric)
        if title == asked.decides:
            decided = leaders
        # A unit shared by all figures is shown once, in the column's head.
        unit = unit_in_words(metric, key)
        columns.append(title if unit in ("", "%") else f"{title}, {unit}")
        percent = " %" * (unit == "%")
        for name, (value, _) in figures.items():
            text = without_unit(value.mean, metric) + percent * math.isfinite(value.mean)
            text = f"**{text}**" if name in leaders else text
            if value.scenes and 1 < len(results.study.scenes) < FEWEST_SCENES:
                text += f" ({_each(results, column, name, metric)}{percent})"
            if value.undefined and value.views:
                text += f", {value.undefined} undefined"
            rows[name].append(text)
    timed: tuple[str, ...] = ()
    if timings:
        seconds = _in_turn(results, asked)
        if seconds:
            timed = (f"time {report_of(asked.columns[asked.decides].probe).cost_of}, ms",)
            for name, row in rows.items():
                row.append(number(1000 * seconds.get(name, math.nan)))
    return Table([*columns, *timed], list(rows.values()), timed=timed), decided


def _each(results: Results, column: AnswerColumn, variant: str, metric: Metric) -> str:
    """Means of the scenes side by side, without a unit, in the study's order."""
    key = column.metric.format(layer=results.layer)
    table = results.views(column.probe, variant, key, column.yaw)
    means = (over_scenes({s: table.get(s, {})}).mean for s in results.study.scene_names)
    return ", ".join(without_unit(x, metric) if math.isfinite(x) else "–" for x in means)


def _leaders(values: Mapping[str, float], metric: Metric) -> list[str]:
    """Variants with the best value, ties included; none if no direction is better."""
    size = {
        name: abs(value) if metric.direction in ("lower", "zero") else -value
        for name, value in values.items()
        if math.isfinite(value)
    }
    if metric.direction == "none" or len(size) < 2:
        return []
    least = min(size.values())
    slack = metric.atol + metric.rtol * abs(least)
    leaders = [name for name, value in size.items() if value <= least + slack]
    return leaders if len(leaders) < len(size) else []


def _in_turn(results: Results, asked: Answer) -> dict[str, float]:
    """Seconds of variants timed in turn; seconds of cells depend on the machine's load."""
    stage = report_of(asked.columns[asked.decides].probe).stage
    timed = timed_in_turn(results, stage) if stage else None
    if timed is None:
        return {}
    return {name: timed.seconds(name).mean for name in asked.variants if name in timed.names}


def _advice(results: Results, asked: Answer, leaders: list[str]) -> str:
    """The best variant by the deciding column."""
    if not leaders:
        return f"No variant is better than the others in {asked.decides}."
    column = asked.columns[asked.decides]
    value, key = _figure(results, column, leaders[0])
    figure = in_words(value.mean, probe(column.probe).metric(key), key)
    several = " or ".join(f"`{name}`" for name in leaders)
    here = " here" * (len(results.study.scenes) < FEWEST_SCENES)
    return f"Of these variants {several} has the best {asked.decides}{here}: {figure}."


def _costs(results: Results, asked: Answer, leaders: list[str]) -> Iterator[str]:
    """Sentences on seconds: of the best variant, and of the pictures' variants."""
    own = report_of(asked.columns[asked.decides].probe)
    timed, taken = timed_in_turn(results, own.stage), _in_turn(results, asked)
    cheapest = min(taken, key=lambda name: taken[name], default="")
    if leaders and cheapest != leaders[0] in taken and taken[cheapest] > 0:
        ratio = taken[leaders[0]] / taken[cheapest]
        count = timed.scenes if timed else 0  # seconds may be of fewer scenes than figures
        few = f", timed on {count} of the scenes" * (count < len(results.study.scenes))
        yield (
            f"It takes {number(1000 * taken[leaders[0]], 2)} ms {own.cost_of}, {number(ratio, 2)}"
            f" times as long as `{cheapest}`{few}."
        )
    for shown in asked.pictures:
        other = report_of(shown.probe)
        seconds = {
            name: results.usual_seconds(shown.probe, name, other.cost) for name in shown.variants
        }
        if shown.probe != own.name and all(map(math.isfinite, seconds.values())):
            each = ", ".join(f"`{n}` {number(s, 2)} s" for n, s in seconds.items())
            yield f"Time of {other.cost_of}, in one pass: {each}."


def _how_sure(results: Results) -> str:
    study = results.study
    count = len(study.scenes)
    if count == 1:
        return f"This is one scene, {study.scene_names[0]}: other scenes may differ."
    if count < FEWEST_SCENES:
        return (
            f"Figures are means over {count} scenes, and brackets hold those of"
            f" {', '.join(study.scene_names)}, in this order. So few scenes say nothing in general."
        )
    return f"Figures are means over {count} scenes ({study.scenes_in_words})."
