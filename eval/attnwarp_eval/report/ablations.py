"""Tables of variants against a baseline, with paired differences and verdicts."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, number
from attnwarp_eval.metrics.registry import Metric
from attnwarp_eval.report.compared import between, detectable_text, difference_text, no_verdict
from attnwarp_eval.report.controls import BLIND, blind
from attnwarp_eval.report.judging import Comparison, JudgedClaim, of_comparisons
from attnwarp_eval.statistics.contrasts import EQUAL_LEVEL, Contrast
from attnwarp_eval.statistics.intervals import benjamini_hochberg
from attnwarp_eval.study.probe_report import ProbeReport, mean_values, report_of
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Ablation

POOLED = (
    "PSNR, dB, is the mean over the views of their decibels; equal pictures, of infinite PSNR, are"
    " left out of it as undefined. Pooled PSNR is that of the mean squared error over the views and"
    " scenes, with those of the ends of its interval; equal pictures have error 0."
)

NOTE = re.compile(r" \((?:\d+ undefined)?(?:, )?(?:(\d+) of \d+ scenes)?\)$")
"""Note behind a mean: values and scenes that are missing."""

MOST_LINES = 50
"""Largest number of lines of short tables on a page; the tables after them are folded."""

CLAIMED = "†"
"""Mark of a p-value that belongs to a claim."""


@dataclass(frozen=True)
class Row:
    """Comparison of a variant with the baseline of its table, in one metric.

    Attributes:
        variant, metric: names of the variant and the metric.
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
    def short(self) -> str:
        """The verdict, if it tells something."""
        few = self.difference.scenes < FEWEST_SCENES or not any(self.difference.by_scene.values())
        return "" if few or self.verdict == "can't tell" else self.verdict

    @property
    def outcome(self) -> str:
        """The verdict; for fewer than six scenes, the number of scenes that agree."""
        few = self.verdict and self.difference.scenes < FEWEST_SCENES
        return no_verdict(self.difference) if few else self.verdict


def differences(results: Results, compared: Sequence[Sequence[Row]]) -> list[Section]:
    """The section with one short table for each ablation of the study; none without any."""
    if not compared:
        return []
    section, lines = Section("Differences"), 0
    for (own, ablation), rows in zip(_tabled(results), compared, strict=True):
        names = _names(ablation)
        table = _main(own, ablation, rows)
        lines += len(table.rows) + 5
        table.folded = lines > MOST_LINES
        section.tables.append(table)
        missing = [n for n in names if not own.records(ablation.probe, n)]
        if missing:
            section.text.append(f"**{ablation.title}: not measured: {', '.join(missing)}.**")
        section.text += [f"{ablation.title}: {ablation.note}"] if ablation.note else []
    if len(results.study.scenes) >= FEWEST_SCENES:
        section.text.insert(
            0,
            "Behind a mean and its 95 % interval stands the verdict on its difference from the"
            " table's first row, paired on scene and view: `better`, `worse`, `equal`, `blind` if"
            " features from a wrong place do as well, or nothing if it can't be told. Flipped signs"
            " of the scenes decide, adjusted over a table, or over the claims. In brackets: the"
            " scenes that have a value, if not all.",
        )
    if folded := [table.caption for table in section.tables if table.folded]:
        section.text.append(f"Folded, as they would not fit on a page: {'; '.join(folded)}.")
    return [section]


def glossary(results: Results) -> str:
    """Meaning of the columns of all short tables; empty without any."""
    meanings = {
        title: own.probe.metric(key)
        for own in (report_of(ablation.probe) for ablation in results.study.ablations)
        for title, key in main_columns(own, results).items()
    }
    return "; ".join(
        f"**{title}**: {m.description}"
        + f" ({m.direction} is better)" * (m.direction in ("higher", "lower"))
        for title, m in meanings.items()
    )


def _tabled(results: Results) -> list[tuple[Results, Ablation]]:
    """Each table of the study, once for each of its edits, with the results that it is of."""
    return [
        (own, ablation.model_copy(update={"title": f"{ablation.title}{name and ': '}{name}"}))
        for ablation in results.study.ablations
        for name, own in results.by_edit(ablation.probe).items()
    ]


def _names(ablation: Ablation) -> list[str]:
    return [ablation.baseline, *[v for v in ablation.variants if v != ablation.baseline]]


def main_columns(own: ProbeReport, results: Results) -> dict[str, str]:
    """Columns of a short table, title -> metric: those in which variants are compared."""
    columns = own.columns_at(results.layer)
    titles = {metric: title for title, metric in columns.items()}
    metrics = [metric.format(layer=results.layer) for metric in own.contrasts]
    return {titles.get(metric, metric): metric for metric in metrics or columns.values()}


def _main(results: Results, ablation: Ablation, compared: Sequence[Row]) -> Table:
    own = report_of(ablation.probe)
    columns = main_columns(own, results)
    told = {(row.variant, row.metric): row.short for row in compared}
    names, table = _names(ablation), {"variant": _names(ablation)}
    for title, metric in columns.items():
        means = [mean_values(results, own.name, name, [metric])[0] for name in names]
        if set(means) == {"–"}:
            continue
        if len(notes := {(NOTE.search(mean) or [""])[0] for mean in means}) == 1:
            title += notes.pop()
            means = [NOTE.sub("", mean) for mean in means]
        means = [NOTE.sub(lambda m: f" ({m[1]} scenes)" if m[1] else "", mean) for mean in means]
        words = (told.get((name, metric), "") for name in names)
        table[title] = [f"{mean} {word}".strip() for mean, word in zip(means, words, strict=True)]
    cells = [list(row) for row in zip(*table.values(), strict=True)]
    return Table(list(table), cells, ablation.title)


def in_detail(results: Results, compared: Sequence[Sequence[Row]]) -> list[Section]:
    """Folded sections, one for each ablation of the study."""
    tables = zip(_tabled(results), compared, strict=True)
    return [_section(own, ablation, rows) for (own, ablation), rows in tables]


def _section(results: Results, ablation: Ablation, compared: Sequence[Row]) -> Section:
    own, names = report_of(ablation.probe), _names(ablation)
    section = Section(f"In detail: {ablation.title}", folded=True)
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
    if any(own.probe.metric(m).squared for m in columns.values()):
        section.text.append(POOLED)
    if len(names) > 1:
        section.tables.append(_table(compared, ablation.baseline))
        if any(row.claim is not None for row in compared):
            section.text.append(
                f"{CLAIMED} in the table of differences: a claim makes this comparison. p-value and"
                " verdict are the claim's, adjusted over the claims and not over the table."
            )
    return section


def compared_of(results: Results, judged: Sequence[JudgedClaim]) -> list[list[Row]]:
    """Rows of each table of variants of the study, from :func:`rows_of`."""
    claimed = of_comparisons(judged)
    return [
        rows_of(own, ablation, claimed if own is results else {})
        for own, ablation in _tabled(results)
    ]


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

    @cache
    def unseen(metric: str) -> bool:
        return own.probe.edits and blind(results, own.name, metric, baseline)

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
            if outcome == "can't tell" and unseen(pair[1]):
                outcome = BLIND
        rows.append(Row(*pair, specification, difference, p, claim, outcome))
    return rows


def _table(compared: Sequence[Row], baseline: str) -> Table:
    rows = []
    for row in compared:
        difference = row.difference
        judged = row.outcome or "–"
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
    return Table(columns, rows, f"Differences from {baseline!r}, with verdicts")
