"""From a run's results to the sections of its report."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any, Literal

from attnwarp_eval.checks import metric as metric_of
from attnwarp_eval.checks.occlusion import by_yaw
from attnwarp_eval.report import figures
from attnwarp_eval.report.claims import judge, load_claims
from attnwarp_eval.report.fits import fits
from attnwarp_eval.report.fronts import fronts
from attnwarp_eval.report.model import Gallery, Picture, Report, Section, Table
from attnwarp_eval.report.pictures import CLASSES, DEPTH_RANGE, EPE_RANGE
from attnwarp_eval.report.results import Results
from attnwarp_eval.statistics import Interval, benjamini_hochberg, interval, paired, verdict

YAW_EDGES = (0, 15, 45, 75, 105, 135, 165, 180)
"""Bins around the yaws 30, 60, ... 150 that studies like to take, with the ends apart."""

WARP_COLUMNS = {
    "EPE, image px": "warp.epe_median",
    "EPE p95": "warp.epe_p95",
    "EPE on 64, layer px": "warp.epe_median_layer.64",
    "within 1 px": "warp.below_1px",
    "feature error, 64": "warp.feature_all_accepted.64",
    "precision": "occlusion.precision",
    "recall": "occlusion.recall",
    "F1": "occlusion.f1",
}
DEPTH_COLUMNS = {
    "AbsRel": "depth.abs_rel",
    "AbsRel inside": "depth.abs_rel.interior",
    "AbsRel at edges": "depth.abs_rel.edge",
    "RMSE": "depth.rmse",
    "median bias inside": "depth.bias_median.interior",
    "delta < 1.01": "depth.delta_1_01",
    "delta < 1.25": "depth.delta_1_25",
    "normal, deg": "depth.normal_median",
}
FIT_COLUMNS = {
    "PSNR, dB": "fit.psnr",
    "SSIM": "fit.ssim",
    "AbsRel": "depth.abs_rel",
    "AbsRel inside": "depth.abs_rel.interior",
    "AbsRel at edges": "depth.abs_rel.edge",
    "median bias inside": "depth.bias_median.interior",
    "delta < 1.01": "depth.delta_1_01",
    "normal, deg": "depth.normal_median",
    "normal inside, deg": "depth.normal_median.interior",
}
COLUMNS = {"warp": WARP_COLUMNS, "depth": DEPTH_COLUMNS, "fit": FIT_COLUMNS}
CONTRASTS = {
    "warp": ["warp.epe_median_layer.64", "warp.feature_all_accepted.64", "occlusion.precision", "occlusion.recall"],
    "depth": ["depth.abs_rel", "depth.abs_rel.interior", "depth.normal_median"],
    "fit": ["fit.psnr", "fit.ssim", "depth.abs_rel", "depth.abs_rel.interior", "depth.normal_median"],
}


def number(value: float | None, digits: int = 3) -> str:
    """A number to ``digits`` significant digits; a dash where it is undefined."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    text = f"{value:.{digits}g}"
    return text if "e" in text else f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"


def spread(value: Interval) -> str:
    """Mean and 95 % interval."""
    if not math.isfinite(value.mean):
        return "–"
    lost = f" ({value.undefined} undefined)" if value.undefined else ""
    if not value.known:
        return number(value.mean) + lost
    return f"{number(value.mean)} ± {number(value.high - value.mean, 2)}{lost}"


def build(results: Results, root: Path, *, timings: bool = True, pictures: bool = True) -> Report:
    """The report's content; figures are written below ``root``/figures.

    Args:
        results: of the run.
        root: the run's folder.
        timings: whether anything measured in seconds or bytes of memory is shown.
        pictures: whether the views' pictures are shown.
    """
    study = results.study
    total = len(results.cells)
    lead = [
        f"Study `{study['name']}`: {results.measured} of {total} cells measured, {len(results.failures)} failed; "
        f"scenes {', '.join(study['scenes'])}; {study['size']} x {study['size']} px; seeds {study['seeds']}.",
        f"Figures are means over {len(study['scenes'])} scenes of means over their views, ± half of the 95 % interval "
        "(Student's t over scenes). Differences are paired on scene and view; verdicts are adjusted for the number of "
        "tests in their table. "
        '"can\'t tell" is not "equal".',
    ]
    sections = [
        _claims(results),
        _calibration(results),
        *_ablations(results),
        *fits(results, root, number, timings=timings),
        *_yaw(results, root),
        *(fronts(results, root, number, spread) if timings else []),
        *(_galleries(results) if pictures else []),
        *_failures(results),
        _how(results, timings),
    ]
    if not timings:
        for section in sections:
            section.tables = [table.without_timings() for table in section.tables]
    return Report(study["title"] or study["name"], lead, sections)


def _mean(results: Results, probe: str, variant: str, metric: str) -> Interval:
    table = results.views(probe, variant, metric)
    return interval({scene: list(values.values()) for scene, values in table.items()})


def _claims(results: Results) -> Section:
    rows = []
    for finding in judge(results, load_claims()):
        if finding.verdict == "not measured":
            continue
        claim = finding.claim
        sides = "; ".join(f"{name}: {spread(value)}" for name, value in finding.sides.items())
        shown = spread(finding.contrast) if len(finding.sides) > 1 else "against 0"
        agree, views = finding.agreement
        rows.append([claim.text, claim.metric, sides, shown, f"{agree} of {views}", finding.here, finding.verdict])
    section = Section("What was expected, and what was seen")
    if not rows:
        section.text = ["Nothing that a claim speaks of was measured."]
        return section
    section.text = [
        "A claim that does not hold on these scenes is a result, not an error. **Here** speaks of these scenes alone: "
        "`seen` when the difference has the expected sign in every scene, with the views that agree beside it. **In "
        "general** speaks of scenes like these, of which a few were drawn, and says `can't tell` when so few cannot "
        "settle it.",
    ]
    columns = ["claim", "metric", "measured", "difference", "views that agree", "here", "in general"]
    section.tables = [Table(columns, rows)]
    return section


def _calibration(results: Results) -> Section:
    study = results.study
    rows = []
    for cell in results.cells:
        if cell["probe"] != "calibration" or cell["record"] is None:
            continue

        def worst(metric: str, pick: Any, record: dict[str, Any] = cell["record"]) -> str:
            values = [v["metrics"].get(metric) for v in record["views"]]
            known = [v for v in values if v is not None]
            undefined = len(values) - len(known)
            return (number(pick(known)) if known else "–") + (f" ({undefined} undefined)" if undefined else "")

        rows.append(
            [
                cell["scene"],
                worst("warp.epe_median", max),
                worst("warp.epe_p95", max),
                worst("occlusion.f1.exact", min),
                worst("occlusion.f1", min),
                *(worst(f"warp.feature_accepted.{size}", max) for size in study["feature_sizes"]),
            ]
        )
    columns = [
        "scene",
        "EPE median, px",
        "EPE p95, px",
        "F1 of the exact mask",
        "F1 of the rules on exact depth",
        *(f"feature error, {size}" for size in study["feature_sizes"]),
    ]
    text = [
        "Before the instrument judges anything it judges itself: the truth's own depth goes through the same warp, "
        "whose endpoint error must be below 1e-3 px in the median, and the exact mask is scored against itself, which "
        "must give F1 = 1. The worst view of each scene is shown. What the rules lose on exact depth, and what "
        "bilinear sampling of a feature field costs at each size, are the floor of everything below.",
    ]
    return Section("Calibration", text, [Table(columns, rows)])


def _ablations(results: Results) -> list[Section]:
    sections = []
    for ablation in results.study["ablations"]:
        probe, baseline = ablation["probe"], ablation["baseline"]
        names = [baseline, *[v for v in ablation["variants"] if v != baseline]]
        names = [n for n in names if results.records(probe, n)]
        if not names:
            continue
        columns = COLUMNS[probe]
        rows = []
        for name in names:
            work = results.counters(probe, name)
            views = sum(len(record["views"]) for _, _, record in results.records(probe, name))
            steady = results.cost(probe, name, "steady")
            rows.append(
                [
                    name,
                    *(spread(_mean(results, probe, name, metric)) for metric in columns.values()),
                    number(work["pairs"] / views / 1e6) if work["pairs"] else "0",
                    number(1000 * sum(steady.values()) / len(steady)) if steady else "–",
                ]
            )
        main = Table(["variant", *columns, "M splat-pixel pairs a view", "ms a view"], rows, timed=("ms a view",))
        section = Section(ablation["title"], [ablation["note"]] if ablation["note"] else [], [main])
        contrasts = _contrasts(results, probe, baseline, names[1:])
        if contrasts.rows:
            section.tables.append(contrasts)
        sections.append(section)
    return sections


def _contrasts(results: Results, probe: str, baseline: str, names: list[str]) -> Table:
    found = []
    for name in names:
        for metric in CONTRASTS[probe]:
            ours, theirs = results.views(probe, name, metric), results.views(probe, baseline, metric)
            found.append((name, metric, paired(theirs, ours)))
    adjusted = benjamini_hochberg([difference.p for _, _, difference in found])
    rows = []
    for (name, metric, difference), p in zip(found, adjusted, strict=True):
        specification = metric_of(metric)
        direction: Literal["higher", "lower"] = "higher" if specification.direction == "higher" else "lower"
        judged: str = verdict(difference, direction, atol=specification.atol, adjusted_p=p)
        if difference.mean == difference.low == difference.high == 0:
            judged = "same values"
        rows.append(
            [name, metric, spread(difference), judged, number(difference.detectable), number(p), str(difference.views)]
        )
    columns = ["variant", "metric", "difference", "verdict", "smallest that would be seen", "adjusted p", "views"]
    return Table(columns, rows, caption=f"Differences from {baseline!r}, with verdicts", folded=True)


def _yaw(results: Results, root: Path) -> list[Section]:
    names = [n for n in results.study["yaw"]["variants"] if results.records("warp", n)]
    if not names:
        return []
    columns = ["variant", *(f"{low}–{high}°" for low, high in itertools.pairwise(YAW_EDGES))]
    rates = {
        "occlusion.false_positive_rate": "Of surface that the source does not show, accepted (false positive rate)",
        "occlusion.false_negative_rate": "Of surface that the source shows, rejected (false negative rate)",
        "occlusion.behind_share": "Of what is accepted, behind the source camera",
        "occlusion.hidden_share": "Of what is accepted, hidden from the source",
    }
    bins = {
        (name, region): by_yaw(results.counts("warp", name, region), YAW_EDGES)
        for name in names
        for region in ("", ".interior", ".edge")
    }
    tables = [
        Table(columns, [[name, *(number(b.scores[metric]) for b in bins[name, ""])] for name in names], caption)
        for metric, caption in rates.items()
    ]
    places = {"": "everywhere", ".interior": "inside surfaces", ".edge": "at edges"}
    for metric in ("precision", "recall", "f1", "false_positive_rate", "false_negative_rate"):
        rows = [
            [name, place, *(number(b.scores[f"occlusion.{metric}"]) for b in bins[name, region])]
            for name in names
            for region, place in places.items()
        ]
        caption = f"{metric.replace('_', ' ').capitalize()}, inside surfaces and at edges apart"
        tables.append(Table([columns[0], "where", *columns[1:]], rows, caption, folded=True))
    rows = [[name, *(number(_accepted(b.counts, "ambiguous")) for b in bins[name, ""])] for name in names]
    tables.append(Table(columns, rows, "Of ambiguous pixels, which are not scored, accepted", folded=True))
    text = [
        "Counts of all scenes' views summed in bins of the yaw between source and target. A dash: nothing to measure, "
        "such as a view in which the source shows nothing at all.",
    ]
    path = root / "figures" / "masks-by-yaw.svg"
    with figures.drawing(path, columns=2) as (left, right):
        for axes, metric, title in (
            (left, "occlusion.false_positive_rate", "unseen surface accepted"),
            (right, "occlusion.false_negative_rate", "visible surface rejected"),
        ):
            series = [figures.Line(name, *_by_yaw(results, name, metric)) for name in names]
            x, y = "yaw from the source, degrees", "share"
            figures.lines(axes, series, x=x, y=y, title=title, share=True, legend=axes is right)
    drawn = Picture(
        "figures/masks-by-yaw.svg", "Both errors of the masks by yaw; means and 95 % intervals over scenes."
    )
    return [Section("Masks by yaw", text, tables, [drawn])]


def _accepted(counts: dict[str, int], label: str) -> float:
    total = counts[f"{label}_accepted"] + counts[f"{label}_rejected"]
    return counts[f"{label}_accepted"] / total if total else math.nan


def _by_yaw(results: Results, variant: str, metric: str) -> tuple[list[float], list[Interval]]:
    yaws = sorted({view["yaw"] for _, _, record in results.records("warp", variant) for view in record["views"]})
    tables = [results.views("warp", variant, metric, (yaw, yaw)) for yaw in yaws]
    return yaws, [interval({s: list(v.values()) for s, v in table.items()}) for table in tables]


def _galleries(results: Results) -> list[Section]:
    shown: dict[tuple[str, str], list[tuple[str, str, dict[str, Any]]]] = {}
    for cell in results.cells:
        for picture in (cell["record"] or {}).get("pictures", []):
            label = "truth's own depth" if cell["probe"] == "calibration" else cell["variants"][0]
            shown.setdefault((cell["scene"], picture["view"]), []).append((cell["probe"], label, picture))
    if not shown:
        return []
    rows: list[tuple[str, list[Picture]]] = []
    for (scene, view), found in shown.items():
        first = [next((p for _, _, p in found if p["what"] == what), None) for what in ("source", "target")]
        rows.append((f"**{scene}, {view}**", [Picture(p["path"], p["what"]) for p in first if p]))
        for label in dict.fromkeys(label for _, label, _ in found):
            own = {p["what"]: p for _, other, p in found if other == label}
            wanted = [what for what in ("warped", "mask", "endpoint-error", "render", "depth-error") if what in own]
            rows.append((label, [Picture(own[what]["path"], what.replace("-", " ")) for what in wanted]))
    legend = "; ".join(f"`{colour}` {name}" for name, (colour, _) in CLASSES.items())
    text = [
        "Warped: the source's own colours as the warp carries them, squares where the mask rejects. "
        f"Mask against truth: {legend}. Endpoint error: dark {EPE_RANGE[0]:g} px to bright {EPE_RANGE[1]:g} px, "
        f"logarithmic, truly visible pixels only. Depth error: blue too near, red too far, full colour at "
        f"{100 * DEPTH_RANGE:g} %.",
    ]
    return [Section("Pictures", text, gallery=Gallery(rows))]


def _failures(results: Results) -> list[Section]:
    if not results.failures:
        return []
    rows = [[f["scene"], f["variant"], f["probe"], f["error"]] for f in results.failures]
    text = ["These cells are missing from every table above. Run the study again to retry them."]
    return [Section("Failed cells", text, [Table(["scene", "variant", "probe", "error"], rows)])]


def _how(results: Results, timings: bool) -> Section:
    used = sorted({name for c in results.cells if c["record"] for v in c["record"]["views"] for name in v["metrics"]})
    names = sorted({".".join(name.split(".")[:2]) for name in used})
    rows = [
        [m.name, m.unit, m.direction, str(m.version), m.description]
        for m in (metric_of(name) for name in names)
        if m.unit != "pixels"
    ]
    text = [
        "Behind a metric's name may stand a region (`interior`, `edge`: within 2 px of a depth or object edge) or the "
        "size of a feature grid. Every value of every view is in `results.jsonl`.",
    ]
    records = [c["record"] for c in results.cells if c["record"]]
    if records:
        environment = records[-1]["environment"]
        versions = ", ".join(f"{k} {v}" for k, v in environment["versions"].items())
        machine = environment["machine"]
        text.append(f"Versions: {versions}. Machine: {machine['system']} {machine['arch']}, {machine['cores']} cores.")
        git = environment["git"]
        if git["sha"]:
            text.append(f"Source revision `{git['sha'][:12]}`{' with local changes' if git['dirty'] else ''}.")
        if timings:
            total = {k: 0.0 for k in ("setup", "truth", "splats", "method", "sample", "checks", "pictures")}
            for record in records:
                for stage in total:
                    total[stage] += record["cost"]["seconds"].get(stage) or 0.0
            peak = max(record["cost"]["peak_memory_mb"] for record in records)
            text.append(
                "Seconds over all cells: "
                + ", ".join(f"{stage} {number(seconds)}" for stage, seconds in total.items())
                + f". Peak memory {peak:.0f} MiB."
            )
    return Section("How it was measured", text, [Table(["metric", "unit", "better", "version", "meaning"], rows)])
