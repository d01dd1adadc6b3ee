"""The probe of edits that change shapes. Oracles: true pictures, whose figures are known; the file's own edits."""

import json
import lzma
from pathlib import Path

import numpy as np
import pytest
import yaml
from torch_threads import on_one_thread

from attnwarp.fit import Views, from_points
from attnwarp.methods import preset
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.stability.closed_forms import orbit, plane_depth, sphere
from attnwarp_eval.study import StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.work import compute
from attnwarp_lab.probes.shape.seeds import EditedViews
from attnwarp_lab.probes.shape.tunings import SeededTuning

FILE = Path(__file__).parents[3] / "docs/truth/shapes.yaml"
STUDY = {
    "name": "shaped", "size": 64, "scenes": [str(FILE)], "views": ["yaw030"], "spp": 1,
    "splats": {"count": 800}, "places": {"shapes": ["added-0", "removed-1"]},
    "editing": {
        "editor": {"ideal": {"settled": 0.4}},
        "options": {"stages": 1, "steps": 4, "noise": "fresh", "iterations": 20},
    },
    "variants": {
        "growing": {"method": "growing true pictures"},
        "after": {"geometry": "truth", "scene_after": True, "options": {"iterations": 0}},
        "before": {"geometry": "truth", "options": {"iterations": 0}},
    },
    "probes": {"shape": ["growing", "after", "before"]},
}  # fmt: skip

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


def cells(folder, **changes):
    (folder / "shaped.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    study = load_study(str(folder / "shaped.yaml"))
    scenes = {str(FILE): load_scene(FILE)}
    return {cell.variant: cell for cell in cells_of(study, scenes) if cell.probe == "shape"}


def test_true_pictures_have_every_figure_at_its_best_and_a_tuning_that_grows_adds_splats(tmp_path):
    own = cells(tmp_path)
    assert {cell.spec["places"][0][0] for cell in own.values()} == {"added-0"}
    record = compute(probe("shape"), own["growing"], tmp_path)
    (view,) = record.views
    for figure in ("same.added", "new.added", "overlap.several", "uncovered.removed"):
        assert view.metrics[f"shape.{figure}"] == 1
    assert view.metrics["shape.lost"] < 0.5  # a picture in bytes, shadows below the limit of change
    before, after = record.extra.splats
    assert before == 800 < after <= 1600
    again = probe("shape").read(record.to_json())
    assert again.extra == record.extra and len(record.extra.answers) == 2


def test_true_geometry_is_that_of_the_scene_before_or_after_the_sources_answer(tmp_path):
    own = cells(tmp_path)
    one, other = (compute(probe("shape"), own[k], tmp_path) for k in ("after", "before"))
    assert one.extra == other.extra  # the source's edit, which no warp changes
    assert one.views[0].metrics != other.views[0].metrics


def test_an_edit_that_the_scene_lacks_and_a_scene_after_without_true_geometry_are_refused(tmp_path):
    with pytest.raises(StudyError, match=r"places.shapes: no edit 'added-1'"):
        cells(tmp_path, places={"shapes": ["added-1"]})
    with pytest.raises(StudyError, match="scene_after without true geometry"):
        cells(tmp_path, variants={**STUDY["variants"], "after": {"scene_after": True}})


def views_of_a_ball(red_floor):
    """Four views of a red ball that is new over a grey floor, or of a disc of the floor in red."""
    cameras = [orbit(yaw, size=48, height=2.0) for yaw in (0, 40, 80, 120)]
    floor = np.stack([plane_depth(camera, (0, 0, 1), -0.6) for camera in cameras])
    ball = np.stack([sphere(camera, 0.5)[0] for camera in cameras])
    points = np.stack(
        [c.unproject(c.pixel_centers(), z) for c, z in zip(cameras, floor, strict=True)]
    )
    disc = np.linalg.norm(points[..., :2], axis=-1) < 0.8
    new = disc if red_floor else np.isfinite(ball)
    before = np.where(np.isfinite(floor)[..., None], 0.6, 0.0) * np.ones(3)
    after = np.where(new[..., None], [0.8, 0.1, 0.1], before)
    return EditedViews(cameras, before, after, np.where(np.isfinite(floor), floor, np.inf))


def test_what_is_new_gets_splats_around_it_and_a_new_colour_gets_none():
    places, colors = views_of_a_ball(red_floor=False).seeds()
    away = np.linalg.norm(places, axis=1)
    # The views' cones touch the ball, so none lies inside it by more than a pixel and a step along the ray, 0.08 each.
    assert len(places) > 100 and away.min() > 0.34
    assert np.median(away) < 0.6
    assert (colors == [204, 26, 26]).all()
    assert len(views_of_a_ball(red_floor=True).seeds()[0]) == 0


def test_a_stage_of_a_seeded_tuning_begins_with_splats_on_what_is_new():
    views = views_of_a_ball(red_floor=False)
    settings = preset("attention_warping", iterations=2, perceptual=0.0)
    originals = Views(views.cameras, list(views.before))
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-1.5, 1.5, 20)], [-0.6]), axis=-1).reshape(-1, 3)
    floor = from_points(grid, kind="2d", sh_degree=0)
    tuning = SeededTuning(floor, views.cameras, settings, 2, originals=originals)
    tuning.advance(0, 2, Views(views.cameras, list(views.after)), range(4))
    after = tuning.gaussians()
    away = np.linalg.norm(after.world_means()[len(floor) :], axis=1)
    assert len(away) > 100 and np.quantile(away, 0.1) > 0.4 and np.median(away) < 0.6
    # A pixel 4 away is 0.07 wide; a splat as large as the gap to others would hide the floor.
    assert after.scales[len(floor) :].max() < 0.1


def test_the_committed_page_has_the_overlap_by_angle_of_its_raw_results():
    folder = Path(__file__).parents[3] / "reports/shape"
    text = lzma.decompress((folder / "results.jsonl.xz").read_bytes()).decode()
    values = [
        view["metrics"].get("shape.overlap.several")
        for line in map(json.loads, text.splitlines())
        if line.get("record") and line["cell"]["variants"] == ["default"]
        for view in line["record"]["views"]
        if view["view"] == "yaw030"
    ]
    mean = np.mean([value for value in values if value is not None])
    table = (folder / "report.md").read_text().partition("| overlap | 10° | 30° |")[2]
    (row,) = (line for line in table.splitlines() if line.startswith("| default |"))
    assert float(row.split("|")[3].split()[0]) == pytest.approx(mean, abs=1e-3)
