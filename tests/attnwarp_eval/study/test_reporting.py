"""Time left of a run. Oracle: cells of known seconds, whose end follows by hand."""

import math
import types

import pytest
from edit_folders import Watched

from attnwarp_eval.study import reporting
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.record import Failure
from attnwarp_eval.study.reporting import CellReporter

UNKNOWN = pytest.approx(math.nan, nan_ok=True)


@pytest.fixture
def clock(monkeypatch):
    now = types.SimpleNamespace(seconds=1000.0)
    fake = types.SimpleNamespace(perf_counter=lambda: now.seconds)
    monkeypatch.setattr(reporting, "time", fake)
    return now


def cells(*kinds, scenes=("a", "b")):
    return [
        Cell({"scene": scene, "kind": kind}, scene, *reversed(kind.split()), seed=0)
        for scene in scenes
        for kind in kinds
    ]


def lefts(clock, todo, seconds):
    """Steps told at the end of each cell, computed one by one."""
    said = []
    reporter = CellReporter(todo, 0, Watched(lambda *step: said.append(step)))
    for cell in todo:
        reporter.start(cell)
        clock.seconds += seconds[cell.probe, cell.variant]
        reporter.end(cell, None)
    return [left for done, total, text, left in said[1::2]]


def test_cells_that_are_left_take_the_mean_of_their_kind(clock):
    seconds = {("warp", "x"): 10, ("warp", "y"): 1}
    # After x: y, x, y at 10 each; then each kind is known.
    todo = cells("warp x", "warp y")
    assert lefts(clock, todo, seconds) == [30, 11, 1, UNKNOWN]


def test_nothing_is_told_while_most_is_of_probes_that_never_finished(clock):
    seconds = {("calibration", "c"): 60, ("warp", "x"): 1, ("warp", "y"): 1}
    todo = cells("calibration c", "warp x", "warp y")
    # A mean of all would have told 300 s after the first; 64 are left.
    assert lefts(clock, todo, seconds) == [UNKNOWN, 63, 62, 2, 1, UNKNOWN]


def test_workers_share_what_is_left_and_what_they_are_at_is_partly_done(clock):
    todo = cells("warp x", scenes="abcd")
    said = []
    reporter = CellReporter(todo, 5, Watched(lambda *step: said.append(step)))
    reporter.start(todo[0])
    clock.seconds += 2
    reporter.start(todo[1])
    clock.seconds += 6
    reporter.end(todo[0], None)
    # 8 s a cell: of one 2 s are left, and two wait, for two workers.
    assert said == [(5, 9, todo[0].title, UNKNOWN), (5, 9, todo[1].title, UNKNOWN),
                    (6, 9, todo[0].title, 9.0)]  # fmt: skip


def test_a_step_among_many_cells_costs_what_one_among_few_costs(clock):
    """Oracle: looks at cells, which follow their number and not its square."""

    class Counted(Cell):
        looks = 0

        def __getattribute__(self, name):
            Counted.looks += name == "probe"
            return super().__getattribute__(name)

    def looks(count):
        todo = [Counted({"k": k}, "a", f"v{k % 3}", "warp", 0) for k in range(count)]
        Counted.looks = 0
        lefts(clock, todo, {("warp", f"v{k}"): 1 for k in range(3)})
        return Counted.looks

    assert looks(200) == 2 * looks(100)


def test_a_cell_that_is_tried_once_more_counts_once(clock):
    todo = cells("warp x", scenes="ab")
    said = []
    reporter = CellReporter(todo, 0, Watched(lambda *step: said.append(step)))
    for seconds in (3, 5):  # a worker is lost after 3
        reporter.start(todo[0])
        clock.seconds += seconds
    reporter.end(todo[0], None)
    assert said[-1] == (1, 2, todo[0].title, 5.0)


def test_a_cell_that_fails_is_told_in_a_line(clock):
    (cell,) = cells("warp x", scenes="a")
    lines = []
    reporter = CellReporter([cell], 0, Watched(log=lines.append))
    reporter.start(cell)
    reporter.end(cell, Failure("a", "x", "warp", "out of memory", ""))
    assert lines == ["a / x / warp FAILED: out of memory"]
