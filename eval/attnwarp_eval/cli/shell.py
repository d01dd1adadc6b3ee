"""The shell shared by both commands, with the harness's additions: exit codes, and runs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from attnwarp.cli import shell
from attnwarp.cli.shell import STOPPED, fail
from attnwarp.process import stops_interrupt

REGRESSION, TOO_LITTLE = 1, 3
"""Exit codes besides those of attnwarp. 1 is reserved for a regression. A run that measured too
little, or with an instrument that is not calibrated, is 3."""


class Regression(SystemExit):
    """Exit of a command that found a regression.

    Typer exits with the same code if a command's output pipe is closed; only the type
    distinguishes the two.
    """

    def __init__(self) -> None:
        super().__init__(REGRESSION)


def check_not_of_run(out: Path, run: Path) -> None:
    """Refuse to overwrite a file of a run.

    Raises:
        InputError: the file is the run's study or report, or is among its cells
            or pictures.
    """
    from attnwarp.errors import InputError
    from attnwarp.io.file import check_other

    for name in ("cells", "failed", "pictures"):
        if out.resolve().is_relative_to((run / name).resolve()):
            raise InputError(f"{out}: lies among the {name} of the run {run}; choose another place")
    for name in ("study.json", "results.jsonl", "report.md", "report.html"):
        check_other(out, run / name, f"a file of the run {run}")


clear_errors = functools.partial(shell.clear_errors, "stopped", strict=True)


@contextmanager
def resumable(state: Callable[[], str]) -> Iterator[None]:
    """Turn Ctrl-C, a polite kill or the terminal's end into one clear line and exit code 130.

    Args:
        state: description of kept work, such as "3 cells are kept"; called after the interrupt.
    """
    try:
        with stops_interrupt():
            yield
    except KeyboardInterrupt:
        message = f"stopped; {state()}, the same command goes on from here"
        raise fail(message, STOPPED) from None


@contextmanager
def scheduler_lost(scheduler: str | None, kept: Callable[[], int]) -> Iterator[None]:
    """Turn a broken connection to a scheduler into one clear line and exit code 3; ``kept`` counts
    stored cells.
    """
    from attnwarp_eval.study.cluster import ClusterLost

    try:
        yield
    except ClusterLost:
        raise fail(
            f"the connection to the scheduler {scheduler} broke; {kept()} cells are kept, the same"
            " command goes on from here",
            TOO_LITTLE,
        ) from None


def names(text: str | None) -> list[str] | None:
    """The parts of a comma-separated option; None if the option was left out."""
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]


def whole_numbers(text: str | None, option: str) -> list[int] | None:
    """Whole numbers of a comma-separated option; None if it was left out."""
    parts = names(text)
    if parts is None:
        return None
    if not parts or not all(part.isdecimal() for part in parts):
        raise fail(f"{option}: got {text!r}, expected whole numbers such as 0,1")
    return [int(part) for part in parts]
