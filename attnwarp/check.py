"""Argument checks of public functions; errors name the argument, its value and the expectation."""

from __future__ import annotations

import difflib
import math
import numbers
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from attnwarp.errors import suggest

if TYPE_CHECKING:
    import torch

MOST_LISTED = 12
"""Number of allowed names up to which an error lists them beside the nearest."""

Array: TypeAlias = "torch.Tensor | np.ndarray[Any, Any]"
"""Array of torch or numpy."""


def shape(
    value: torch.Tensor | np.ndarray, expected: Sequence[int | str | None], name: str
) -> None:
    """Raise ValueError unless ``value`` has the ``expected`` shape.

    An int must match; None or a string (a name for the reader, such as "N") matches any length.

    Example:
        >>> import numpy as np
        >>> from attnwarp import check
        >>> check.shape(np.zeros((5, 2)), ("N", 3), "points")
        Traceback (most recent call last):
        ValueError: points: got shape (5, 2), expected (N, 3)
    """
    actual = tuple(value.shape)
    fits = len(actual) == len(expected) and all(
        not isinstance(e, int) or a == e for a, e in zip(actual, expected, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if e is None else str(e) for e in expected)
        raise ValueError(f"{name}: got shape {actual}, expected ({wanted})")


def same_aspect(size: tuple[int, int], full: tuple[int, int], name: str, remedy: str) -> None:
    """Raise ValueError unless a picture of ``full`` can have been resized to ``size``.

    Each side of the smaller picture may be rounded independently, by less than a pixel.

    Args:
        size: (h, w) of the given picture.
        full: (H, W) of the full picture.

    Example:
        >>> from attnwarp import check
        >>> check.same_aspect((12, 21), (100, 165), "m", "crop")  # an eighth
        >>> check.same_aspect((21, 12), (100, 165), "m", "crop")
        Traceback (most recent call last):
        ValueError: m: got 21 x 12 (height x width), expected the aspect ratio of 100 x 165; crop
    """
    (h, w), (H, W) = size, full
    if abs(h * W - w * H) > max(H + W, h + w):
        raise ValueError(
            f"{name}: got {h} x {w} (height x width), expected the aspect ratio of {H} x {W};"
            f" {remedy}"
        )


def finite(value: torch.Tensor | np.ndarray, name: str) -> None:
    """Raise ValueError naming the first row of ``value`` with a NaN or an infinity."""
    # torch is not imported here, so that checks of numpy arrays stay fast.
    array = value.detach().cpu().numpy() if hasattr(value, "detach") else np.asarray(value)
    bad = ~np.isfinite(array)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name}: {array[index]} at index {index}; {int(bad.sum())} of {array.size} values are"
            " not finite"
        )


def tensor(value: Array, name: str) -> torch.Tensor:
    """Return a tensor unchanged; convert an array, sharing its memory if torch can read it.

    Raises:
        TypeError: the value is neither a tensor nor an array.

    Example:
        >>> import numpy as np
        >>> tensor(np.eye(2)[::-1], "pose").tolist()  # flipped: torch needs a copy
        [[0.0, 1.0], [1.0, 0.0]]
    """
    import torch

    if isinstance(value, torch.Tensor):
        return value
    if not isinstance(value, np.ndarray):
        raise TypeError(
            f"{name}: got {type(value).__name__}, expected a torch.Tensor or a NumPy array"
        )
    # torch accepts no array that is flipped, of foreign byte order or read-only.
    native = value.dtype.newbyteorder("=")
    if min(value.strides, default=0) < 0:  # also along a side of 1, where NumPy sees no flip
        value = value.copy()
    return torch.from_numpy(np.require(value, native, ("C", "W")))


def instance(value: Any, kind: type, name: str, expected: str) -> None:
    """Raise TypeError unless ``value`` is an instance of ``kind``.

    Example:
        >>> from attnwarp import check
        >>> check.instance("corrected", dict, "settings", "a dictionary")
        Traceback (most recent call last):
        TypeError: settings: got str, expected a dictionary
    """
    if not isinstance(value, kind):
        raise TypeError(f"{name}: got {type(value).__name__}, expected {expected}")


LARGEST = sys.float_info.max
"""Largest float; larger integers have no float, which every formula needs."""


def is_number(value: Any, *, whole: bool = False) -> bool:
    """Return True if ``value`` is a number of Python or numpy, and an integer if ``whole``; False
    for a bool.

    Example:
        >>> from attnwarp import check
        >>> check.is_number(True), check.is_number(2.0), check.is_number(2.0, whole=True)
        (False, True, False)
    """
    kind = numbers.Integral if whole else numbers.Real
    return isinstance(value, kind) and not isinstance(value, bool)


def number(value: Any, low: float, high: float, name: str, *, whole: bool = False) -> float:
    """Convert ``value`` to a Python number; it must be finite, in [low, high], and whole if asked.

    Numbers of numpy are accepted. A whole number stays an int, so that settings keep their JSON.

    Raises:
        ValueError: the value violates these conditions.

    Example:
        >>> import numpy as np
        >>> from attnwarp import check
        >>> check.number(np.int64(2), 0, 5, "steps", whole=True)
        2
        >>> check.number(2.5, 0, float("inf"), "steps", whole=True)
        Traceback (most recent call last):
        ValueError: steps: got 2.5, expected a whole number >= 0
    """
    # Converted to Python's type before comparison, since the largest float has no float32.
    plain: float = math.nan
    if is_number(value, whole=whole):
        plain = int(value) if isinstance(value, numbers.Integral) else float(value)
    if not (abs(plain) <= LARGEST and low <= plain <= high):
        kind = "a whole number" if whole else "a number"
        bounds = f">= {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
        text = repr(value)
        shown = text if len(text) <= 80 else f"{text[:40]}... ({len(text)} characters)"
        raise ValueError(f"{name}: got {shown}, expected {kind} {bounds}")
    return plain


def size(value: Any, name: str) -> tuple[int, int]:
    """Convert ``value`` to a (height, width) of positive integers.

    Raises:
        ValueError: the value is something else.

    Example:
        >>> from attnwarp import check
        >>> check.size((8, 2.5), "size")
        Traceback (most recent call last):
        ValueError: size: got (8, 2.5), expected (height, width) of whole numbers from 1
    """
    pair = isinstance(value, Sequence) and not isinstance(value, str | bytes)
    sides = tuple(value) if pair or (isinstance(value, np.ndarray) and value.ndim == 1) else ()
    if len(sides) != 2 or not all(is_number(side, whole=True) and side >= 1 for side in sides):
        raise ValueError(f"{name}: got {value!r}, expected (height, width) of whole numbers from 1")
    return int(sides[0]), int(sides[1])


def seconds(value: Any, name: str) -> None:
    """Raise ValueError unless ``value`` is a number of seconds >= 0, which may be infinite.

    Example:
        >>> from attnwarp import check
        >>> check.seconds(None, "checkpoint_seconds")
        Traceback (most recent call last):
        ValueError: checkpoint_seconds: got None, expected seconds >= 0
    """
    if not is_number(value) or not value >= 0:
        raise ValueError(f"{name}: got {value!r}, expected seconds >= 0")


def text(value: Any, name: str) -> None:
    """Raise ValueError unless ``value`` is a string.

    Example:
        >>> from attnwarp import check
        >>> check.text(2024, "suffix")
        Traceback (most recent call last):
        ValueError: suffix: got 2024, expected a string
    """
    if not isinstance(value, str):
        raise ValueError(f"{name}: got {value!r}, expected a string")


def one_of(value: str, allowed: Sequence[str], name: str) -> str:
    """Return ``value`` if it is among ``allowed``, else raise ValueError listing them. Of many,
    those nearest to a misspelt one are listed.

    Example:
        >>> from attnwarp import check
        >>> check.one_of("a_0", ["a0", *map(str, range(40))], "setting")
        Traceback (most recent call last):
        ValueError: setting: got 'a_0'; did you mean 'a0'? It is none of the 41 names
    """
    if value not in allowed:
        raise ValueError(f"{name}: got {value!r}{_expected(str(value), allowed)}")
    return value


def _expected(word: str, allowed: Sequence[str]) -> str:
    """Write which names are allowed."""
    near = difflib.get_close_matches(word, allowed)
    if near and len(allowed) > MOST_LISTED:
        names = " or ".join(map(repr, near))
        return f"; did you mean {names}? It is none of the {len(allowed)} names"
    return f", expected one of {', '.join(map(repr, allowed))}{suggest(word, allowed)}"
