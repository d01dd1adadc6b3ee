"""An edit in a few views. Oracles: methods of known colours, whose difference scikit-image gives; exact masks."""

import math

import numpy as np
import pytest
import yaml
from skimage.color import deltaE_ciede2000, rgb2lab

from attnwarp_eval import metrics
from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.metrics import multiview
from attnwarp_eval.report.build import build
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.results import Outcome, Results
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, EditedScene, Method
from attnwarp_eval.study.work import compute
from attnwarp_eval.world import world

STUDY = {
    "name": "shown",
    "size": 64,
    "scenes": ["ball.yaml", "spheres"],
    "spp": 1,
    "splats": {"count": 300},
    "carry": {"size": 32, "edits": {"ball": "make the ball red"}},
    "variants": {"painted": {"method": "painted"}},
    "probes": {"carry": ["painted"]},
}  # fmt: skip
RED, PINK = (0.8, 0.1, 0.1), (0.9, 0.5, 0.6)


def load(folder, **changes):
    (folder / "shown.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    return load_study(str(folder / "shown.yaml"))


def cells(study):
    scenes = dict(zip(study.scenes, map(load_scene, study.scenes), strict=True))
    return [cell for cell in cells_of(study, scenes) if cell.probe == "carry"]


def painting(monkeypatch, source):
    """Register a method that paints the segments of the source and of the targets."""
    seen = []

    def run(job):
        colors = [source, *[PINK] * (len(job.cameras) - 1)]
        seen.append(job)
        edited = {
            view: np.rint(
                255 * (image if color is None else np.where(inside[..., None], color, image))
            ).astype(np.uint8)
            for view, (image, inside, color) in enumerate(
                zip(job.images, job.segments, colors, strict=True)
            )
        }
        return EditedScene(job.gaussians, edited, {"edit": 1.0}, {})

    settings = EDITING_METHODS["attention_warping"].settings
    monkeypatch.setitem(EDITING_METHODS, "painted", Method(settings, run))
    return seen


def test_views_differ_from_the_source_by_their_colours_at_the_points_that_both_see(
    folder, tmp_path, monkeypatch
):
    seen = painting(monkeypatch, RED)
    study = load(folder)
    (cell,) = cells(study)  # of the scene that has words, and at the edit's own size
    record = compute(probe("carry"), cell, tmp_path)
    figures = [view.metrics["multiview.delta_e"] for view in record.views]
    colors = [rgb2lab(np.rint(255 * np.array(c)).astype(np.uint8)) for c in (RED, PINK)]
    defined = [value for value in figures if not math.isnan(value)]
    assert defined
    np.testing.assert_allclose(defined, deltaE_ciede2000(*colors), atol=1e-3)
    of, names = world(str(folder / "ball.yaml"), 32), ["source", *cell.spec["views"]]
    (index,) = (of.scene.object_names.index(name) for name in cell.spec["thing"])
    for name, segment in zip(names, seen[0].segments, strict=True):
        np.testing.assert_array_equal(
            segment, of.geometry.trace(of.camera(name)).object_id == index
        )
    assert seen[0].instruction == "make the ball red"
    assert [p.view for p in record.pictures if p.content == "after"] == names

    outcome = Outcome(cell.id, cell.title, "ball", ("painted",), "carry", 0, record)
    page = build(Results(study, [outcome], []), tmp_path)
    (grid,) = next(s for s in page.sections if s.title == "Edited views side by side").grids
    assert [label for label, _ in grid.rows] == ["before", "painted"]
    assert grid.columns[0] == "source" and len(grid.columns) == len(names)


def test_a_part_has_the_sources_colour_in_any_light_and_not_another(folder, tmp_path, monkeypatch):
    """Oracles: a ball painted alike, or not, in source and views, and pictures whose linear light is halved."""
    for colors, shares in (((PINK, PINK), {1.0}), ((RED, PINK), {0.0}), ((None, PINK), set())):
        painting(monkeypatch, colors[0])
        (cell,) = cells(load(folder))
        views = compute(probe("carry"), cell, tmp_path).views
        for end in ("seen", "unseen"):
            found = [view.metrics[f"multiview.same_part.{end}"] for view in views]
            assert {value for value in found if not math.isnan(value)} == shares
    every, grey = np.ones((8, 8), bool), np.full((8, 8, 3), 0.5)
    dark, dim_pink = (to_srgb(to_linear(np.broadcast_to(c, (8, 8, 3))) / 2) for c in (0.5, PINK))
    pictures = (grey, dark), (grey * 0 + PINK, dim_pink)
    assert metrics.same_parts(*pictures, [(every, every)]) == 1.0
    assert metrics.same_parts((grey, grey), pictures[1], [(every, every)]) == 0.0
    few = np.arange(64).reshape(8, 8) < multiview.LEAST_PART - 1
    assert math.isnan(metrics.same_parts(*pictures, [(every, few)]))


def test_a_source_that_did_not_change_has_no_edit_to_carry(folder, tmp_path, monkeypatch):
    painting(monkeypatch, None)
    (cell,) = cells(load(folder))
    record = compute(probe("carry"), cell, tmp_path)
    assert all(math.isnan(view.metrics["multiview.delta_e"]) for view in record.views)


def test_pictures_are_no_larger_than_the_studys(folder, monkeypatch):
    painting(monkeypatch, RED)
    assert [cells(load(folder, size=size))[0].spec["size"] for size in (64, 16)] == [32, 16]


def test_words_for_a_scene_that_is_not_there_are_refused(folder, monkeypatch):
    painting(monkeypatch, RED)
    study = load(folder, carry={"edits": {"bal": "red"}})
    with pytest.raises(StudyError, match=r"carry.edits: the study has no scene 'bal'.*'ball'"):
        probe("carry").check_scenes(study, [load_scene(str(folder / "ball.yaml"))])
    with pytest.raises(StudyError, match=r"carry.edits: got none"):
        load(folder, carry={"size": 32})


def test_features_of_another_scene_are_taken_and_true_pictures_are_refused(folder):
    controlled = {"other": {"control": "another scene"}}
    (cell,) = cells(load(folder, variants=controlled, probes={"carry": ["other"]}))
    assert cell.spec["other"]["scene"] == load_scene("spheres").content_hash
    bound = {"bound": {"method": "true pictures"}}
    with pytest.raises(StudyError, match="'bound' takes the true pictures of an edit"):
        load(folder, variants=bound, probes={"carry": ["bound"]})


def test_each_scene_has_noise_of_its_own(folder, monkeypatch):
    painting(monkeypatch, RED)
    edits = {"ball": "make the ball red", "spheres": "make it red"}
    things = {**STUDY.get("things", {}), "spheres": ["melon"]}
    both = cells(load(folder, carry={"edits": edits, "size": 32}, things=things))
    assert len({cell.spec["settings"]["seed"] for cell in both}) == len(both) == 2


def test_the_shipped_quick_study_edits_the_bear_alone():
    study = load_study("quick")
    assert {cell.scene for cell in cells(study)} == {"bear"}
    assert cells(load_study("quick", scenes=["spheres"])) == []
