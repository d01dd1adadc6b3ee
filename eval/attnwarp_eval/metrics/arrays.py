"""Helpers of checks and metrics: validation of arrays, and means that may be NaN."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp import check

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def floats(value: Any, shape: Sequence[int | str | None], name: str) -> Array:
    """``value`` (array or tensor) as a float64 array of ``shape``."""
    array = np.asarray(value, dtype=np.float64)
    check.shape(array, shape, name)
    return array


def mask(value: Any, shape: Sequence[int | str | None], name: str) -> Mask:
    """``value`` (array or tensor) as a bool array of ``shape``; other types are refused."""
    array = np.asarray(value)
    if array.dtype != np.bool_:
        raise ValueError(f"{name}: got {array.dtype}, expected bool")
    check.shape(array, shape, name)
    return array


def share(part: int, whole: int) -> float:
    """part / whole, NaN if ``whole`` is 0."""
    return part / whole if whole else float("nan")


def mean(values: Array) -> float:
    """Mean in float64, NaN when empty."""
    return float(values.mean()) if values.size else float("nan")


def quantile(values: Array, q: float) -> float:
    """Quantile, interpolated linearly, NaN when empty."""
    return float(np.quantile(values, q)) if values.size else float("nan")


def quantiles(values: Array, qs: Sequence[float]) -> list[float]:
    """Several quantiles of the same values, from one partial sort."""
    if not values.size:
        return [float("nan")] * len(qs)
    return [float(value) for value in np.quantile(values, qs)]


def regions(edge: Mask | None, shape: tuple[int, ...]) -> dict[str, Mask]:
    """Regions of figures, by suffix: everything and, with known edges, interior and band."""
    whole = np.ones(shape, dtype=bool)
    return {"": whole} if edge is None else {"": whole, ".interior": ~edge, ".edge": edge}
