"""The sRGB transfer curve (IEC 61966-2-1), and the difference of two pictures' colours."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt


def to_srgb(linear: npt.ArrayLike) -> npt.NDArray[Any]:
    """Linear values to sRGB-encoded ones in [0, 1], by IEC 61966-2-1.

    Args:
        linear: linear values of any shape; values outside [0, 1] are clipped. A float dtype stays
            the same.

    Example:
        >>> [round(float(value), 4) for value in to_srgb([0.0, 0.2140411, 1.0, 2.0])]
        [0.0, 0.5, 1.0, 1.0]
    """
    value = np.asarray(linear)
    value = np.clip(value if value.dtype.kind == "f" else value.astype(np.float64), 0, 1)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055).astype(
        value.dtype
    )


def to_linear(srgb: npt.ArrayLike) -> npt.NDArray[Any]:
    """sRGB values in [0, 1] to linear, of the same float dtype; inverse of :func:`to_srgb`."""
    value = np.asarray(srgb)
    value = np.clip(value if value.dtype.kind == "f" else value.astype(np.float64), 0, 1)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(
        value.dtype
    )


def color_difference(
    a: npt.NDArray[Any], b: npt.NDArray[Any], mask: npt.NDArray[np.bool_]
) -> float:
    """Mean CIEDE2000 of two (H, W, 3) sRGB pictures inside a mask; NaN if the mask is empty."""
    from skimage.color import deltaE_ciede2000, rgb2lab

    if not mask.any():
        return math.nan
    return float(deltaE_ciede2000(rgb2lab(a[mask]), rgb2lab(b[mask])).mean())
