"""What would settle the claims that cannot be told: more scenes or more seeds, and their cost."""

from __future__ import annotations

import math

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.report.claims import JudgedClaim, judge, load_claims
from attnwarp_eval.statistics.planning import MOST_SCENES, effect_interval, scenes_needed
from attnwarp_eval.study.results import Results

HOURS = "hours"


def settling(results: Results, timings: bool = True) -> list[Section]:
    """The section of the report; none where every claim has a verdict.

    Args:
        results: of the run.
        timings: whether it says what that would take.
    """
    findings = [
        finding
        for finding in judge(results, load_claims())
        if finding.verdict == "can't tell" and finding.parts and finding.parts.scenes > 0
    ]
    if not findings:
        return []
    hours = _hours_a_scene(results)
    rows = [_row(finding, hours) for finding in findings]
    seeds = any(not math.isnan(finding.parts.share) for finding in findings if finding.parts)
    columns = ["claim", "difference", "scenes", "scenes needed", HOURS]
    columns += ["share of seeds", "± with as many seeds again"] if seeds else []
    text = [
        "For each claim that cannot be told in general: what a study of its own would need.",
        (
            "- **Scenes needed**: with so many, one test at 5 % would tell in 80 % of studies, were"
            " the true difference and its spread between scenes those seen here. Both are estimates"
            " from few scenes; the brackets have 80 % of what is compatible with them. The"
            " adjustment for several claims asks for more."
        ),
    ]
    if timings:
        text[1] += (
            f"\n- **Hours** of one worker at the whole study on so many scenes, {number(hours)} a"
            " scene as here."
        )
    if seeds:
        text[1] += (
            "\n- **Share of seeds** in the squared spread between scenes: what few seeds add to it,"
            " estimated from how the seeds of one scene differ. The rest is how scenes differ, and"
            " no seed takes that away.\n"
            "- **± with as many seeds again**: what half of the interval would then be, on the same"
            " scenes."
        )
    return [Section("What would settle the rest", text, [Table(columns, rows, timed=(HOURS,))])]


def _row(finding: JudgedClaim, hours: float) -> list[str]:
    parts, contrast = finding.parts, finding.contrast
    assert parts is not None
    low, high = effect_interval(contrast.mean, parts.scenes, contrast.scenes)
    # In units of the spread. Where their signs differ, the truth may be 0.
    smallest = 0.0 if low <= 0 <= high else min(abs(low), abs(high))
    likely = scenes_needed(contrast.mean, parts.scenes)
    fewest, most = (scenes_needed(e, 1.0) for e in (max(abs(low), abs(high)), smallest))
    row = [
        finding.claim.text,
        spread(contrast),
        str(contrast.scenes),
        f"{_count(likely)} ({_count(fewest)} to {_count(most)})",
        "–" if likely > MOST_SCENES else number(likely * hours, 2),
    ]
    if not math.isnan(parts.share):
        half = contrast.high - contrast.mean
        narrower = parts.with_seeds(2 * parts.seeds) / parts.scenes
        row += [f"{100 * parts.share:.0f} %", number(half * narrower, 2)]
    return row


def _count(scenes: int) -> str:
    return f"over {MOST_SCENES}" if scenes > MOST_SCENES else str(scenes)


PARTS_OF_OTHERS = ("warm", "steady", "method: ")
"""Stages that others contain begin so."""


def _hours_a_scene(results: Results) -> float:
    """Of one worker, at all cells of a scene but for timing in turn."""
    seconds = sum(
        value or 0.0
        for record in results.all_records()
        for stage, value in record.cost.seconds.items()
        if not stage.startswith(PARTS_OF_OTHERS)
    )
    return seconds / 3600 / len(results.study.scenes)
