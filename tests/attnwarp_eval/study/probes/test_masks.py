"""Masks lifted in a study. Oracle: a ball's outline in closed form, and masks lifted by hand."""

import math

import numpy as np
import pytest
import yaml
from ball_scene import SCENE

from attnwarp.editing.segment import cut_out
from attnwarp.warp import lift_masks
from attnwarp_eval import metrics
from attnwarp_eval.report import write_report
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.run import execute, plan
from attnwarp_eval.study.work import compute
from attnwarp_eval.world import splats, turned, world

SIZE, SPLATS = 64, {"kind": "2d", "count": 3000, "position_noise": 0.0, "normal_noise": 0.0}
STUDY = {
    "name": "lifted",
    "size": SIZE,
    "scenes": ["ball.yaml"],
    "spp": 2,
    "splats": SPLATS,
    "variants": {
        "one": {},
        "three": {"lifted": {"masks": 3}},
        "from a box": {"lifted": {"by": "box"}},
        "same as one": {"lifted": {"masks": 1}},
    },
    "probes": {"masks": ["one", "three", "from a box", "same as one"]},
    "ablations": [
        {"title": "Masks", "probe": "masks", "baseline": "one", "variants": ["three", "from a box"]}
    ],
    "pictures": {"variants": ["one"], "views": ["yaw030"]},
}


@pytest.fixture
def folder(tmp_path, coarse_textures, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball.yaml").write_text(yaml.safe_dump(SCENE))
    return tmp_path


def load(folder, **changes):
    (folder / "lifted.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    return load_study(str(folder / "lifted.yaml"))


def ball(camera):
    """(H, W) bool: the pixel's central ray meets the ball, which nothing hides."""
    rays = camera.directions() @ camera.rotation
    toward = np.array([0, 0, 0.9]) - camera.position
    along = (rays * toward).sum(-1) / np.linalg.norm(rays, axis=-1)
    return np.sum(toward**2) - along**2 < 0.9**2


def test_figures_are_those_of_masks_lifted_by_hand_against_the_balls_outline(folder):
    store = Store(folder / "run")
    planned = plan(load(folder), store)
    assert execute(planned, store).complete
    records = {}
    for cell in planned.cells:
        if cell.probe == "masks":
            records |= dict.fromkeys(cell.labels, probe("masks").read(store.read(cell.id)))
    assert records["one"] is records["same as one"]

    of = world("ball.yaml", SIZE)
    model = splats("ball.yaml", SIZE, 0, **SPLATS)
    cameras = [of.source, turned(of.scene, 120), turned(of.scene, 240)]
    exact = [ball(camera) for camera in cameras]
    rows, columns = (np.flatnonzero(exact[0].any(axis)) for axis in (1, 0))
    box = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    cut = cut_out(np.clip(of.image("source", 2), 0, 1), box=box)
    by_hand = {
        "one": lift_masks(model, cameras[:1], exact[:1]),
        "three": lift_masks(model, cameras, exact),
        "from a box": lift_masks(model, cameras[:1], [cut]),
    }
    for name, lifted in by_hand.items():
        for view in records[name].views:
            camera, pair = of.targets[view.name], of.pair(view.name, SIZE)
            want = metrics.mask_overlap(
                lifted.render(camera) > 0.5, ball(camera), pair.visible, pair.unseen
            )
            for key, value in want.items():
                got = view.metrics[key]
                assert got == value or (math.isnan(got) and math.isnan(value)), (name, key)
            assert view.metrics["masks.back"] == lifted.agreement[0]
    given = [records[name].views[0].metrics["masks.given"] for name in ("one", "from a box")]
    assert given == [1, (cut & exact[0]).sum() / (cut | exact[0]).sum()]

    write_report(store, long=True)
    text = (folder / "run/report.md").read_text()
    assert "Lifted masks by yaw" in text and "Overlap where it does not" in text
    assert len(list((folder / "run/pictures").glob("*/yaw030-lifted.jpg"))) == 1


def test_a_source_that_hardly_shows_the_thing_has_nothing_to_lift(folder):
    wall = {
        "name": "wall",
        "shape": {"type": "box", "center": [1.8, 0, 2], "size": [0.2, 6, 4]},
        "texture": {"type": "checker", "colors": ["#808080", "#909090"], "size": 1.0},
    }
    objects = [*SCENE["objects"], wall]
    (folder / "ball.yaml").write_text(yaml.safe_dump({**SCENE, "objects": objects}))
    names = {"masks": ["one", "from a box"]}
    variants = {name: STUDY["variants"][name] for name in names["masks"]}
    study = load(folder, views=["yaw120"], probes=names, variants=variants, ablations=[])
    for cell in cells_of(study, {str(folder / "ball.yaml"): load_scene("ball.yaml")}):
        if cell.probe == "masks":
            (view,) = compute(probe("masks"), cell, folder).views
            assert (
                view.metrics["masks.thing"]
                == ball(world("ball.yaml", SIZE).targets["yaw120"]).sum()
            )
            assert math.isnan(view.metrics["masks.iou"]) and math.isnan(view.metrics["masks.given"])


@pytest.mark.door
@pytest.mark.parametrize(
    ("variant", "message"),
    [
        ({"lifted": {"masks": 0}}, "lifted.masks"),
        ({"lifted": {"by": "hand"}}, "lifted.by"),
        ({"geometry": "truth"}, "'one' renders nothing, so there is no mask to lift"),
    ],
)
def test_variants_that_cannot_be_lifted_are_refused(folder, variant, message):
    with pytest.raises(StudyError, match=message):
        load(folder, variants={"one": variant}, probes={"masks": ["one"]}, ablations=[], pictures={})  # fmt: skip
