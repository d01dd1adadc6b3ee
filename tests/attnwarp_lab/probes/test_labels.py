"""Oracle: labels counted by the metrics themselves along warps made by hand; a study's own words for errors."""

import math

import numpy as np
import pytest
import yaml

from attnwarp.warp import preset
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.shared.warps import warp_truth
from attnwarp_eval.study.work import compute
from attnwarp_eval.world import world
from attnwarp_lab.ideal.labels import carried_labels, label_transport
from attnwarp_lab.ideal.parts import token_parts
from attnwarp_lab.ideal.thing import labels_of

THING = ["melon", "planet"]
EXACT = {"depth_relative": 0.0001, "depth_spread": 0.02}
STUDY = {
    "name": "carried",
    "size": 64,
    "scenes": ["spheres"],
    "views": ["yaw030"],
    "spp": 1,
    "labels": {"grids": [8, 16], "parts": [6, 9]},
    "things": {"spheres": THING},
    "variants": {
        "exact": {"geometry": "truth", "set": EXACT},
        "exact mask": {"geometry": "truth", "mask": "truth"},
        "everywhere": {
            "geometry": "truth",
            "set": {"depth_spread": 0.02, "in_front": False, "depth_agreement": False, "normal_test": "none"},
        },
    },
    "probes": {"labels": ["exact", "exact mask", "everywhere"]},
    "ablations": [{"title": "Rules", "probe": "labels", "baseline": "exact", "variants": ["everywhere"]}],
}  # fmt: skip


def load(folder, **changes):
    (folder / "carried.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    return load_study(str(folder / "carried.yaml"))


def test_a_cell_has_the_labels_of_its_warp_by_grid_and_parts(tmp_path):
    study = load(tmp_path)
    cell = next(
        c for c in cells_of(study, {"spheres": load_scene("spheres")}) if c.probe == "labels"
    )
    (view,) = compute(probe("labels"), cell, tmp_path).views
    of = world("spheres", 64)
    pair = of.pair("yaw030", 64)
    warped = warp_truth(of, pair, preset("corrected", **EXACT))
    for parts in (6, 9):
        cameras = [of.camera(name) for name in ("source", "yaw030")]
        labels = labels_of(of.scene, of.geometry, cameras, THING, parts)
        for grid in (8, 16):
            source, target = (token_parts(labels[n], (grid, grid)) for n in ("source", "yaw030"))
            carried = carried_labels(warped.at((grid, grid)), source)
            own = label_transport(carried, target, labels["yaw030"], pair.visible, pair.unseen)
            for key, value in own.items():
                got = view.metrics[f"{key}.{grid}.{parts}"]
                assert got == value or (math.isnan(got) and math.isnan(value))
    # Without a grid in its name: tokens of 4 px, the first number of parts.
    assert view.metrics["labels.right"] == view.metrics["labels.right.16.6"]


def test_an_exact_mask_carries_no_label_to_what_the_source_does_not_see(tmp_path):
    """Oracle: by definition nothing that most pixels call hidden is painted, and nearly all that
    is seen takes a label.
    """
    cells = cells_of(load(tmp_path), {"spheres": load_scene("spheres")})
    views = {
        c.variant: compute(probe("labels"), c, tmp_path).views[0].metrics
        for c in cells
        if c.probe == "labels"
    }
    exact = views["exact mask"]
    assert exact["labels.painted_hidden"] == 0 < views["everywhere"]["labels.painted_hidden"]
    assert exact["labels.none"] < 0.1 < views["exact"]["labels.none"]


@pytest.mark.door
def test_a_thing_that_the_scene_lacks_is_refused(tmp_path):
    scenes = {"spheres": load_scene("spheres")}
    with pytest.raises(StudyError, match="things.spheres: no object 'melone'.*'melon'"):
        cells_of(load(tmp_path, things={"spheres": ["melone"]}), scenes)
    with pytest.raises(
        StudyError, match="things: scene 'spheres' has no edit with several answers; name"
    ):
        cells_of(load(tmp_path, things={}), scenes)


def test_a_scene_with_answers_needs_no_names():
    from attnwarp_eval.study.shared.things import thing_of

    study = load_study("quick")  # it names the things of spheres and fence alone
    assert thing_of(study, load_scene("bear")) == ["bear"]
    assert np.isin(thing_of(study, load_scene("spheres")), load_scene("spheres").object_names).all()
