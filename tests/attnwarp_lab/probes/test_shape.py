"""The probe of edits that change shapes. Oracles: true pictures, whose figures are known; the file's own edits."""

import json
import lzma
from pathlib import Path

import numpy as np
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
        "true": {"method": "true pictures"},
        "after": {"geometry": "truth", "scene_after": True, "options": {"iterations": 0}},
        "before": {"geometry": "truth", "options": {"iterations": 0}},
    },
    "probes": {"shape": ["true", "after", "before"]},
}  # fmt: skip

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


def cells(folder, **changes):
    (folder / "shaped.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    study = load_study(str(folder / "shaped.yaml"))
    scenes = {str(FILE): load_scene(FILE)}
    return {cell.variant: cell for cell in cells_of(study, scenes) if cell.probe == "shape"}


def test_true_pictures_have_every_figure_at_its_best(tmp_path):
    own = cells(tmp_path)
    assert {cell.spec["places"][0][0] for cell in own.values()} == {"added-0"}
    record = compute(probe("shape"), own["true"], tmp_path)
    (view,) = record.views
    for figure in ("same.added", "new.added", "overlap.several", "uncovered.removed"):
        assert view.metrics[f"shape.{figure}"] == 1
    assert view.metrics["shape.lost"] < 0.5  # a picture in bytes, shadows below the limit of change
    assert record.extra.splats == (800, 800)  # tuning moves splats and adds none
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
