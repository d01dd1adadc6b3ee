"""Report of hard cases: where the numerics hold, break, or refuse."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.stability import DECADES, Outcome, level_name
from attnwarp_eval.study.probe_report import Layout, Place, ProbeReport, register_report
from attnwarp_eval.study.probes.stability.measure import Swept, must_hold, read_sweeps
from attnwarp_eval.study.results import Results


@register_report
class StabilityReport(ProbeReport):
    """Verdicts, errors against hardness, and every error."""

    name = "stability"
    measures = "hard cases of the numerics"

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """The verdicts, the errors against hardness, and every error."""
        swept = read_sweeps(results)
        if not swept:
            return
        yield Place.RESULT, _verdicts(swept)
        yield Place.RESULT, _figures(swept, layout)
        yield Place.APPENDIX, _every_error(swept)


def verdict_lines(swept: Sequence[Swept]) -> list[str]:
    """A line for each level that had to hold and does not."""
    return [
        f"{sweep.case.name} / {sweep.way.name}: {_what_failed(sweep, outcome)}"
        for sweep in swept
        for outcome in sweep.failures
    ]


def _what_failed(sweep: Swept, outcome: Outcome) -> str:
    bound = sweep.case.bounds[sweep.way.direction]
    level = f"{sweep.case.hardness} {level_name(outcome.level)}"
    if outcome.must_refuse:
        return f"accepted at {level}, expected an error"
    if outcome.refusal:
        return f"refused at {level}: {outcome.refusal}"
    return (
        f"error {_error(outcome.error)} at {level}, expected at most"
        f" {number(outcome.tolerance, 2)} ({bound.unit})"
    )


def _error(error: float) -> str:
    return "not finite" if math.isinf(error) else "0" if error == 0 else f"{error:.1e}"


def _verdicts(swept: Sequence[Swept]) -> Section:
    failed = verdict_lines(swept)
    names = {sweep.case.name for sweep in swept}
    numbers = {sweep.case.number for sweep in swept}
    levels = sum(len(sweep.outcomes) for sweep in swept)
    text = [
        (
            f"{len(names)} sweeps of {len(numbers)} hard cases, each by several ways:"
            f" {len(swept)} in all, {levels} evaluations. A case must hold"
            " up to its required level; harder ones follow until it breaks. Margin: decades"
            f" between error and tolerance, at most {DECADES:g}; the worst of a case's ways is"
            " shown. No oracle shares code with what it judges."
        ),
        (
            "Every required level holds."
            if not failed
            else "**Required levels that do not hold:** " + "; ".join(failed) + "."
        ),
    ]
    ending: list[list[str]] = []
    whole: list[list[str]] = []
    for name in dict.fromkeys(sweep.case.name for sweep in swept):
        own = [sweep for sweep in swept if sweep.case.name == name]
        for direction in ("forward", "backward"):
            part = [sweep for sweep in own if sweep.way.direction == direction]
            if part:
                (ending if any(sweep.end for sweep in part) else whole).append(_row(part))
    columns = [
        "#",
        "case",
        "direction",
        "swept",
        "must hold to",
        "worst margin up to there",
        "its error",
        "tolerance",
        "what ends it",
        "why",
    ]
    tables = [
        Table(columns, ending, "Cases that break, or are refused, at some level."),
        Table(columns[:-2], [row[:-2] for row in whole], "Cases that hold at every level."),
    ]
    return Section("Where hard inputs break the numerics", text, [t for t in tables if t.rows])


def _row(swept: Sequence[Swept]) -> list[str]:
    hard, direction = swept[0].case, swept[0].way.direction
    bound = hard.bounds[direction]
    required = [outcome for sweep in swept for outcome in sweep.outcomes if outcome.required] or [
        outcome for sweep in swept for outcome in sweep.outcomes[:1]
    ]
    worst = min(required, key=lambda outcome: (outcome.margin, -outcome.error))
    ends: dict[str, list[str]] = {}
    for sweep in swept:
        end = sweep.end
        if end is not None:
            level = f"{'refused' if end.refusal else 'breaks'} at {level_name(end.level)}"
            error = "" if end.refusal else f" ({_error(end.error)})"
            side = f"{sweep.way.backend} {sweep.way.precision}{error}"
            ends.setdefault(level, []).append(side)
    last = level_name(max(required, key=lambda outcome: hard.levels.index(outcome.level)).level)
    return [
        str(hard.number),
        f"`{hard.name}`: {hard.title}",
        direction,
        hard.hardness,
        last,
        number(worst.margin, 2),
        "refused, as it must be" if worst.must_refuse else _error(worst.error),
        _tolerance(bound.unit, worst.tolerance),
        "; ".join(f"{level}: {', '.join(who)}" for level, who in ends.items()),
        hard.limit,
    ]


def _tolerance(unit: str, tolerance: float) -> str:
    return f"no {unit}" if tolerance == 0.5 else f"{number(tolerance, 2)} {unit}"


def _figures(swept: Sequence[Swept], layout: Layout) -> Section:
    """Errors in units of their tolerance against hardness, a panel a case that ends somewhere."""
    pictures = []
    panels = [
        list(of_case)
        for _, of_case in groupby(
            sorted(swept, key=lambda sweep: (sweep.case.number, sweep.case.name)),
            key=lambda sweep: sweep.case.name,
        )
    ]
    ending = [panel for panel in panels if any(sweep.end for sweep in panel)]
    for group in dict.fromkeys(panel[0].case.group for panel in ending):
        members = [panel for panel in ending if panel[0].case.group == group]
        path = layout.figure(f"stability-{group}.svg")
        columns = min(3, len(members))
        rows = -(-len(members) // columns)
        width = 3.3 * columns
        with charts.drawing(path, columns, 2.3 * rows, rows=rows, width=width) as axes:
            for index, axis in enumerate(axes):
                if index < len(members):
                    _panel(axis, members[index])
                else:
                    axis.set_visible(False)
            labelled: list[list[str]] = []
            for axis in axes[: len(members)]:
                handles, labels = axis.get_legend_handles_labels()
                if labels not in labelled:
                    labelled.append(labels)
                    axis.legend(handles, labels, fontsize=5, loc="upper left")
        caption = f"Hard cases of {group} that break, or are refused, at some level."
        pictures.append(Picture(f"figures/{path.name}", caption))
    text = [
        (
            "Decades of error over tolerance, from -3 to 3, against hardness: the first wrong digit"
            " is where a line crosses 0. What must hold is left of the dotted line (of the dashed"
            " one for gradients). Solid lines are values, dashed ones gradients; a cross at the top"
            f" is a refusal. {len(panels) - len(ending)} other cases hold at every level."
        ),
    ]
    return Section("Error against hardness", text, figures=pictures)


def _panel(axes: Any, swept: Sequence[Swept]) -> None:
    hard = swept[0].case
    # Where a case has values and gradients, the legend names the values.
    named = swept[0].way.direction
    levels = [outcome.level for outcome in swept[0].outcomes]
    sides = list(dict.fromkeys((s.way.backend, s.way.precision) for s in swept))
    for sweep in swept:
        side = (sweep.way.backend, sweep.way.precision)
        index = sides.index(side)
        forward = sweep.way.direction == "forward"
        # Lines that lie on each other stand side by side.
        x = [0.06 * (index - (len(sides) - 1) / 2) + k for k in range(len(levels))]
        axes.plot(
            x,
            [math.nan if o.refusal else -o.margin for o in sweep.outcomes],
            color=charts.PALETTE[index],
            linestyle="-" if forward else "--",
            marker=charts.MARKERS[index],
            markersize=3 if forward else 2,
            linewidth=1,
            label=" ".join(side) if sweep.way.direction == named else None,
        )
        refused = [place for place, o in zip(x, sweep.outcomes, strict=True) if o.refusal]
        axes.plot(refused, [DECADES] * len(refused), "x", color=charts.PALETTE[index], markersize=5)
    axes.axhline(0, color="black", linewidth=0.7)
    for way in {s.way.direction: s.way for s in swept}.values():
        last = sum(hard.is_required(level, way.direction) for level in levels)
        style = ":" if way.direction == "forward" else "--"
        axes.axvline(last - 0.5, color="black", linewidth=0.7, linestyle=style)
    axes.set_ylim(-DECADES - 0.3, DECADES + 0.3)
    axes.set_yticks([-DECADES, 0, DECADES])
    axes.set_xticks(range(len(levels)), [level_name(v) for v in levels], rotation=40, ha="right")
    axes.tick_params(labelsize=6)
    axes.set_title(f"{hard.number} {hard.name}: {hard.hardness}", loc="left", fontsize=7)


def _every_error(swept: Sequence[Swept]) -> Section:
    """Section on each case, with every error."""
    tables = []
    for name in dict.fromkeys(sweep.case.name for sweep in swept):
        own = [sweep for sweep in swept if sweep.case.name == name]
        tables.append(case_table(own))
    refusals = [
        [f"`{sweep.case.name}`", level_name(outcome.level), outcome.refusal]
        for sweep in {s.case.name: s for s in swept if any(o.refusal for o in s.outcomes)}.values()
        for outcome in [next(o for o in sweep.outcomes if o.refusal)]
    ]
    if refusals:
        columns = ["case", "level", "message"]
        tables.append(Table(columns, refusals, "The first refusal of each case."))
    text = [
        "One row a level; `!` marks a required level that does not hold, `~` a harder one.",
    ]
    return Section("Every hard case", text, tables)


def case_table(swept: Sequence[Swept]) -> Table:
    """The errors of one case, a row a level and a column a way."""
    hard = swept[0].case
    levels = [outcome.level for outcome in swept[0].outcomes]
    rows = []
    for k, level in enumerate(levels):
        rows.append([level_name(level), *(_cell(sweep.outcomes[k]) for sweep in swept)])
    bounds = "; ".join(
        f"{direction} {_tolerance(bound.unit, bound.at(hard.levels[0]))}: {bound.reason}"
        for direction, bound in hard.bounds.items()
    )
    caption = (
        f"{hard.number} `{hard.name}`. Input: {hard.input}. Oracle: {hard.oracle}. Tolerance at"
        f" the first level: {bounds}."
    )
    return Table([hard.hardness, *(sweep.way.name for sweep in swept)], rows, caption, folded=True)


def _cell(outcome: Outcome) -> str:
    if outcome.refusal:
        text = "refused"
    else:
        text = "accepted" if outcome.must_refuse else _error(outcome.error)
    if outcome.verdict == "breaks":
        return f"{text} {'!' if must_hold(outcome) else '~'}"
    return text
