"""Progress of a fit for people: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from attnwarp.fit.loop import Step

if TYPE_CHECKING:
    from rich.console import Console

LINE_SECONDS = 10.0
"""Seconds between two lines where there is no terminal."""


def describe(step: Step) -> str:
    """One line of figures."""
    held = "" if step.held_out is None else f", held out {_decibels(step.held_out)}"
    return f"loss {step.loss:.4f}, PSNR {_decibels(step.psnr)}{held}, {step.splats} splats"


def _decibels(value: float) -> str:
    return f"{value:.2f} dB" if math.isfinite(value) else "inf dB"


@contextmanager
def progress_display(
    console: Console | None = None, *, title: str = "fit"
) -> Iterator[Callable[[Step], None]]:
    """What to pass as ``watch`` to :func:`attnwarp.fit.fit`; writes to stderr unless told where.

    Example:
        >>> import sys
        >>> from rich.console import Console
        >>> from attnwarp.fit import Step
        >>> from attnwarp.fit.progress import progress_display
        >>> with progress_display(Console(file=sys.stdout, width=100), title="bear") as watch:
        ...     watch(Step(9, 9, loss=0.02, psnr=28.0, held_out=None, splats=60, seconds=2.0))
        bear [9/9] 2 s: loss 0.0200, PSNR 28.00 dB, 60 splats
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
    # On a narrow terminal the figures go over two lines rather than the counts losing their digits.
    columns = (
        TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True)),
        BarColumn(bar_width=12, table_column=Column(no_wrap=True)),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[figures]}", markup=False, table_column=Column(no_wrap=False)),
    )
    with Progress(*columns, console=target) as bar:
        task = bar.add_task(title, total=None, figures="")

        def update(step: Step) -> None:
            bar.update(
                task, completed=step.iteration, total=step.iterations, figures=describe(step)
            )

        yield update


def _lines(console: Console, title: str) -> Callable[[Step], None]:
    last = time.perf_counter()

    def write(step: Step) -> None:
        nonlocal last
        now = time.perf_counter()
        if now - last < LINE_SECONDS and step.iteration != step.iterations:
            return
        last = now
        text = (
            f"{title} [{step.iteration}/{step.iterations}] {step.seconds:.0f} s: {describe(step)}"
        )
        console.print(text, markup=False, highlight=False, soft_wrap=True)

    return write
