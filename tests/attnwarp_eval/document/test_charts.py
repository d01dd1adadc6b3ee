"""Figures as they are drawn: boxes of text in pixels, by matplotlib's own measure."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from further import further
from matplotlib.text import Text
from scipy import stats

from attnwarp_eval.document import charts
from attnwarp_eval.statistics.intervals import Interval, interval


def around(value: float) -> Interval:
    return Interval(
        value, 0.9 * value, 1.1 * value, scenes=3, views=9, undefined=0, detectable=0.1, p=0.01
    )


@pytest.mark.parametrize("spread", further(0.0, 0.02))
@pytest.mark.parametrize("log", further(True, False))
def test_names_at_a_front_cover_no_other_and_stay_inside(tmp_path, log, spread) -> None:
    random = np.random.default_rng(0)
    points = {
        f"variant {k}": tuple(around(v) for v in (1 + spread * random.random(2))) for k in range(8)
    }
    points["alone"] = (around(10.0), around(10.0))
    # The second panel's label of y makes the first one narrower once its names stand.
    with charts.drawing(tmp_path / "front.svg", columns=2) as panels:
        for axes, y in zip(panels, ("error", "an error with a very long name " * 3), strict=True):
            charts.cost_front(axes, points, x="seconds", y=y, title="front", log=log)
    for axes in panels:
        notes = axes.texts
        assert sorted(note.get_text() for note in notes) == sorted(points)
        boxes = {note.get_text(): Text.get_window_extent(note) for note in notes}
        for one, other in itertools.combinations(boxes.values(), 2):
            assert not one.overlaps(other)
        frame = axes.get_window_extent().padded(1)
        assert all(frame.contains(*box.min) and frame.contains(*box.max) for box in boxes.values())
        (alone,) = [note for note in notes if note.get_text() == "alone"]
        assert np.hypot(*alone.xyann) < 60 and not alone.arrow_patch.get_visible()
    assert "variant 3" in (tmp_path / "front.svg").read_text()


def test_a_bar_ends_at_the_lowest_and_the_highest_of_few_scenes_and_else_at_the_interval() -> None:
    values = {f"scene {k}": [float(k)] for k in range(1, 7)}
    few = dict(list(values.items())[:5])
    assert charts.ends(interval(few)) == (1.0, 5.0)
    # By scipy: t(0.975, 5) = 2.5706 times the standard error of 1 to 6.
    half = stats.t.ppf(0.975, 5) * np.std(np.arange(1, 7), ddof=1) / np.sqrt(6)
    assert charts.ends(interval(values)) == pytest.approx((3.5 - half, 3.5 + half))
    assert all(map(np.isnan, charts.ends(interval({"scene 1": [float("nan")]}))))


@pytest.mark.parametrize("dominated", [charts.MOST_NAMES - 2, charts.MOST_NAMES - 1])
def test_a_crowded_front_names_its_own_points_and_the_others_in_titles(tmp_path, dominated) -> None:
    points = {f"poor {k}": (around(5 + 0.1 * k), around(3.0)) for k in range(dominated)}
    points |= {"fast": (around(1.0), around(2.0)), "exact": (around(2.0), around(1.0))}
    with charts.drawing(tmp_path / "front.svg") as (axes,):
        assert charts.cost_front(axes, points, x="s", y="e", title="f") == ["fast", "exact"]
        names = {note.get_text() for note in axes.texts}
    assert names == ({"fast", "exact"} if len(points) > charts.MOST_NAMES else set(points))
    text = (tmp_path / "front.svg").read_text()
    assert all(f"{name}: " in text for name in points)


@pytest.mark.parametrize(("apart", "shifts"), [({}, (0, 0, 0)), ({"apart": 2.0}, (-2, 0, 2))])
def test_lines_stand_where_their_numbers_are_or_apart_about_there(tmp_path, apart, shifts) -> None:
    series = [charts.Line(name, [0.5, 1.0], [around(1.0), around(2.0)]) for name in "abc"]
    with charts.drawing(tmp_path / "lines.svg") as (axes,):
        charts.lines(axes, series, x="seconds", y="dB", title="fits", **apart)
        for bars, shift in zip(axes.containers, shifts, strict=True):
            np.testing.assert_allclose(bars.lines[0].get_xdata(), [0.5 + shift, 1.0 + shift])


@pytest.mark.parametrize(("log", "lowest"), [(False, -11.0), (True, 0.15)])
def test_bars_of_a_front_are_whole_and_cut_on_logarithmic_axes_alone(tmp_path, log, lowest) -> None:
    wide = Interval(3.0, -11.0, 17.0, scenes=2, views=9, undefined=0, detectable=0.1, p=0.5)
    with charts.drawing(tmp_path / "front.svg") as (axes,):
        points = {"wide": (around(1.0), wide)}
        charts.cost_front(axes, points, x="seconds", y="error", title="front", log=log)
        across, along = axes.containers[0].lines[2]
        (bar,) = along.get_segments()
        assert bar[:, 1] == pytest.approx([lowest, 17.0])
        assert across.get_segments()[0][:, 0] == pytest.approx([0.9, 1.1])


def test_dollars_in_a_name_stand_for_themselves(tmp_path) -> None:
    """Two dollars would begin and end a formula; Matplotlib's SVG has every text as a comment."""
    name, title = "costs $x_{ or $y", "$^ and $"
    one = around(1.0)
    with charts.drawing(tmp_path / "lines.svg") as (axes,):
        charts.lines(axes, [charts.Line(name, [0.0, 1.0], [one, one])], x=title, y="y", title=title)
    with charts.drawing(tmp_path / "front.svg") as (axes,):
        charts.cost_front(axes, {name: (one, one)}, x="x", y="y", title=title)
    for file in ("lines", "front"):
        drawn = (tmp_path / f"{file}.svg").read_text()
        assert f"<!-- {name} -->" in drawn and f"<!-- {title} -->" in drawn
