"""Comparison of two variants of a run in one figure, on the figure's scale; every comparison in a
report uses it.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from attnwarp_eval.document.model import Marked
from attnwarp_eval.document.numbers import FEWEST_SCENES, number
from attnwarp_eval.metrics.counted import COUNTED
from attnwarp_eval.metrics.registry import Metric
from attnwarp_eval.statistics.contrasts import Contrast, contrast
from attnwarp_eval.statistics.intervals import ByView
from attnwarp_eval.study.probe import probe, probes
from attnwarp_eval.study.probe_report import report_of
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Ablation

Yaw = tuple[float, float]


def between(
    results: Results, name: str, first: str, second: str, metric: str, yaw: Yaw | None = None
) -> Contrast:
    """Contrast of the second variant with the first.

    Args:
        yaw: closed range of views' yaws from the source, in degrees; any if None.
    """
    a, b = (results.views(name, who, metric, yaw) for who in (first, second))
    sides = [_counts(results, name, who, metric, yaw) for who in (first, second)]
    return on_scale(results, name, metric, a, b, sides)


def differences_of(results: Results, table: Ablation) -> Iterator[tuple[str, str, Contrast]]:
    """Variant, metric and contrast with the baseline of a table, in all metrics that it tests."""
    name, baseline = table.probe, table.baseline
    for variant in table.variants:
        for metric in report_of(name).contrasts_at(results.layer) if variant != baseline else ():
            yield variant, metric, between(results, name, baseline, variant, metric)


def on_scale(
    results: Results,
    name: str,
    metric: str,
    a: ByView,
    b: ByView,
    counts: list[ByView | None],
) -> Contrast:
    """Contrast of two tables of a figure, on the figure's scale.

    Args:
        a, b: scene -> view (and seed) -> value.
        counts: denominators of the shares; None if unknown.
    """
    specification = probe(name).metric(metric)
    first, second = counts
    of = None if first is None or second is None else (first, second)
    return contrast(
        a, b, specification.scale, floor=floor_of(results, metric, specification), counts=of
    )


def floor_of(results: Results, metric: str, specification: Metric) -> float:
    """Error below which a figure means nothing: the calibration's error if it has the same
    distance, and at least the metric's tolerance.
    """
    if specification.unit not in ("px", "layer px"):
        return specification.atol
    values = [
        view.metrics.get(metric, math.nan)
        for own in probes()
        if own.always
        for _, record in results.finished(own.name)
        for view in record.views
    ]
    finite = [value for value in values if math.isfinite(value)]
    return max(specification.atol, float(np.median(finite)) if finite else 0.0)


def _counts(
    results: Results, name: str, variant: str, metric: str, yaw: Yaw | None
) -> ByView | None:
    """Denominators of the shares; None if the run has no counts."""
    specification = probe(name).metric(metric)
    behind = metric.removeprefix(specification.name)
    tables = [
        results.views(name, variant, f"{count}{behind}", yaw)
        for count in COUNTED.get(specification.name, ())
    ]
    total: dict[str, dict[str, float]] = defaultdict(dict)
    for table in tables:
        for scene, views in table.items():
            for view, value in views.items():
                total[scene][view] = total[scene].get(view, 0.0) + value
    shares = results.views(name, variant, metric, yaw)
    known = all(
        math.isfinite(total[scene].get(view, math.nan))
        for scene, views in shares.items()
        for view, share in views.items()
        if math.isfinite(share)
    )
    return dict(total) if tables and known else None


_UNITS = {
    "px": "px",
    "dB": "dB",
    "dE00": "dE00",
    "deg": "degrees",
    "pixels": "pixels",
    "rows": "rows",
    "views": "views",
}
"""Unit of a metric -> the word after its figure, for figures shown unconverted."""


def unit_in_words(metric: Metric, key: str) -> str:
    """Unit behind a figure in a sentence; ``key`` is as for :func:`in_words`."""
    if metric.unit in ("share", "ratio"):
        return "%"
    if metric.unit == "layer px":
        grid = key.rpartition(".")[2]
        return f"px of a {grid} grid" if grid.isdigit() else "px of the grid"
    return _UNITS.get(metric.unit, "")


def without_unit(value: float, metric: Metric) -> str:
    """A figure for a sentence without its unit: in percent for a share."""
    if not math.isfinite(value):
        return "undefined"
    if metric.unit in ("share", "ratio"):
        percent = 100 * value
        return f"{percent:.0f}" if abs(percent) >= 10 else number(percent, 2)
    return number(value, 2 if abs(value) < 10 else 3)


def in_words(value: float, metric: Metric, key: str) -> str:
    """Format a figure with its unit for a sentence.

    Args:
        value: value of the figure; NaN where undefined.
        metric: specification of the figure.
        key: name of the figure in a record; its last part may be the size of a feature grid.

    Example:
        >>> from attnwarp_eval.metrics.registry import METRICS
        >>> in_words(0.686, METRICS["occlusion.hidden_share"], "occlusion.hidden_share")
        '69 %'
        >>> key = "warp.epe_median_layer.64"
        >>> in_words(0.4671, METRICS[key], key)
        '0.47 px of a 64 grid'
    """
    unit = unit_in_words(metric, key) if math.isfinite(value) else ""
    return f"{without_unit(value, metric)} {unit}".strip()


def difference_text(value: Contrast, unit: str, level: float = 0.95) -> str:
    """Format a difference with the interval of its verdict's level; below six scenes
    with the lowest and the highest scene.

    Factors up to 2 are shown in percent, larger ones and ratios of odds as factors.

    Example:
        >>> tables = [{f"s{k}": {"v": v + 0.01 * v * k} for k in range(6)} for v in (1.0, 0.6)]
        >>> difference_text(contrast(*tables, "ratio"), "px")
        '-40 % (-40 to -40 %)'
    """
    if not value.by_scene:
        return "–"
    few = value.scenes < FEWEST_SCENES
    mean, low, high = value.range() if few else value.shown(level)
    if value.scale == "ratio" and max(mean, high) <= 2:
        texts, behind = [_percent(x - 1) for x in (mean, low, high)], " %"
    elif value.scale == "share" or (value.scale == "plain" and unit == "share"):
        texts, behind = [_percent(x) for x in (mean, low, high)], " points"
    elif value.scale == "plain":
        texts = [f"{'+' if x > 0 else ''}{number(x)}" for x in (mean, low, high)]
        behind = f" {unit}" if unit not in ("ratio", "cosine", "own") else ""
    else:
        word = "odds × " if value.scale == "odds" else "× "
        texts, behind = [number(x) for x in (mean, low, high)], ""
        texts[0] = f"{word}{texts[0]}"
    lone = value.scenes < 2 or not math.isfinite(low)
    brackets = "" if lone else f" ({texts[1]} to {texts[2]}{behind})"
    note = f" ({value.undefined} undefined)" if value.undefined else ""
    return f"{texts[0]}{behind}{brackets}{note}"


def no_verdict(value: Contrast) -> str:
    """Count of the scenes with the sign of the mean, for fewer than six, which give no verdict.

    Example:
        >>> tables = [{f"s{k}": {"v": v + 0.01 * k} for k in range(2)} for v in (1.0, 0.6)]
        >>> no_verdict(contrast(*tables, "ratio"))
        '2 of 2 scenes lower; no verdict'
    """
    sign = -1 if value.flips.mean < 0 else 1
    alike = sum(sign * one > value.flips.rounding for one in value.by_scene.values())
    scenes = f"{value.scenes} scene{'' if value.scenes == 1 else 's'}"
    text = f"{alike} of {scenes} {'lower' if sign < 0 else 'higher'}; no verdict"
    return Marked(text, "untold")


def detectable_text(value: Contrast) -> str:
    """The smallest difference that one test at 5 % detects in 80 % of studies."""
    least = value.student.detectable
    if value.scenes < FEWEST_SCENES or not math.isfinite(least):
        return "–"
    if value.scale == "ratio":
        return f"{number(100 * math.expm1(least), 2)} %"
    if value.scale == "odds":
        return f"odds × {number(math.exp(least))}"
    return f"{number(100 * least, 2)} points" if value.scale == "share" else number(least)


def _percent(share: float) -> str:
    return f"{'+' if share > 0 else ''}{number(100 * share, 2)}"
