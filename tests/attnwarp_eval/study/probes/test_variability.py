"""Oracles: methods that give the true pictures of planned answers by seed and view, and CIEDE2000 of those pictures."""

import math

import numpy as np
import pytest
import written_runs
import yaml
from ball_scene import COLORS
from skimage.color import deltaE_ciede2000, rgb2lab

from attnwarp_eval.metrics.gates import gated
from attnwarp_eval.report import write_report
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, StudyError, cells_of, load_study
from attnwarp_eval.study.edit_truth import edit_truth
from attnwarp_eval.study.editing_methods import EDITING_METHODS, EditedScene, Method
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import Layout, report_of
from attnwarp_eval.study.run import execute, plan

VIEWS = ("source", "yaw015", "yaw030", "yaw120")
SEEDS = [3, 4, 5]
NAMES = list(COLORS)


def planned(answer):
    """A method that shows answer(seed, view); the view before the edit for None."""

    def run(job):
        edited = {}
        for view in range(len(job.images)):
            name = answer(job.settings["seed"], view)
            image = job.images[view] if name is None else job.truth[name][view]
            edited[view] = np.rint(255 * image).astype(np.uint8)
        return EditedScene(job.gaussians, edited, {"edit": 1.0}, {"network_rows": 2})

    return Method(EDITING_METHODS["attention_warping"].settings, run)


PLANS = {
    "always red": lambda seed, view: "red",
    "nothing": lambda seed, view: None,
    "by seed": lambda seed, view: NAMES[seed % 3],
    "by view": lambda seed, view: NAMES[(seed + view) % 3],
}


def study_of(folder, **changes):
    content = {
        "name": "mine", "size": 32, "scenes": ["ball.yaml"], "spp": 4, "seeds": SEEDS,
        "splats": {"count": 300},
        "variants": {name: {"method": name} for name in PLANS},
        "probes": {"variability": list(PLANS)},
        "pictures": {"variants": ["by seed"], "views": ["yaw030"]},
    }  # fmt: skip
    (folder / "mine.yaml").write_text(yaml.safe_dump({**content, **changes}))
    return load_study(str(folder / "mine.yaml"))


@pytest.fixture(scope="module")
def measured(folder, tmp_path_factory):
    """(records by variant, the run's folder)."""
    with pytest.MonkeyPatch.context() as patch:
        for name, answers in PLANS.items():
            patch.setitem(EDITING_METHODS, name, planned(answers))
        study, store = study_of(folder), Store(tmp_path_factory.mktemp("run"))
        summary = execute(plan(study, store), store)
        assert summary.complete, summary.failures
        write_report(store)
        cells = [c for c in plan(study, store).cells if c.probe == "variability"]
    reader = probe("variability").read
    return {cell.variant: store.read_as(cell.id, reader) for cell in cells}, store.root


def figure(record, name):
    return {v.name.split("/")[1]: v.metrics[f"variability.{name}"] for v in record.views}


def difference(folder, view, a, b):
    """Mean CIEDE2000 of two answers' true pictures, inside the ball."""
    scene = str(folder / "ball.yaml")
    truth = edit_truth(scene, 32, 4, "some_colour", VIEWS)
    pictures = [truth.originals if name is None else truth.answers[name] for name in (a, b)]
    bytes_ = [np.rint(255 * p[view]) / 255 for p in pictures]
    inside = truth.union[view]
    return deltaE_ciede2000(rgb2lab(bytes_[0][inside]), rgb2lab(bytes_[1][inside])).mean()


def test_variety_between_seeds_is_the_difference_of_the_planned_pictures(measured, folder):
    records, _ = measured
    for name in ("by seed", "by view"):
        for view, value in figure(records[name], "between").items():
            # Three seeds give the three colours once each, in either plan.
            pairs = [("red", "green"), ("red", "blue"), ("green", "blue")]
            expected = np.mean([difference(folder, view, a, b) for a, b in pairs])
            assert value == pytest.approx(expected, rel=1e-4)
            assert value > 20
    assert set(figure(records["always red"], "between").values()) == {0.0}


def test_change_is_against_the_view_before_the_edit(measured, folder):
    records, _ = measured
    for view, value in figure(records["always red"], "change").items():
        assert value == pytest.approx(difference(folder, view, "red", None), abs=0.3)  # 8 bits
    assert max(figure(records["nothing"], "change").values()) < 0.3


def test_views_that_differ_within_a_seed_disagree_and_others_do_not(measured):
    records, _ = measured
    floor = figure(records["by seed"], "within_floor")
    for name in ("by seed", "always red"):
        within = figure(records[name], "within")
        # True pictures of one colour disagree about as little as those before the edit.
        assert all(abs(within[v] - floor[v]) < 2 for v in within if not math.isnan(floor[v]))
    within = [v for v in figure(records["by view"], "within").values() if not math.isnan(v)]
    assert within and min(within) > 20


def test_answers_follow_the_plan_and_one_scene_tells_nothing_in_general(measured):
    records, root = measured
    keys = records["by seed"].views[0].metrics
    assert [key for key in keys if gated(key)] == ["variability.within"]
    assert records["by seed"].extra.answers == tuple(NAMES[seed % 3] for seed in SEEDS)
    assert records["always red"].extra.answers == ("red",) * 3
    report = (root / "report.md").read_text()
    rows = {line.split(" | ")[0][2:]: line for line in report.splitlines() if line.startswith("| ")}
    assert all(rows[name].endswith("| can't tell |") for name in PLANS)
    pictures = {p.content for p in records["by seed"].pictures}
    assert pictures == {"before", "seed-3", "seed-4", "seed-5"}
    assert "Seeds side by side" in report


SCENES = ("one", "two", "three")
THREE = {
    # Change, between, within of each scene; the floor is 1. Intervals are mean ± 2.48 sd.
    "changes nothing": [(0.1, 0.0, 1.0), (0.2, 0.0, 1.0), (0.3, 0.0, 1.0)],
    "always the same": [(20, 0.1, 1.5), (21, 0.2, 1.5), (22, 0.3, 1.5)],
    "varies, and agrees within a seed": [(20, 12, 3), (21, 13, 3), (22, 12, 4)],
    "varies, within a seed too": [(20, 12, 13), (21, 13, 14), (22, 12, 14)],
    # Excess -5, 1, 0: on both sides of 0, though its mean is that of a method that agrees.
    "varies, can't tell whether within a seed too": [(20, 12, 2), (21, 12, 8), (22, 12, 7)],
    # A variety of 13 ± 19.
    "can't tell whether it varies": [(20, 5, 1), (21, 13, 1), (22, 20.5, 1)],
}


def written(table):
    """The run of variants with these figures by scene, one view each."""
    keys = ("change", "between", "within")
    extra = {
        "varied": {"name": "e", "instruction": "i", "seeds": [1, 2], "answers": ["red", "red"]}
    }
    cells = [
        written_runs.outcome(
            "variability", scene, [name],
            written_runs.record(
                [("e/v", 15.0, {f"variability.{k}": v for k, v in zip(keys, row, strict=True)}
                  | {"variability.within_floor": 1.0})], **extra),
            f"{name}-{scene}",
        )
        for name, rows in table.items() for scene, row in zip(SCENES, rows, strict=True)
    ]  # fmt: skip
    content = {
        "name": "mine", "scenes": list(SCENES), "seeds": [1, 2],
        "variants": {name: {"options": {"stages": 1 + i}} for i, name in enumerate(table)},
        "probes": {"variability": list(table)},
    }  # fmt: skip
    return written_runs.results(content, cells)


def test_the_reports_words_need_an_interval_on_one_side_of_their_limit(tmp_path):
    ((_, section),) = report_of("variability").sections(written(THREE), Layout(tmp_path))
    (table,) = section.tables
    assert {row[0]: row[-1] for row in table.rows} == {name: name for name in THREE}
    shown = next(row for row in table.rows if row[0] == "varies, and agrees within a seed")
    # The three scenes' own values: 1 is the floor within, and the excess is within - between / 2 - 1.
    assert shown[1:5] == [
        "21.0 (20.0 to 22.0)",
        "12.3 (12.0 to 13.0)",
        "2.33 (2.00 to 3.00)",
        "-3.83 (-4.50 to -3.00)",
    ]


def test_every_seed_has_its_own_settings_and_all_share_the_splats(folder, monkeypatch):
    jobs = []

    def run(job):
        jobs.append((job.settings["seed"], job.gaussians.means.numpy().tobytes()))
        return planned(PLANS["always red"]).run(job)

    monkeypatch.setitem(
        EDITING_METHODS, "spy", Method(EDITING_METHODS["attention_warping"].settings, run)
    )
    from attnwarp_eval.study.work import compute

    study = study_of(
        folder, variants={"a": {"method": "spy"}}, probes={"variability": ["a"]}, pictures={}
    )
    scenes = {name: load_scene(name) for name in study.scenes}
    cell = next(c for c in cells_of(study, scenes) if c.probe == "variability")
    record = compute(probe("variability"), cell, folder)
    assert [seed for seed, _ in jobs] == SEEDS and len({means for _, means in jobs}) == 1
    assert record.cost.counters["network_rows"] == 2 * len(SEEDS)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": [1]}, r"seeds: got \[1\], expected at least 2"),
        ({"variants": {"a": {"method": "dge", "budget": {"seconds": 2}}}}, "'a' has a budget"),
    ],
)
def test_what_cannot_vary_is_refused(folder, changes, message):
    content = {
        "variants": {"a": {"method": "dge"}},
        "probes": {"variability": ["a"]},
        "pictures": {},
    }
    with pytest.raises(StudyError, match=message):
        study_of(folder, **{**content, **changes})
