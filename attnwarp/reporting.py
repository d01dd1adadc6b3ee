"""How long work is reported to people: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import bisect
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rich.console import Console

LINE_SECONDS = 10.0
"""Seconds between two lines where there is no terminal."""

PACE_SECONDS = 5.0
"""The time left is not told earlier."""

FEWEST = 4
"""Steps of which the latter half alone tells the pace; of fewer, one would decide."""


class Reporter:
    """Receives how work stands. This one shows nothing; subclasses do.

    Example:
        >>> from attnwarp.reporting import Reporter
        >>> class Printed(Reporter):
        ...     def step(self, done, total, text):
        ...         print(f"{done / total:.0%}: {text}")
        >>> Printed().step(3, 4, "tuning")
        75%: tuning
    """

    def step(self, done: int, total: int, text: str) -> None:
        """Receive that ``done`` of ``total`` steps are done, and what is at work."""

    def log(self, text: str) -> None:
        """Receive a line that stays to be read."""


SILENT = Reporter()


class Pace:
    """Tells the time left by the mean pace of the latter half of what was done since the first
    count, that of a resumed work: the first steps compile, and say little of the others. Of fewer
    than :data:`FEWEST` steps all count.

    Example:
        >>> from attnwarp.reporting import Pace
        >>> Pace().left(3, 9)  # too early to tell
        ''
    """

    def __init__(self) -> None:
        self._counts: list[tuple[float, int]] = []

    def left(self, done: int, total: int) -> str:
        """The end of a line, such as ", 3 min left"; empty while it cannot be told."""
        now = time.perf_counter()
        if self._counts and done < self._counts[-1][1]:
            self._counts.clear()  # other work
        if not self._counts or done > self._counts[-1][1]:
            self._counts.append((now, done))
        began, before = self._counts[0]
        if now - began < PACE_SECONDS or not before < done < total:
            return ""
        half = before + (done - before) // 2 if done - before >= FEWEST else before
        since, had = self._counts[bisect.bisect_right(self._counts, half, key=lambda c: c[1]) - 1]
        return f", {_duration((now - since) / (done - had) * (total - done))} left"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class Show(Protocol):
    """Shows how work stands."""

    def __call__(self, done: int, total: int, text: str, line: str | None = None) -> None:
        """Show ``done`` of ``total`` and the text; ``line`` replaces the text where there is no
        terminal.
        """
        ...


@contextmanager
def display(console: Console | None = None, *, title: str) -> Iterator[Show]:
    """A display of progress on stderr, or on another console.

    Args:
        console: of rich; a terminal gets a bar, anything else lines with the time left.
        title: of the work.

    Example:
        >>> import sys
        >>> from rich.console import Console
        >>> from attnwarp.reporting import display
        >>> with display(Console(file=sys.stdout, width=100), title="bear") as show:
        ...     show(9, 9, "done")
        bear [9/9] done
    """
    import rich.console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column

    target = console or rich.console.Console(stderr=True)
    if not target.is_terminal:
        yield _lines(target, title)
        return
    # On a narrow terminal the text goes over two lines rather than the counts losing their digits.
    columns = (
        TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True)),
        BarColumn(bar_width=12, table_column=Column(no_wrap=True)),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[text]}", markup=False, table_column=Column(no_wrap=False)),
    )
    with Progress(*columns, console=target) as bar:
        task = bar.add_task(title, total=None, text="")

        def show(done: int, total: int, text: str, line: str | None = None) -> None:
            bar.update(task, completed=done, total=total, text=text)

        yield show


def _lines(console: Console, title: str) -> Show:
    last = time.perf_counter()
    pace = Pace()

    def show(done: int, total: int, text: str, line: str | None = None) -> None:
        nonlocal last
        now, left = time.perf_counter(), pace.left(done, total)
        if now - last < LINE_SECONDS and done != total:
            return
        last = now
        whole = f"{title} [{done}/{total}] {text if line is None else line}{left}"
        console.print(whole, markup=False, highlight=False, soft_wrap=True)

    return show


@contextmanager
def reporter(
    console: Console | None = None, *, title: str, log: Callable[[str], None] | None = None
) -> Iterator[Reporter]:
    """Report on stderr, or on another console: a bar on a terminal, a line now and then elsewhere.

    Args:
        console: of rich.
        title: of the work.
        log: prints lines that stay; the console if left out.

    Example:
        >>> import sys
        >>> from rich.console import Console
        >>> from attnwarp.reporting import reporter
        >>> with reporter(Console(file=sys.stdout, width=100), title="bear") as report:
        ...     report.step(9, 9, "done")
        bear [9/9] done
    """
    with display(console, title=title) as show:
        yield _Shown(show, log)


class _Shown(Reporter):
    def __init__(self, show: Show, log: Callable[[str], None] | None) -> None:
        self._show, self._log = show, log

    def step(self, done: int, total: int, text: str) -> None:
        self._show(done, total, text)

    def log(self, text: str) -> None:
        if self._log is not None:
            self._log(text)
