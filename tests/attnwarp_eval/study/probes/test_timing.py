"""Oracles: rows that the editor's network was truly given, against their closed form; planned seconds on a machine that drifts."""

import math

import pytest
import written_runs
import yaml
from ball_scene import SCENE

from attnwarp_eval.document.numbers import number
from attnwarp_eval.report.fronts import fronts
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import Layout, report_of
from attnwarp_eval.study.probes.editing.result import EditResult
from attnwarp_eval.study.run import expected, plan, verify
from attnwarp_eval.study.shared import method_run
from attnwarp_eval.study.shared.edit_truth import Judgement
from attnwarp_eval.study.work import compute

ROUNDS = 3
STUDY = {
    "name": "mine",
    "size": 32,
    "scenes": ["ball.yaml"],
    "spp": 4,
    "splats": {"count": 300},
    "timing_rounds": ROUNDS,
    "editing": {"options": {"views_per_stage": 1, "stages": 2, "steps": 1, "iterations": 1}},
    "variants": {
        "full": {},
        "other": {"options": {"stages": 1, "steps": 3}},
        "oracle": {"geometry": "truth"},
    },
    "probes": {"editing": ["full", "other"], "timing": ["full", "other"]},
}  # fmt: skip
BRANCHES = 2
"""Rows through the network for a view and a step; image guidance of 1 drops a branch."""

# (targets, steps, stages) by the settings above.
PLANNED = {
    "full": (2, 1, 2),
    "other": (1, 3, 1),
}


def load(folder, **changes):
    (folder / "ball.yaml").write_text(yaml.safe_dump(SCENE))
    content = {**STUDY, **changes}
    named = {name for names in content["probes"].values() for name in names}
    content["variants"] = {k: v for k, v in content["variants"].items() if k in named}
    (folder / "mine.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return load_study(str(folder / "mine.yaml"))


def test_a_stored_study_times_the_edit_that_was_timed(tmp_path):
    """The first of the file, which need not be the first by name."""
    order = ["some_colour=red", "some_colour"]
    study = load(tmp_path, editing={**STUDY["editing"], "edits": {"ball": dict.fromkeys(order)}})
    store = Store(tmp_path / "run")
    planned = plan(study, store)
    (cell,) = (c for c in planned.cells if c.probe == "timing")
    assert order != sorted(order) and cell.spec["edit"]["name"] == order[0]
    store.write_study(expected(planned))
    assert not verify(store).damaged


def test_every_setting_runs_once_a_round_with_the_network_passes_of_its_plan(
    tmp_path, coarse_textures
):
    study = load(tmp_path)
    scenes = {name: load_scene(name) for name in study.scenes}
    (cell,) = (c for c in cells_of(study, scenes) if c.probe == "timing")
    rows = []
    network = method_run.load(cell.sources["editor 0"], cell.spec["contestants"][0]["editor"]).unet
    hook = network.register_forward_pre_hook(
        lambda _, args, kwargs: rows.append(len(args[0])), with_kwargs=True
    )
    try:
        record = compute(probe("timing"), cell, tmp_path)
    finally:
        hook.remove()

    expected = {
        name: {
            "network_rows": (1 + targets) * steps * BRANCHES,
            "iterations": stages,
        }
        for name, (targets, steps, stages) in PLANNED.items()
    }
    assert dict(zip(cell.labels, record.extra.work, strict=True)) == expected
    # One round to compile; the first setting runs twice a round.
    once = sum(work["network_rows"] for work in expected.values())
    assert sum(rows) == (ROUNDS + 1) * (once + expected["full"]["network_rows"])

    seconds = record.extra.seconds
    for rounds in seconds.values():
        assert [len(row) for row in rounds] == [ROUNDS] * (len(PLANNED) + 1)
    for index in range(len(PLANNED) + 1):
        for turn in range(ROUNDS):
            parts = [seconds[part][index][turn] for part in ("source", "warp", "edit", "tune")]
            assert seconds["whole"][index][turn] == pytest.approx(sum(parts))
    assert probe("timing").read(record.to_json()).extra == record.extra


@pytest.mark.parametrize(
    ("variant", "says"),
    [
        ({"geometry": "truth"}, "'odd' renders nothing, so there is no time to take"),
        ({"mask": "truth"}, "'odd' takes its mask from the scene's truth"),
        ({"control": "another scene"}, "'odd' takes features of another scene"),
        ({"method": "true pictures"}, "'odd' edits nothing"),
    ],
)
def test_what_has_no_seconds_of_its_own_is_refused(tmp_path, variant, says):
    probes = {"editing": ["full", "odd"], "timing": ["full", "odd"]}
    with pytest.raises(StudyError, match=says):
        load(tmp_path, editing={}, variants={"full": {}, "odd": variant}, probes=probes)


def test_a_variant_of_warps_is_timed_as_a_warp_beside_whole_edits_on_the_first_scenes(tmp_path):
    probes = {"editing": ["full"], "warp": ["slow"], "timing": ["full", "slow"]}
    study = load(tmp_path, scenes=["ball.yaml", "bear", "dinosaur"], views=["yaw030"], probes=probes,
                 variants={"full": {}, "slow": {"set": {"opaque": 0.9}}}, seeds=[0, 1],
                 timed_scenes=2)  # fmt: skip
    cells = cells_of(study, {path: load_scene(path) for path in study.scenes})
    timed = [(c.scene, c.labels, c.seed) for c in cells if c.probe == "timing"]
    warps = [(scene, ("slow",), seed) for scene in ("ball", "bear") for seed in (0, 1)]
    assert sorted(timed) == sorted([*warps, ("ball", ("full",), 0), ("bear", ("full",), 0)])


ERROR = "multiview.delta_e_above.edit_inside"
VARIANTS = ["full", "alone", "fast", "slow"]
RATIOS = {"full": 1.0, "alone": 0.8, "fast": 0.25, "slow": 4.0}
DRIFT = [1.0, 1.0, 2.0, 2.0, 2.0, 16.0, 16.0]
"""Slowness of the machine in each round."""

ERRORS = {"full": 1.0, "alone": 9.0, "fast": 3.0, "slow": 0.5}
BY_CELLS = {"full": 1.0, "alone": 1.0, "fast": 40.0, "slow": 0.1}
"""Seconds of separate cells, which the machine's drift has turned upside down."""


def edited(scene, name, edit="red", times=1.0):
    done = Judgement("edited", True, 30.0, 10.0, 10.0)
    extra = EditResult(edit, "paint it red", done, done, {}, {}, 30.0, 2, 0.0)
    data = written_runs.record(
        [(f"{edit}/v0", 15.0, {ERROR: ERRORS[name], "fidelity.mse.edit_inside": ERRORS[name]})],
        spec={"method": "attention_warping", "settings": {}, "editor": {"sha256": "a"}},
        cost={"seconds": {part: times * BY_CELLS[name] for part in ("whole", "method: edit")}},
        **extra.to_json(),
    )
    return written_runs.outcome("editing", scene, [name], data, f"{scene}-{name}-{edit}")


def in_turn(scene, names, drift=DRIFT):
    def rounds(share):
        rows = [[share * 2.0 * RATIOS[name] * slow for slow in drift] for name in names]
        return [*rows, rows[0]]

    shares = {"whole": 1.0, "source": 0.1, "warp": 0.1, "edit": 0.3, "tune": 0.5}
    data = written_runs.record(
        [],
        spec={
            "rounds": len(drift),
            "edit": {"name": "red"},
        },
        cost={
            "rounds": {stage: rounds(share) for stage, share in shares.items()},
            "work": [{"network_rows": 8, "iterations": 2}] * len(names),
        },
    )
    return written_runs.outcome("timing", scene, names, data)


def results(timed=(), more=(), drift=DRIFT):
    scenes = ["bear", "face"]
    study = {
        "name": "mine",
        "size": 64,
        "scenes": scenes,
        "variants": {name: {} for name in VARIANTS},
        "probes": {"editing": VARIANTS},
        "fronts": [{"title": "Cost", "probe": "editing", "metric": ERROR, "variants": VARIANTS}],
    }
    cells = [edited(scene, name) for scene in scenes for name in VARIANTS]
    return written_runs.results(
        study, [*cells, *more, *(in_turn(scene, timed, drift) for scene in scenes if timed)]
    )


def test_the_front_has_the_seconds_of_one_pass_in_turn_where_they_are_there(tmp_path):
    (section,) = fronts(results(VARIANTS), Layout(tmp_path))
    rows = {row[0]: row[2:] for row in section.tables[0].rows}
    # Twice the ratio, times the machine's middle round; separate cells say the contrary.
    assert rows["full"] == ["4000", "1", "baseline", "yes"]
    assert rows["fast"] == ["1000", "0.250 [0.250, 0.250]", "faster", "yes"]
    assert rows["slow"] == ["16000", "4.00 [4.00, 4.00]", "slower", "yes"]
    assert rows["alone"][3:] == ["no"]
    assert "the edit red of bear, the edit red of face" in section.text[1]

    (section,) = fronts(results(), Layout(tmp_path))
    assert {row[0]: row[2] for row in section.tables[0].rows} == {
        name: f"{1000 * BY_CELLS[name]:.0f}" if BY_CELLS[name] >= 1 else "100" for name in VARIANTS
    }
    assert "a study with a `timing` probe" in section.text[1]


def test_few_rounds_call_nothing_faster_and_say_how_few_they_are(tmp_path):
    for rounds in (3, 5):
        run = results(VARIANTS, drift=DRIFT[:rounds])
        (section,) = report_of("timing").sections(run, Layout(tmp_path))
        (front,) = fronts(run, Layout(tmp_path))
        for table in (section.tables[0], front.tables[0]):
            verdicts = {row[0]: row[table.columns.index("verdict")] for row in table.rows}
            assert verdicts["fast"] == verdicts["slow"] == f"can't tell ({rounds} rounds)"


def test_one_pass_has_means_over_scenes_of_the_seconds_of_their_edits_in_the_front(tmp_path):
    # A scene with two edits does not outvote the other: (s + 3 s) / 2 of bear, s of face.
    run = results(more=[edited("bear", name, "blue", 3.0) for name in VARIANTS])
    expected = {name: (2 * BY_CELLS[name] + BY_CELLS[name]) / 2 for name in VARIANTS}
    (section,) = fronts(run, Layout(tmp_path))
    assert {row[0]: row[2] for row in section.tables[0].rows} == {
        name: number(1000 * seconds) for name, seconds in expected.items()
    }


def test_the_section_of_seconds_holds_medians_spreads_and_ratios(tmp_path):
    (section,) = report_of("timing").sections(results(VARIANTS), Layout(tmp_path))
    table = section.tables[0]
    rows = {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows}
    fast = rows["fast"]
    assert (fast["s, median"], fast["lowest to highest"]) == ("1.00", "0.500 to 8.00")
    assert fast["ratio to 'full'"] == "0.250 [0.250, 0.250]"
    assert fast["network rows"] == "8"
    assert math.isclose(float(rows["full"]["tune, s"]), 2.0)
    assert not list(
        report_of("timing").sections(results(VARIANTS), Layout(tmp_path, timings=False))
    )
