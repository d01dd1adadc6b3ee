"""Reports of a run's cells, and of the time left that they tell."""

from __future__ import annotations

import math
import time
from collections.abc import Hashable, Sequence

from attnwarp.reporting import Reporter
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.record import Failure


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
        self._rest = {cell.id: cell for cell in todo}
        self._since: dict[str, float] = {}
        self._most = 1  # cells at work at a time
        self._spent: dict[Hashable, list[float]] = {}

    def start(self, cell: Cell) -> None:
        """Report that a cell begins."""
        self._since[cell.id] = time.perf_counter()
        self._most = max(self._most, len(self._since))
        self._step(cell)

    def end(self, cell: Cell, failure: Failure | None) -> None:
        """Report that a cell ended, and what went wrong."""
        seconds = time.perf_counter() - self._since.pop(cell.id)
        for group in _groups(cell):
            self._spent.setdefault(group, []).append(seconds)
        del self._rest[cell.id]
        self.done += 1
        if failure is not None:
            self.report.log(f"{cell.title} FAILED: {failure.error}")
        self._step(cell)

    def _step(self, cell: Cell) -> None:
        self.report.step(self.done, self.total, cell.title, self.left())

    def left(self) -> float:
        """Seconds; NaN while they cannot be told."""
        rest = self._rest.values()
        unseen = sum(cell.probe not in self._spent for cell in rest)
        if not self._spent or 2 * unseen > len(rest) or not rest:
            return math.nan
        now = time.perf_counter()
        seconds = sum(
            max(0.0, self._expected(cell) - (now - self._since.get(cell.id, now))) for cell in rest
        )
        return seconds / min(self._most, len(rest))

    def _expected(self, cell: Cell) -> float:
        spent = next(self._spent[group] for group in _groups(cell) if group in self._spent)
        return sum(spent) / len(spent)


def _groups(cell: Cell) -> tuple[Hashable, ...]:
    """Groups that a cell's seconds belong to, the narrowest first."""
    return (cell.probe, cell.variant), cell.probe, None
