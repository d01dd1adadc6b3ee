"""The probe of edits that change shapes. Oracles: true pictures, whose figures are known; the file's own edits."""

from pathlib import Path

import pytest
import yaml
from torch_threads import on_one_thread

from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.work import compute

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
