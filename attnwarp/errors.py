"""The one kind of error that is a person's to mend: the command line shows its message and exits
with code 2.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence


class InputError(ValueError):
    """An input that cannot be used. The message names the file, what came, what was expected, and
    the remedy.
    """


def suggest(word: str, known: Sequence[str]) -> str:
    """The end of a message: the known word nearest to a misspelt one; empty where none is near."""
    near = nearest(word, known)
    return "" if near is None else f"; did you mean {near!r}?"


def nearest(word: str, known: Sequence[str]) -> str | None:
    """The known word nearest to a misspelt one; None where none is near."""
    return next(iter(difflib.get_close_matches(word, known, n=1)), None)
