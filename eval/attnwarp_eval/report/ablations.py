"""Tables of variants against a baseline, with paired differences and verdicts."""

from __future__ import annotations

from typing import Any, Literal

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.metrics.registry import metric as metric_of
from attnwarp_eval.report.results import Results
from attnwarp_eval.report.words import mean_of, number, spread
from attnwarp_eval.statistics.intervals import benjamini_hochberg, paired, verdict

COLUMNS = {
    "warp": {
        "EPE, image px": "warp.epe_median",
        "EPE p95": "warp.epe_p95",
        "EPE on {layer}, layer px": "warp.epe_median_layer.{layer}",
        "within 1 px": "warp.below_1px",
        "feature error, {layer}": "warp.feature_all_accepted.{layer}",
        "precision": "occlusion.precision",
        "recall": "occlusion.recall",
        "F1": "occlusion.f1",
    },
    "depth": {
        "AbsRel": "depth.abs_rel",
        "RMSE": "depth.rmse",
        "bias": "depth.bias_relative",
        "median bias inside": "depth.bias_median.interior",
        "delta < 1.01": "depth.delta_1_01",
        "delta < 1.25": "depth.delta_1_25",
        "normal, deg": "depth.normal_median",
    },
    "fit": {
        "PSNR, dB": "fit.psnr",
        "SSIM": "fit.ssim",
        "AbsRel": "depth.abs_rel",
        "AbsRel inside": "depth.abs_rel.interior",
        "AbsRel at edges": "depth.abs_rel.edge",
        "median bias inside": "depth.bias_median.interior",
        "delta < 1.01": "depth.delta_1_01",
        "normal, deg": "depth.normal_median",
        "normal inside, deg": "depth.normal_median.interior",
    },
}
"""What the main table of each probe shows."""

PLACES = [
    "depth.abs_rel",
    "depth.rmse",
    "depth.bias_relative",
    "depth.delta_1_01",
    "depth.delta_1_25",
    "depth.normal_median",
]
"""What is shown inside surfaces and at edges apart."""

CONTRASTS = {
    "warp": [
        "warp.epe_median_layer.{layer}",
        "warp.feature_all_accepted.{layer}",
        "occlusion.precision",
        "occlusion.recall",
    ],
    "depth": [
        "depth.abs_rel",
        "depth.abs_rel.interior",
        "depth.bias_median.interior",
        "depth.normal_median",
    ],
    "fit": [
        "fit.psnr",
        "fit.ssim",
        "depth.abs_rel",
        "depth.abs_rel.interior",
        "depth.normal_median",
    ],
}
"""What a variant's difference from the baseline is tested in."""

ONCE = "ms a view, one pass"


def ablations(results: Results) -> list[Section]:
    """A section for each ablation that the study names."""
    return [_section(results, ablation) for ablation in results.study["ablations"]]


def _section(results: Results, ablation: dict[str, Any]) -> Section:
    probe, baseline = ablation["probe"], ablation["baseline"]
    names = [baseline, *[v for v in ablation["variants"] if v != baseline]]
    section = Section(ablation["title"], [ablation["note"]] if ablation["note"] else [])
    missing = [name for name in names if not results.records(probe, name)]
    if missing:
        section.text.append(f"**Not measured:** {', '.join(missing)}.")
    columns = {
        k.format(layer=results.layer): v.format(layer=results.layer)
        for k, v in COLUMNS[probe].items()
    }
    rows = []
    for name in names:
        work = results.counters(probe, name)
        views = sum(len(record["views"]) for _, _, record in results.records(probe, name))
        steady = results.cost(probe, name, "steady")
        rows.append(
            [
                name,
                *_figures(results, probe, name, list(columns.values())),
                number(work["pairs"] / views / 1e6) if views else "–",
                number(1000 * sum(steady.values()) / len(steady)) if steady else "–",
            ]
        )
    section.tables.append(
        Table(["variant", *columns, "M splat-pixel pairs a view", ONCE], rows, timed=(ONCE,))
    )
    section.tables += _more(results, probe, names)
    if len(names) > 1:
        section.tables.append(_contrasts(results, probe, baseline, names[1:]))
    return section


def _figures(results: Results, probe: str, name: str, metrics: list[str]) -> list[str]:
    scenes = len(results.study["scenes"])
    return [spread(mean_of(results, probe, name, metric), scenes) for metric in metrics]


def _more(results: Results, probe: str, names: list[str]) -> list[Table]:
    """What does not fit into the main table, folded."""
    if probe == "depth":
        wanted = {"inside surfaces": "interior", "at edges": "edge"}
        columns = ["variant", "where", *(metric.removeprefix("depth.") for metric in PLACES)]
        rows = [
            [
                name,
                place,
                *_figures(results, probe, name, [f"{metric}.{region}" for metric in PLACES]),
            ]
            for name in names
            for place, region in wanted.items()
        ]
        return [Table(columns, rows, "Inside surfaces and at edges apart", folded=True)]
    if probe != "warp":
        return []
    sizes = results.study["feature_sizes"]
    kinds = {
        "all that is accepted": "warp.feature_all_accepted",
        "accepted and truly visible": "warp.feature_accepted",
        "and inside surfaces": "warp.feature_accepted.interior",
    }
    rows = [
        [name, kind, *_figures(results, probe, name, [f"{metric}.{size}" for size in sizes])]
        for name in names
        for kind, metric in kinds.items()
    ]
    caption = "Feature error by grid size (the floor stands under Calibration)"
    return [Table(["variant", "over", *map(str, sizes)], rows, caption, folded=True)]


def _contrasts(results: Results, probe: str, baseline: str, names: list[str]) -> Table:
    metrics = [metric.format(layer=results.layer) for metric in CONTRASTS[probe]]
    found = [
        (
            name,
            metric,
            paired(results.views(probe, baseline, metric), results.views(probe, name, metric)),
        )
        for name in names
        for metric in metrics
    ]
    adjusted = benjamini_hochberg([difference.p for _, _, difference in found])
    rows = []
    for (name, metric, difference), p in zip(found, adjusted, strict=True):
        specification = metric_of(metric)
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
        found_in = f"{difference.scenes}, {difference.views}"
        rows.append(
            [
                name,
                metric,
                spread(difference),
                judged,
                number(difference.detectable),
                number(p),
                found_in,
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
        columns, rows, caption=f"Differences from {baseline!r}, with verdicts", folded=True
    )
