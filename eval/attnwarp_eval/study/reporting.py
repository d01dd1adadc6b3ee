"""Reports of a run's cells, and of the time left that they tell."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Hashable, Sequence

from attnwarp.reporting import Reporter
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.record import Failure

LEFT_SECONDS = 0.1
"""Least time between two workings of the time left: cells may take less, and have many kinds."""


class CellReporter:
    """Reports cells as they begin and end.

    A cell that is left takes the mean seconds of finished ones of its probe and variant. Where
    there is none yet, it takes the mean of its probe, else of all. The time left is not told while
    most cells that are left are of probes of which none has finished.

    Args:
        todo: cells to compute.
        done: cells that an earlier run finished.
        report: receives a step for each beginning and end, and lines.
    """

    def __init__(self, todo: Sequence[Cell], done: int, report: Reporter) -> None:
        self.report, self.done, self.total = report, done, done + len(todo)
        self._waiting = Counter(_kind(cell) for cell in todo)
        self._working: dict[str, tuple[Kind, float]] = {}
        self._most = 1  # cells at work at a time
        self._spent: dict[Hashable, tuple[int, float]] = {}
        self._told = -math.inf, math.nan

    def start(self, cell: Cell) -> None:
        """Report that a cell begins, or begins once more."""
        if cell.id not in self._working:
            self._waiting[_kind(cell)] -= 1
        self._working[cell.id] = _kind(cell), time.perf_counter()
        self._most = max(self._most, len(self._working))
        self._step(cell)

    def end(self, cell: Cell, failure: Failure | None) -> None:
        """Report that a cell ended, and what went wrong."""
        kind, since = self._working.pop(cell.id)
        seconds = time.perf_counter() - since
        for group in _groups(kind):
            count, total = self._spent.get(group, (0, 0.0))
            self._spent[group] = count + 1, total + seconds
        self.done += 1
        if failure is not None:
            self.report.log(f"{cell.title} FAILED: {failure.error}")
        self._step(cell)

    def _step(self, cell: Cell) -> None:
        self.report.step(self.done, self.total, cell.title, self.left())

    def left(self) -> float:
        """Seconds; NaN while they cannot be told."""
        now = time.perf_counter()
        if now - self._told[0] >= LEFT_SECONDS or self.done == self.total:
            self._told = now, self._left(now)
        return self._told[1]

    def _left(self, now: float) -> float:
        rest = self.total - self.done
        parts = [(kind, count, 0.0) for kind, count in self._waiting.items()]
        parts += [(kind, 1, now - since) for kind, since in self._working.values()]
        unseen = sum(count for kind, count, _ in parts if kind[0] not in self._spent)
        if not self._spent or 2 * unseen > rest or not rest:
            return math.nan
        seconds = sum(count * max(0.0, self._expected(kind) - gone) for kind, count, gone in parts)
        return seconds / min(self._most, rest)

    def _expected(self, kind: Kind) -> float:
        count, total = next(self._spent[g] for g in _groups(kind) if g in self._spent)
        return total / count


Kind = tuple[str, str]
"""Probe and variant of a cell."""


def _kind(cell: Cell) -> Kind:
    return cell.probe, cell.variant


def _groups(kind: Kind) -> tuple[Hashable, ...]:
    """Groups that a cell's seconds belong to, the narrowest first."""
    return kind, kind[0], None
