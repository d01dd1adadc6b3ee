"""Outcome of one file read by two readers."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")


class Outcome(StrEnum):
    """Every file ends in one of these; the last two are failures."""

    SAME = "same"
    BOTH_REFUSE = "refused by both"
    REFUSED = "refused with a message"
    NOTICE = "differs, as a notice says"
    ALONE = "read by us alone"
    SILENT = "SILENT DIFFERENCE"
    CRASH = "ERROR WITHOUT A MESSAGE"


FAILURES = (Outcome.SILENT, Outcome.CRASH)


@dataclass(frozen=True)
class Row:
    """One file.

    Attributes:
        part: "meshes", "transforms.json" or "COLMAP".
        name: of the file or variant.
        outcome: what came of it.
        detail: the message, or both values of what differs.
    """

    part: str
    name: str
    outcome: Outcome
    detail: str = ""


@dataclass(frozen=True)
class Reading:
    """Reading of a file by our reader: exactly one of ``result`` and ``error`` is set."""

    result: object | None
    error: Exception | None
    notices: tuple[str, ...]


def attempt(read: Callable[[], object]) -> Reading:
    """Call ``read`` and keep what it returns, raises and warns."""
    with warnings.catch_warnings(record=True) as notices:
        warnings.simplefilter("always")
        try:
            result, error = read(), None
        except Exception as caught:  # any error at all is a finding of the survey
            result, error = None, caught
    return Reading(result, error, tuple(str(notice.message) for notice in notices))


def refusal(part: str, name: str, error: Exception, folder: Path, *, both: bool) -> Row:
    """The row of a file that our reader refuses: its message must name the file.

    Args:
        part, name: of the row.
        error: what our reader raised.
        folder: cut from the message, since it differs from run to run.
        both: whether the other reader refuses the file too.
    """
    message = " ".join(str(error).split())
    expected = isinstance(error, ValueError | FileNotFoundError)
    if not expected or str(folder) not in message:
        return Row(part, name, Outcome.CRASH, f"{type(error).__name__}: {message}"[:200])
    message = message.replace(f"{folder}/", "")
    return Row(part, name, Outcome.BOTH_REFUSE if both else Outcome.REFUSED, message)
