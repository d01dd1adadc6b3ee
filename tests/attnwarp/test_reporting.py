"""Lines of progress in a log file. Oracle: work of a known pace, whose end follows by hand."""

import io
import types

import pytest
from rich.console import Console

import attnwarp.reporting
from attnwarp.reporting import display


@pytest.fixture
def clock(monkeypatch):
    now = types.SimpleNamespace(seconds=1000.0)
    fake = types.SimpleNamespace(perf_counter=lambda: now.seconds)
    monkeypatch.setattr(attnwarp.reporting, "time", fake)
    return now


def lines(clock, steps, total, seconds):
    """The lines of steps that each take so many seconds."""
    text = io.StringIO()
    with display(Console(file=text, force_terminal=False), title="bear") as show:
        for done in steps:
            show(done, total, "at work")
            clock.seconds += seconds
    return text.getvalue().splitlines()


def test_a_line_tells_the_time_left_and_the_last_one_has_none(clock):
    # The first step is counted at 0 s, step k at k - 1 s.
    assert lines(clock, range(1, 31), 30, 1.0) == [
        "bear [11/30] at work, 19 s left",
        "bear [21/30] at work, 9 s left",
        "bear [30/30] at work",
    ]


@pytest.mark.parametrize(
    ("total", "left"),
    [
        (100, "89 s"),
        (101, "2 min"),  # 90 s
        (5410, "90 min"),  # 5399 s
        (5411, "1.5 h"),  # 5400 s
        (36011, "10.0 h"),
    ],
)
def test_the_unit_of_the_time_left_grows_with_it(clock, total, left):
    (line,) = lines(clock, range(1, 12), total, 1.0)
    assert line == f"bear [11/{total}] at work, {left} left"


def test_steps_of_an_earlier_sitting_do_not_count_for_the_pace(clock):
    # 500 steps were done before; now each takes 10 s, and 97 are left after the second of now.
    assert lines(clock, (501, 502, 503), 600, 10.0)[-1] == "bear [503/600] at work, 16 min left"


def test_what_cannot_be_told_is_left_out(clock):
    # No step is done, or the number of all is not known.
    assert lines(clock, (0, 0), 9, 60.0) == ["bear [0/9] at work"]
    assert lines(clock, (1, 2), 0, 60.0) == ["bear [2/0] at work"]
    # Work that began 4 s ago, when it may still compile.
    pace = attnwarp.reporting.Pace()
    assert pace.left(0, 90) == ""
    clock.seconds += 4
    assert pace.left(8, 90) == ""
    clock.seconds += 4
    assert pace.left(16, 90) == ", 37 s left"  # 74 at 2 a second


def test_slow_first_steps_are_forgotten_and_other_work_begins_anew(clock):
    pace = attnwarp.reporting.Pace()
    assert pace.left(0, 20) == ""
    clock.seconds += 60  # one that compiles
    pace.left(1, 20)
    for done in range(2, 10):
        clock.seconds += 2
        said = pace.left(done, 20)
    # Of 9 steps the last 5 took 10 s; 11 are left. The mean of all would have said 94 s.
    assert said == ", 22 s left"
    clock.seconds += 10
    assert pace.left(0, 20) == ""
    clock.seconds += 10
    assert pace.left(1, 20) == ", 3 min left"  # 19 at 10 s
