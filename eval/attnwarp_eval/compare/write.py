"""A comparison as a document, as a page with pictures, and as JSON."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.compare.judge import Comparison, FigureVerdict
from attnwarp_eval.compare.pictures import Change
from attnwarp_eval.document import write
from attnwarp_eval.document.model import Gallery, Picture, Report, Section, Slider, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.metrics.registry import METRICS

ORDER = ("worse", "can't tell", "better", "equal")

COLUMNS = [
    "verdict",
    "probe",
    "variant",
    "metric",
    "baseline",
    "run",
    "difference",
    "worst view",
]

LONGEST = 50
"""Rows of a table for a terminal or a summary; the JSON has them all."""


def summary(comparison: Comparison) -> str:
    """The outcome in one line."""
    counts = Counter[str](row.verdict for row in comparison.rows)
    text = ", ".join(f"{counts[name]} {name}" for name in ORDER)
    if comparison.incomplete:
        outcome = "the run lacks some of the baseline"
    elif comparison.regressed:
        outcome = "regression"
    elif comparison.too_little:
        outcome = f"{'too little' if comparison.rows else 'nothing'} to compare"
    else:
        outcome = "pass"
    if comparison.left_out:
        outcome += " of what both have"
    return f"{outcome}: {text}; {len(comparison.faults)} missing or changed"


def document(comparison: Comparison, notes: Sequence[str] = ()) -> Report:
    """The comparison as a document: faults first, then every verdict except "equal"."""
    lead = [f"**{summary(comparison)}**", *(f"**Note**: {n}." for n in notes), METHOD]
    if comparison.too_little:
        lead.append(f"Too little to compare: {comparison.too_little}.")
    sections = []
    counters = [fault for fault in comparison.faults if fault.kind == "counter"]
    if counters:
        rows = [[fault.name, fault.detail] for fault in counters]
        sections.append(_section("Counts of work that changed", ["count", "detail"], rows))
    if others := [fault for fault in comparison.faults if fault.kind != "counter"]:
        rows = [[fault.kind, fault.name, fault.detail] for fault in others]
        sections.append(_section("Missing or changed", ["what", "name", "detail"], rows))
    changed = sorted(
        (row for row in comparison.rows if row.verdict != "equal"),
        key=lambda row: ORDER.index(row.verdict),
    )
    if changed:
        rows = [_cells(row) for row in changed]
        sections.append(_section("Figures that changed", COLUMNS, rows))
    if comparison.left_out:
        rows = [[name] for name in comparison.left_out]
        sections.append(_section("Left out, as one side alone has it", ["name"], rows))
    if comparison.added:
        rows = [[name] for name in comparison.added]
        sections.append(_section("Only in the run (take in with --update)", ["name"], rows))
    return Report(f"Comparison of study {comparison.study}", lead, sections)


def page(
    comparison: Comparison,
    changes: Sequence[Change],
    why_none: str = "",
    notes: Sequence[str] = (),
) -> str:
    """The comparison as one HTML file, with every figure, and the pictures of the largest changes.

    Args:
        changes: the pictured views that changed, the largest change first.
        why_none: reason for missing pictures if ``changes`` is empty.
        notes: sentences before the verdicts.
    """
    report = document(comparison, notes)
    pictures = Section("Pictures of what changed most", [why_none] if not changes else [HOW])
    if changes:
        pictures.gallery = Gallery([(_sentence(change), _sliders(change)) for change in changes])
    rows = [_cells(row) for row in comparison.rows]
    every = Table(COLUMNS, rows, f"All {len(rows)} figures", folded=True)
    return write.page(
        Report(
            report.title,
            report.lead,
            [pictures, *report.sections, Section("Every figure", [], [every])],
        ),
        Path(),
    )


HOW = (
    "The views whose figures moved by the most margins, the largest first. Left of the handle is"
    " the baseline, right of it the run."
)


def _sentence(change: Change) -> str:
    if math.isfinite(change.margins):
        size = f"{number(change.margins)} margins"
    else:
        size = "defined on one side only"
    return (
        f"**{change.scene}, {change.view}** {change.probe} of {change.variant}: `{change.metric}`"
        f" {number(change.before, 4)} -> {number(change.now, 4)} ({size})"
    )


def _sliders(change: Change) -> list[Slider]:
    return [
        Slider(
            Picture(str(before), f"{content.replace('-', ' ')}, baseline"),
            Picture(str(after), "run"),
        )
        for content, (before, after) in change.pictures.items()
    ]


def as_json(comparison: Comparison, notes: Sequence[str] = ()) -> dict[str, Any]:
    """The whole comparison as JSON: null where undefined."""
    return dict(
        without_nan(
            {
                "regressed": comparison.regressed,
                "too_little": comparison.too_little,
                "summary": summary(comparison),
                **({"notes": list(notes)} if notes else {}),
                **asdict(comparison),
            }
        )
    )


METHOD = (
    "A view that got worse by more than its metric's margin is a regression, smaller changes are"
    " tested over the scenes. Counters must be the same, those behind rounded numbers within 0.1 %;"
    ' seconds are not compared. "can\'t tell" is not "equal".'
)
"""Description of a comparison for a report."""


def _section(title: str, columns: list[str], rows: list[list[str]]) -> Section:
    text = [f"The first {LONGEST} of {len(rows)}."] if len(rows) > LONGEST else []
    return Section(title, text, [Table(columns, rows[:LONGEST])])


def _views(count: int) -> str:
    return "1 view is" if count == 1 else f"{count} views are"


def _cells(row: FigureVerdict) -> list[str]:
    difference = number(row.difference.mean)
    if row.difference.bounded:
        difference += f" ± {number(row.difference.high - row.difference.mean, 2)}"
    unit = METRICS[row.metric].unit
    worst = ""
    if row.worst is not None:
        name, before, now = row.worst
        worst = f"{name}: {number(before, 4)} -> {number(now, 4)}"
    if row.beyond_margin and row.difference.views > 1:
        worst += f" (beyond its margin in {row.beyond_margin} of {row.difference.views} views)"
    if row.undefined:
        worst += f" ({_views(row.undefined)} undefined now)"
    means = [f"{number(value, 4)}" for value in (row.baseline, row.run)]
    if math.isfinite(row.difference.mean):
        difference += f" {unit}"
    return [row.verdict, row.probe, row.variant, row.metric, *means, difference, worst.strip()]
