"""What every command shares: exit codes, and errors in one line."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from attnwarp.cli import shell
from attnwarp.cli.shell import STOPPED, USAGE, closed_pipe
from attnwarp.process import stops_interrupt

PASS, REGRESSION, TOO_LITTLE, CRASH = 0, 1, 3, 70
"""Exit codes beside those of attnwarp. 1 is reserved for a regression. A run that measured too
little, or with an instrument that is not calibrated, is 3. A fault of this program is 70, as in
sysexits."""


class Regression(SystemExit):
    """The end of a command that has seen a regression, with its exit code.

    Typer ends a command whose output pipe is closed with the same code; only the type tells the
    two apart.
    """

    def __init__(self) -> None:
        super().__init__(REGRESSION)


def fail(message: str, code: int = USAGE) -> typer.Exit:
    """Print an error on stderr; raise what this returns."""
    typer.echo(f"attnwarp-eval: {message}", err=True)
    return typer.Exit(code)


def check_not_of_run(out: Path, run: Path) -> None:
    """Refuse to write a command's result over a file of a run.

    Args:
        out: file of the result.
        run: folder that the command reads.

    Raises:
        InputError: the file says what the run is, or is its report; or it would lie among its cells
            or pictures.
    """
    from attnwarp.errors import InputError
    from attnwarp.io.file import check_other

    for name in ("cells", "failed", "pictures"):
        if out.resolve().is_relative_to((run / name).resolve()):
            raise InputError(f"{out}: lies among the {name} of the run {run}; choose another place")
    for name in (
        "study.json", "results.jsonl", "results.jsonl.sha256", "report.md", "report.html",
    ):  # fmt: skip
        check_other(out, run / name, f"a file of the run {run}")


_printed: set[str] = set()
"""What was said of scenes by this process: they are built more than once."""


def warn(text: str) -> None:
    """Print a warning on stderr, once a process."""
    if text not in _printed:
        _printed.add(text)
        typer.echo(f"attnwarp-eval: warning: {text}", err=True)


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn errors about a person's input into one clear line and exit code 2, and what a scene's
    meshes give notice of into one line each.
    """
    from attnwarp.errors import InputError

    show_others = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        # By name: the class is imported with all that reads scenes.
        if any(base.__name__ == "SceneNotice" for base in category.__mro__):
            warn(str(message))
        else:
            show_others(message, category, *rest, **more)

    try:
        with warnings.catch_warnings():
            warnings.showwarning = show
            yield
    except InputError as error:
        raise fail(str(error)) from None
    except RuntimeError as error:
        if "Symlink loop" not in str(error):  # of Path.resolve() before Python 3.13
            raise
        raise fail(f"{error}; name another path") from None
    except KeyboardInterrupt:
        raise fail("interrupted", STOPPED) from None
    except BrokenPipeError:
        raise closed_pipe() from None
    except OSError as error:
        raise fail(file_error(error)) from None


def file_error(error: OSError) -> str:
    """An error of the file system, with the remedy."""
    if isinstance(error, FileNotFoundError | FileExistsError | IsADirectoryError):
        if error.errno is None:  # raised by the library, whose message has the remedy
            return str(error)
    elif error.errno is None:  # such as dask's timeouts, which have no text: no file is at fault
        text = f"{type(error).__name__}: {error}".removesuffix(": ")
        return f"a connection between processes failed ({text}); run the same command again"
    return shell.file_error(error)


@contextmanager
def resumable(state: Callable[[], str]) -> Iterator[None]:
    """Turn Ctrl-C, a polite kill or the terminal's end into one clear line and exit code 130.

    Args:
        state: what is finished and stays, such as "3 cells are kept"; asked after the interrupt.
    """
    try:
        with stops_interrupt():
            yield
    except KeyboardInterrupt:
        message = f"interrupted; {state()}, the same command goes on from here"
        raise fail(message, STOPPED) from None


def names(text: str | None) -> list[str] | None:
    """The parts of a comma-separated option; None if the option was left out."""
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]
