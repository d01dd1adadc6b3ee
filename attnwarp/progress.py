"""Progress of long work for people: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rich.console import Console

LINE_SECONDS = 10.0
"""Seconds between two lines where there is no terminal."""


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
        console: of rich; a terminal gets a bar, anything else lines.
        title: of the work.

    Example:
        >>> import sys
        >>> from rich.console import Console
        >>> from attnwarp.progress import display
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

    def show(done: int, total: int, text: str, line: str | None = None) -> None:
        nonlocal last
        now = time.perf_counter()
        if now - last < LINE_SECONDS and done != total:
            return
        last = now
        whole = f"{title} [{done}/{total}] {text if line is None else line}"
        console.print(whole, markup=False, highlight=False, soft_wrap=True)

    return show
