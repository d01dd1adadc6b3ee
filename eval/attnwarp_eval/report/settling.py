"""Measurements that would settle the claims that cannot be told: more scenes or more seeds, and
their cost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean
from typing import Any

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.report.judging import JudgedClaim, count_of
from attnwarp_eval.statistics.planning import MOST_SCENES, effect_interval, scenes_needed
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.splats import is_fitted

HOURS = "hours"


def settling(
    results: Results, judged: Sequence[JudgedClaim], timings: bool = True
) -> list[Section]:
    """The section of the report; none where every claim has a verdict.

    Args:
        timings: whether it says what that would take.
    """
    findings = [
        finding
        for finding in judged
        if finding.verdict == "can't tell" and finding.contrast.deviation > 0
    ]
    if not findings:
        return []
    hours = _hours_a_scene(results) if timings else math.nan
    seeds = any(not math.isnan(finding.parts.share) for finding in findings)
    columns = ["claim", "difference", "scenes", "scenes needed"]
    columns += [HOURS] if math.isfinite(hours) else []
    columns += ["share of seeds"] if seeds else []
    notes = [
        "**Scenes needed**: with so many, a difference would be told in 80 % of studies, were the"
        " true difference and its spread between scenes those seen here. Its test is at the level"
        " that the adjustment for all claims leaves it here. Difference and spread are estimates"
        " from few scenes; the brackets have 80 % of what is compatible with them. A verdict names"
        " fewer where those would rather show that the difference lies within its bound."
    ]
    if math.isfinite(hours):
        notes.append(
            "**Hours** of one worker at the whole study on so many scenes, without timing in turn:"
            f" {number(hours)} a scene, as here."
        )
    if seeds:
        notes.append(
            "**Share of seeds** in the squared spread between scenes: what few seeds add to it,"
            " estimated from how the seeds of one scene differ. The rest is how scenes differ, and"
            " no seed takes that away."
        )
    text = [
        "For each claim that cannot be told in general: what a study of its own would need.",
        "\n".join(f"- {note}" for note in notes),
    ]
    rows = [_row(finding, columns, hours) for finding in findings]
    return [Section("What would settle the rest", text, [Table(columns, rows, timed=(HOURS,))])]


def _row(finding: JudgedClaim, columns: list[str], hours: float) -> list[str]:
    contrast = finding.contrast
    mean, level = contrast.flips.mean, contrast.level(finding.p)
    low, high = effect_interval(mean, contrast.deviation, contrast.scenes)
    # In units of the spread. Where their signs differ, the truth may be 0.
    smallest = 0.0 if low <= 0 <= high else min(abs(low), abs(high))
    likely, fewest, most = (
        scenes_needed(effect, 1.0, level=level)
        for effect in (mean / contrast.deviation, max(abs(low), abs(high)), smallest)
    )
    cells = {
        "claim": finding.claim.text,
        "difference": finding.difference,
        "scenes": str(contrast.scenes),
        "scenes needed": f"{count_of(likely)} ({count_of(fewest)} to {count_of(most)})",
    }
    if likely <= MOST_SCENES:
        cells[HOURS] = number(likely * hours, 2)
    if not math.isnan(finding.parts.share):
        cells["share of seeds"] = f"{100 * finding.parts.share:.0f} %"
    return [cells.get(column, "–") for column in columns]


def _hours_a_scene(results: Results) -> float:
    """Hours of one worker for the cells of a scene whose cells are all done; NaN where there is
    none, or where splats were fitted, whose seconds no cell has.
    """
    scenes: dict[str, list[Record[Any] | None]] = {}
    for cell in results.cells:
        if probe(cell.probe).needs_scenes:  # hard cases are none
            scenes.setdefault(cell.scene, []).append(cell.record)
    done = [
        [record for record in records if record is not None]
        for records in scenes.values()
        if None not in records
    ]
    if not done or any(is_fitted(record.spec) for records in done for record in records):
        return math.nan
    return fmean(sum(map(seconds_of, records)) for records in done) / 3600


def seconds_of(record: Record[Any]) -> float:
    """Seconds of a cell, each counted once: the first view and the others are within the rest, and
    parts of an edit within its whole.
    """
    inner = ("warm", "steady", "method: ") if "whole" in record.cost.seconds else ("warm", "steady")
    return sum(
        seconds or 0.0
        for stage, seconds in record.cost.seconds.items()
        if not stage.startswith(inner)
    )
