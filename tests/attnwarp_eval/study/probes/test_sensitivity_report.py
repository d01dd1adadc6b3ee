"""Hand-made records: which shares, correlations and sections follow from their numbers is worked
out by hand.
"""

import json
import math

import pytest
import written_runs

from attnwarp_eval.document.write import markdown
from attnwarp_eval.report.build import build
from attnwarp_eval.report.results import lines
from attnwarp_eval.statistics.intervals import interval
from attnwarp_eval.study.flawed_edits import CONDITIONS, RIGHT
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import Layout, report_of
from attnwarp_eval.study.probes.sensitivity.report import FLAWS, ROWS, beats, curve, power, share

MSE, CLIP = "fidelity.mse", "embedding.clip_similarity"
SPEC = {"size": 32, "rounds": 3, "encoders": {"clip": {"weights_sha256": "c" * 64}}}


def record(views, key=MSE, rounds=None):
    """A cell whose views have ``key`` in each condition: a dict of condition -> value, 1 where none
    is given.
    """
    return written_runs.record(
        [
            (f"e/v{i}", 0.0, {f"{key}.{c.name}": v.get(c.name, 1.0) for c in CONDITIONS})
            for i, v in enumerate(views)
        ],
        spec=SPEC,
        cost={"rounds": rounds or {key: [0.2, 0.1, 0.3]}},
    )


def results(records, seeds=(0,)):
    """The run whose records each scene has for every seed."""
    study = {
        "name": "by-hand",
        "scenes": list(records),
        "encoders": {"clip": "clip-small"},
        "probes": {"sensitivity": []},
    }
    return written_runs.results(
        study,
        [
            written_runs.outcome("sensitivity", scene, ["metrics"], one)
            for scene, one in records.items()
            for _ in seeds
        ],
    )


def read(data):
    return probe("sensitivity").read(data)


@pytest.mark.parametrize(
    ("key", "right", "flawed", "expected"),
    [
        (MSE, 0.0, 0.1, 1),  # less is better
        (MSE, 0.2, 0.1, 0),
        (MSE, 0.1, 0.1, 0.5),
        (MSE, 0.1, 0.1005, 0.5),  # within 1 %, its rtol
        (CLIP, 0.3, 0.2, 1),  # more is better
        (CLIP, 0.3, 0.3005, 0.5),  # within 1e-3, its atol
        (CLIP, 0.2, 0.3, 0),
        (CLIP, float("nan"), 0.3, None),
        (MSE, 0.0, float("inf"), None),
    ],
)
def test_the_right_result_wins_loses_or_cannot_be_told(key, right, flawed, expected):
    result = beats(key, right, flawed)
    assert math.isnan(result) if expected is None else result == expected


def test_a_share_is_the_mean_over_scenes_of_the_mean_over_views_with_ties_as_half_and_undefined_counted():
    one = record(
        [{RIGHT: 0.0, "blurred": 0.1}, {RIGHT: 0.2, "blurred": 0.1}, {RIGHT: 0.1, "blurred": None}]
    )
    two = record([{RIGHT: 0.0, "blurred": 0.1}, {RIGHT: 0.1, "blurred": 0.1}])
    result = share([("one", read(one)), ("two", read(two))], MSE, "blurred")
    assert result == interval({"one": [1.0, 0.0, float("nan")], "two": [1.0, 0.5]})
    assert result.mean == pytest.approx((0.5 + 0.75) / 2)
    assert result.undefined == 1


def steps(*values, key=MSE):
    names = [c.name for c in CONDITIONS[:5]]
    return {
        f"{key}.{name}": math.nan if value is None else value
        for name, value in zip(names, values, strict=True)
    }


@pytest.mark.parametrize(
    ("values", "key", "rank", "monotone"),
    [
        ((4.0, 3.0, 2.0, 1.0, 0.0), MSE, 1, 1),
        ((0.0, 1.0, 2.0, 3.0, 4.0), MSE, -1, 0),
        ((0.1, 0.2, 0.3, 0.4, 0.5), CLIP, 1, 1),
        ((0.1, 0.2, 0.3, 0.5, 0.4), CLIP, 0.9, 0),  # 1 - 6 * 2 / (5 * 24)
        ((0.1, 0.2, 0.3, 0.4, 0.4005), CLIP, 1, 0),  # the last step is within the tolerance
        ((None, 0.2, 0.3, 0.4, 0.5), CLIP, 1, 1),
        ((0.3,) * 5, CLIP, 0, 0),
        ((None, None, None, 0.4, 0.5), CLIP, None, None),
    ],
)
def test_a_curve_is_ranked_with_the_strength_and_its_steps_are_counted(values, key, rank, monotone):
    result = curve(steps(*values, key=key), key)
    if rank is None:
        assert all(map(math.isnan, result))
    else:
        assert result == (pytest.approx(rank), monotone)


def test_power_is_the_mean_over_the_flaws_a_metric_is_meant_for():
    row = next(row for row in ROWS if row.key == "consistency.delta_e")
    shares = {c.name: interval({"a": [0.0]}) for c in FLAWS}
    shares |= {"inconsistent": interval({"a": [1.0]}), "noisy": interval({"a": [0.5]})}
    shares["misplaced"] = interval({"a": [float("nan")]})
    assert power(row, shares) == 0.75


def test_the_report_shows_what_can_be_seen_and_says_where_a_metric_moves_the_wrong_way(tmp_path):
    views = [{RIGHT: 0.5, "blurred": 0.2, "strength_000": 0.9}]
    made = results({"one": record(views), "two": record(views)})
    sections = [s for _, s in report_of("sensitivity").sections(made, Layout(tmp_path))]
    assert [s.title for s in sections] == [
        "Which metric can see what",
        "Metrics against the strength of an edit",
        "What a metric costs and what it can see",
    ]
    (table,) = sections[0].tables
    shown = dict(zip(table.columns, table.rows[0], strict=True))
    assert shown["metric"] == "truth, PSNR"
    assert shown["blurred"] == "0"
    assert shown["strength 0"] == "1.00"
    drawing = (tmp_path / "figures" / "sensitivity.svg").read_text()
    assert "#67001f" in drawing  # the far red end of RdBu: below 0.5
    assert "#053061" in drawing  # and its blue one
    (costs,) = sections[2].tables
    assert (
        dict(zip(costs.columns, costs.rows[0], strict=True))["ms a picture"] == "200"
    )  # the median of three rounds


def test_records_of_several_seeds_are_of_one_scene(tmp_path):
    cells = {"one": record([{RIGHT: 0.5}] * 2), "two": record([{RIGHT: 0.5}] * 2), "lost": None}
    made = results(cells, seeds=(0, 1))
    first, strengths, _ = (s for _, s in report_of("sensitivity").sections(made, Layout(tmp_path)))
    assert first.text[0] == "**Measured on 2 of 3 scenes.**"
    assert first.text[1].startswith("2 right results of edits in 2 scenes, 4 pairs of a result")
    # No share lacks one of the two scenes.
    for table in (*first.tables, *strengths.tables):
        assert table.rows and not [text for row in table.rows for text in row if " of " in text]


def test_seconds_of_several_seeds_are_averaged(tmp_path):
    """Medians of 0.1 and 0.3 s."""
    views = [{RIGHT: 0.5}]
    both = [record(views, rounds={MSE: [t, t, 9.0]}) for t in (0.1, 0.3)]
    study = {
        "name": "by-hand",
        "scenes": ["one"],
        "seeds": [0, 1],
        "encoders": {"clip": "clip-small"},
        "probes": {"sensitivity": []},
    }
    outcomes = [written_runs.outcome("sensitivity", "one", ["metrics"], one) for one in both]
    made = written_runs.results(study, outcomes)
    *_, costs = [s for _, s in report_of("sensitivity").sections(made, Layout(tmp_path))]
    (table,) = costs.tables
    shown = dict(zip(table.columns, table.rows[0], strict=True))
    assert (shown["metric"], shown["ms a picture"]) == ("truth, PSNR", "200")


def test_without_timings_two_reports_of_other_seconds_are_the_same_bytes(tmp_path):
    texts = []
    for seconds in (0.1, 0.7):
        one = record([{RIGHT: 0.0}], rounds={MSE: [seconds] * 3})
        made = results({"one": one, "two": one})
        texts.append(markdown(build(made, tmp_path, timings=False)))
        assert "What a metric costs" in markdown(build(made, tmp_path))
    assert texts[0] == texts[1]
    assert "What a metric costs" not in texts[0]
    assert "Which metric can see what" in texts[0]


def test_results_keep_every_figure_with_what_is_undefined(tmp_path):
    made = results({"one": record([{RIGHT: 0.0, "blurred": None}, {RIGHT: 0.0, "blurred": 0.3}])})
    rows = {row["metric"]: row for row in map(json.loads, lines(made))}
    assert rows["fidelity.mse.blurred"]["undefined"] == 1
    assert rows["fidelity.mse.blurred"]["views"] == {"e/v0": None, "e/v1": 0.3}
    assert rows["fidelity.mse.blurred"]["value"] == 0.3


def test_a_study_without_the_probe_has_no_such_section(tmp_path):
    made = results({"one": None})
    assert list(report_of("sensitivity").sections(made, Layout(tmp_path))) == []
