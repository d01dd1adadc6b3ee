"""From a run's results to the sections of its report."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

from attnwarp_eval.document import figures
from attnwarp_eval.document.model import Gallery, Picture, Report, Section, Table
from attnwarp_eval.metrics.occlusion import by_yaw
from attnwarp_eval.metrics.registry import metric as metric_of
from attnwarp_eval.report.ablations import ablations
from attnwarp_eval.report.calibration import calibration
from attnwarp_eval.report.claims import judge, load_claims
from attnwarp_eval.report.effects import effects
from attnwarp_eval.report.fits import fits
from attnwarp_eval.report.fronts import fronts
from attnwarp_eval.report.results import Results
from attnwarp_eval.report.sensitivity import sensitivity
from attnwarp_eval.report.words import number, spread
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_eval.study.pictures import CLASSES, DEPTH_RANGE, EPE_RANGE

YAW_EDGES = (0, 15, 45, 75, 105, 135, 165, 180)
"""Bins around the yaws 30, 60, ... 150 that studies like to take, with the ends apart."""


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
        (
            f"Study `{study['name']}`: {results.measured} of {total} cells measured,"
            f" {len(results.failures)} failed; scenes {', '.join(study['scenes'])}; {study['size']}"
            f" x {study['size']} px; seeds {study['seeds']}."
        ),
        (
            f"Figures are means over {len(study['scenes'])} scenes of means over their views, ±"
            " half of the 95 % interval (Student's t over scenes). Differences are paired on scene"
            " and view; verdicts are adjusted for the number of tests in their table. \"can't"
            ' tell" is not "equal".'
        ),
    ]
    sections = [
        _claims(results),
        calibration(results),
        *sensitivity(results, root, timings=timings),
        *ablations(results),
        *fits(results, root, number, timings=timings),
        *_yaw(results, root),
        *(fronts(results, root) if timings else []),
        *(_galleries(results) if pictures else []),
        *_failures(results),
        *effects(results),
        _how(results, timings),
    ]
    if not timings:
        for section in sections:
            section.tables = [table.without_timings() for table in section.tables]
    return Report(study["title"] or study["name"], lead, sections)


def _claims(results: Results) -> Section:
    rows = []
    for finding in judge(results, load_claims()):
        claim = finding.claim
        sides = "; ".join(f"{name}: {spread(value)}" for name, value in finding.sides.items())
        shown = spread(finding.contrast) if len(finding.sides) > 1 else "against 0"
        agree, views = finding.agreement
        rows.append(
            [
                claim.text,
                finding.here,
                finding.verdict,
                f"{agree} of {views}",
                shown,
                sides,
                finding.metric,
            ]
        )
    section = Section("What was expected, and what was seen")
    if not rows:
        section.text = ["Nothing that a claim speaks of was measured."]
        return section
    section.text = [
        (
            "A claim that does not hold on these scenes is a result, not an error. **Here** speaks"
            " of these scenes alone: `seen` when the difference has the expected sign in every"
            " scene, with the views that agree beside it. **In general** speaks of scenes like"
            " these, of which a few were drawn, and says `can't tell` when so few cannot settle it."
        ),
    ]
    columns = [
        "claim",
        "here",
        "in general",
        "views that agree",
        "difference",
        "measured",
        "metric",
    ]
    section.tables = [Table(columns, rows)]
    return section


def _yaw(results: Results, root: Path) -> list[Section]:
    names = [n for n in results.study["yaw"]["variants"] if results.records("warp", n)]
    if not names:
        return []
    columns = ["variant", *(f"{low}–{high}°" for low, high in itertools.pairwise(YAW_EDGES))]
    rates = {
        "occlusion.false_positive_rate": (
            "Of surface that the source does not show, accepted (false positive rate)"
        ),
        "occlusion.false_negative_rate": (
            "Of surface that the source shows, rejected (false negative rate)"
        ),
        "occlusion.behind_share": "Of what is accepted, behind the source camera",
        "occlusion.hidden_share": "Of what is accepted, hidden from the source",
    }
    bins = {
        (name, region): by_yaw(results.counts("warp", name, region), YAW_EDGES)
        for name in names
        for region in ("", ".interior", ".edge")
    }
    tables = [
        Table(
            columns,
            [[name, *(number(b.scores[metric]) for b in bins[name, ""])] for name in names],
            caption,
        )
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
    rows = [
        [name, *(number(_accepted(b.counts, "ambiguous")) for b in bins[name, ""])]
        for name in names
    ]
    tables.append(
        Table(columns, rows, "Of ambiguous pixels, which are not scored, accepted", folded=True)
    )
    text = [
        (
            "Counts of all scenes' views summed in bins of the yaw between source and target. A"
            " dash: nothing to measure, such as a view in which the source shows nothing at all."
        ),
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
        "figures/masks-by-yaw.svg",
        "Both errors of the masks by yaw; means and 95 % intervals over scenes.",
    )
    return [Section("Masks by yaw", text, tables, [drawn])]


def _accepted(counts: dict[str, int], label: str) -> float:
    total = counts[f"{label}_accepted"] + counts[f"{label}_rejected"]
    return counts[f"{label}_accepted"] / total if total else math.nan


def _by_yaw(results: Results, variant: str, metric: str) -> tuple[list[float], list[Interval]]:
    yaws = sorted(
        {
            view["yaw"]
            for _, _, record in results.records("warp", variant)
            for view in record["views"]
        }
    )
    tables = [results.views("warp", variant, metric, (yaw, yaw)) for yaw in yaws]
    return yaws, [interval({s: list(v.values()) for s, v in table.items()}) for table in tables]


def _galleries(results: Results) -> list[Section]:
    shown: dict[tuple[str, str], list[tuple[str, str, dict[str, Any]]]] = {}
    for cell in results.cells:
        for picture in (cell["record"] or {}).get("pictures", []):
            label = "truth's own depth" if cell["probe"] == "calibration" else cell["variants"][0]
            shown.setdefault((cell["scene"], picture["view"]), []).append(
                (cell["probe"], label, picture)
            )
    if not shown:
        return []
    rows: list[tuple[str, list[Picture]]] = []
    for (scene, view), found in shown.items():
        first = [
            next((p for _, _, p in found if p["what"] == what), None)
            for what in ("source", "target")
        ]
        rows.append((f"**{scene}, {view}**", [Picture(p["path"], p["what"]) for p in first if p]))
        for label in dict.fromkeys(label for _, label, _ in found):
            own = {p["what"]: p for _, other, p in found if other == label}
            wanted = [
                what
                for what in ("warped", "mask", "endpoint-error", "render", "depth-error")
                if what in own
            ]
            rows.append(
                (label, [Picture(own[what]["path"], what.replace("-", " ")) for what in wanted])
            )
    legend = "; ".join(f"`{colour}` {name}" for name, (colour, _) in CLASSES.items())
    text = [
        (
            "Warped: the source's own colours as the warp carries them, squares where the mask"
            f" rejects. Mask against truth: {legend}. Endpoint error: dark {EPE_RANGE[0]:g} px to"
            f" bright {EPE_RANGE[1]:g} px, logarithmic, truly visible pixels only. Depth error:"
            f" blue too near, red too far, full colour at {100 * DEPTH_RANGE:g} %."
        ),
    ]
    return [Section("Pictures", text, gallery=Gallery(rows))]


def _failures(results: Results) -> list[Section]:
    if not results.failures:
        return []
    rows = [[f["scene"], f["variant"], f["probe"], f["error"]] for f in results.failures]
    text = ["These cells are missing from every table above. Run the study again to retry them."]
    return [Section("Failed cells", text, [Table(["scene", "variant", "probe", "error"], rows)])]


def _how(results: Results, timings: bool) -> Section:
    used = sorted(
        {
            name
            for c in results.cells
            if c["record"]
            for v in c["record"]["views"]
            for name in v["metrics"]
        }
    )
    names = sorted({".".join(name.split(".")[:2]) for name in used})
    rows = [
        [m.name, m.unit, m.direction, str(m.version), m.description]
        for m in (metric_of(name) for name in names)
        if not m.is_count
    ]
    text = [
        (
            "Behind a metric's name may stand a region (`interior`, `edge`: within 2 px of a depth"
            " or object edge) or the size of a feature grid. Every value of every view is in"
            " `results.jsonl`."
        ),
    ]
    records = [c["record"] for c in results.cells if c["record"]]
    if records:
        text += _environments(records)
        if timings:
            total = {
                k: 0.0
                for k in ("setup", "truth", "splats", "method", "sample", "checks", "pictures")
            }
            for record in records:
                for stage in total:
                    total[stage] += record["cost"]["seconds"].get(stage) or 0.0
            peak = max(record["cost"]["peak_memory_mb"] for record in records)
            text.append(
                "Seconds over all cells: "
                + ", ".join(f"{stage} {number(seconds)}" for stage, seconds in total.items())
                + f". Peak memory {peak:.0f} MiB."
            )
    return Section(
        "How it was measured",
        text,
        [Table(["metric", "unit", "better", "version", "meaning"], rows)],
    )


def _environments(records: list[dict[str, Any]]) -> list[str]:
    """Every state of code, versions and machine that cells of this run were computed with, and how
    many.
    """
    counted: dict[str, int] = {}
    for record in records:
        environment = record["environment"]
        git, machine = environment["git"], environment["machine"]
        revision = f"revision `{git['sha'][:12]}`" if git["sha"] else "an installed copy"
        if git["dirty"]:
            revision += " with local changes"
        versions = ", ".join(
            f"{name} {version}" for name, version in environment["versions"].items()
        )
        where = f"{machine['system']} {machine['arch']}, {machine['cores']} cores"
        described = f"{revision}; {versions}; {where}"
        counted[described] = counted.get(described, 0) + 1
    if len(counted) == 1:
        return [f"Computed with {next(iter(counted))}."]
    lines = [
        f"{count} cells with {described}"
        for described, count in sorted(counted.items(), key=lambda x: -x[1])
    ]
    return [
        "**The cells of this run were computed with more than one state of code or machine:** "
        + "; ".join(lines)
        + "."
    ]
