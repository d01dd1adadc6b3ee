"""Report of hard cases: where the numerics hold, break, or refuse."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.stability import DECADES, Bound, Outcome, level_name
from attnwarp_eval.study.probe_report import Layout, ProbeReport, register_report
from attnwarp_eval.study.probes.stability.measure import Swept, read_sweeps
from attnwarp_eval.study.results import Results

COLUMNS = (
    "#", "case", "direction", "swept", "must hold to", "worst margin up to there", "its error",
    "tolerance", "what ends it", "why",
)  # fmt: skip


@register_report
class StabilityReport(ProbeReport):
    """Verdicts, and every error."""

    name = "stability"
    measures = "hard cases of the numerics"

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """The verdicts, and every error."""
        if swept := read_sweeps(results):
            yield _verdicts(swept)
            yield _every_error(swept)


def verdict_lines(swept: Sequence[Swept]) -> list[str]:
    """A line for each level that must hold and does not."""
    return [
        f"{sweep.case.name} / {sweep.way.name}: {_what_failed(sweep, outcome)}"
        for sweep in swept
        for outcome in sweep.outcomes
        if outcome.verdict == "breaks" and outcome.must_hold
    ]


def _what_failed(sweep: Swept, outcome: Outcome) -> str:
    level = f"{sweep.case.hardness} {level_name(outcome.level)}"
    if outcome.must_refuse:
        return f"accepted at {level}, expected an error"
    if outcome.refusal:
        return f"refused at {level}: {outcome.refusal}"
    tolerance = f"{number(outcome.tolerance, 2)} ({sweep.case.bounds[sweep.way.direction].unit})"
    return f"error {_error(outcome.error)} at {level}, expected at most {tolerance}"


def _error(error: float) -> str:
    return "not finite" if math.isinf(error) else "0" if error == 0 else f"{error:.1e}"


def _tolerance(bound: Bound, tolerance: float) -> str:
    return f"no {bound.unit}" if tolerance == 0.5 else f"{number(tolerance, 2)} {bound.unit}"


def _grouped(swept: Sequence[Swept], directions: bool) -> list[list[Swept]]:
    """Sweeps of one case, and of one direction if directions are shown separately."""
    parts: dict[tuple[str, str], list[Swept]] = {}
    for sweep in swept:
        key = sweep.case.name, sweep.way.direction if directions else ""
        parts.setdefault(key, []).append(sweep)
    return list(parts.values())


def _verdicts(swept: Sequence[Swept]) -> Section:
    failed = verdict_lines(swept)
    names, numbers = ({getattr(s.case, key) for s in swept} for key in ("name", "number"))
    text = [
        (
            f"{len(names)} sweeps of {len(numbers)} hard cases, each by several ways:"
            f" {len(swept)} in all, {sum(len(sweep.outcomes) for sweep in swept)} evaluations. A"
            " case must hold up to its required level; harder ones follow until it breaks. Margin:"
            f" decades between error and tolerance, at most {DECADES:g}; the worst of a case's ways"
            " is shown. No oracle shares code with what it judges."
        ),
        (
            f"**Required levels that do not hold:** {'; '.join(failed)}."
            if failed
            else "Every required level holds."
        ),
    ]
    # Sweeps with a level that does not hold come first.
    parts = sorted(_grouped(swept, directions=True), key=lambda part: not any(s.end for s in part))
    table = Table(list(COLUMNS), [_row(part) for part in parts])
    return Section("Where hard inputs break the numerics", text, [table])


def _row(swept: Sequence[Swept]) -> list[str]:
    hard, direction = swept[0].case, swept[0].way.direction
    outcomes = [outcome for sweep in swept for outcome in sweep.outcomes]
    required = [o for o in outcomes if o.required] or [sweep.outcomes[0] for sweep in swept]
    worst = min(required, key=lambda outcome: (outcome.margin, -outcome.error))
    ends: dict[str, list[str]] = {}
    for sweep in swept:
        if (end := sweep.end) is not None:
            level = f"{'refused' if end.refusal else 'breaks'} at {level_name(end.level)}"
            error = "" if end.refusal else f" ({_error(end.error)})"
            side = f"{sweep.way.backend} {sweep.way.precision}{error}"
            ends.setdefault(level, []).append(side)
    return [
        str(hard.number),
        f"`{hard.name}`: {hard.title}",
        direction,
        hard.hardness,
        level_name(max((o.level for o in required), key=hard.levels.index)),
        number(worst.margin, 2),
        "refused, as it must be" if worst.must_refuse else _error(worst.error),
        _tolerance(hard.bounds[direction], worst.tolerance),
        "; ".join(f"{level}: {', '.join(who)}" for level, who in ends.items()) or "–",
        hard.limit if ends else "–",
    ]


def _every_error(swept: Sequence[Swept]) -> Section:
    """Section on each case: a row a level, a column a way, and the first refusal."""
    text = "One row a level; `!` marks a required level that does not hold, `~` a harder one."
    tables = [_case_table(part) for part in _grouped(swept, directions=False)]
    return Section("Every hard case", [text], tables, folded=True)


def _case_table(swept: Sequence[Swept]) -> Table:
    hard = swept[0].case
    by_level = list(zip(*(sweep.outcomes for sweep in swept), strict=True))
    rows = [[level_name(level[0].level), *map(_cell, level)] for level in by_level]
    bounds = "; ".join(
        f"{direction} {_tolerance(bound, bound.at(hard.levels[0]))}: {bound.reason}"
        for direction, bound in hard.bounds.items()
    )
    caption = (
        f"{hard.number} `{hard.name}`. Input: {hard.input}. Oracle: {hard.oracle}. Tolerance at"
        f" the first level: {bounds}."
    )
    if refusals := [one for level in by_level for o in level if (one := o.refusal)]:
        caption += f" First refusal: {refusals[0]}."
    return Table([hard.hardness, *(s.way.name for s in swept)], rows, caption)


def _cell(outcome: Outcome) -> str:
    text = "accepted" if outcome.must_refuse else _error(outcome.error)
    mark = "" if outcome.verdict != "breaks" else " !" if outcome.must_hold else " ~"
    return f"{'refused' if outcome.refusal else text}{mark}"
