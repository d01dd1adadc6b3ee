"""Answer of a report. Oracle: hand-made records whose means follow by hand."""

import pytest
import written_runs
from pydantic import ValidationError

from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.write import markdown
from attnwarp_eval.report.answer import answer
from attnwarp_eval.study.record import PictureFile
from attnwarp_eval.study.study import parse_study

SCENES = ["one", "two", "three"]
HIDDEN, ERROR = "occlusion.hidden_share", "warp.feature_all_accepted.64"
# Scene -> (share hidden at 30 degrees, at 90 degrees, error of features at both).
VALUES = {
    "masked": [(0.0, 0.02, 0.2), (0.0, 0.01, 0.3), (0.0, 0.03, 0.1)],
    "open": [(0.1, 0.60, 0.9), (0.1, 0.70, 0.8), (0.1, 0.80, 1.0)],
}
STUDY = {
    "name": "hand-made",
    "scenes": SCENES,
    "variants": {"masked": {}, "open": {"set": {"depth_agreement": False}}},
    "probes": {"warp": ["masked", "open"]},
    "answer": {
        "question": "What does the mask buy?",
        "sentences": ["Without it {hidden|open} is hidden, with it {hidden|masked}."],
        "variants": {"masked": "keeps what is seen", "open": "keeps all"},
        "columns": {
            "hidden": {"probe": "warp", "metric": HIDDEN, "yaw": [60, 180]},
            "feature error": {"probe": "warp", "metric": ERROR},
        },
        "decides": "feature error",
    },
}


def run(scenes=SCENES, asked=STUDY["answer"], taken=None):
    """A run; ``taken``: seconds of masked and open, taken in turn."""
    cells = []
    for name, values in VALUES.items():
        for scene, (near, far, error) in zip(scenes, values * 2, strict=False):
            views = [
                ("yaw030", 30.0, {HIDDEN: near, ERROR: error}),
                ("yaw090", 90.0, {HIDDEN: far, ERROR: error}),
            ]
            record = written_runs.record(views, cost={"seconds": {"steady": 0.05}})
            cells.append(written_runs.outcome("warp", scene, [name], record))
    study = {**STUDY, "scenes": scenes, "answer": asked}
    if taken is not None:
        study["probes"] = {**STUDY["probes"], "timing": ["masked", "open"]}
        pair = [[seconds] * 3 for seconds in (*taken, taken[0])]  # the first one runs twice
        data = written_runs.record(
            [], spec={"rounds": 3, "views": ["v0"]}, cost={"rounds": {"render": pair, "pair": pair}}
        )
        cells.append(written_runs.outcome("timing", scenes[0], ["masked", "open"], data))
    return written_runs.results(study, cells)


def test_a_sentence_has_the_share_of_a_gain_that_a_control_reaches():
    column = {"probe": "warp", "metric": HIDDEN, "alone": "open"}
    figures = {
        "none": {**column, "control": "open"},  # reaches what is reached without anything
        "all": {**column, "control": "masked"},
    }
    asked = {**STUDY["answer"], "figures": figures}
    asked["sentences"] = ["The control reaches {none|masked}, or {all|masked}."]
    text = answer(run(asked=asked)).text
    assert text[1] == "The control reaches 0 % (0 to 0 %), or 100 % (100 to 100 %)."


def test_an_answer_has_the_means_over_scenes_of_views_in_range_as_words():
    section = answer(run(taken=(0.05, 0.05)))
    assert section.text[:2] == [
        "**What does the mask buy?**",
        "Without it 70 % is hidden, with it 2.0 %.",
    ]
    table = section.tables[0]
    assert table.columns == ["variant", "hidden", "feature error", "time a view, ms"]
    assert table.rows == [
        ["`masked`", "**2.0 %** (2.0, 1.0, 3.0 %)", "**20 %** (20, 30, 10 %)", "50.0"],
        ["`open`", "70 % (60, 70, 80 %)", "90 % (90, 80, 100 %)", "50.0"],
    ]


def test_views_without_a_value_are_counted_and_not_averaged_in():
    made = run()
    made.cells[0].record.views[0].metrics[ERROR] = float("nan")  # one of two views of one scene
    assert answer(made).tables[0].rows[0][2] == "**20 %** (20, 30, 10 %), 1 undefined"


def test_the_variant_that_is_best_where_it_decides_is_recommended_from_six_scenes_on():
    section = answer(run([f"scene{k}" for k in range(6)]))
    advice = section.text[2]
    assert advice.startswith("Of these variants `masked` has the best feature error:")
    assert section.tables[0].rows[0][1:3] == ["**2.0 %**", "**20 %**"]  # without their range
    assert "nothing in general" not in advice
    advice = answer(run()).text[2]
    assert advice.startswith("Of these variants `masked` has the best feature error here: 20 %.")
    assert "brackets hold those of one, two, three, in this order." in advice
    assert "So few scenes say nothing in general." in advice


def test_a_figure_that_no_record_has_is_undefined_and_recommends_nobody():
    columns = {"lands": {"probe": "warp", "metric": "warp.epe_median"}}
    asked = {**STUDY["answer"], "sentences": [], "columns": columns, "decides": "lands"}
    section = answer(run(asked=asked))
    assert section.tables[0].rows[0][1] == "undefined"
    assert section.text[1].startswith("No variant is better than the others")


def test_a_sentence_with_a_figure_that_was_not_measured_is_left_out():
    asked = {
        **STUDY["answer"],
        "figures": {"near": {"probe": "warp", "metric": HIDDEN, "yaw": [0, 60]}},
        "sentences": ["Near: {near|open}.", "Near: {near|masked}."],
    }
    made = run(asked=asked)
    del made.cells[:3]  # all of `masked`
    assert answer(made).text[1] == "Near: 10 %."
    assert answer(made).text[2].startswith(("Of these", "No variant"))


def test_pictures_stand_in_a_row_for_each_variant_and_a_column_for_each_view():
    asked = {
        **STUDY["answer"],
        "pictures": [
            {
                "caption": "C",
                "probe": "warp",
                "scene": "two",
                "first": {"true": "target"},
                "content": "warped",
                "variants": ["open", "masked"],
            }
        ],
    }
    made = run(asked=asked)
    for cell in made.cells[1::3]:  # of the scene "two"
        name = cell.variants[0]
        files = [("yaw030", "target"), ("yaw030", "warped"), ("yaw090", "warped")]
        pictures = [PictureFile(view, what, f"{name}-{view}-{what}", "") for view, what in files]
        object.__setattr__(cell.record, "pictures", tuple(pictures))
    (grid,) = answer(made).grids
    paths = [(label, [p and p.path for p in row]) for label, row in grid.rows]
    assert grid.columns == ["30°", "90°"]
    assert paths == [
        ("true", ["open-yaw030-target", None]),
        ("open", ["open-yaw030-warped", "open-yaw090-warped"]),
        ("masked", ["masked-yaw030-warped", "masked-yaw090-warped"]),
    ]
    assert answer(run(asked=asked)).grids == []  # a run without pictures
    assert answer(made, pictures=False).grids == []


def test_the_variant_to_use_comes_with_its_time_beside_the_cheapest():
    made = run(taken=(0.1, 0.05))
    assert (
        "It takes 100 ms a view, 2.0 times as long as `open`, timed on 1 of the scenes."
        in answer(made).text[2]
    )
    assert "as long as" not in answer(made, timings=False).text[2]


def test_seconds_of_cells_that_ran_at_other_times_are_no_cost():
    made = run()
    for cell in made.cells[:3]:
        cell.record.cost.seconds["steady"] = 0.1
    assert "as long as" not in answer(made).text[2]
    assert answer(made).tables[0].columns == ["variant", "hidden", "feature error"]


def test_a_study_without_a_question_has_no_answer():
    assert answer(run(asked=None)) is None


def test_seconds_are_left_out_of_a_report_without_timings():
    assert answer(run(), timings=False).tables[0].columns[-1] == "feature error"


@pytest.mark.parametrize(
    "change, message",
    [
        ({"sentences": ["{hiden|open} of it"]}, "did you mean 'hidden'"),
        ({"sentences": ["{hidden|opn} of it"]}, "did you mean 'open'"),
        ({"decides": "hiden"}, "answer.decides: no column 'hiden'"),
        (
            {"columns": {"hidden": {"probe": "warp", "metric": "occlusion.hiden"}}},
            "no metric 'occlusion.hiden'",
        ),
        ({"variants": {"masked": "a", "shut": "b"}}, "no variant 'shut'"),
    ],
)
def test_a_name_that_an_answer_does_not_have_is_refused(change, message):
    with pytest.raises(ValidationError, match=message):
        parse_study({**STUDY, "answer": {**STUDY["answer"], **change}})


def test_an_answer_stands_first_and_what_is_folded_is_closed_in_markdown():
    first = Section("Answer", ["**Why?**"], [Table(["a"], [["1"]])])
    text = markdown(Report("Title", ["Lead."], [Section("Rest", ["x"], folded=True)], first))
    order = [text.index(part) for part in ("# Title", "**Why?**", "| 1 |", "Lead.", "<details>")]
    assert order == sorted(order)
    # The heading stays, so that links to it hold.
    assert "<details><summary>Rest</summary>\n\n## Rest\n\nx\n\n</details>" in text
