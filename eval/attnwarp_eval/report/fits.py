"""The fits of a run: what each came to, and accuracy against time as it proceeded."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from attnwarp_eval.document import figures
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.files import canonical_json
from attnwarp_eval.report.results import Results
from attnwarp_eval.statistics.intervals import Interval, interval

CURVES: dict[str, tuple[str, Callable[[dict[str, Any]], float | None]]] = {
    "PSNR of held-out views": ("dB", lambda point: point["psnr"]),
    "AbsRel of depth": ("ratio", lambda point: point["measures"].get("depth.abs_rel")),
    "normals": ("deg", lambda point: point["measures"].get("depth.normal_median")),
}

TIMED = ("CPU seconds", "seconds", "CPU seconds to 28 dB")


def fits(
    results: Results, root: Path, number: Callable[[float | None], str], *, timings: bool
) -> list[Section]:
    """The section of the fits, none if nothing was fitted.

    Args:
        results: of the run.
        root: the run's folder; figures are written below it.
        number: how a number is written.
        timings: whether anything measured in seconds is shown.
    """
    own: dict[str, str] = {}
    for cell in results.cells:
        if cell["probe"] == "fit" and cell["record"] is not None:
            # Variants that look at one fit in different ways share its curve; the first gives it
            # its name.
            how = canonical_json({**cell["record"]["spec"]["fit"], "seed": cell["seed"]})
            own.setdefault(how, cell["variants"][0])
    names = list(dict.fromkeys(own.values()))
    if not names:
        return []
    rows = []
    for name in names:
        for scene, seed, record in results.records("fit", name):
            last = record["curve"][-1]
            views = [view["metrics"] for view in record["views"]]
            reached = next(
                (p["cpu_seconds"] for p in record["curve"] if p["psnr"] and p["psnr"] >= 28), None
            )
            rows.append(
                [
                    name,
                    scene if seed == 0 else f"{scene}, seed {seed}",
                    number(_mean([view["fit.psnr"] for view in views])),
                    number(last["psnr_pooled"]),
                    number(_mean([view["fit.ssim"] for view in views])),
                    number(last["measures"].get("depth.abs_rel")),
                    number(last["measures"].get("depth.normal_median")),
                    str(last["splats"]),
                    str(last["iteration"]),
                    number(last["cpu_seconds"]),
                    number(last["seconds"]),
                    number(reached),
                ]
            )
    columns = [
        "fit",
        "scene",
        "PSNR",
        "pooled PSNR",
        "SSIM",
        "AbsRel",
        "normal, deg",
        "splats",
        "iterations",
        *TIMED,
    ]
    how, size = results.study["fit"], results.study["size"]
    fitted = how["views"] - -(-how["views"] // 8)
    text = [
        (
            f"Every fit begins with the same {how['points']} points per scene, scattered about the"
            f" surfaces by {number(how['noise'])} of their spacing, and sees {fitted} of"
            f" {how['views']} true pictures at {size} x {size} px; every 8th is held out, and"
            " measured. PSNR is a mean over views, pooled PSNR that of their mean squared error."
            " Depth in this table and in the curves is median depth, by intersection for 2D splats"
            " and at the ray's peak for 3D ones; other ways to read depth off the same splats"
            " stand in the tables above."
        ),
    ]
    section = Section("Fits", text, [Table(columns, rows, timed=TIMED)])
    if timings:
        section.text.append(
            "Curves: means over scenes at each evaluation, 95 % intervals over scenes, against the"
            " CPU seconds of the iterations, those of all threads together (evaluations and files"
            " are not in them)."
        )
        section.figures.append(_curves(results, root, names))
    return [section]


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _curves(results: Results, root: Path, names: list[str]) -> Picture:
    path = root / "figures" / "fits.svg"
    with figures.drawing(path, columns=len(CURVES)) as axes:
        for where, (title, (unit, pick)) in zip(axes, CURVES.items(), strict=True):
            series = [figures.Line(name, *_curve(results, name, pick)) for name in names]
            figures.lines(where, series, x="CPU seconds", y=unit, title=title, log=unit == "ratio")
    return Picture("figures/fits.svg", "Accuracy against time as the fits proceed.")


def _curve(
    results: Results, name: str, pick: Callable[[dict[str, Any]], float | None]
) -> tuple[list[float], list[Interval]]:
    """CPU seconds and values at the evaluations that every scene has, without the one before the
    first iteration.
    """
    curves = [
        (f"{scene}/{seed}", {p["iteration"]: p for p in record["curve"]})
        for scene, seed, record in results.records("fit", name)
    ]
    common = sorted(set.intersection(*({*curve} for _, curve in curves)) - {0})
    seconds = [sum(curve[k]["cpu_seconds"] for _, curve in curves) / len(curves) for k in common]
    values = []
    for k in common:
        found = {scene: pick(curve[k]) for scene, curve in curves}
        values.append(
            interval({scene: [math.nan if v is None else v] for scene, v in found.items()})
        )
    return seconds, values
