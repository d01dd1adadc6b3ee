"""Perceptual colours: CIE Lab, and the difference of two colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

RGB_TO_XYZ = np.array(
    [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
"""White of illuminant D65 for the 2 degree observer; ``RGB_TO_XYZ`` converts linear sRGB to XYZ."""


def to_lab(srgb: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Convert sRGB to CIE Lab, by IEC 61966-2-1 and CIE 15. OpenCV's result is off by up to 0.4.

    Args:
        srgb: (..., 3), uint8 or floating in [0, 1].

    Returns:
        (..., 3) of L in [0, 100], a and b.
    """
    value = np.asarray(srgb, np.float64) / (255 if srgb.dtype == np.uint8 else 1)
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    ratio = linear @ RGB_TO_XYZ.T / WHITE
    x, y, z = np.moveaxis(
        np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116), -1, 0
    )
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def ciede2000(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Compute CIEDE2000, dE00, of pairs of colours, by Sharma, Wu and Dalal, "The CIEDE2000
    Color-Difference Formula", Color Research and Application 30, 2005. A difference of 1 is just
    visible side by side.

    Args:
        a, b: (..., 3) colours in CIE Lab.

    Returns:
        (...) differences of the pairs.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    chroma = (np.hypot(a[..., 1], a[..., 2]) + np.hypot(b[..., 1], b[..., 2])) / 2
    # Half of this factor is added to a, which makes neighbourhoods of grey rounder.
    stretch = 1 + (1 - np.sqrt(chroma**7 / (chroma**7 + 25.0**7))) / 2
    (L1, C1, h1), (L2, C2, h2) = (
        (v[..., 0], np.hypot(stretch * v[..., 1], v[..., 2]),
         np.arctan2(v[..., 2], stretch * v[..., 1]) % (2 * np.pi))
        for v in (a, b)
    )  # fmt: skip
    # For opposite hues, rounding must not decide which direction is shorter.
    turn = h2 - h1 - 2 * np.pi * np.sign(h2 - h1) * (abs(h2 - h1) > np.pi + 1e-9)
    dH = 2 * np.sqrt(C1 * C2) * np.sin(turn / 2)
    L, C = (L1 + L2) / 2, (C1 + C2) / 2
    h = np.where(C1 * C2 > 0, h1 + turn / 2, h1 + h2)  # a grey has no hue: take the other colour's
    T = (
        1 - 0.17 * np.cos(h - np.radians(30)) + 0.24 * np.cos(2 * h)
        + 0.32 * np.cos(3 * h + np.radians(6)) - 0.2 * np.cos(4 * h - np.radians(63))
    )  # fmt: skip
    S_L = 1 + 0.015 * (L - 50) ** 2 / np.sqrt(20 + (L - 50) ** 2)
    S_C, S_H = 1 + 0.045 * C, 1 + 0.015 * C * T
    around_blue = (np.degrees(h) % 360 - 275) / 25
    R_T = -2 * np.sqrt(C**7 / (C**7 + 25.0**7)) * np.sin(np.radians(60) * np.exp(-(around_blue**2)))
    light, chromatic, hue = (L2 - L1) / S_L, (C2 - C1) / S_C, dH / S_H
    return np.sqrt(light**2 + chromatic**2 + hue**2 + R_T * chromatic * hue)
