"""Errors at depth edges. Oracles: shares planted scene by scene; labels carried by hand; the control's own warp."""

import numpy as np
import pytest
import torch
import written_runs
import yaml

from attnwarp import Camera
from attnwarp.warp import FeatureWarp, correspond
from attnwarp.warp import preset as warp_preset
from attnwarp_eval.report import write_report
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import Layout, report_of
from attnwarp_eval.study.run import execute, plan
from attnwarp_eval.study.shared.controls import MovedView
from attnwarp_eval.study.shared.warps import warp_truth
from attnwarp_eval.study.work import compute
from attnwarp_eval.world import world
from attnwarp_lab.ideal.edges import PLACES
from attnwarp_lab.ideal.labels import carried_labels, label_transport
from attnwarp_lab.ideal.parts import token_parts
from attnwarp_lab.ideal.thing import labels_of

SCENES = [f"s{k}" for k in range(8)]
RIGHT = {"exact": (0.9, 0.9), "edgy": (0.6, 0.9), "far": (0.9, 0.7)}
"""Shares that are right at an edge and away from it."""


def planted():
    study = {
        "name": "edges", "size": 64, "scenes": SCENES, "variants": {name: {} for name in RIGHT},
        "probes": {"labels": list(RIGHT)},
        "edges": {"labels": {"exact": "exact", "methods": ["edgy", "far"]}},
    }  # fmt: skip
    cells = []
    for number, scene in enumerate(SCENES):
        for name, (at, away) in RIGHT.items():
            at = at - 0.01 * number * (name == "edgy")
            own = dict.fromkeys(PLACES, away) | {"edge0": at, "away": away}
            figures = {f"labels.right.{place}": value for place, value in own.items()}
            data = written_runs.record([("yaw030", 30.0, figures)])
            cells.append(written_runs.outcome("labels", scene, [name], data, f"{scene}-{name}"))
    return written_runs.results(study, cells)


def test_a_label_that_is_none_stays_none_where_it_is_carried():
    camera = Camera(np.array([[3.0, 0, 1.5], [0, 3, 0.5], [0, 0, 1]]), np.eye(4), 3, 1)
    same = correspond(camera, camera, np.ones((1, 3)))
    layer = FeatureWarp(same, torch.tensor([[True, True, False]]))
    assert carried_labels(layer, np.array([[-2, 4, 5]], np.int16)).tolist() == [[-2, 4, -2]]


THING = ["melon", "planet"]
STUDY = {
    "name": "edged", "size": 64, "scenes": ["spheres"], "views": ["yaw010", "yaw030"], "spp": 1,
    "labels": {"grids": [16], "parts": [6]}, "things": {"spheres": THING},
    "variants": {
        "exact": {"geometry": "truth", "set": {"depth_relative": 0.0001}},
        "plain": {"geometry": "truth"},
        "mirrored": {"geometry": "truth", "control": "mirrored"},
    },
    "probes": {"labels": ["exact", "plain", "mirrored"]},
    "edges": {"labels": {"exact": "exact", "control": "mirrored", "methods": ["plain"], "parts": 9}},
}  # fmt: skip


def load(folder, **changes):
    (folder / "edged.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    return load_study(str(folder / "edged.yaml"))


def test_labels_of_a_control_are_those_of_its_warps(tmp_path):
    study = load(tmp_path)
    cells = cells_of(study, {"spheres": load_scene("spheres")})
    views = {
        cell.variant: compute(probe("labels"), cell, tmp_path).views
        for cell in cells
        if cell.probe == "labels"
    }
    of, names = world("spheres", 64), ["source", "yaw010", "yaw030"]
    labels = labels_of(of.scene, of.geometry, [of.camera(n) for n in names], THING, 9)
    source, target = (token_parts(labels[name], (16, 16)) for name in ("source", "yaw030"))
    pair = of.between("source", "yaw030")
    moved = MovedView.of(warp_truth(of, pair, warp_preset("corrected")), "mirrored")
    carried = carried_labels(moved.at((16, 16)), source)
    own = label_transport(carried, target, labels["yaw030"], pair.visible, pair.unseen)
    assert views["mirrored"][1].metrics["labels.right.all"] == own["labels.right"]
    assert own["labels.right"] < views["plain"][1].metrics["labels.right.all"]


@pytest.mark.slow
def test_a_study_that_asks_has_one_figure_and_one_table(tmp_path):
    study = load(tmp_path)
    store = Store(tmp_path / "run")
    execute(plan(study, store), store)
    write_report(store)
    text = (tmp_path / "run/report.md").read_text()
    assert text.count("## Do carried features err at depth edges?") == 1
    assert "figures/edges-labels.svg" in text
    assert (tmp_path / "run/figures/edges-labels.svg").is_file()


def test_a_method_that_is_not_measured_is_refused(tmp_path):
    with pytest.raises(
        StudyError, match=r"edges\.labels: no variant 'plane'; did you mean 'plain'"
    ):
        load(tmp_path, edges={"labels": {"exact": "exact", "methods": ["plane"]}})


def test_the_table_has_what_is_right_at_an_edge_and_away_from_it(tmp_path):
    (section,) = report_of("labels").sections(planted(), Layout(tmp_path))
    table, _ = section.tables
    told = {row[0]: row[1:4] for row in table.rows}
    # Right at an edge in 8 scenes: .60, .59, ... .53; away .9 in all.
    assert told["edgy"][0].startswith("0.565") and told["edgy"][1].startswith("0.900")
    assert float(told["edgy"][2].split()[0]) == pytest.approx(-33.5, abs=0.5)
    assert told["far"][2].startswith("+20 points") and told["exact"][2].startswith("0 points")
