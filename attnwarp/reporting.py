"""Progress reports of long work: a bar on a terminal, occasional lines elsewhere."""

from __future__ import annotations

import bisect
import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, Task

LINE_SECONDS = 10.0
"""Seconds between two lines without a terminal."""

PACE_SECONDS = 5.0
"""Seconds before the first estimate of the time left."""

FEWEST = 4
"""Number of steps from which only the latter half sets the pace; for fewer, one would decide."""


class Reporter:
    """Receiver of progress. This class shows nothing; subclasses do.

    Example:
        >>> from attnwarp.reporting import Reporter
        >>> class Printed(Reporter):
        ...     def step(self, done, total, text, left=None):
        ...         print(f"{done / total:.0%}: {text}")
        >>> Printed().step(3, 4, "tuning")
        75%: tuning
    """

    def step(self, done: int, total: int, text: str, left: float | None = None) -> None:
        """Receive the number of finished steps, and the current step.

        Args:
            text: name of the current step, or of the step that has just ended.
            left: seconds left, if the work knows better than the pace; NaN while it does not
                know.
        """

    def log(self, text: str) -> None:
        """Receive a line that stays on the screen."""


SILENT = Reporter()


class Part(Reporter):
    """Reporter of one part of several works: its messages are shown with the count of all works."""

    def __init__(self, report: Reporter, done: int, total: int) -> None:
        self._report, self._done, self._total = report, done, total

    def step(self, done: int, total: int, text: str, left: float | None = None) -> None:
        """Report the current step."""
        self._report.step(self._done, self._total, text)

    def log(self, text: str) -> None:
        """Pass a line on."""
        self._report.log(text)


class Pace:
    """Estimator of the time left from the mean pace of the latter half of the steps since the first
    count, where a resumed work began: the first steps compile and are not typical. With fewer than
    :data:`FEWEST` steps, all count."""

    def __init__(self) -> None:
        self._counts: list[tuple[float, int]] = []

    def left(self, done: int, total: int) -> float | None:
        """Estimate the seconds left; None while unknown."""
        now = time.perf_counter()
        if self._counts and done < self._counts[-1][1]:
            self._counts.clear()  # a different work
        if not self._counts or done > self._counts[-1][1]:
            self._counts.append((now, done))
        began, before = self._counts[0]
        if now - began < PACE_SECONDS or not before < done < total:
            return None
        half = before + (done - before) // 2 if done - before >= FEWEST else before
        since, had = self._counts[bisect.bisect_right(self._counts, half, key=lambda c: c[1]) - 1]
        return (now - since) / (done - had) * (total - done)


def duration(seconds: float) -> str:
    """Format seconds for a person.

    Example:
        >>> from attnwarp.reporting import duration
        >>> duration(100), duration(5500)
        ('2 min', '1.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class _Shown(Reporter):
    """Reporter that forwards steps to `show`, which subclasses implement per output."""

    def __init__(self, console: Console, title: str) -> None:
        self.console, self.title = console, title
        self._pace = Pace()

    def step(self, done: int, total: int, text: str, left: float | None = None) -> None:
        paced = self._pace.left(done, total)
        known = paced if left is None else None if math.isnan(left) else left
        self.show(done, total, text, known)

    def show(self, done: int, total: int, text: str, left: float | None) -> None:
        raise NotImplementedError

    def log(self, text: str) -> None:
        # Unwrapped, so that the line can be searched.
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)


class _Lines(_Shown):
    def __init__(self, console: Console, title: str, every: bool) -> None:
        super().__init__(console, title)
        self._every = every
        self._last = time.perf_counter()
        self._done: int | None = None

    def show(self, done: int, total: int, text: str, left: float | None) -> None:
        now = time.perf_counter()
        further = self._every and self._done not in (None, done)
        self._done = done
        if now - self._last < LINE_SECONDS and not further and (done != total or not total):
            return
        self._last = now
        count = f"[{done}/{total}]" if total else ""
        rest = "" if left is None else f", {duration(left)} left"
        self.log(" ".join(part for part in (self.title, count, text + rest) if part))


class _Bar(_Shown):
    def __init__(self, console: Console, title: str, stack: ExitStack) -> None:
        super().__init__(console, title)
        self._stack = stack
        self._bar: Progress | None = None

    def show(self, done: int, total: int, text: str, left: float | None) -> None:
        if self._bar is None:  # lines before the first step need no bar
            self._bar = self._stack.enter_context(_bar(self.console))
            self._bar.add_task(self.title, total=None, text=text, count="", ends=None)
        self._bar.update(
            self._bar.task_ids[0],
            completed=done,
            total=total or None,
            text=text,
            count=f"{done}/{total}" if total else "",
            ends=None if left is None else time.perf_counter() + left,
        )


def _bar(console: Console) -> Progress:
    from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn
    from rich.table import Column
    from rich.text import Text

    class Left(ProgressColumn):
        def render(self, task: Task) -> Text:
            ends = task.fields["ends"]
            left = 0 if ends is None else ends - time.perf_counter()
            return Text(f"{duration(left)} left" if left > 0 else "")

    def text(name: str, **column: Any) -> TextColumn:
        return TextColumn(name, markup=False, table_column=Column(**column))

    # On a narrow terminal the text wraps, so that the counts keep their digits.
    return Progress(
        text("{task.description}", no_wrap=True),
        BarColumn(bar_width=12, table_column=Column(no_wrap=True)),
        text("{task.fields[count]}", no_wrap=True),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        Left(table_column=Column(no_wrap=True)),
        text("{task.fields[text]}"),
        console=console,
    )


@contextmanager
def reporter(
    console: Console | None = None, *, title: str = "", every: bool = False
) -> Iterator[Reporter]:
    """Report on stderr or another console: a bar on a terminal, occasional lines elsewhere.

    Args:
        console: console of rich.
        title: title of the work.
        every: True prints a line for each finished step without a terminal.

    Example:
        >>> import sys
        >>> from rich.console import Console
        >>> from attnwarp.reporting import reporter
        >>> with reporter(Console(file=sys.stdout, width=100), title="bear") as report:
        ...     report.step(9, 9, "done")
        bear [9/9] done
    """
    from rich.console import Console as RichConsole

    target = console or RichConsole(stderr=True)
    if not target.is_terminal:
        yield _Lines(target, title, every)
        return
    with ExitStack() as stack:
        yield _Bar(target, title, stack)
