"""Tables of variants against a baseline, with paired differences and verdicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, number
from attnwarp_eval.metrics.registry import Metric
from attnwarp_eval.report.compared import between, detectable_text, difference_text, no_verdict
from attnwarp_eval.report.controls import BLIND, blind
from attnwarp_eval.report.judging import Comparison, JudgedClaim, of_comparisons
from attnwarp_eval.statistics.contrasts import EQUAL_LEVEL, Contrast
from attnwarp_eval.statistics.intervals import benjamini_hochberg
from attnwarp_eval.study.probe_report import mean_values, report_of
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Ablation

POOLED = (
    "PSNR, dB, is the mean over the views of their decibels; equal pictures, of infinite PSNR, are"
    " left out of it as undefined. Pooled PSNR is that of the mean squared error over the views and"
    " scenes, with those of the ends of its interval; equal pictures have error 0."
)

CLAIMED = "†"
"""Mark of a p-value that belongs to a claim."""


@dataclass(frozen=True)
class Row:
    """Comparison of a variant with the baseline of its table, in one metric.

    Attributes:
        variant, metric: names of the variant and the metric.
        specification: specification of the metric.
        difference: difference of the variant from the baseline.
        p: p-value adjusted over the table, or over the claims if a claim makes this comparison.
        claim: claim that makes this comparison, if any.
        verdict: verdict; empty if no direction of the metric is better.
    """

    variant: str
    metric: str
    specification: Metric
    difference: Contrast
    p: float
    claim: JudgedClaim | None
    verdict: str

    @property
    def text(self) -> str:
        """The difference, with the interval of the verdict's level."""
        level = EQUAL_LEVEL if self.verdict == "equal" else self.difference.level(self.p)
        return difference_text(self.difference, self.specification.unit, level)

    @property
    def outcome(self) -> str:
        """The verdict; for fewer than six scenes, the number of scenes that agree."""
        few = self.verdict and self.difference.scenes < FEWEST_SCENES
        return no_verdict(self.difference) if few else self.verdict


def ablations(results: Results, compared: Sequence[Sequence[Row]]) -> list[Section]:
    """Sections, one for each ablation of the study."""
    sections = list(map(partial(_section, results), results.study.ablations, compared))
    for section, ablation in zip(sections, results.study.ablations, strict=True):
        own = report_of(ablation.probe)
        if any(own.probe.metric(m).squared for m in own.columns_at(results.layer).values()):
            section.text.append(POOLED)
            break
    return sections


def _section(results: Results, ablation: Ablation, compared: Sequence[Row]) -> Section:
    own, baseline = report_of(ablation.probe), ablation.baseline
    names = [baseline, *[v for v in ablation.variants if v != baseline]]
    section = Section(ablation.title, [ablation.note] if ablation.note else [])
    missing = [name for name in names if not results.records(own.name, name)]
    if missing:
        section.text.append(f"**Not measured:** {', '.join(missing)}.")
    columns = own.columns_at(results.layer)
    # A probe without renders has no counts of pairs.
    counted = any("pairs" in results.counters(own.name, name) for name in names)
    rows = []
    for name in names:
        work = results.counters(own.name, name)
        views = sum(len(record.views) for _, _, record in results.records(own.name, name))
        once = results.usual_seconds(own.name, name, own.cost)
        rows.append(
            [
                name,
                *mean_values(results, own.name, name, columns.values()),
                *([number(work["pairs"] / views / 1e6) if views else "–"] if counted else []),
                number(1000 * once) if math.isfinite(once) else "–",
            ]
        )
    time = f"ms {own.cost_of}, one pass"
    pairs = ["M splat-pixel pairs a view"] if counted else []
    section.tables.append(Table(["variant", *columns, *pairs, time], rows, timed=(time,)))
    section.tables += own.details(results, names)
    if len(names) > 1:
        untold = {r.metric for r in compared if r.outcome == "can't tell"}
        unseen = {m for m in untold if own.probe.edits and blind(results, own.name, m, baseline)}
        section.tables.append(_table(compared, ablation.baseline, unseen))
        if unseen:
            section.text.append(
                f"**{BLIND.capitalize()}:** {', '.join(sorted(unseen))}. Features from the wrong"
                " place did not do worse here, so this study cannot see where features come from"
                f' by these figures; {BLIND!r} stands for "can\'t tell".'
            )
        if any(row.claim is not None for row in compared):
            section.text.append(
                f"{CLAIMED} in the table of differences: a claim makes this comparison. p-value and"
                " verdict are the claim's, adjusted over the claims and not over the table."
            )
    return section


def compared_of(results: Results, judged: Sequence[JudgedClaim]) -> list[list[Row]]:
    """Rows of each table of variants of the study, from :func:`rows_of`."""
    claimed = of_comparisons(judged)
    return [rows_of(results, ablation, claimed) for ablation in results.study.ablations]


def rows_of(
    results: Results, ablation: Ablation, claimed: Mapping[Comparison, JudgedClaim]
) -> list[Row]:
    """Rows of each variant against the baseline, in each metric that its probe tests.

    A comparison has one verdict in a report. So a comparison that a claim judges takes the claim's
    verdict, and is not a test of this table.

    Args:
        claimed: result of :func:`attnwarp_eval.report.judging.of_comparisons`.
    """
    own, baseline = report_of(ablation.probe), ablation.baseline
    pairs = [
        (name, metric.format(layer=results.layer))
        for name in ablation.variants
        if name != baseline
        for metric in own.contrasts
    ]
    differences = [between(results, own.name, baseline, *pair) for pair in pairs]
    of_claims = [claimed.get((own.name, m, frozenset({baseline, n}))) for n, m in pairs]
    adjusted = benjamini_hochberg(
        [
            difference.flips.p if claim is None else math.nan
            for difference, claim in zip(differences, of_claims, strict=True)
        ]
    )
    rows = []
    for pair, difference, of_table, claim in zip(
        pairs, differences, adjusted, of_claims, strict=True
    ):
        specification = own.probe.metric(pair[1])
        p = of_table if claim is None else claim.p
        outcome = ""
        if claim is not None and claim.verdict in ("blind", "equal"):
            outcome = claim.verdict
        elif specification.direction in ("higher", "lower"):
            outcome = difference.verdict(specification.direction, adjusted_p=p)
        rows.append(Row(*pair, specification, difference, p, claim, outcome))
    return rows


def _table(compared: Sequence[Row], baseline: str, unseen: Set[str]) -> Table:
    rows = []
    for row in compared:
        difference = row.difference
        judged = row.outcome or "–"
        if judged == "can't tell" and row.metric in unseen:
            judged = BLIND
        if difference.views == 0:
            judged = "not measured"
        elif not any(difference.by_scene.values()):
            judged = "same values"
        rows.append(
            [
                row.variant,
                row.metric,
                row.text,
                judged,
                detectable_text(difference),
                number(row.p) + (f" {CLAIMED}" if row.claim is not None else ""),
                f"{difference.scenes}, {difference.views}",
            ]
        )
    columns = [
        "variant",
        "metric",
        "difference",
        "verdict",
        "smallest that one test alone would see",
        "adjusted p",
        "scenes, views",
    ]
    return Table(
        columns, rows, caption=f"Differences from {baseline!r}, with verdicts", folded=True
    )
