"""Report of hard cases: where the numerics hold, break, or refuse."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.stability import DECADES, Outcome, level_name
from attnwarp_eval.study.probe_report import Layout, Place, ProbeReport, register_report
from attnwarp_eval.study.probes.stability.measure import Swept, must_hold, read_sweeps
from attnwarp_eval.study.results import Results


@register_report
class StabilityReport(ProbeReport):
    """Verdicts, and every error."""

    name = "stability"
    measures = "hard cases of the numerics"

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """The verdicts, and every error."""
        swept = read_sweeps(results)
        if not swept:
            return
        yield Place.RESULT, _verdicts(swept)
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
    parts: dict[tuple[str, str], list[Swept]] = {}
    for sweep in swept:
        parts.setdefault((sweep.case.name, sweep.way.direction), []).append(sweep)
    # Those that end somewhere come first.
    ordered = sorted(parts.values(), key=lambda part: not any(sweep.end for sweep in part))
    columns = [
        "#", "case", "direction", "swept", "must hold to", "worst margin up to there", "its error",
        "tolerance", "what ends it", "why",
    ]  # fmt: skip
    table = Table(columns, [_row(part) for part in ordered])
    return Section("Where hard inputs break the numerics", text, [table])


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
        "; ".join(f"{level}: {', '.join(who)}" for level, who in ends.items()) or "–",
        hard.limit if ends else "–",
    ]


def _tolerance(unit: str, tolerance: float) -> str:
    return f"no {unit}" if tolerance == 0.5 else f"{number(tolerance, 2)} {unit}"


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
