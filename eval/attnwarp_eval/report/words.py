"""How numbers are written in a report."""

from __future__ import annotations

import math

from attnwarp_eval.report.results import Results
from attnwarp_eval.statistics.intervals import Interval, interval


def number(value: float | None, digits: int = 3) -> str:
    """A number to ``digits`` significant digits; a dash where it is undefined."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    text = f"{value:.{digits}g}"
    return (
        text
        if "e" in text
        else f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"
    )


def spread(value: Interval, scenes: int | None = None) -> str:
    """Mean ± half of the 95 % interval, with what was undefined, and the scenes measured where they
    are not all.
    """
    if not math.isfinite(value.mean):
        return "–"
    notes = [f"{value.undefined} undefined"] if value.undefined else []
    if scenes is not None and value.scenes < scenes:
        notes.append(f"{value.scenes} of {scenes} scenes")
    note = f" ({', '.join(notes)})" if notes else ""
    if not value.known:
        return number(value.mean) + note
    return f"{number(value.mean)} ± {number(value.high - value.mean, 2)}{note}"


def mean_of(results: Results, probe: str, variant: str, metric: str) -> Interval:
    """Mean over scenes of a variant's metric, with its interval."""
    table = results.views(probe, variant, metric)
    return interval({scene: list(values.values()) for scene, values in table.items()})
