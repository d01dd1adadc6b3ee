"""Progress of a run's cells, with an estimate of the time left."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Hashable, Sequence

from attnwarp.reporting import Reporter
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.record import Failure

LEFT_SECONDS = 0.1
"""Least seconds between two estimates of the time left: cells may be faster, and of many kinds."""


class CellReporter:
    """Reporter of cells as they begin and end.

    The estimate for a cell to do is the mean seconds of finished cells of its probe and variant,
    else of its probe, else of all cells. The time left is unknown while most cells to do are of
    probes without a finished cell.

    Args:
        todo: cells to compute.
        done: cells that an earlier run finished.
        report: callback for a step at each beginning and end, and for lines.
    """

    def __init__(self, todo: Sequence[Cell], done: int, report: Reporter) -> None:
        self.report, self.done, self.total = report, done, done + len(todo)
        self._waiting = Counter(_kind(cell) for cell in todo)
        self._working: dict[str, tuple[Kind, float]] = {}
        self._most = 1  # cells at work at a time
        self._spent: dict[Hashable, tuple[int, float]] = {}
        self._told = -math.inf, math.nan

    def start(self, cell: Cell) -> None:
        """Report that a cell begins, or begins again."""
        if cell.id not in self._working:
            self._waiting[_kind(cell)] -= 1
        self._working[cell.id] = _kind(cell), time.perf_counter()
        self._most = max(self._most, len(self._working))
        self._step(cell)

    def end(self, cell: Cell, failure: Failure | None) -> None:
        """Report that a cell ended, with its failure."""
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
        """Seconds left; NaN while they are unknown."""
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
    """Groups of a cell for the means of seconds, the narrowest first."""
    return kind, kind[0], None
