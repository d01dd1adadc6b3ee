"""Tables of variants against a baseline, with paired differences and verdicts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from attnwarp_eval.document.model import Marked, Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, note, number, pooled, spread
from attnwarp_eval.report.compared import detectable_text, differences_of
from attnwarp_eval.report.controls import UNCONTROLLED, outcomes_of
from attnwarp_eval.report.judging import Comparison, judged
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import ProbeReport, mean_values, report_of
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Ablation

POOLED = (
    "PSNR, dB, is the mean over the views of their decibels; equal pictures, of infinite PSNR, are"
    " left out of it as undefined. Pooled PSNR is that of the mean squared error over the views and"
    " scenes, with those of the ends of its interval; equal pictures have error 0."
)

MOST_LINES = 50
"""Largest number of lines of short tables on a page; the tables after them are folded."""

CLAIMED = "†"
"""Mark of a p-value that belongs to a claim."""


def differences(results: Results, compared: Sequence[Sequence[Comparison]]) -> list[Section]:
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
    metrics = own.contrasts_at(results.layer) or columns.values()
    return {titles.get(metric, metric): metric for metric in metrics}


def _main(results: Results, ablation: Ablation, compared: Sequence[Comparison]) -> Table:
    """Means of the main figures with their verdicts. What all means of a column lack stands in its
    head.
    """
    report, count = report_of(ablation.probe), len(results.study.scenes)
    verdicts = {
        (one.b, one.metric): one
        for one in compared
        if one.contrast.scenes >= FEWEST_SCENES
        and any(one.contrast.by_scene.values())
        and one.word != "can't tell"
    }
    names, columns = _names(ablation), {"variant": _names(ablation)}
    for title, metric in main_columns(report, results).items():
        means = [results.mean(report.name, name, metric) for name in names]
        if not any(mean.views for mean in means):
            continue
        notes = [note(mean, count) * bool(mean.views) for mean in means]
        if len(set(notes)) == 1:
            title, notes = title + notes[0], [""] * len(notes)
        else:
            few = [bool(mean.views) and mean.scenes < count for mean in means]
            notes = [f" ({m.scenes} scenes)" * f for m, f in zip(means, few, strict=True)]
        shown = pooled if report.probe.metric(metric).squared else spread
        columns[title] = [
            _with_verdict(f"{shown(replace(mean, undefined=0))}{of}", verdicts.get((name, metric)))
            for name, mean, of in zip(names, means, notes, strict=True)
        ]
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    return Table(list(columns), rows, ablation.title)


def _with_verdict(text: str, one: Comparison | None) -> str:
    if one is None or not one.verdict:
        return text
    text = f"{text} {one.verdict}"
    return Marked(text, one.word) if one.word in ("better", "worse") else text


def in_detail(results: Results, compared: Sequence[Sequence[Comparison]]) -> list[Section]:
    """Folded sections, one for each ablation of the study."""
    tables = zip(_tabled(results), compared, strict=True)
    return [_section(own, ablation, rows) for (own, ablation), rows in tables]


def _section(results: Results, ablation: Ablation, compared: Sequence[Comparison]) -> Section:
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
        if any(one.claim is not None for one in compared):
            section.text.append(
                f"{CLAIMED} in the table of differences: a claim makes this comparison. p-value and"
                " verdict are the claim's, adjusted over the claims and not over the table."
            )
    return section


def compared_of(results: Results, claims: Sequence[Comparison]) -> list[list[Comparison]]:
    """Comparisons of each table of variants of the study.

    A comparison has one verdict in a report. So one that a claim makes over all views takes the
    claim's, and is not a test of its table.

    Args:
        claims: the judged claims of the run.
    """
    claimed = {
        (one.probe, one.metric, frozenset((one.a, one.b))): one
        for one in claims
        if one.claim is not None and one.claim.yaw is None and one.word != "not finished"
    }
    return [
        judged(_comparisons(of, ablation, claimed if of is results else {}))
        for of, ablation in _tabled(results)
    ]


def _comparisons(
    results: Results,
    ablation: Ablation,
    claimed: Mapping[tuple[str, str, frozenset[str]], Comparison],
) -> Iterator[Comparison]:
    """Each variant against the baseline, in each metric that the probe tests."""
    name, baseline = ablation.probe, ablation.baseline
    outcomes = outcomes_of(results, name, baseline)
    for variant, metric, value in differences_of(results, ablation):
        better = probe(name).metric(metric).direction
        direction = better if better in ("higher", "lower") else None
        outcome = outcomes.get(metric, UNCONTROLLED)
        one = Comparison(name, metric, baseline, variant, value, direction, outcome)
        claim = claimed.get((name, metric, frozenset((baseline, variant))))
        if claim is not None and direction is not None:
            word = claim.word
            if word in ("better", "worse"):  # of what the claim expects
                word = value.verdict(direction, adjusted_p=claim.p)
            one = replace(one, claim=claim.claim, p=claim.p, word=word)
        yield one


def _table(compared: Sequence[Comparison], baseline: str) -> Table:
    rows = []
    for one in compared:
        verdict = one.verdict or "–"
        if one.contrast.views == 0:
            verdict = "not measured"
        elif not any(one.contrast.by_scene.values()):
            verdict = "same values"
        rows.append(
            [
                one.b,
                one.metric,
                one.difference,
                verdict,
                detectable_text(one.contrast),
                number(one.p) + (f" {CLAIMED}" if one.claim is not None else ""),
                f"{one.contrast.scenes}, {one.contrast.views}",
                number(one.contrast.student.p),
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
        "p by Student's t",
    ]
    return Table(columns, rows, f"Differences from {baseline!r}, with verdicts")
