"""Surfaces in a study. Oracles: a ball in closed form, the figures that other probes give of the same
splats, and pairs of settings counted by hand.
"""

import math

import pytest
import written_runs
import yaml
from ball_scene import SCENE

from attnwarp_eval.report import write_report
from attnwarp_eval.study import Store, StudyError, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import Layout, Place, report_of
from attnwarp_eval.study.run import execute, plan

SIZE = 32
ACCEPTING = {"in_front": False, "opaque": None, "depth_agreement": False, "normal_test": "none"}
"""Rules under which so small and rough a fit carries something."""

STUDY = {
    "name": "surfaces",
    "title": "Which figure is it?",
    "size": SIZE,
    "scenes": ["ball.yaml"],
    "views": ["yaw015", "yaw030"],
    "feature_sizes": [SIZE, 8],
    "spp": 1,
    "labels": {"grids": [8], "parts": [12]},
    "fit": {
        "views": 9,
        "points": 300,
        "settings": {"iterations": 30, "sh_degree": 0, "evaluate_every": 1000},
    },
    "variants": {
        "short": {"fitted": True, "fit": {"kind": "2d", "iterations": 2}, "set": ACCEPTING},
        "long": {"fitted": True, "fit": {"kind": "2d"}, "set": ACCEPTING},
        "exact": {"geometry": "truth", "set": {"depth_relative": 0.0001, "depth_spread": 0.02}},
    },
    "probes": {
        "surfaces": ["short", "long", "exact"],
        "warp": ["short", "long", "exact"],
        "labels": ["short", "long", "exact"],
        "fit": ["short", "long"],
    },
}


@pytest.fixture(scope="module")
def run(tmp_path_factory, coarse_textures):
    folder = tmp_path_factory.mktemp("surfaces")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "ball.yaml").write_text(yaml.safe_dump(SCENE))
        (folder / "surfaces.yaml").write_text(yaml.safe_dump(STUDY))
        store = Store(folder / "run")
        planned = plan(load_study("surfaces.yaml"), store)
        assert execute(planned, store).complete
        write_report(store)
        records = {
            (cell.probe, name): probe(cell.probe).read(store.read(cell.id))
            for cell in planned.cells
            if cell.probe != "calibration"
            for name in cell.labels
        }
        yield records, (folder / "run/report.md").read_text()


def same(a, b):
    return a == b or (math.isnan(a) and math.isnan(b))


def test_figures_of_views_are_those_of_the_other_probes(run):
    records, _ = run
    for name in ("short", "long", "exact"):
        ours = {view.name: view.metrics for view in records["surfaces", name].views}
        others = {
            one: [*records[one, name].views] for one in ("warp", "labels", "fit")
            if (one, name) in records
        }  # fmt: skip
        compared = 0
        for one, views in others.items():
            for view in views:
                for key, value in view.metrics.items():
                    parts = key.split(".")
                    if one == "labels" and len(parts) > 2:
                        continue  # by grid and parts; the plain figure is there too
                    if one == "fit" and parts[-1] in ("interior", "edge"):
                        continue
                    assert same(ours[view.name][key], value), (name, one, view.name, key)
                    compared += 1
        assert compared > 100


def test_the_mesh_of_exact_depth_lies_on_the_surface_to_a_fraction_of_a_voxel(run):
    records, _ = run
    mesh = {
        name: next(v.metrics for v in records["surfaces", name].views if v.name.startswith("mesh/"))
        for name in ("short", "long", "exact")
    }
    # A pixel of 32 at 3.57 from what the cameras look at, through 50 degrees.
    voxel = 2 * math.hypot(3.5, 0.7) * math.tan(math.radians(25)) / SIZE
    assert mesh["exact"]["surface.accuracy"] < voxel / 2
    assert mesh["exact"]["surface.normal_consistency"] > 0.9
    # Seven views see the ground and most of the ball within the ball of the cameras' radius.
    reach, inner = math.hypot(3.5, 0.7), 0.9
    ground = math.pi * (reach**2 - 0.8**2)
    assert mesh["exact"]["surface.true_points"] * (voxel / 2) ** 2 > 0.5 * ground
    assert mesh["exact"]["surface.true_points"] * (voxel / 2) ** 2 < 2 * (
        ground + 4 * math.pi * inner**2
    )
    for name in ("short", "long"):
        assert mesh[name]["surface.chamfer"] > mesh["exact"]["surface.chamfer"]
        assert mesh[name]["surface.f_score"] < mesh["exact"]["surface.f_score"]


def test_the_report_begins_with_the_figure_that_ranks_best(run):
    _, text = run
    head = text[: text.index("Kendall's tau of each figure")]
    assert "Which figure is it?" in head and "best is **" in head
    assert "2 settings of fits" in head  # exact depth is no fit
    assert "| exact |" in text and "CPU seconds of the fit" in text


NAMES = ["a", "b", "c", "d"]
FIGURES = {
    # Best first by each: of 6 pairs chamfer has one the other way, F-score two, AbsRel none.
    "warp.feature_all_accepted.8": [0.1, 0.2, 0.3, 0.4],
    "surface.chamfer": [0.1, 0.2, 0.4, 0.3],
    "surface.f_score": [0.8, 0.9, 0.6, 0.7],
    "depth.abs_rel": [1.0, 2.0, 3.0, 4.0],
    "labels.right": [0.9, 0.8, 0.7, math.nan],
}


def results(scenes, figures=FIGURES, last=None):
    """Runs of four settings; ``last`` are figures of the last scene in place of the others'."""
    cells = []
    for scene in scenes:
        own = last if last is not None and scene == scenes[-1] else figures
        for k, name in enumerate(NAMES):
            mine = {key: None if math.isnan(row[k]) else row[k] for key, row in own.items()}
            data = written_runs.record([("yaw030", 30.0, mine)])
            cells.append(written_runs.outcome("surfaces", scene, [name], data))
    study = {
        "name": "s", "title": "Which is it?", "size": SIZE, "scenes": list(scenes), "feature_sizes": [8],
        "fit": {"views": 9}, "variants": {n: {"fitted": True, "fit": {"iterations": k + 1}} for k, n in enumerate(NAMES)},
        "probes": {"surfaces": NAMES},
    }  # fmt: skip
    return written_runs.results(study, cells)


def answer(of, tmp_path):
    ((place, section),) = report_of("surfaces").sections(of, Layout(tmp_path))
    assert place is Place.ANSWER
    return section, {row[0]: row for row in section.tables[0].rows}


SCENES = ["bear", "fence", "spheres", "glass", "opposed", "slats"]


def test_taus_are_those_of_pairs_counted_by_hand(tmp_path):
    section, rows = answer(results(SCENES), tmp_path)
    with_error = {name: float(row[2].split()[0]) for name, row in rows.items() if row[2] != "–"}
    assert with_error == {"AbsRel": 1.0, "chamfer": 0.667, "F-score": 0.333}
    # The last setting has no label, so three pairs are left, and F-score has two of them.
    assert float(rows["F-score"][4].split()[0]) == 0.333
    assert float(rows["chamfer"][4].split()[0]) == 1.0
    accepted, labels, _ = section.text[
        0
    ].splitlines()  # no scene has an error of all that is visible
    assert "**Feature error, accepted**: best is **AbsRel 1.0 ± 0**, which orders 100 %" in accepted
    # Six scenes that all agree: 2 of 64 patterns of signs.
    assert accepted.endswith("Worse: chamfer 0.67 ± 0, F-score 0.33 ± 0.")
    # Of two tests 2 of 64 is not rare enough.
    assert "best is **chamfer 1.0 ± 0**" in labels
    assert labels.endswith("Not told apart from it: AbsRel 1.0 ± 0, F-score 0.33 ± 0.")


def test_a_scene_without_a_mesh_is_left_out_and_counted(tmp_path):
    empty = FIGURES | {"surface.chamfer": [math.nan] * 4}
    _, rows = answer(results(SCENES, last=empty), tmp_path)
    assert "1 undefined" in rows["chamfer"][2] and rows["chamfer"][2].startswith("0.667")


def test_a_run_of_one_setting_ranks_nothing(tmp_path):
    of = results(["bear"], {key: row[:1] + [math.nan] * 3 for key, row in FIGURES.items()})
    assert list(report_of("surfaces").sections(of, Layout(tmp_path))) == []


def test_tokens_of_parts_of_pixels_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball.yaml").write_text(yaml.safe_dump(SCENE))
    study = {**STUDY, "size": 30, "feature_sizes": [30], "probes": {"surfaces": ["long"]}}
    del study["labels"]
    study["variants"] = {"long": STUDY["variants"]["long"]}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(study))
    with pytest.raises(StudyError, match="size: got 30, expected a multiple of 4"):
        load_study("s.yaml")
