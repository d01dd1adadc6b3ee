"""Errors at depth edges. Oracles: errors planted scene by scene; labels carried by hand; the control's own warp."""

import itertools

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
from attnwarp_lab.ideal.edge_report import EdgeTable
from attnwarp_lab.ideal.edges import PLACES, edges_of
from attnwarp_lab.ideal.labels import carried_labels, label_transport
from attnwarp_lab.ideal.parts import token_parts
from attnwarp_lab.ideal.thing import labels_of

SCENES = [f"s{k}" for k in range(8)]
WRONG = {"exact": (0.1, 0.1), "good": (0.1, 0.1), "edgy": (0.4, 0.1), "far": (0.1, 0.3)}
"""Shares that are wrong at an edge and away from it; those of a control are .9."""
METHODS = ["good", "edgy", "far"]


def planted(control=0.9, **changes):
    wrong = {**WRONG, "moved": (control, control), **changes}
    study = {
        "name": "edges", "size": 64, "scenes": SCENES, "variants": {name: {} for name in wrong},
        "probes": {"labels": list(wrong)},
        "edges": {"labels": {"exact": "exact", "control": "moved", "methods": METHODS}},
    }  # fmt: skip
    cells = []
    for number, scene in enumerate(SCENES):
        for name, (at, away) in wrong.items():
            at = at + 0.01 * number * (name == "edgy")
            own = dict.fromkeys(PLACES, away) | {"edge0": at, "away": away}
            figures = {f"labels.wrong.{place}": value for place, value in own.items()}
            figures |= {f"labels.right.{place}": 1 - value for place, value in own.items()}
            data = written_runs.record([("yaw030", 30.0, figures)])
            cells.append(written_runs.outcome("labels", scene, [name], data, f"{scene}-{name}"))
    return written_runs.results(study, cells)


def table_of(results):
    figures = ("labels.right.{}", "labels.wrong.{}", "labels.painted_hidden.{}")
    edges = edges_of(results.study, "labels")
    return EdgeTable(results, "labels", edges, {name: (name, *figures) for name in edges.named})


def test_each_method_has_one_verdict_on_its_errors_beyond_those_of_exact_geometry():
    found = table_of(planted())
    assert {name: found.verdict(name) for name in METHODS} == {
        "good": "does not hold: equal",
        "edgy": "holds",
        "far": "the opposite holds",
    }
    # Of 8 scenes that all err by .3 to .37 more at an edge, two of 256 patterns are as far.
    assert found.judged["edgy"].flips.mean == pytest.approx(0.335)
    assert found.judged["edgy"].flips.p == 2 / 256


def test_a_control_that_brings_more_than_half_makes_a_method_blind():
    found = table_of(planted(control=0.4))
    # Right at an edge: .6 by the control, .9 by the method, 0 by views alone.
    assert found.share_of_control("good") == pytest.approx((0.6 / 0.9,) * 3)
    assert found.verdict("good") == "blind"
    assert table_of(planted()).share_of_control("good")[0] == pytest.approx(0.1 / 0.9)
    # A method that brings nothing is judged all the same.
    found = table_of(planted(good=(1.0, 1.0)))
    assert np.isnan(found.share_of_control("good")).all()
    assert found.verdict("good") == "does not hold: equal"


def test_a_label_that_is_none_stays_none_along_a_chain():
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


def test_labels_of_a_chain_and_of_a_control_are_those_of_their_warps(tmp_path):
    study = load(tmp_path)
    cells = cells_of(study, {"spheres": load_scene("spheres")})
    views = {
        cell.variant: compute(probe("labels"), cell, tmp_path).views
        for cell in cells
        if cell.probe == "labels"
    }
    of, names = world("spheres", 64), ["source", "yaw010", "yaw030"]
    labels = labels_of(of.scene, of.geometry, [of.camera(n) for n in names], THING, 9)
    tokens = {name: token_parts(labels[name], (16, 16)) for name in names}

    def figures(carried, name):
        pair = of.pair(name, 64)
        return label_transport(carried, tokens[name], labels[name], pair.visible, pair.unseen)

    settings, carried = warp_preset("corrected"), tokens["source"]
    for link, (before, name) in enumerate(itertools.pairwise(names)):
        warp = warp_truth(of, of.between(before, name), settings)
        carried = carried_labels(warp.at((16, 16)), carried)
        got, own = views["plain"][link].metrics, figures(carried, name)
        assert got[f"labels.right.link{link + 1}.chain"] == own["labels.right"]
        assert got["labels.wrong.all.chain"] == own["labels.wrong"]
    moved = MovedView.of(warp_truth(of, of.between("source", "yaw030"), settings), "mirrored")
    own = figures(carried_labels(moved.at((16, 16)), tokens["source"]), "yaw030")
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
    assert "| plain, from view to view |" in text and "figures/edges-labels.svg" in text
    assert (tmp_path / "run/figures/edges-labels.svg").is_file()


def test_a_method_that_is_not_measured_is_refused(tmp_path):
    with pytest.raises(
        StudyError, match=r"edges\.labels: no variant 'plane'; did you mean 'plain'"
    ):
        load(tmp_path, edges={"labels": {"exact": "exact", "methods": ["plane"]}})


def test_the_report_has_the_sections_of_planted_errors(tmp_path):
    (section,) = report_of("labels").sections(planted(), Layout(tmp_path))
    table, _ = section.tables
    assert [row[-1] for row in table.rows if row[0] in METHODS] == [
        "does not hold: equal", "holds", "the opposite holds",
    ]  # fmt: skip
