"""Progress of an edit for people: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

LINE_SECONDS = 10.0
"""Seconds between two lines where there is no terminal."""


@dataclass(frozen=True)
class Step:
    """How an edit stands.

    Attributes:
        done, total: steps of denoising and iterations of tuning.
        text: the part at work.

    Example:
        >>> from attnwarp.propagate import Step
        >>> step = Step(30, 120, "stage 1 of 3: editing view 2 of 4")
        >>> f"{step.done / step.total:.0%}"
        '25%'
    """

    done: int
    total: int
    text: str


@contextmanager
def progress_display(
    console: Console | None = None, *, title: str = "edit"
) -> Iterator[Callable[[Step], None]]:
    """What to pass as ``watch`` to :func:`attnwarp.propagate.propagate`; writes to stderr unless
    told where.

    Example:
        >>> import sys
        >>> from rich.console import Console
        >>> from attnwarp.propagate import Step
        >>> from attnwarp.propagate.progress import progress_display
        >>> with progress_display(Console(file=sys.stdout, width=100), title="bear") as watch:
        ...     watch(Step(9, 9, "done"))
        bear [9/9] done
    """
    from rich.console import Console as Terminal
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column

    target = console or Terminal(stderr=True)
    if not target.is_terminal:
        yield _lines(target, title)
        return
    columns = (
        TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True)),
        BarColumn(bar_width=12, table_column=Column(no_wrap=True)),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[text]}", markup=False, table_column=Column(no_wrap=False)),
    )
    with Progress(*columns, console=target) as bar:
        task = bar.add_task(title, total=None, text="")
        yield lambda step: bar.update(task, completed=step.done, total=step.total, text=step.text)


def _lines(console: Console, title: str) -> Callable[[Step], None]:
    last, text = 0.0, ""

    def write(step: Step) -> None:
        nonlocal last, text
        now = time.perf_counter()
        if now - last < LINE_SECONDS and step.done != step.total:
            return
        last, text = now, step.text
        line = f"{title} [{step.done}/{step.total}] {text}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    return write
