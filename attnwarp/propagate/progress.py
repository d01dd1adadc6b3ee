"""Progress of an edit for people."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from attnwarp.progress import display

if TYPE_CHECKING:
    from rich.console import Console


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
    with display(console, title=title) as show:
        yield lambda step: show(step.done, step.total, step.text)
