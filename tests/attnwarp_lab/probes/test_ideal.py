"""Oracles: the figures of the metrics along the method called by hand; sentences that a fault must give."""

import dataclasses
import json
import math

import numpy as np
import pytest
import written_runs
import yaml
from torch_threads import on_one_thread
from typer.testing import CliRunner

from attnwarp.methods import attention_warping, preset
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.cli.main import app
from attnwarp_eval.report.build import build
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import report_of
from attnwarp_eval.study.work import compute
from attnwarp_eval.two_view import HIDDEN
from attnwarp_eval.world import splats, world
from attnwarp_lab.ideal.figures import part_answers, part_figures
from attnwarp_lab.ideal.share import Alone, alone, solve_share
from attnwarp_lab.ideal.thing import Thing, in_front
from attnwarp_lab.probes.ideal import measure

THING = ["melon", "planet", "beach_ball"]
STUDY = {
    "name": "parts",
    "size": 64,
    "scenes": ["spheres"],
    "views": ["yaw010", "yaw030"],
    "spp": 1,
    "splats": {"count": 2000},
    "things": {"spheres": THING},
    "editing": {
        "editor": {"ideal": {"parts": 8, "colors": 3, "settled": 0.4}},
        "options": {"stages": 1, "steps": 5, "iterations": 0, "noise": "fresh"},
    },
    "variants": {"full": {}, "mirrored": {"control": "mirrored"}},
    "probes": {"ideal": ["full", "mirrored"]},
}  # fmt: skip

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


def load(folder, **changes):
    (folder / "parts.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    return load_study(str(folder / "parts.yaml"))


def cells(study):
    return [c for c in cells_of(study, {"spheres": load_scene("spheres")}) if c.probe == "ideal"]


@pytest.fixture(scope="module")
def records(tmp_path_factory, coarse_textures):
    folder = tmp_path_factory.mktemp("ideal")
    study = load(folder)
    return {cell.variant: compute(probe("ideal"), cell, folder) for cell in cells(study)}


def test_a_cell_has_the_figures_of_algorithm_1_with_the_ideal_editor(records):
    of, names = world("spheres", 64), ["source", "yaw010", "yaw030"]
    cameras = [of.camera(name) for name in names]
    thing = Thing.of(of.scene, of.geometry, cameras, THING, parts=8, colors=3, spp=1)
    share = solve_share(thing.grams, 0.4, 5)
    seed = records["full"].spec["settings"]["seed"]
    settings = preset(
        "attention_warping", stages=1, steps=5, iterations=0, noise="fresh", seed=seed
    )
    model = splats("spheres", 64, 0, kind="2d", count=2000, position_noise=0.0, normal_noise=0.0)
    pictures = [thing.before[name] for name in names]
    result = attention_warping(
        model, cameras, pictures, thing.editor(share), "Paint its parts", settings
    )
    edited = {names[k]: p.astype(np.float32) / np.float32(255) for k, p in result.edited.items()}
    answers = part_answers(edited["source"], thing.truth("source"), 8)
    record = records["full"]
    counted = {
        key: record.cost.counters[key] for key in ("network_rows", "view_pairs", "iterations")
    }
    assert counted == {"network_rows": 15, "view_pairs": 2, "iterations": 0}
    assert list(record.extra.answers) == answers.tolist() and record.extra.share == share
    assert (
        record.extra.fault is None
        and record.extra.agreement == alone(thing.grams, share, 5).agreement
    )
    for view in record.views:
        name = view.name.removeprefix("parts/")
        pair = of.pair(name, 64)
        own = part_figures(
            edited[name], thing.truth(name), answers, pair.visible, pair.label == HIDDEN,
            in_front(pair, thing.labels["source"]),
        )  # fmt: skip
        for key, value in own.items():
            got = view.metrics[f"{key}.edit"]
            assert got == pytest.approx(value, nan_ok=True)
            assert f"{key}.render" not in view.metrics  # its splats are not tuned


def test_what_stands_before_a_hidden_pixel_is_what_the_source_shows_there():
    of = world("spheres", 64)
    pair = of.pair("yaw030", 64)
    source = np.arange(64 * 64, dtype=np.int16).reshape(64, 64)
    front = in_front(pair, source)
    rows, columns = np.nonzero(pair.in_source_image)
    for y, x in list(zip(rows, columns, strict=True))[::37]:
        u, v = pair.xy[y, x]
        assert front[y, x] == source[min(int(v), 63), min(int(u), 63)]
    assert (front[~pair.in_source_image] == -1).all()


def test_a_control_decides_the_cell_and_its_figures(records):
    full, mirrored = records["full"], records["mirrored"]
    assert (
        full.id != mirrored.id
        and mirrored.spec["control"] == "mirrored"
        and "control" not in full.spec
    )
    assert full.extra.answers == mirrored.extra.answers  # the source's edit is the same
    first, second = ([v.metrics["parts.delta_e.edit"] for v in r.views] for r in (full, mirrored))
    assert not np.allclose(first, second)


def test_an_editor_with_a_favourite_is_not_ideal(records, tmp_path, monkeypatch):
    record = records["full"]
    fault = Alone(0.1, (0.9, 0.05, 0.05), 0.8).fault()
    data = {**record.to_json(), "ideal": {**record.extra.to_json()["ideal"], "fault": fault}}
    study = {**STUDY, "scenes": ["spheres"]}
    made = written_runs.results(
        study, [written_runs.outcome("ideal", "spheres", ["full"], data, "one")]
    )
    assert report_of("ideal").problems(made) == [
        "spheres: not ideal in full: alone, answers come in 90 %, 5 %, 5 % of cases, expected 33 % of each"
    ]
    sound = written_runs.outcome("ideal", "spheres", ["full"], record.to_json(), "one")
    assert report_of("ideal").problems(written_runs.results(study, [sound])) == []


def test_a_run_whose_editor_is_not_ideal_ends_with_3(tmp_path, monkeypatch):
    def collapsed(*_):
        return Alone(0.1, (0.98, 0.01, 0.01), 0.96)

    monkeypatch.setattr(measure, "alone", collapsed)
    (tmp_path / "parts.yaml").write_text(
        yaml.safe_dump(
            {**STUDY, "views": ["yaw010"], "variants": {"full": {}}, "probes": {"ideal": ["full"]}}
        )
    )
    result = CliRunner().invoke(
        app, ["run", str(tmp_path / "parts.yaml"), "--out", str(tmp_path / "run")]
    )
    assert result.exit_code == 3, result.output
    assert "not ideal in full: alone, answers come in 98 %, 1 %, 1 % of cases" in result.output


def test_the_report_says_what_the_editor_is(records, tmp_path):
    from attnwarp_eval.document.write import markdown

    outcomes = [
        written_runs.outcome("ideal", "spheres", [name], record.to_json(), name)
        for name, record in records.items()
    ]
    study = {
        **STUDY,
        "ablations": [
            {"title": "Controls", "probe": "ideal", "baseline": "full", "variants": ["mirrored"]}
        ],
    }
    text = markdown(build(written_runs.results(study, outcomes), tmp_path, timings=False))
    assert "## The ideal editor" in text and "| parts | colors | settled | cross | steps |" in text
    assert "seen" in text and "through" in text and "bleed, dE00" in text


@pytest.mark.door
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"editing": {"editor": {"name": "small-plain"}}}, "probes.ideal: 'full' has no ideal editor"),
        ({"probes": {"editing": ["full"]}}, "probes.editing: 'full' has the ideal editor"),
        ({"variants": {"full": {"method": "dge"}}, "probes": {"ideal": ["full"]}, "editing": {"editor": {"ideal": {}}}}, "method 'dge' of 'full' changes attention"),
        ({"variants": {"full": {"control": "upside down"}, "mirrored": {}}}, "control"),
        ({"editing": {"editor": {"ideal": {"settled": 1.5}}}}, "settled"),
    ],
)  # fmt: skip
def test_what_the_ideal_editor_cannot_do_is_refused(tmp_path, changes, message):
    with pytest.raises(StudyError, match=message):
        load(tmp_path, **changes)


def with_controls(folder):
    controls = {"other": {"control": "another scene"}}
    study = load(
        folder, scenes=["spheres", "bear"], views=["yaw030"], variants={"full": {}, **controls},
        probes={"ideal": ["full", *controls]},
    )  # fmt: skip
    scenes = {name: load_scene(name) for name in ("spheres", "bear")}
    planned = (cell for cell in cells_of(study, scenes) if cell.probe == "ideal")
    return scenes, {(cell.scene, cell.variant): cell for cell in planned}


def test_another_scene_is_the_next_and_each_has_noise_of_its_own(tmp_path):
    scenes, of = with_controls(tmp_path)
    for scene, other in (("spheres", "bear"), ("bear", "spheres")):
        entry = of[scene, "other"].spec["other"]
        assert (
            entry["scene"] == scenes[other].content_hash and "other" not in of[scene, "full"].spec
        )
    # Noise of its own for each scene, the same for all its variants.
    seeds = {
        scene: {of[scene, name].spec["settings"]["seed"] for name in ("full", "other")}
        for scene in scenes
    }
    assert [len(own) for own in seeds.values()] == [1, 1] and seeds["spheres"] != seeds["bear"]


def test_a_cells_spec_stays_its_address_where_the_method_fails(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise RuntimeError("no memory")

    monkeypatch.setattr(measure, "run_method", fails)
    cell = cells(load(tmp_path))[0]
    with pytest.raises(RuntimeError, match="no memory"):
        compute(probe("ideal"), cell, tmp_path)
    assert digest(cell.spec) == cell.id
    # The thing lives as long as its world.
    assert {key[0] for key in world("spheres", 64).made} == {"thing"}


@pytest.mark.slow
def test_features_of_another_scene_do_not_reach_the_targets(tmp_path):
    _, of = with_controls(tmp_path)
    record = compute(probe("ideal"), of["spheres", "other"], tmp_path)
    right = compute(probe("ideal"), of["spheres", "full"], tmp_path)
    # The source is edited as ever.
    assert record.extra.answers == right.extra.answers
    seen = [r.views[0].metrics["parts.seen.edit"] for r in (record, right)]
    assert seen[0] < seen[1] - 0.1


def test_another_scene_needs_two(tmp_path):
    study = load(
        tmp_path, variants={"full": {"control": "another scene"}}, probes={"ideal": ["full"]}
    )
    with pytest.raises(StudyError, match="'spheres' alone"):
        cells(study)


def test_an_unreachable_settling_names_the_range(records):
    of = world("spheres", 64)
    cameras = [of.camera(name) for name in ("source", "yaw010")]
    thing = Thing.of(of.scene, of.geometry, cameras, THING, parts=8, colors=3, spp=1)
    with pytest.raises(ValueError, match="settled: got 0.01, expected a number between"):
        solve_share(thing.grams, 0.01, 5)


def test_a_record_survives_json(records):
    record = records["full"]
    again = probe("ideal").read(json.loads(json.dumps(record.to_json())))
    assert again.extra == record.extra
    assert dataclasses.asdict(again.extra)["answers"] and math.isfinite(again.extra.part_share)


def test_an_editor_that_drifts_moves_what_it_edits_and_a_cell_measures_it(tmp_path):
    variants = {"full, 0 px": {}, "full, 4 px": {"drift": {"shift": 4}}}
    study = load(tmp_path, variants=variants, probes={"ideal": list(variants)})
    full, drifts = (compute(probe("ideal"), cell, tmp_path) for cell in cells(study))
    assert full.id != drifts.id
    moved = [record.views[0].metrics["edit.drift"] for record in (full, drifts)]
    assert moved[0] < 1 and moved[1] == pytest.approx(4, abs=0.5)  # 64 px, repainted in part
    seen = [np.mean([v.metrics["parts.delta_e.edit"] for v in r.views]) for r in (full, drifts)]
    assert seen[1] > seen[0] + 1
