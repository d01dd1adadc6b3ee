"""Progress of a fit for people."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from attnwarp.fit.loop import Step
from attnwarp.reporting import display

if TYPE_CHECKING:
    from rich.console import Console


def describe(step: Step) -> str:
    """One line of figures."""
    held = "" if step.held_out is None else f", held out {_decibels(step.held_out)}"
    if held and step.evaluated not in (None, step.iteration):
        held += f" at {step.evaluated}"
    return f"loss {step.loss:.4f}, PSNR {_decibels(step.psnr)}{held}, {step.splats} splats"


def _decibels(value: float) -> str:
    return f"{value:.2f} dB" if math.isfinite(value) else "inf dB"


def more_points(count: int, most: int) -> str:
    """What is said of a start that has more splats than a fit may grow to.

    Example:
        >>> more_points(5000, 4000)
        '5000 first points, more than --max-splats 4000: the fit keeps them all and adds none'
    """
    return (
        f"{count} first points, more than --max-splats {most}: the fit keeps them all and adds none"
    )


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
    with display(console, title=title) as show:

        def watch(step: Step) -> None:
            figures = describe(step)
            show(step.iteration, step.iterations, figures, f"{step.seconds:.0f} s: {figures}")

        yield watch
