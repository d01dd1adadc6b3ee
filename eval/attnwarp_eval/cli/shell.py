"""What every command shares: exit codes, errors in one line, and one progress bar."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from attnwarp.cli import shell
from attnwarp.cli.shell import STOPPED, USAGE, closed_pipe
from attnwarp.process import stops_interrupt
from attnwarp.reporting import LINE_SECONDS, Pace

if TYPE_CHECKING:
    import rich.progress
    from rich.console import Console
    from rich.progress import TaskID

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


class Progress:
    """Progress of one command on stderr: a bar on a terminal, else lines, now and then or for every
    call.

    Attributes:
        console: stderr.
    """

    def __init__(
        self, console: Console, bar: rich.progress.Progress, task: TaskID, lines: bool
    ) -> None:
        self.console = console
        self._bar = bar
        self._task = task
        self._lines = lines
        self._pace = Pace()
        self._told = time.monotonic()

    def __call__(self, done: int, total: int, step: str) -> None:
        """Show how far the work is.

        Args:
            done: steps finished.
            total: steps in all; 0 while their number is unknown.
            step: what is at work, or has just ended.
        """
        self._bar.update(self._task, description=step, completed=done, total=total or None)
        if not self.console.is_terminal and (self._lines or self._due()):
            left = self._pace.left(done, total)
            self.line(f"[{done}/{total}] {step}{left}" if total else step)

    def step(self, text: str) -> None:
        """Name what is at work, without a count."""
        self._bar.update(self._task, description=text)
        if not self.console.is_terminal and self._due():
            self.line(text)

    def _due(self) -> bool:
        """Whether a log file has had no line for a while."""
        now = time.monotonic()
        if now - self._told < LINE_SECONDS:
            return False
        self._told = now
        return True

    def line(self, text: str) -> None:
        """Print a line above the bar; a log file gets it whole, so that it can be searched."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def progress(total: int = 0, *, done: int = 0, lines: bool = False) -> Iterator[Progress]:
    """The progress bar of a command.

    Args:
        total: number of steps; 0 while it is unknown.
        done: steps finished before.
        lines: without a terminal, print a line for every call, not every ten seconds alone.
    """
    import rich.progress
    from rich.console import Console, RenderableType
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        ProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Known(ProgressColumn):
        """A column for work whose steps are counted; empty for any other."""

        def __init__(self, inner: ProgressColumn) -> None:
            super().__init__()
            self.inner = inner

        def render(self, task: rich.progress.Task) -> RenderableType:
            return Text() if task.total is None else self.inner(task)

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        Known(MofNCompleteColumn()),
        TimeElapsedColumn(),
        Known(TextColumn("left")),
        Known(TimeRemainingColumn()),
    )
    with rich.progress.Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        yield Progress(
            console, bar, bar.add_task("starting", total=total or None, completed=done), lines
        )
