"""Validation of pictures and masks."""

from __future__ import annotations

from typing import Any

import numpy as np

from attnwarp import check
from attnwarp_eval.metrics import arrays
from attnwarp_eval.metrics.arrays import Array, Mask


def picture(
    value: Any, name: str, *, within: Mask | None = None, shape: tuple[int, ...] | None = None
) -> Array:
    """``value`` (array or CPU tensor) as an (H, W, 3) float64 picture whose values in ``within``
    are in [0, 1].

    Values outside ``within`` may be anything, NaN included, and are 0 in the result, so that they
    cannot leak into a figure.

    Raises:
        ValueError: not float32 or float64; another shape; in ``within`` a value that is not finite
            or outside [0, 1].
    """
    array = np.asarray(value)
    if array.dtype not in (np.float32, np.float64):
        remedy = "; divide by 255" if array.dtype == np.uint8 else ""
        raise ValueError(
            f"{name}: got {array.dtype}, expected float32 or float64 in [0, 1]{remedy}"
        )
    check.shape(array, ("H", "W", 3), name)
    if shape is not None and array.shape[:2] != tuple(shape[:2]):
        got = " x ".join(map(str, array.shape[:2]))
        raise ValueError(f"{name}: got {got} pixels (H x W), expected {shape[0]} x {shape[1]}")
    array = array.astype(np.float64)
    if within is not None:
        array = np.where(within[..., None], array, 0.0)
    bad = ~((array >= 0) & (array <= 1))
    if bad.any():
        row, column, channel = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name}: {array[row, column, channel]:.6g} at row {row}, column {column}, channel"
            f" {channel}; {int(bad.sum())} values are NaN or outside [0, 1]. Clip it, or leave"
            " those pixels out with a mask"
        )
    return array


def region(value: Any, shape: tuple[int, ...], name: str = "mask") -> Mask:
    """``value`` as an (H, W) bool mask of a picture of ``shape``; all True if None."""
    if value is None:
        return np.ones(shape[:2], dtype=bool)
    return arrays.mask(value, shape[:2], name)


def pair(
    image: Any, target: Any, mask: Any, names: tuple[str, str] = ("image", "target")
) -> tuple[Array, Array, Mask]:
    """Validate two pictures of one size and the mask of counted pixels; see :func:`picture`."""
    first = np.asarray(image)
    check.shape(first, ("H", "W", 3), names[0])
    inside = region(mask, first.shape)
    return (
        picture(first, names[0], within=inside),
        picture(target, names[1], within=inside, shape=first.shape),
        inside,
    )
