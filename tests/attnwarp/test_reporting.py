"""Lines of progress in a log file. Oracle: work of a known pace, whose end follows by hand."""

import io
import math

import pytest
from rich.console import Console

import attnwarp.reporting
from attnwarp.reporting import Part, reporter


def lines(clock, steps, total, seconds):
    """The lines of steps that each take so many seconds."""
    text = io.StringIO()
    with reporter(Console(file=text, force_terminal=False), title="bear") as report:
        for done in steps:
            report.step(done, total, "at work")
            clock.seconds += seconds
    return text.getvalue().splitlines()


def test_a_line_tells_the_time_left_and_the_last_one_has_none(clock):
    # The first step is counted at 0 s, step k at k - 1 s.
    assert lines(clock, range(1, 31), 30, 1.0) == [
        "bear [11/30] at work, 19 s left",
        "bear [21/30] at work, 9 s left",
        "bear [30/30] at work",
    ]


def test_steps_of_an_earlier_sitting_do_not_count_for_the_pace(clock):
    # 500 steps were done before; now each takes 10 s, and 97 are left after the second of now.
    assert lines(clock, (501, 502, 503), 600, 10.0)[-1] == "bear [503/600] at work, 16 min left"


def test_what_cannot_be_told_is_left_out(clock):
    # No step is done, or the number of all is not known.
    assert lines(clock, (0, 0), 9, 60.0) == ["bear [0/9] at work"]
    assert lines(clock, (1, 2), 0, 60.0) == ["bear at work"]
    # Work that began 4 s ago, when it may still compile.
    pace = attnwarp.reporting.Pace()
    assert pace.left(0, 90) is None
    clock.seconds += 4
    assert pace.left(8, 90) is None
    clock.seconds += 4
    assert pace.left(16, 90) == 37  # 74 at 2 a second


def test_slow_first_steps_are_forgotten_and_other_work_begins_anew(clock):
    pace = attnwarp.reporting.Pace()
    assert pace.left(0, 20) is None
    clock.seconds += 60  # one that compiles
    pace.left(1, 20)
    for done in range(2, 10):
        clock.seconds += 2
        said = pace.left(done, 20)
    # Of 9 steps the last 5 took 10 s; 11 are left. The mean of all would have said 94 s.
    assert said == 22
    clock.seconds += 10
    assert pace.left(0, 20) is None
    clock.seconds += 10
    assert pace.left(1, 20) == 190  # 19 at 10 s


def test_a_log_file_gets_each_line_whole():
    text = io.StringIO()
    lost = "worker tcp://127.0.0.1:39003 was lost at spheres / calibration / calibration; " * 3
    with reporter(Console(file=text, width=80), every=True) as report:
        report.step(0, 18, "at work")
        report.log(lost)
        report.step(1, 18, lost)
    assert text.getvalue() == f"{lost}\n[1/18] {lost}\n"


def test_work_that_is_only_named_gets_a_line_every_ten_seconds(clock):
    text = io.StringIO()
    with reporter(Console(file=text)) as report:
        for seconds, view in ((4, "view 1"), (7, "view 2"), (1, "view 3")):
            clock.seconds += seconds
            report.step(0, 0, view)
    assert text.getvalue() == "view 2\n"


def test_every_step_that_is_done_gets_a_line_and_the_time_left_that_its_work_knows(clock):
    text = io.StringIO()
    with reporter(Console(file=text), every=True) as report:
        for done, left in ((0, None), (0, None), (1, 95.0), (1, 90.0), (2, math.nan)):
            report.step(done, 3, "cell", left)
            clock.seconds += 9
    assert text.getvalue().splitlines() == ["[1/3] cell, 2 min left", "[2/3] cell"]


def test_a_part_keeps_the_count_of_the_whole():
    text = io.StringIO()
    with reporter(Console(file=text), every=True) as report:
        report.step(0, 9, "view 0")
        part = Part(report, 3, 9)
        part.step(1, 400, "view 1")
        part.log("a line")
    assert text.getvalue() == "[3/9] view 1\na line\n"


@pytest.mark.parametrize("width", [80, 140])
def test_on_a_terminal_the_counts_keep_their_digits(width):
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=width, color_system=None)
    figures = "loss 0.0374, PSNR 33.91 dB, held out 33.20 dB at 2500, 20000 splats"
    with reporter(console, title="bear") as report:
        report.step(2999, 3000, figures)
        report.step(3000, 3000, figures)
    assert "3000/3000" in text.getvalue() and "loss 0.0374" in text.getvalue()
    assert "\N{HORIZONTAL ELLIPSIS}" not in text.getvalue()


def test_a_bar_has_counts_and_the_time_left_only_where_they_are_known():
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=100)
    with reporter(console) as report:
        assert text.getvalue() == ""  # before the first step there is no bar
        report.step(0, 0, "points")
    assert "points" in text.getvalue()
    assert "left" not in text.getvalue() and "0/0" not in text.getvalue()
    with reporter(console) as report:
        report.step(3, 9, "view 3", 40.9)
    assert "3/9" in text.getvalue() and "41 s left" in text.getvalue()
