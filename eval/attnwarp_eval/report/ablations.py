"""Tables of variants against a baseline, with paired differences and verdicts."""

from __future__ import annotations

from typing import Any, Literal

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.statistics.intervals import Interval, benjamini_hochberg, paired, verdict
from attnwarp_eval.study.probes import probe
from attnwarp_eval.study.probes.base import Probe, mean_values
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Ablation


def ablations(results: Results) -> list[Section]:
    """A section for each ablation that the study names."""
    return [_section(results, ablation) for ablation in results.study.ablations]


def _section(results: Results, ablation: Ablation) -> Section:
    own, baseline = probe(ablation.probe), ablation.baseline
    names = [baseline, *[v for v in ablation.variants if v != baseline]]
    section = Section(ablation.title, [ablation.note] if ablation.note else [])
    missing = [name for name in names if not results.records(own.name, name)]
    if missing:
        section.text.append(f"**Not measured:** {', '.join(missing)}.")
    columns = {
        title.format(layer=results.layer): metric.format(layer=results.layer)
        for title, metric in own.columns.items()
    }
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
        section.tables.append(_contrasts(results, own, ablation))
    return section


def contrasts(results: Results, ablation: Ablation) -> list[tuple[str, str, Interval, float]]:
    """(variant, metric, difference from the baseline, p-value adjusted over the table)."""
    own, baseline = probe(ablation.probe), ablation.baseline
    metrics = [metric.format(layer=results.layer) for metric in own.contrasts]
    differences = [
        (
            name,
            metric,
            paired(
                results.views(own.name, baseline, metric), results.views(own.name, name, metric)
            ),
        )
        for name in ablation.variants
        if name != baseline
        for metric in metrics
    ]
    adjusted = benjamini_hochberg([difference.p for _, _, difference in differences])
    return [(*difference, p) for difference, p in zip(differences, adjusted, strict=True)]


def _contrasts(results: Results, own: Probe[Any], ablation: Ablation) -> Table:
    rows = []
    for name, metric, difference, p in contrasts(results, ablation):
        specification = own.metric(metric)
        judged: str = "–"
        if specification.direction in ("higher", "lower"):
            direction: Literal["higher", "lower"] = (
                "higher" if specification.direction == "higher" else "lower"
            )
            judged = verdict(difference, direction, atol=specification.atol, adjusted_p=p)
        if difference.views == 0:
            judged = "not measured"
        elif difference.mean == difference.low == difference.high == 0:
            judged = "same values"
        rows.append(
            [
                name,
                metric,
                spread(difference),
                judged,
                number(difference.detectable),
                number(p),
                f"{difference.scenes}, {difference.views}",
            ]
        )
    columns = [
        "variant",
        "metric",
        "difference",
        "verdict",
        "smallest that would be seen",
        "adjusted p",
        "scenes, views",
    ]
    return Table(
        columns, rows, caption=f"Differences from {ablation.baseline!r}, with verdicts", folded=True
    )
