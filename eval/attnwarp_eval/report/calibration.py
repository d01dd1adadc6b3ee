"""The instrument judged by itself, before it judges anything."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.report.results import Results
from attnwarp_eval.report.words import number

LARGEST_EPE = 1e-3
"""Pixels: the largest median endpoint error of the truth's own depth through the warp."""

SMALLEST_SHARE = 0.99
"""Of pixels whose surface point Mitsuba must find where the ray caster does. Rays on outlines may
fall either way.
"""


def problems(results: Results) -> list[str]:
    """What is wrong with the instrument in this run: one line a scene and figure; empty when it is
    calibrated.
    """
    found = []
    calibrated = set()
    for cell in results.cells:
        if cell["probe"] != "calibration":
            continue
        if cell["record"] is None:
            found.append(f"{cell['scene']}: the calibration was not measured")
            continue
        calibrated.add(cell["scene"])
        tests: list[tuple[str, Callable[[float], bool], str]] = [
            ("warp.epe_median", lambda v: v < LARGEST_EPE, f"below {LARGEST_EPE:g} px"),
            ("occlusion.f1.exact", lambda v: v == 1, "1"),
            (
                "calibration.mitsuba_agrees",
                lambda v: v >= SMALLEST_SHARE,
                f"at least {SMALLEST_SHARE:g}",
            ),
        ]
        for metric, passes, expected in tests:
            values = _values(cell["record"], metric)
            found += [
                f"{cell['scene']}: {metric} is {number(v)}, expected {expected}"
                for v in values
                if not passes(v)
            ]
            if not values:
                found.append(f"{cell['scene']}: {metric} is undefined in every view")
    return found


def calibration(results: Results) -> Section:
    """The section of the report."""
    sizes = results.study["feature_sizes"]
    bad = problems(results)
    rows = []
    for cell in results.cells:
        if cell["probe"] != "calibration" or cell["record"] is None:
            continue
        record = cell["record"]
        worst = {
            "warp.epe_median": max,
            "warp.epe_p95": max,
            "calibration.mitsuba_agrees": min,
            "occlusion.f1.exact": min,
            "occlusion.f1": min,
            **{f"warp.feature_accepted.{size}": max for size in sizes},
            **{f"warp.feature_accepted.interior.{size}": max for size in sizes},
        }
        figures = [_worst(record, metric, pick) for metric, pick in worst.items()]
        passed = not any(line.startswith(f"{cell['scene']}: ") for line in bad)
        rows.append([cell["scene"], "passed" if passed else "FAILED", *figures])
    columns = [
        "scene",
        "calibration",
        "EPE median, px",
        "EPE p95, px",
        "Mitsuba agrees",
        "F1 of the exact mask",
        "F1 of the rules on exact depth",
        *(f"feature error, {size}" for size in sizes),
        *(f"inside surfaces, {size}" for size in sizes),
    ]
    text = [
        (
            "The truth's own depth goes through the same warp, whose median endpoint error must"
            f" stay below {LARGEST_EPE:g} px; the exact mask is scored against itself, which must"
            " give F1 = 1; and Mitsuba, which shares no code with the ray caster, must find the"
            " same surface point (within 1e-4 of its distance) in at least"
            f" {100 * SMALLEST_SHARE:g} % of a view's pixels. The worst view of each scene is"
            " shown."
        ),
        (
            "What the rules lose on exact depth, and what bilinear sampling of a feature field"
            " costs at each size, are the floor of everything below: at coarse grids most of it"
            " lies at edges, where taps reach across."
        ),
    ]
    if bad:
        text.insert(
            0,
            "**The instrument is not calibrated; nothing below can be trusted:** "
            + "; ".join(bad)
            + ".",
        )
    return Section("Calibration", text, [Table(columns, rows)])


def _values(record: dict[str, Any], metric: str) -> list[float]:
    found = [view["metrics"].get(metric) for view in record["views"]]
    return [float(v) for v in found if v is not None]


def _worst(record: dict[str, Any], metric: str, pick: Callable[[list[float]], float]) -> str:
    values = _values(record, metric)
    absent = sum(
        metric in view["metrics"] and view["metrics"][metric] is None for view in record["views"]
    )
    return (number(pick(values)) if values else "–") + (f" ({absent} undefined)" if absent else "")
