"""How work that takes long tells how far it is; :mod:`attnwarp_eval.cli` shows it."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int, str], None]
"""Called with the steps done, all steps, and the step at work; 0 steps in all where their number is
not known.
"""


Tell = Callable[[str], None]
"""Called with the step at work, where somebody else counts the steps."""


def silent(done: int, total: int, step: str) -> None:
    """Show nothing."""


def untold(step: str) -> None:
    """Tell nobody."""
