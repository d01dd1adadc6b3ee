"""The probe of the audit at 64 px: figures against their functions on the same true pictures, and a
report of figures made by hand.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import written_runs
import yaml
from ball_scene import any_colour, ball_scene
from scipy.ndimage import map_coordinates
from torch_threads import on_one_thread

from attnwarp.camera import fundamental
from attnwarp.encoders import EncoderInfo
from attnwarp.errors import InputError
from attnwarp.io import read_image
from attnwarp.warp import warp_view
from attnwarp_eval import metrics
from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.document.write import markdown
from attnwarp_eval.report.build import build
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import StudyError, cells_of, load_study, shared
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.work import compute
from attnwarp_eval.truth import Geometry, appearance, two_view
from attnwarp_eval.world import splats, turned
from attnwarp_lab.probes.audit.figures import FIGURES, TRUTHS
from attnwarp_lab.probes.audit.flaws import CONDITIONS, FLAWS
from attnwarp_lab.probes.audit.measure import ARM
from attnwarp_lab.probes.audit.report import Pairs, judged, rank_correlation
from attnwarp_lab.probes.audit.views import (
    METAL,
    PAIRS,
    RIGHT,
    TRAPS,
    VARNISHED,
    edit_of_others,
    varnished,
)

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)

BRIGHT = {"red": "#d02020", "yellow": "#e0d020"}
BOX = {
    "name": "box",
    "shape": {"type": "box", "center": [0.3, 1.6, 0.3], "size": [0.6, 0.6, 0.6]},
    "texture": {"type": "checker", "colors": ["#c0c0c0", "#d0d0d0"], "size": 0.3},
}
ORANGE = {"object": "box", "paint": "#e08020"}
EDITS = [
    any_colour("any", "Paint the ball", "a blue ball", "a bright ball", BRIGHT),
    {"name": "green", "changes": [{"object": "ball", "paint": "#30c050"}]},
    {"name": "box", "changes": [ORANGE]},
]
SPLATS = {"kind": "2d", "count": 1000, "position_noise": 0.1, "normal_noise": 3.0}
WORDS = {"instruction": "Paint it", "source": "a ball", "target": "a painted ball"}


def write(path, colors=("#3050c0", "#80a0d0"), edits=EDITS):
    look = {"look_at": [0, 0, 0.7], "radius": 4, "targets": (30,)}
    said = [{**WORDS, **edit} for edit in edits]
    content = ball_scene(f"Ball {path.stem}", 0.8, colors, look, said, objects=[BOX])
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    return [write(folder / "one.yaml"), write(folder / "two.yaml", ("#30c050", "#205020"))]


def cells(scenes, folder, **changes):
    said = {
        "name": "small",
        "size": 64,
        "scenes": [str(path) for path in scenes],
        "spp": 2,
        "timing_rounds": 3,
        "encoders": {"clip": "clip-small", "dino": "dino-small", "perceptual": "perceptual-small"},
        "audit": {"edits": ["any"], "yaws": [10, -20], "splats": SPLATS},
        "editing": {
            "editor": {"ideal": {"settled": 0.4}},
            "options": {"steps": 5, "noise": "fresh", "iterations": 0, "stages": 1},
        },
        "variants": {"carried": {}},
        "probes": {"audit": ["carried"]},
        **changes,
    }
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(said))
    study = load_study(str(path))
    found = cells_of(study, {name: load_scene(name) for name in study.scenes})
    return [cell for cell in found if cell.probe == "audit"]


@pytest.fixture(scope="module")
def record(scenes, tmp_path_factory, coarse_textures):
    folder = tmp_path_factory.mktemp("run")
    return compute(probe("audit"), cells(scenes, folder)[0], folder, threads=1)


def shown(scene, camera):
    return to_srgb(np.clip(appearance(scene, camera, spp=2, seed=0), 0, 1))


def test_every_metric_has_every_condition_and_its_seconds(record):
    view, other = record.views
    assert (view.name, view.yaw) == ("turned10", pytest.approx(10))
    assert other.name == "turned-20"
    keys = [f.key for f in FIGURES if f.splats != "fitted"]
    expected = {f"{key}.{name}" for key in keys for name in (*PAIRS, *CONDITIONS, f"{ARM}carried")}
    assert set(view.metrics) == expected
    assert set(record.extra.seconds) == set(keys)
    for key in (*expected, *(figure.key for figure in FIGURES)):
        assert probe("audit").metric(key).unit


def test_figures_are_those_of_their_functions_on_the_true_pictures(record, scenes):
    scene, other = (load_scene(str(path)).with_size(64, 64) for path in scenes)
    camera = turned(scene, 10)
    geometry = Geometry(scene)
    pair = two_view(geometry, scene.source, camera)
    red = scene.edited("any", "red")
    source, target, before = shown(red, scene.source), shown(red, camera), shown(scene, camera)
    found = record.views[0].metrics
    judged = {
        "right": (source, target),
        "unedited=1": (source, before),
        "elsewhere=1": (source, shown(other, turned(other, 10))),
        "weak_all=1": (shown(scene, scene.source), before),
    }
    for name, pictures in judged.items():
        exact = metrics.cross_view(*pictures, pair)
        assert found[f"consistency.delta_e.{name}"] == pytest.approx(
            np.nanmean(exact.delta_e[::2, ::2]), rel=1e-5, abs=1e-5
        )
        matches = metrics.sift_matches(*pictures)
        F = fundamental(scene.source, camera)
        median = metrics.tsed([metrics.epipolar_distance(*matches, F)]).medians[0]
        assert found[f"consistency.tsed_distance.{name}"] == pytest.approx(median, nan_ok=True)
        assert found[f"consistency.tsed_2px.{name}"] == float(median < 2)
        # A surface point's position in the source is exact; its label, that of the nearest pixel.
        labels = found[f"multiview.labels.{name}"]
        assert labels > 0.9 if name in ("right", "weak_all=1") else labels < 0.5
    assert found["multiview.parts.right"] == 1 and found["multiview.parts.unedited=1"] == 0
    view = warp_view(splats(scenes[0], 64, 0, **SPLATS), scene.source, camera, warn_empty=False)
    where = view.correspondence.xy.numpy()[::2, ::2] - 0.5
    light = np.stack(
        [
            map_coordinates(to_linear(source)[..., c], where[..., ::-1].transpose(2, 0, 1), order=1)
            for c in range(3)
        ],
        axis=-1,
    )
    inside = ((where >= 0) & (where <= 63)).all(axis=-1) & view.mask.numpy()[::2, ::2]
    expected = np.abs(to_srgb(light.clip(0, 1)) - target[::2, ::2])[inside].mean()
    assert found["consistency.rendered_mae_srgb.right"] == pytest.approx(expected, rel=1e-4)
    assert found["multiview.delta_e_above.right"] == 0
    above = found["multiview.delta_e_above.unedited=1"]
    assert above > 1
    assert found["consistency.edit_delta_e.unedited=1"] > 1


def test_alone_a_scene_has_no_view_of_another_one_nor_another_thing_without_its_edit(tmp_path):
    path = write(tmp_path / "one.yaml", edits=EDITS[:2])
    audit = {"edits": ["any"], "yaws": [10], "splats": {"count": 500}}
    (cell,) = cells(
        [path], tmp_path, encoders={}, size=32, audit=audit, probes={"audit": []}, variants={}
    )
    assert cell.spec["other"] is None and cell.spec["other_edit"] is None
    result = compute(probe("audit"), cell, tmp_path, threads=1)
    found = result.views[0].metrics
    assert "consistency.delta_e.elsewhere=1" not in found
    assert "consistency.delta_e.misdirected_all=1" not in found
    assert "embedding.clip_image.right" not in found


def test_another_thing_is_none_that_the_edit_changes(scenes):
    scene = load_scene(str(scenes[0]))
    assert edit_of_others(scene, "any") == ["box", scene.edited("box").content_hash]
    assert edit_of_others(scene, "box")[0] == "any"


@pytest.mark.parametrize(
    ("audit", "message"),
    [
        ({"edits": ["green"]}, "audit.edits: scene 'ball' has no edit 'green' with two answers"),
        ({"yaws": [0, 8]}, "got 0, which the source has"),
    ],
)
def test_what_cannot_be_asked_says_why(scenes, tmp_path, audit, message):
    with pytest.raises(StudyError, match=message):
        cells(scenes, tmp_path, audit=audit)


def test_an_edit_that_the_file_no_longer_has_is_refused(tmp_path):
    path = write(tmp_path / "one.yaml")
    (cell,) = cells([path], tmp_path, encoders={})
    write(path, edits=[*EDITS[:2], {"name": "box", "changes": [{**ORANGE, "paint": "#ffffff"}]}])
    with pytest.raises(InputError, match="edit 'box' of scene 'ball' .* start the run again"):
        compute(probe("audit"), cell, tmp_path, threads=1)


def test_a_cells_id_follows_the_weights_and_other_weights_are_refused(
    scenes, tmp_path, monkeypatch
):
    weights = "w"

    def load(name, kind="clip"):
        info = EncoderInfo(name, "clip", f"/at/{name}", weights, "as it is", None, 3)
        return SimpleNamespace(about=info)

    monkeypatch.setattr(shared.encoders, "load_encoder", load)
    first, moved = (
        cells(scenes[:1], tmp_path, encoders={"clip": name})[0]
        for name in ("clip-small", "clip:/elsewhere")
    )
    assert first.sources != moved.sources and first.id == moved.id
    weights = "other"
    assert cells(scenes[:1], tmp_path, encoders={"clip": "clip-small"})[0].id != first.id
    with pytest.raises(InputError, match="'clip-small': its weights have changed since the run"):
        compute(probe("audit"), first, tmp_path, threads=1)


ARMS = ["a", "b", "c", "d"]


def by_hand(scenes, value, seeds=1):
    """A run whose metric ``value(key, condition, yaw, scene)`` gives, the same for every seed."""
    spec = {"size": 64, "rounds": 3, "edit": "any", "yaws": [10.0, 120.0], "encoders": {}}
    spec |= {"arms": {arm: {} for arm in ARMS}}
    keys = [f.key for f in FIGURES if f.key.startswith(("consistency.", "multiview."))]
    names = (*PAIRS, *CONDITIONS, *(ARM + arm for arm in ARMS))
    records = {}
    for scene in range(scenes):
        views = [
            (
                f"turned{yaw:g}", yaw,
                {f"{key}.{name}": value(key, name, yaw, scene) for key in keys for name in names},
            )
            for yaw in spec["yaws"]
        ]  # fmt: skip
        records[f"s{scene}"] = written_runs.record(
            views, spec=spec, cost={"rounds": {key: [0.1, 0.1, 0.2] for key in keys}}
        )
    study = {"name": "by-hand", "scenes": list(records), "probes": {"audit": []}}
    outcomes = [
        written_runs.outcome("audit", scene, ["any"], one)
        for scene, one in records.items()
        for _ in range(seeds)
    ]
    return written_runs.results(study, outcomes)


def pairs_of(run):
    return Pairs([(cell.scene, one) for cell, one in run.finished("audit")])


FLAW = {flaw.name: flaw for flaw in FLAWS}


def test_the_report_says_what_the_numbers_say(tmp_path):
    def value(key, name, yaw, scene):
        if key == "consistency.tsed_2px":
            return float(name in PAIRS)  # sees all, needs no truth; higher is better
        if key == "consistency.tsed_distance":
            return None if yaw > 60 else 1.0
        if key == "consistency.rendered_delta_e":  # sees slides from 4 px on, and fears highlights
            slid = name.startswith("slid=") and float(name.partition("=")[2]) >= 4
            return 5.0 + scene if slid or name == VARNISHED else 1.0 + scene / 100
        if key == "consistency.perceptual":  # gamed by blur
            return 0.5 if name.startswith("blur_all") else 1.0 + scene
        return float(scene)

    run = by_hand(8, value)
    pairs = pairs_of(run)
    rows = {row.key: row for row in pairs.rows}
    best, colours = rows["consistency.tsed_2px"], rows["consistency.rendered_delta_e"]
    assert pairs.counted(best, pairs.near).value == 1
    assert pairs.alarms(colours) == 1
    assert pairs.alarms(colours, METAL) == 0
    # Flaws as large as highlights do not stand out against varnished pairs, and do against metal.
    slid = FLAW["slid"].key(4)
    assert pairs.area(colours, [slid], pairs.near, [VARNISHED]).value == 0.5
    assert pairs.area(colours, [slid], pairs.near, [METAL]).value == 1
    assert pairs.undefined(rows["consistency.tsed_distance"], 120) == 1
    sees, blind, games = judged(pairs, colours)
    assert sees == ["texture slid"] and len(blind) == sum(not f.alike for f in FLAWS) - 1
    assert games == []
    assert judged(pairs, rows["consistency.perceptual"])[2] == ["all views: blur"]
    text = markdown(build(run, tmp_path))
    line = next(line for line in text.splitlines() if line.startswith("| colour, depth |"))
    assert "| 1: texture slid |" in line and "| 100 % / 0 % |" in line
    assert text.index("| is gamed by |") < text.index("Real edits and their true disagreement")


def test_a_figure_is_ranked_by_the_true_disagreement_of_real_edits_of_a_scene():
    order = {ARM + arm: k for k, arm in enumerate(ARMS)}

    def value(key, name, yaw, scene):
        if name not in order:
            return 1.0
        if key == "multiview.delta_e_above":
            return 10.0 * scene + order[name]
        if key == "consistency.held_psnr":  # dB: falls as disagreement grows
            return -float(order[name])
        if key == "consistency.rendered_delta_e":  # 0, 1, 3, 2: one of six pairs turned around
            return {2: 3.0, 3: 2.0}.get(order[name], float(order[name]))
        return 1.0

    pairs = pairs_of(by_hand(7, value))
    truth, labels = TRUTHS[0], TRUTHS[1]
    rows = {row.key: row for row in pairs.rows}
    assert pairs.tau(rows["consistency.held_psnr"], truth).mean == pytest.approx(1)
    assert pairs.tau(rows["consistency.rendered_delta_e"], truth).mean == pytest.approx(4 / 6)
    assert pairs.tau(rows["consistency.fitted_psnr"], truth).mean == 0
    assert math.isnan(pairs.tau(rows["consistency.held_psnr"], labels).mean)


def test_a_metric_is_ranked_with_the_size_of_a_flaw_and_seeds_are_of_one_scene():
    def value(key, name, yaw, scene):
        _, size = CONDITIONS.get(name, (None, 0.0))
        if key == "consistency.held_psnr":  # higher is better: falls as the flaw grows
            return 9.0 - size
        if key == "consistency.held_distance":  # 0, 2, 1, 3 and 4 for sizes that rise
            return {0.5: 2.0, 1.0: 1.0, 2.0: 3.0, 4.0: 4.0}.get(size, 0.0)
        return 1.0

    pairs = pairs_of(by_hand(2, value, seeds=2))
    assert pairs.scenes == 2
    rows = {row.key: row for row in pairs.rows}
    points, error = (rows[f"consistency.held_{name}"] for name in ("psnr", "distance"))
    assert pairs.follows(points, FLAW["slid"]).mean == pytest.approx(1)
    assert pairs.follows(error, FLAW["blur"]).mean == pytest.approx(0.9)  # 1 - 6 * 2 / (5 * 24)
    assert pairs.follows(rows["consistency.delta_e"], FLAW["noise"]).mean == 0
    assert math.isnan(rank_correlation((0, 1, 2), (1.0, math.nan, 2.0)))


def test_a_file_of_scores_is_judged_as_any_figure_and_a_bad_one_says_why(scenes, tmp_path):
    audit = {"edits": ["any"], "yaws": [10], "splats": {"count": 500}, "pictures": True}
    small = {
        "encoders": {},
        "size": 32,
        "probes": {"audit": []},
        "variants": {},
        "timing_rounds": 3,
    }
    (cell,) = cells([scenes[0]], tmp_path, audit=audit, **small)
    compute(probe("audit"), cell, tmp_path, threads=1)
    folder = tmp_path / "audit" / cell.scene / "any"
    lines = (folder / "pairs.csv").read_text().splitlines()
    assert lines[0] == "scene,edit,condition,source,target"
    darkness = [",".join([lines[0], "darkness lower"])]
    for line in lines[1:]:  # the protocol: a score of the pictures of each row
        _, _, condition, source, target = line.split(",")
        pictures = [read_image(folder / condition / f"{v}.png")[0] for v in (source, target)]
        darkness.append(f"{line},{-np.mean(pictures)}")
    path = tmp_path / "scores.csv"
    path.write_text("\n".join(darkness))
    audit = {**audit, "pictures": False, "scores": str(path)}
    (cell,) = cells([scenes[0]], tmp_path, audit=audit, **small)
    record = compute(probe("audit"), cell, tmp_path, threads=1)
    key = "consistency.score_lower.darkness"
    want = float(darkness[1].rpartition(",")[2])
    assert record.views[0].metrics[f"{key}.right"] == pytest.approx(want)
    assert Pairs([("one", record)]).rows[0].key == key
    path.write_text("scene,edit,condition,source,target,MEt3R\n")
    (cell,) = cells([scenes[0]], tmp_path, audit=audit, **small)
    with pytest.raises(InputError, match="scores such as 'MEt3R lower'"):
        compute(probe("audit"), cell, tmp_path, threads=1)


def test_a_coat_reflects_4_percent_ahead_and_all_of_the_light_that_grazes_it():
    paint, metal = np.full((1, 3, 3), 0.2), np.full((1, 3, 3), 1.2)
    hits = SimpleNamespace(cosine=np.array([[1.0, 0.0, np.nan]]))
    found = varnished(paint, metal, hits, np.array([[True, True, False]]))
    np.testing.assert_allclose(found[0, :, 0], [0.24, 1.2, 0.2])


def test_right_pairs_are_not_the_traps():
    assert not set(TRAPS) & set(RIGHT)
