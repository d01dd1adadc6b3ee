"""Notation of numbers in a document."""

from __future__ import annotations

import math
from collections.abc import Callable

from attnwarp_eval.statistics.intervals import Interval, Ratio

FEWEST_SCENES = 6
"""Number of scenes below which a document shows their range instead of an interval."""


def number(value: float | None, digits: int = 3) -> str:
    """A number to ``digits`` significant digits; a dash where it is undefined.

    Example:
        >>> number(0.0123456), number(12345.6), number(None)
        ('0.0123', '12346', '–')
    """
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    text = f"{value:.{digits}g}"
    if abs(float(text)) >= 10**digits:  # rounded: 999.6 has as many digits as 1000
        return f"{value:.0f}"
    return (
        text
        if "e" in text
        else f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"
    )


def pooled(error: Interval, scenes: int | None = None) -> str:
    """PSNR of a mean squared error, with the PSNRs of its interval's ends.

    Args:
        error: mean squared error of pictures in [0, 1]. For an error of 0, and an end of the
            interval at most 0, the PSNR is infinite.
        scenes: as for :func:`spread`.

    Example:
        >>> from attnwarp_eval.statistics.intervals import interval
        >>> pooled(interval({"bear": [0.01], "fence": [0.011], "glass": [0.009]}))
        '20.0 [19.0, 21.2]'
        >>> pooled(interval({"bear": [0.0], "fence": [0.02]}))  # of 0 and 0.02
        '20.0 [8.63, inf]'
    """
    return bracketed(error.mean, error.high, error.low, form=decibels) + note(error, scenes)


def decibels(error: float) -> str:
    """PSNR of a mean squared error of pictures in [0, 1]; a dash where it is NaN.

    Example:
        >>> decibels(0.01), decibels(0.0), decibels(float("nan"))
        ('20.0', 'inf', '–')
    """
    return "inf" if error <= 0 else number(-10 * math.log10(error))


def spread(value: Interval, scenes: int | None = None) -> str:
    """Mean ± half of the 95 % interval, with the number of undefined values.

    For few scenes it is the mean with the lowest and the highest scene: an interval would make a
    statement about scenes in general.

    Args:
        scenes: scenes of the study; if fewer were measured, the text says how many.

    Example:
        >>> from attnwarp_eval.statistics.intervals import interval
        >>> spread(interval({"bear": [1.0], "fence": [1.1], "glass": [0.9]}))
        '1.00 (0.900 to 1.10)'
        >>> spread(interval({f"drawn-{k}": [1.0 + 0.1 * k] for k in range(6)}))
        '1.25 ± 0.20'
    """
    if not math.isfinite(value.mean):
        return "–"
    missing = note(value, scenes)
    few = value.scenes < FEWEST_SCENES and math.isfinite(value.least)  # NaN: of rounds, not scenes
    if few and value.least < value.most:
        return f"{number(value.mean)} ({number(value.least)} to {number(value.most)}){missing}"
    if few or not value.bounded:
        return number(value.mean) + missing
    return f"{number(value.mean)} ± {number(value.high - value.mean, 2)}{missing}"


def bracketed(value: float, *ends: float, form: Callable[[float], str] = number) -> str:
    """A value with the ends of its interval, each written by ``form``; alone where an end is
    undefined, or without any.

    Example:
        >>> bracketed(2.0, 1.5, 2.25), bracketed(2.0), bracketed(2.0, math.nan, math.nan)
        ('2.00 [1.50, 2.25]', '2.00', '2.00')
        >>> bracketed(0.1, 0.05, 0.2, form="{:.0%}".format)
        '10% [5%, 20%]'
    """
    if not ends or not all(map(math.isfinite, ends)):
        return form(value)
    return f"{form(value)} [{', '.join(map(form, ends))}]"


def ratio_text(value: Ratio) -> str:
    """A ratio of seconds with its 95 % interval, if it has one.

    Example:
        >>> from attnwarp_eval.statistics.intervals import time_ratio
        >>> [ratio_text(time_ratio([[2.0] * n], [[1.0] * n])) for n in (6, 1)]
        ['2.00 [2.00, 2.00]', '2.00']
    """
    return bracketed(value.ratio, value.low, value.high)


def note(value: Interval, scenes: int | None) -> str:
    """Note, in brackets, on values missing from a mean.

    Example:
        >>> from attnwarp_eval.statistics.intervals import interval
        >>> note(interval({"bear": [1.0], "fence": [2.0]}), scenes=3)
        ' (2 of 3 scenes)'
    """
    notes = [f"{value.undefined} undefined"] if value.undefined else []
    if scenes is not None and value.scenes < scenes:
        notes.append(f"{value.scenes} of {scenes} scenes")
    return f" ({', '.join(notes)})" if notes else ""
