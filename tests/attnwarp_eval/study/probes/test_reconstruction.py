"""The probe of COLMAP's reconstructions: sets against the metric on pictures made here, and a report
of figures made by hand.
"""

import math

import numpy as np
import pytest
import written_runs
import yaml
from ball_scene import any_colour, ball_scene
from torch_threads import on_one_thread

from attnwarp_eval import metrics
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.document.write import markdown
from attnwarp_eval.report.build import build
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probes.reconstruction.measure import CONDITIONS, FLAWED, SECONDS
from attnwarp_eval.study.shared.right_views import PAIRS
from attnwarp_eval.study.work import compute
from attnwarp_eval.truth import appearance
from attnwarp_eval.world import turned

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)

BRIGHT = {"red": "#d02020", "yellow": "#e0d020"}
EDIT = any_colour("any", "Paint the ball", "a blue ball", "a bright ball", BRIGHT)


def cells(tmp_path, **changes):
    path = tmp_path / "ball.yaml"
    look = {"look_at": [0, 0, 0.7], "radius": 4, "targets": (30,)}
    path.write_text(yaml.safe_dump(ball_scene("Ball", 0.8, ("#3050c0", "#80a0d0"), look, [EDIT])))
    said = {
        "name": "small",
        "size": 128,
        "scenes": [str(path)],
        "spp": 2,
        "reconstruction": {"edit": "any", "yaws": [8, -8], **changes},
        "probes": {"reconstruction": []},
    }
    study = tmp_path / "study.yaml"
    study.write_text(yaml.safe_dump(said))
    made = load_study(str(study))
    found = cells_of(made, {name: load_scene(name) for name in made.scenes})
    return [cell for cell in found if cell.probe == "reconstruction"]


def test_figures_are_those_of_the_metric_on_the_true_pictures(tmp_path):
    pytest.importorskip("pycolmap")
    (cell,) = cells(tmp_path)
    record = compute(probe("reconstruction"), cell, tmp_path, threads=1)
    (view,) = record.views
    scene = load_scene(str(tmp_path / "ball.yaml")).with_size(128, 128)
    cameras = [scene.source, turned(scene, 8), turned(scene, -8)]

    def shown(of, camera):
        return to_srgb(np.clip(appearance(of, camera, spp=2, seed=0), 0, 1))

    red = scene.edited("any", "red")
    right = [shown(red, camera) for camera in cameras]
    flawed = [right[0], shown(scene, cameras[1]), right[2]]
    for name, images in (("right", right), ("unedited=1", flawed)):
        for key, value in metrics.reconstruct(images, cameras).figures().items():
            assert view.metrics[f"{key}.{name}"] == pytest.approx(value, nan_ok=True)
    # One scene has no view of another one; all else was reconstructed, if to nothing.
    assert np.isnan(view.metrics["consistency.colmap_failed.elsewhere=1"])
    assert len(record.extra.seconds[SECONDS]) == len(CONDITIONS) - 1


def test_a_sweep_without_views_of_its_own_is_refused(tmp_path):
    with pytest.raises(StudyError, match="got 0, which the source has"):
        cells(tmp_path, yaws=[0, 8])


def test_the_report_says_what_the_numbers_say(tmp_path):
    records = {}
    for scene in range(6):
        figures = {}
        for name in CONDITIONS:
            failed = name == "elsewhere=1"
            figures |= {
                f"consistency.colmap_{key}.{name}": value
                for key, value in {
                    "registered": 0.0 if failed else 1.0 if name in PAIRS else 5 / 9,
                    "points": 0 if failed else 100 + scene,
                    "track_length": math.nan if failed else 3.0,
                    "error": math.nan if failed else 0.5,
                    "failed": float(failed),
                }.items()
            }
        records[f"s{scene}"] = written_runs.record(
            [("turned-8", 8.0, figures)],
            spec={"size": 128, "yaws": [8.0, -8.0], "edit": "any"},
            cost={"rounds": {SECONDS: [1.0, 2.0, 9.0]}},
        )
    study = {"name": "by-hand", "scenes": list(records), "probes": {"reconstruction": []}}
    run = written_runs.results(
        study,
        [
            written_runs.outcome("reconstruction", scene, ["metrics"], one)
            for scene, one in records.items()
        ],
    )
    text = markdown(build(run, tmp_path))
    assert f"**registered views** sees {len(FLAWED)} of {len(FLAWED)} flaws" in text
    assert "**points** sees 1 of 6 flaws: another scene." in text
    assert "In a flawed set 1 of the 3 views have the flaw" in text
    assert "| another scene | 0 % | 0 | – | – | 6 of 6 |" in text
    assert "| another answer, 100 % of the object | 56 % |" in text
