"""The probe of the audit at 64 px: figures against their functions on the same true pictures, and a
report of figures made by hand.
"""

import numpy as np
import pytest
import written_runs
import yaml
from ball_scene import any_colour, ball_scene
from torch_threads import on_one_thread

from attnwarp.camera import fundamental
from attnwarp_eval import metrics
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.document.write import markdown
from attnwarp_eval.report.build import build
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import StudyError, cells_of, load_study
from attnwarp_eval.study.flaws import CONDITIONS
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probes.audit.report import ROWS, Pairs
from attnwarp_eval.study.shared.right_views import (
    METAL,
    PAIRS,
    RIGHT,
    TRAPS,
    VARNISHED,
    varnished,
)
from attnwarp_eval.study.work import compute
from attnwarp_eval.truth import Geometry, appearance, two_view
from attnwarp_eval.world import turned

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)

BRIGHT = {"red": "#d02020", "yellow": "#e0d020"}
EDIT = any_colour("any", "Paint the ball", "a blue ball", "a bright ball", BRIGHT)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    paths = []
    for name, colors in (("one", ("#3050c0", "#80a0d0")), ("two", ("#30c050", "#205020"))):
        look = {"look_at": [0, 0, 0.7], "radius": 4, "targets": (30,)}
        content = ball_scene(f"Ball {name}", 0.8, colors, look, [EDIT])
        paths.append(folder / f"{name}.yaml")
        paths[-1].write_text(yaml.safe_dump(content))
    return paths


def cells(scenes, folder, **changes):
    said = {
        "name": "small",
        "size": 64,
        "scenes": [str(path) for path in scenes],
        "spp": 2,
        "timing_rounds": 3,
        "encoders": {"clip": "clip-small", "dino": "dino-small", "perceptual": "perceptual-small"},
        "audit": {"edit": "any", "yaws": [10, 40], "splats": {"count": 1000}},
        "probes": {"audit": []},
        **changes,
    }
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(said))
    made = load_study(str(path))
    found = cells_of(made, {name: load_scene(name) for name in made.scenes})
    return [cell for cell in found if cell.probe == "audit"]


@pytest.fixture(scope="module")
def record(scenes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return compute(probe("audit"), cells(scenes, folder)[0], folder, threads=1)


def test_every_metric_has_every_condition_and_its_seconds(record):
    assert [(view.name, view.yaw) for view in record.views] == [
        ("turned10", pytest.approx(10)),
        ("turned40", pytest.approx(40)),
    ]
    wanted = {f"{row.key}.{name}" for row in ROWS for name in (*PAIRS, *CONDITIONS)}
    for view in record.views:
        assert set(view.metrics) == wanted
    assert set(record.extra.seconds) == {row.key for row in ROWS}
    for key in wanted:
        assert probe("audit").metric(key).unit


def test_figures_are_those_of_their_functions_on_the_true_pictures(record, scenes):
    scene = load_scene(str(scenes[0])).with_size(64, 64)
    other = load_scene(str(scenes[1])).with_size(64, 64)
    camera = turned(scene, 10)
    pair = two_view(Geometry(scene), scene.source, camera)
    red = scene.edited("any", "red")
    source, target, before, elsewhere = (
        to_srgb(np.clip(appearance(of, view, spp=2, seed=0), 0, 1))
        for of, view in (
            (red, scene.source), (red, camera), (scene, camera), (other, turned(other, 10)),
        )
    )  # fmt: skip
    found = record.views[0].metrics
    for name, picture in (("right", target), ("unedited=1", before), ("elsewhere=1", elsewhere)):
        exact = metrics.cross_view(source, picture, pair)
        assert found[f"consistency.delta_e.{name}"] == pytest.approx(
            np.nanmean(exact.delta_e[::2, ::2]), rel=1e-6
        )
        matches = metrics.sift_matches(source, picture)
        F = fundamental(scene.source, camera)
        median = metrics.tsed([metrics.epipolar_distance(*matches, F)]).medians[0]
        assert found[f"consistency.tsed_distance.{name}"] == pytest.approx(median, nan_ok=True)
        assert found[f"consistency.tsed_2px.{name}"] == float(median < 2)
    assert found["multiview.delta_e_above.right"] == 0
    above = found["multiview.delta_e_above.unedited=1"]
    assert above > 1
    assert found["consistency.edit_delta_e.unedited=1"] > 1


def test_alone_a_scene_has_no_view_of_another_one(scenes, tmp_path):
    (cell,) = cells(scenes[:1], tmp_path, encoders={}, audit={"edit": "any", "yaws": [10]})
    assert cell.spec["other"] is None
    result = compute(probe("audit"), cell, tmp_path, threads=1)
    found = result.views[0].metrics
    assert np.isnan(found["consistency.delta_e.elsewhere=1"])
    assert "embedding.clip_image.right" not in found


def test_an_edit_with_one_answer_is_refused(scenes, tmp_path):
    with pytest.raises(StudyError, match="audit.edit: scene 'ball' has no edit 'nay'"):
        cells(scenes, tmp_path, audit={"edit": "nay"})


def by_hand(scenes, value):
    """A run whose metric ``value(key, condition, yaw, scene)`` gives."""
    spec = {"size": 64, "rounds": 3, "edit": "any", "yaws": [10.0, 120.0], "encoders": {}}
    rows = [row for row in ROWS if row.key.startswith("consistency.")]
    records = {}
    for scene in range(scenes):
        views = [
            (
                f"turned{yaw:g}",
                yaw,
                {
                    f"{row.key}.{name}": value(row.key, name, yaw, scene)
                    for row in rows
                    for name in (*PAIRS, *CONDITIONS)
                },
            )
            for yaw in spec["yaws"]
        ]
        records[f"s{scene}"] = written_runs.record(
            views, spec=spec, cost={"rounds": {row.key: [0.1, 0.1, 0.2] for row in rows}}
        )
    study = {"name": "by-hand", "scenes": list(records), "probes": {"audit": []}}
    return written_runs.results(
        study,
        [written_runs.outcome("audit", scene, ["metrics"], one) for scene, one in records.items()],
    )


def test_the_report_says_what_the_numbers_say(tmp_path):
    def value(key, name, yaw, scene):
        if key == "consistency.tsed_2px":
            return float(name in PAIRS)  # sees all, needs no truth; higher is better
        if key == "consistency.tsed_distance":
            return None if yaw > 60 else 1.0
        if key == "consistency.rendered_delta_e":  # sees slides from 4 px on, and fears highlights
            slid = name.startswith("slid=") and float(name.partition("=")[2]) >= 4
            return 5.0 + scene if slid or name == VARNISHED else 1.0 + scene / 100
        return float(scene)

    run = by_hand(8, value)
    pairs = Pairs([(cell.scene, one) for cell, one in run.finished("audit")])
    rows = {row.key: row for row in pairs.rows}
    flaws = {flaw.name: flaw for flaw, _ in CONDITIONS.values()}
    best, colours = rows["consistency.tsed_2px"], rows["consistency.rendered_delta_e"]
    assert pairs.best() is best
    assert pairs.counted(best, pairs.near).value == 1
    assert pairs.smallest(colours, flaws["slid"]) == 4
    assert pairs.smallest(colours, flaws["hue"]) is None
    assert pairs.alarms(colours) == 1
    assert pairs.alarms(colours, METAL) == 0
    # Flaws as large as highlights do not stand out against varnished pairs, and do against metal.
    slid = flaws["slid"].key(4)
    assert pairs.area(colours, [slid], pairs.near, [VARNISHED]).value == 0.5
    assert pairs.area(colours, [slid], pairs.near, [METAL]).value == 1
    assert pairs.alarms(best) == 0
    assert pairs.undefined(rows["consistency.tsed_distance"], 120) == 1
    assert pairs.shown(rows["consistency.perceptual"], flaws["slid"]).value == 0.5
    text = markdown(build(run, tmp_path))
    assert "Without truth, report 'TSED at 2 px'" in text
    assert "AUROC 1.00 [1.00, 1.00] over the five flaws" in text
    assert "**colour, rendered depth** sees 1 of 10 flaws (texture slid)" in text
    assert "takes highlights for a flaw in 100 % of pairs" in text
    assert "has no value in 0 % at 10, 100 % at 120 degrees" in text
    cannot = text.partition("Cannot tell a view of another scene")[2].partition("\n")[0]
    assert "epipolar distance" in cannot
    assert "TSED" not in cannot
    assert (tmp_path / "figures/audit.svg").is_file()


def test_a_coat_reflects_4_percent_ahead_and_all_of_the_light_that_grazes_it():
    from types import SimpleNamespace

    paint, metal = np.full((1, 3, 3), 0.2), np.full((1, 3, 3), 1.2)
    hits = SimpleNamespace(cosine=np.array([[1.0, 0.0, np.nan]]))
    found = varnished(paint, metal, hits, np.array([[True, True, False]]))
    np.testing.assert_allclose(found[0, :, 0], [0.24, 1.2, 0.2])


def test_right_pairs_are_not_the_traps():
    assert not set(TRAPS) & set(RIGHT)
