"""Tables of variants against a baseline, with paired differences and verdicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.report.claims import Comparison, JudgedClaim, of_comparisons
from attnwarp_eval.report.controls import BLIND, blind
from attnwarp_eval.statistics.intervals import (
    Interval,
    Verdict,
    benjamini_hochberg,
    paired,
    verdict,
)
from attnwarp_eval.study.probe_report import is_mse, mean_values, report_of
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Ablation

POOLED = (
    "PSNR, dB, is the mean over the views of their decibels; equal pictures, of infinite PSNR, are"
    " left out of it as undefined. Pooled PSNR is that of the mean squared error over the views and"
    " scenes, with those of the ends of its interval; equal pictures have error 0."
)

CLAIMED = "†"
"""Stands beside the p-value of a comparison that a claim makes."""


@dataclass(frozen=True)
class Contrast:
    """A variant against the baseline of its table, in one metric.

    Attributes:
        variant, metric: names.
        difference: the variant's minus the baseline's.
        p: adjusted over the table, or over the claims where one makes this comparison.
        claimed: whether one does.
        verdict: None where no direction of the metric is better.
    """

    variant: str
    metric: str
    difference: Interval
    p: float
    claimed: bool
    verdict: Verdict | None


def ablations(results: Results, compared: Sequence[Sequence[Contrast]]) -> list[Section]:
    """A section for each ablation that the study names.

    Args:
        results: of the run.
        compared: of each, from :func:`compared_of`.
    """
    sections = list(map(partial(_section, results), results.study.ablations, compared))
    for section, ablation in zip(sections, results.study.ablations, strict=True):
        if any(map(is_mse, report_of(ablation.probe).columns_at(results.layer).values())):
            section.text.append(POOLED)
            break
    return sections


def _section(results: Results, ablation: Ablation, compared: Sequence[Contrast]) -> Section:
    own, baseline = report_of(ablation.probe), ablation.baseline
    names = [baseline, *[v for v in ablation.variants if v != baseline]]
    section = Section(ablation.title, [ablation.note] if ablation.note else [])
    missing = [name for name in names if not results.records(own.name, name)]
    if missing:
        section.text.append(f"**Not measured:** {', '.join(missing)}.")
    columns = own.columns_at(results.layer)
    # Probes that render nothing for a view count no pairs.
    counted = any("pairs" in results.counters(own.name, name) for name in names)
    rows = []
    for name in names:
        work = results.counters(own.name, name)
        views = sum(len(record.views) for _, _, record in results.records(own.name, name))
        once = results.seconds(own.name, name, own.cost)
        rows.append(
            [
                name,
                *mean_values(results, own.name, name, columns.values()),
                *([number(work["pairs"] / views / 1e6) if views else "–"] if counted else []),
                number(1000 * sum(once.values()) / len(once)) if once else "–",
            ]
        )
    time = f"ms {own.cost_of}, one pass"
    pairs = ["M splat-pixel pairs a view"] if counted else []
    section.tables.append(Table(["variant", *columns, *pairs, time], rows, timed=(time,)))
    section.tables += own.details(results, names)
    if len(names) > 1:
        unseen = {
            metric
            for metric in {
                c.metric for c in compared if c.verdict == "can't tell" and c.difference.views
            }
            if own.probe.edits and blind(results, own.name, metric, baseline)
        }
        section.tables.append(_table(compared, ablation.baseline, unseen))
        if unseen:
            section.text.append(
                f"**{BLIND.capitalize()}:** {', '.join(sorted(unseen))}. Features from the wrong"
                " place did not do worse here, so this study cannot see where features come from"
                f' by these figures; {BLIND!r} stands for "can\'t tell".'
            )
        if any(contrast.claimed for contrast in compared):
            section.text.append(
                f"{CLAIMED} in the table of differences: a claim makes this comparison. p-value and"
                " verdict are the claim's, adjusted over the claims and not over the table."
            )
    return section


def compared_of(results: Results, judged: Sequence[JudgedClaim]) -> list[list[Contrast]]:
    """The :func:`contrasts` of each table of variants of the study.

    Args:
        results: of the run.
        judged: the claims that it has measurements for.
    """
    claimed = of_comparisons(judged)
    return [contrasts(results, ablation, claimed) for ablation in results.study.ablations]


def contrasts(
    results: Results, ablation: Ablation, claimed: Mapping[Comparison, float]
) -> list[Contrast]:
    """Each variant against the baseline, in each metric that its probe tests.

    A comparison has one verdict in a report. So one that a claim makes has the claim's, and is no
    test of this table.

    Args:
        results: of the run.
        ablation: of the study.
        claimed: from :func:`attnwarp_eval.report.claims.of_comparisons`.
    """
    own, baseline = report_of(ablation.probe), ablation.baseline
    pairs = [
        (name, metric.format(layer=results.layer))
        for name in ablation.variants
        if name != baseline
        for metric in own.contrasts
    ]
    differences = [
        paired(results.views(own.name, baseline, metric), results.views(own.name, name, metric))
        for name, metric in pairs
    ]
    of_claims = [claimed.get((own.name, m, frozenset({baseline, n}))) for n, m in pairs]
    adjusted = benjamini_hochberg(
        [
            difference.p if of_claim is None else math.nan
            for difference, of_claim in zip(differences, of_claims, strict=True)
        ]
    )
    rows = []
    for pair, difference, of_table, of_claim in zip(
        pairs, differences, adjusted, of_claims, strict=True
    ):
        specification, judged = own.probe.metric(pair[1]), of_claim is not None
        p = of_table if of_claim is None else of_claim
        outcome: Verdict | None = None
        if specification.direction in ("higher", "lower"):
            # Claims know no tolerance, so a comparison that one makes has none here.
            atol = 0.0 if judged else specification.atol
            outcome = verdict(difference, specification.direction, atol=atol, adjusted_p=p)
        rows.append(Contrast(*pair, difference, p, judged, outcome))
    return rows


def _table(compared: Sequence[Contrast], baseline: str, unseen: Set[str]) -> Table:
    rows = []
    for contrast in compared:
        difference = contrast.difference
        judged: str = contrast.verdict or "–"
        if judged == "can't tell" and contrast.metric in unseen:
            judged = BLIND
        if difference.views == 0:
            judged = "not measured"
        elif difference.mean == difference.low == difference.high == 0:
            judged = "same values"
        rows.append(
            [
                contrast.variant,
                contrast.metric,
                spread(difference),
                judged,
                number(difference.detectable),
                number(contrast.p) + (f" {CLAIMED}" if contrast.claimed else ""),
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
