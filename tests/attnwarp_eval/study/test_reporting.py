"""Progress of a run. Oracle: the cells, counted by hand."""

from edit_folders import Watched

from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.record import Failure
from attnwarp_eval.study.reporting import CellReporter


def test_a_cell_that_is_tried_once_more_counts_once_and_one_that_fails_is_told_in_a_line():
    cell = Cell({}, "a", "x", "warp", seed=0)
    steps, lines = [], []
    reporter = CellReporter(2, 5, Watched(lambda *step: steps.append(step[:2]), lines.append))
    for _ in range(2):  # a worker is lost
        reporter.start(cell)
    reporter.end(cell, Failure("a", "x", "warp", "out of memory", ""))
    assert steps == [(5, 7), (5, 7), (6, 7)]
    assert lines == ["a / x / warp FAILED: out of memory"]
