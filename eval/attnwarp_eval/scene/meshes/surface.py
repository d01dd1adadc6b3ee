"""Surface returned by the readers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Surface:
    """Polygons in the layout of a file.

    Args:
        vertices: (V, 3).
        corners: (C,) indices into ``vertices``, polygon after polygon.
        sizes: (P,) corners of each polygon; they sum to C.
        tint: (V, 3) linear RGB, or None.
        ignored: unused contents of the file, with its number, such as "3 lines".
    """

    vertices: Array
    corners: Indices
    sizes: Indices
    tint: Array | None = None
    ignored: tuple[str, ...] = ()


def clip(token: str) -> str:
    """Format a token for a message: quoted, on one line, shortened."""
    return ascii(token if len(token) <= 40 else token[:37] + "...")


def unit_colors(values: Array) -> Array:
    """(V, 3) linear RGB of sRGB values from 0 to 1, or from 0 to 255 where one is above 1.

    Raises:
        ValueError: a value is negative or above 255.
    """
    from attnwarp_eval.colors import to_linear

    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    if low < 0 or high > 255:
        raise ValueError(f"vertex colours: got {low:g} to {high:g}, expected 0 to 1 or 0 to 255")
    return to_linear(values / 255 if high > 1 else values)
