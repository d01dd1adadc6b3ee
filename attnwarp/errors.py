"""Errors and warnings about a person's input: the command line shows their message, and exits with
code 2 after an error.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence


class InputError(ValueError):
    """An input that cannot be used. The message names the file, what came, what was expected, and
    the remedy.
    """


class InputWarning(UserWarning):
    """An input that is used, though perhaps not as it was meant. The message names the file, and
    what was left out or changed.
    """


def suggest(word: str, allowed: Sequence[str]) -> str:
    """The end of a message: the allowed word nearest to a misspelt one; empty where none is near.

    Example:
        >>> suggest("lr_mean", ["lr_means", "ssim"])
        "; did you mean 'lr_means'?"
    """
    near = difflib.get_close_matches(word, allowed, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""
