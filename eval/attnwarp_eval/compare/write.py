"""A comparison as a document and as JSON."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict
from typing import Any

from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.compare.judge import Comparison, Row
from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.metrics.registry import METRICS

ORDER = ("worse", "can't tell", "better", "equal")

LONGEST = 50
"""Rows of a table for a terminal or a summary; the JSON has them all."""


def summary(comparison: Comparison) -> str:
    """The outcome in one line.

    Example:
        >>> summary(Comparison("quick", True, 3, (), ()))
        "nothing to compare: 0 worse, 0 can't tell, 0 better, 0 equal; 0 missing or changed"
    """
    counts = Counter[str](row.verdict for row in comparison.rows)
    text = ", ".join(f"{counts[name]} {name}" for name in ORDER)
    if comparison.regressed:
        outcome = "regression"
    else:
        outcome = "nothing to compare" if comparison.too_little else "pass"
    return f"{outcome}: {text}; {len(comparison.faults)} missing or changed"


def document(comparison: Comparison) -> Report:
    """The comparison as a document: faults first, then every verdict but "equal".

    Example:
        >>> document(Comparison("quick", True, 3, (), ())).title
        'Comparison of study quick'
    """
    lead = [f"**{summary(comparison)}**", _method(comparison)]
    if comparison.too_little:
        lead.append(f"Too little to compare: {comparison.too_little}.")
    sections = []
    if comparison.faults:
        rows = [[fault.kind, fault.name, fault.detail] for fault in comparison.faults]
        sections.append(_section("Missing or changed", ["what", "name", "detail"], rows))
    changed = sorted(
        (row for row in comparison.rows if row.verdict != "equal"),
        key=lambda row: ORDER.index(row.verdict),
    )
    if changed:
        columns = ["verdict", "probe", "variant", "metric", "baseline", "run", "difference"]
        rows = [_cells(row) for row in changed]
        sections.append(_section("Figures that changed", [*columns, "worst view"], rows))
    if comparison.added:
        rows = [[name] for name in comparison.added]
        sections.append(_section("Only in the run (take in with --update)", ["name"], rows))
    return Report(f"Comparison of study {comparison.study}", lead, sections)


def as_json(comparison: Comparison) -> dict[str, Any]:
    """Everything, as JSON has it: null where undefined.

    Example:
        >>> as_json(Comparison("quick", True, 3, (), ()))["regressed"]
        False
    """
    return dict(
        without_nan(
            {
                "regressed": comparison.regressed,
                "too_little": comparison.too_little,
                "summary": summary(comparison),
                **asdict(comparison),
            }
        )
    )


def _method(comparison: Comparison) -> str:
    if comparison.exact:
        return (
            "Same seeds on both sides: a view that got worse by more than its metric's margin is a"
            " regression, smaller changes are tested over the scenes. Counters must be the same;"
            ' seconds are not compared. "can\'t tell" is not "equal".'
        )
    return (
        "Other seeds: differences are paired on scene and view and tested over the scenes, with"
        " p-values adjusted for all tests (Benjamini & Hochberg). Counters and seconds are not"
        ' compared. "can\'t tell" is not "equal".'
    )


def _section(title: str, columns: list[str], rows: list[list[str]]) -> Section:
    text = [f"The first {LONGEST} of {len(rows)}."] if len(rows) > LONGEST else []
    return Section(title, text, [Table(columns, rows[:LONGEST])])


def _cells(row: Row) -> list[str]:
    difference = number(row.difference.mean)
    if row.difference.known:
        difference += f" ± {number(row.difference.high - row.difference.mean, 2)}"
    unit = METRICS[row.metric].unit
    worst = ""
    if row.worst is not None:
        name, before, now = row.worst
        worst = f"{name}: {number(before, 4)} -> {number(now, 4)}"
    if row.undefined:
        worst += f" ({row.undefined} views are undefined now)"
    means = [f"{number(value, 4)}" for value in (row.baseline, row.run)]
    if math.isfinite(row.difference.mean):
        difference += f" {unit}"
    return [row.verdict, row.probe, row.variant, row.metric, *means, difference, worst.strip()]
