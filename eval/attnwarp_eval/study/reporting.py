"""Progress of a run's cells."""

from __future__ import annotations

from attnwarp.reporting import Reporter
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.record import Failure


class CellReporter:
    """Reporter of cells as they begin and end.

    Args:
        todo: number of cells to compute.
        done: number of cells that an earlier run finished.
        report: callback for a step at each beginning and end, and for lines.
    """

    def __init__(self, todo: int, done: int, report: Reporter) -> None:
        self.report, self.done, self.total = report, done, done + todo

    def start(self, cell: Cell) -> None:
        """Report that a cell begins, or begins again."""
        self.report.step(self.done, self.total, cell.title)

    def end(self, cell: Cell, failure: Failure | None) -> None:
        """Report that a cell ended, with its failure."""
        self.done += 1
        if failure is not None:
            self.report.log(f"{cell.title} FAILED: {failure.error}")
        self.start(cell)
