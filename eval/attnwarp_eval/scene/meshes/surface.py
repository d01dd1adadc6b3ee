"""Surface returned by the readers, and parsing shared by all text formats."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def lines(data: bytes) -> Iterator[tuple[int, str]]:
    """The lines of a text file with their numbers, from 1; names and comments come in any encoding.

    Only line feeds and carriage returns end a line: str.splitlines() would cut UTF-8's "Å" in two.
    """
    return enumerate((line.decode("latin-1") for line in data.splitlines()), 1)


@dataclass(frozen=True, eq=False)
class Surface:
    """Polygons in the layout of a file.

    Args:
        vertices: (V, 3).
        corners: (C,) indices into ``vertices``, polygon after polygon.
        sizes: (P,) corners of each polygon; they sum to C.
        tint: (V, 3) linear RGB, or None.
        ignored: unused contents of the file, with its number, such as "3 lines".
        cut_off: reason why the file's end may be missing despite valid syntax, or None.
        first: number of the first vertex in the file's numbering, for messages.
    """

    vertices: Array
    corners: Indices
    sizes: Indices
    tint: Array | None = None
    ignored: tuple[str, ...] = ()
    cut_off: str | None = None
    first: int = 0


def polygons(faces: Sequence[Sequence[int]]) -> tuple[Indices, Indices]:
    """``corners`` and ``sizes`` of a :class:`Surface` from one list of indices for each face."""
    sizes = np.fromiter((len(face) for face in faces), np.int64, len(faces))
    corners = np.fromiter((k for face in faces for k in face), np.int64, int(sizes.sum()))
    return corners, sizes


def decimal(token: str, line: int) -> float:
    """Parse a number of a text file.

    Raises:
        ValueError: not a number, or not finite.
    """
    try:
        value = float(token)
    except ValueError:
        value = float("nan")
    # float() also takes 1_000 and infinity, which no mesh format has.
    if not np.isfinite(value) or "_" in token:
        raise ValueError(f"line {line}: got {clip(token)}, expected a finite number")
    return value


def whole(token: str, line: int) -> int:
    """Parse a whole number of a text file, of at most 18 digits.

    Raises:
        ValueError: not a whole number.
    """
    digits = token.removeprefix("-")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 18):
        raise ValueError(f"line {line}: got {clip(token)}, expected a whole number")
    return int(token)


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
