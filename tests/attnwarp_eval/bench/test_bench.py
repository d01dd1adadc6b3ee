"""Oracles: the same pictures in a study, true pictures and pictures spoiled on purpose, COLMAP's own reader."""

import hashlib
import json
import math
import re
import shutil
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image
from typer.testing import CliRunner

from attnwarp.errors import InputError
from attnwarp.io import read_dataset, read_image
from attnwarp.io.lock import alone_in
from attnwarp.warp import PRESETS, warp_view
from attnwarp_eval import cost
from attnwarp_eval.bench import result, score, suite, warps
from attnwarp_eval.cli.main import app
from attnwarp_eval.files import write_picture
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.shared.edit_truth import EditTruth
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, EditedScene, Method
from attnwarp_eval.study.work import compute
from attnwarp_eval.truth.mitsuba import build
from attnwarp_eval.two_view import AMBIGUOUS, HIDDEN, VISIBLE, Hits, TwoView
from attnwarp_eval.world import splats as sampled
from attnwarp_eval.world import world

SIZE, SPP, SCENE = 48, 2, "drawn-0"


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "TEXELS", 4 * SIZE)
        suite.export(folder, count=1, seed=9, size=SIZE, spp=SPP, targets=2)
        yield folder
        build.forget()


@pytest.fixture
def no_drift(monkeypatch):
    """Drift, the dearest figure, left out where a test reads others."""
    monkeypatch.setattr(score, "edit_drift", lambda *_: math.nan)


def true_pictures(bench, edit, answers):
    """Pictures of the shipped truth, one answer a view."""
    views = json.loads((bench / SCENE / "edits.json").read_text())["views"]
    folder = bench / SCENE / "truth" / edit
    return {
        view: read_image(folder / answer / f"{view}.png")
        for view, answer in zip(views, answers, strict=True)
    }


def handed_in(folder, edits):
    for edit, pictures in edits.items():
        for view, picture in pictures.items():
            write_picture(folder / SCENE / edit / f"{view}.png", picture)
    return folder


def scored(bench, tmp_path, pictures, edit="some_colour", track=result.SAME):
    if tmp_path.joinpath("in").exists():
        shutil.rmtree(tmp_path / "in")
    folder = handed_in(tmp_path / "in", {edit: pictures})
    (folder / "method.json").write_text(json.dumps({"track": track}))
    (one,) = score.score(bench, folder, tmp_path / "out").scores
    return one


def test_readers_of_both_formats_see_the_same_cameras(bench):
    one, two = (read_dataset(bench / SCENE / part) for part in ("transforms.json", "sparse/0"))
    assert len(one.cameras) == 3
    for a, b in zip(one.cameras, two.cameras, strict=True):
        assert (a.width, a.height) == (b.width, b.height) == (SIZE, SIZE)
        np.testing.assert_allclose(a.K, b.K, rtol=1e-12)
        np.testing.assert_allclose(a.world_to_camera, b.world_to_camera, atol=1e-12)
    np.testing.assert_allclose(one.points, two.points, rtol=1e-6)


def test_pycolmap_opens_the_export(bench):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(bench / SCENE / "sparse" / "0")
    assert model.num_images() == 3 and model.num_points3D() == suite.POINTS
    by_name = {image.name: image for image in model.images.values()}
    for camera in read_dataset(bench / SCENE / "transforms.json").cameras:
        pose = by_name[camera.name.removeprefix("images/")].cam_from_world().matrix()
        np.testing.assert_allclose(pose, camera.world_to_camera[:3], atol=1e-9)


def test_nerfstudios_rules_read_the_export(bench):
    """Rules of its NerfstudioDataParser: intrinsics at the top or in every frame, paths below the
    folder, masks and depths of all frames or none, rays (x - cx) / fl_x, -(y - cy) / fl_y, -1 in
    ``transform_matrix``, points by Open3D. Rays and depth must meet the truth's source pixels.
    """
    o3d = pytest.importorskip("open3d")
    place = bench / SCENE
    meta = json.loads((place / "transforms.json").read_text())
    frames = meta["frames"]
    for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        assert name in meta or all(name in frame for frame in frames)
    assert meta["camera_model"] == "OPENCV" and not {"k1", "k2", "k3", "p1", "p2"} & set(meta)
    assert not any({"mask_path", "depth_file_path"} & set(frame) for frame in frames)
    assert not any(f"{split}_filenames" in meta for split in ("train", "val", "test"))
    paths = [place / frame["file_path"] for frame in frames]
    assert len(set(paths)) == len(frames) and all(path.is_file() for path in paths)
    points = o3d.io.read_point_cloud(str(place / meta["ply_file_path"]))
    assert len(points.points) == len(points.colors) == suite.POINTS

    poses = {Path(f["file_path"]).stem: np.array(f["transform_matrix"]) for f in frames}
    grid = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), -1)
    x, y = ((grid - [meta["cx"], meta["cy"]]) / [meta["fl_x"], meta["fl_y"]]).transpose(2, 0, 1)
    depth = np.load(place / "depth" / "yaw010.npy")
    rays = np.stack([x, -y, -np.ones_like(x)], -1) @ poses["yaw010"][:3, :3].T
    surface = poses["yaw010"][:3, 3] + rays * depth[..., None]
    seen = (surface - poses["source"][:3, 3]) @ poses["source"][:3, :3]
    mine = np.stack([
        meta["cx"] + meta["fl_x"] * seen[..., 0] / -seen[..., 2],
        meta["cy"] - meta["fl_y"] * seen[..., 1] / -seen[..., 2],
    ], -1)  # fmt: skip
    true = np.load(place / "truth" / "source_pixel" / "yaw010.npy")
    # A stranger's mask has the picture's two dimensions.
    visible = np.asarray(Image.open(place / "truth" / "visible" / "yaw010.png")) == 255
    inside = np.asarray(Image.open(place / "masks" / "colour" / "yaw010.png"))
    assert visible.mean() > 0.2 and inside.shape == depth.shape and set(inside.flat) == {0, 255}
    # Depth and pixels are stored in float32.
    np.testing.assert_allclose(mine[visible], true[visible], atol=1e-3)


def test_scores_equal_those_of_a_study_to_the_last_digit(bench, tmp_path):
    answers = ("red", "blue", "red")
    pictures = true_pictures(bench, "some_colour", answers)
    path = bench / SCENE / "truth" / "scene.yaml"

    def run(job):
        edited = {k: picture[..., :3] for k, picture in enumerate(pictures.values())}
        return EditedScene(job.gaussians, edited, {"edit": 1.0}, {"views": len(edited)})

    EDITING_METHODS["handed in"] = Method(EDITING_METHODS["attention_warping"].settings, run)
    study = {
        "name": "same", "size": SIZE, "scenes": [str(path)], "spp": SPP, "splats": {"count": 100},
        "views": list(pictures)[1:], "editing": {"edits": {SCENE: {"some_colour": None}}},
        "variants": {"one": {"method": "handed in"}}, "probes": {"editing": ["one"]},
    }  # fmt: skip
    (tmp_path / "same.yaml").write_text(yaml.safe_dump(study))
    try:
        loaded = load_study(str(tmp_path / "same.yaml"))
        scenes = {name: load_scene(name) for name in loaded.scenes}
        cell = next(c for c in cells_of(loaded, scenes) if c.probe == "editing")
        record = compute(probe("editing"), cell, tmp_path)
    finally:
        del EDITING_METHODS["handed in"]
    one = scored(bench, tmp_path, pictures)
    assert len(record.views) == 2
    for view in record.views:
        for name, value in one.by_view[view.name.partition("/")[2]].items():
            np.testing.assert_equal(value, view.metrics[name])


@pytest.mark.usefixtures("no_drift")
def test_scores_of_other_code_and_damaged_ones_are_measured_again(bench, tmp_path, monkeypatch):
    pictures, measured, measure = true_pictures(bench, "colour", ["edited"] * 3), [], score._score
    monkeypatch.setattr(score, "_score", lambda *given: measured.append(1) or measure(*given))
    for source, times in (("one", 1), ("one", 1), ("two", 2)):
        for module in (cost, score):
            monkeypatch.setattr(module, "source_hash", lambda source=source: source, raising=False)
        one = scored(bench, tmp_path, pictures, "colour")
        assert len(measured) == times
    kept = tmp_path / "out" / "scores" / f"{SCENE}-colour.json"
    for text in (kept.read_text()[:99], '{"key": 1}', "\x92"):
        kept.write_bytes(text.encode("latin-1"))
        np.testing.assert_equal(asdict(scored(bench, tmp_path, pictures, "colour")), asdict(one))
    assert len(measured) == times + 3


def test_true_pictures_of_one_answer_have_no_error(bench, tmp_path):
    for edit, answer in (("some_colour", "blue"), ("colour", "edited")):
        one = scored(bench, tmp_path, true_pictures(bench, edit, [answer] * 3), edit)
        assert one.remarks == [] and one.figures["done"] == 1
        # Both sides are rounded to 8 bits.
        assert one.figures["error"] == 0 and one.figures["outside"] < 1
        assert one.figures["amount"] > score.LITTLE


@pytest.mark.parametrize(("amplitude", "named"), [(1.0, False), (0.75, False), (0.25, True)])
def test_noise_of_the_truth_is_no_texture_that_pictures_must_have(amplitude, named):
    rng, size = np.random.default_rng(0), 128
    wave = np.broadcast_to(0.1 * np.sin(np.arange(size) * np.pi / 4)[:, None], (size, size, 3))
    one, two, *again = (wave + rng.normal(0, 0.15, (size, size, 1)) for _ in range(4))
    where = {"source": np.ones((size, size), bool)}
    truth = EditTruth({"source": one}, {"blue": {"source": two}}, {"blue": where}, where)
    pictures = {"source": 0.5 + amplitude * wave}
    said = [x for x in score._remarks(truth, pictures, "source", "blue", again) if "smooth" in x]
    assert len(said) == named
    for remark in said:
        # Power that two renders of 16,000 pixels share has a standard error of 8 %.
        assert abs(int(re.search(r"\d+", remark)[0]) - 100 * amplitude) < 5


def spoiled(bench):
    """Pictures that no method should be praised for, by what a remark says of them."""
    true = true_pictures(bench, "some_colour", ["blue"] * 3)
    views = list(true)
    masks = {v: read_image(bench / SCENE / "masks" / "some_colour" / f"{v}.png") > 0 for v in views}
    originals = {v: read_image(bench / SCENE / "images" / f"{v}.png") for v in views}
    inside = np.concatenate([p[masks[v][..., 0]] for v, p in true.items()]).mean(0)
    tint = np.array([160, 170, 255]) / 255
    return true, {
        "unedited": originals,
        "smooth: blurred": {v: cv2.GaussianBlur(p, (0, 0), 4) for v, p in true.items()},
        "smooth: textureless": {
            v: np.where(masks[v], inside, p).astype(np.uint8) for v, p in originals.items()
        },
        "smooth: flat": {v: np.full_like(p, (90, 100, 160)) for v, p in true.items()},
        "copies of the source": dict.fromkeys(views, true["source"]),
        "names swapped": {
            "source": true["source"], views[1]: true[views[2]], views[2]: true[views[1]],
        },
        "one tint": {v: (p * tint).astype(np.uint8) for v, p in originals.items()},
        "two answers": true_pictures(bench, "some_colour", ["blue", "red", "blue"]),
    }  # fmt: skip


@pytest.mark.usefixtures("no_drift")
@pytest.mark.parametrize("track", [result.SAME, result.OWN])
def test_the_truth_is_first_in_every_ranking_column_and_copies_are_not(bench, tmp_path, track):
    true, cheats = spoiled(bench)
    best = scored(bench, tmp_path, true, track=track)
    assert best.remarks == [] and best.figures["done"] == 1
    assert best.figures["error"] == 0 and best.figures["apart"] < 0.05  # 8 bits
    done = {}
    for content, pictures in cheats.items():
        one = scored(bench, tmp_path, pictures, track=track)
        named = any(content.partition(":")[0] in remark for remark in one.remarks)
        assert named != (content in ("one tint", "two answers")), content
        assert one.figures["error"] > best.figures["error"] + 0.5, content
        assert not one.figures["apart"] < best.figures["apart"], content
        done[content] = one.figures["done"]
    assert done["unedited"] == min(done.values()) == 0
    # All that is visible inside is alike between copies: below the floor of the true views.
    assert (
        track == result.SAME
        or scored(bench, tmp_path, cheats["copies of the source"], track=track).figures["apart"]
        > 0.5
    )


@pytest.mark.usefixtures("no_drift")
def test_an_editor_that_disturbs_the_background_stands_before_unedited_pictures(bench, tmp_path):
    true, cheats = spoiled(bench)
    masks = {v: read_image(bench / SCENE / "masks" / "some_colour" / f"{v}.png") > 0 for v in true}
    disturbed = {v: np.where(masks[v], p, 0.8 * p + 20).astype(np.uint8) for v, p in true.items()}
    one, unedited = (scored(bench, tmp_path, p).figures for p in (disturbed, cheats["unedited"]))
    assert one["outside"] > 3 and 3 < one["error"] < unedited["error"] - 3


@pytest.mark.usefixtures("no_drift")
def test_leaving_the_worst_view_out_gains_nothing(bench, tmp_path):
    true = true_pictures(bench, "some_colour", ["blue"] * 3)
    last = list(true)[-1]
    some = {view: picture for view, picture in true.items() if view != last}
    original = read_image(bench / SCENE / "images" / f"{last}.png")
    left_out = scored(bench, tmp_path, some).figures["error"]
    assert left_out == scored(bench, tmp_path, some | {last: original}).figures["error"] > 0.5


def test_a_missing_view_is_said_and_a_wrong_size_or_damage_refused(bench, tmp_path):
    pictures = true_pictures(bench, "colour", ["edited"] * 3)
    last = list(pictures)[-1]
    some = {view: picture for view, picture in pictures.items() if view != last}
    assert scored(bench, tmp_path, some, "colour").remarks == [f"missing: {last}"]
    with pytest.raises(InputError, match=f"{last}.png: has 24 x 24 px, expected {SIZE} x {SIZE}"):
        scored(bench, tmp_path, some | {last: pictures[last][:24, :24]}, "colour")
    copy = tmp_path / "copy"
    shutil.copytree(bench, copy)
    (copy / SCENE / "edits.json").write_text("{}")
    with pytest.raises(InputError, match="missing or changed"):
        score.score(copy, tmp_path / "in", tmp_path / "out")


def given_away(bench, tmp_path, file, text):
    """A copy of the bench with another file in it, whose hash fits."""
    copy = tmp_path / "given"
    shutil.copytree(bench, copy)
    (copy / file).write_text(text)
    held = json.loads((copy / suite.FILE).read_text())
    if file in held["files"]:
        held["files"][file] = hashlib.sha256(text.encode()).hexdigest()
        (copy / suite.FILE).write_text(json.dumps(held))
    return copy


@pytest.mark.parametrize(
    ("file", "name", "place"),
    [
        (f"{SCENE}/edits.json", '"colour"', "edits.0.name"),
        (suite.FILE, f'"{SCENE}"', "scenes.0"),
        (suite.FILE, '"source"', "views.0"),
    ],
)
def test_a_bench_from_elsewhere_writes_in_the_folder_named_alone(
    bench, tmp_path, file, name, place
):
    text = (bench / file).read_text().replace(name, '"../../../evil"', 1)
    copy = given_away(bench, tmp_path, file, text)
    handed_in(tmp_path / "in", {"colour": true_pictures(bench, "colour", ["edited"] * 3)})
    for call in (["run", "--method", "by_view", "--set", "steps=1"], ["score"]):
        out = ["--out", str(tmp_path / "out")] if call == ["score"] else []
        done = CliRunner().invoke(
            app, ["bench", call[0], str(copy), str(tmp_path / "in"), *call[1:], *out]
        )
        assert done.exit_code == 2 and place in done.stderr, done.output
    assert not list(tmp_path.parent.glob("evil*")) and not list(tmp_path.rglob("evil*"))


def test_a_hand_in_that_links_out_of_its_folder_is_refused(bench, tmp_path):
    pictures = true_pictures(bench, "colour", ["edited"] * 3)
    place = handed_in(tmp_path / "in", {"colour": pictures}) / SCENE / "colour"
    (place / "source.png").unlink()
    (place / "source.png").symlink_to(bench / SCENE / "truth" / "colour" / "edited" / "source.png")
    with pytest.raises(InputError, match=r"source.png'?: leads out of"):
        score.score(bench, tmp_path / "in", tmp_path / "out")
    shutil.rmtree(place)
    place.symlink_to(bench / SCENE / "truth" / "colour" / "edited")
    with pytest.raises(InputError, match="leads out of"):
        score.score(bench, tmp_path / "in", tmp_path / "out")


def test_an_export_goes_on_where_it_was_and_mends_what_is_lost_or_replaced(bench, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(bench, copy)
    (copy / suite.FILE).unlink()
    kept = (copy / SCENE / "splats.ply").stat().st_mtime_ns
    asked = {"count": 1, "seed": 9, "size": SIZE, "spp": SPP, "targets": 2}
    assert suite.export(copy, **asked) == suite.Suite.read(bench)
    assert (copy / SCENE / "splats.ply").stat().st_mtime_ns == kept
    with pytest.raises(InputError, match="other settings"):
        suite.export(copy, **asked | {"seed": 10})
    with alone_in(copy), pytest.raises(InputError, match="another run writes to this folder"):
        suite.export(copy, **asked)
    (copy / SCENE / "images" / "source.png").unlink()
    shutil.copy(bench / SCENE / "images" / "source.png", copy / SCENE / "images" / "yaw010.png")
    with pytest.raises(InputError, match=r"source.png: is missing or changed; export"):
        suite.Suite.read(copy)
    suite.export(copy, **asked)
    assert suite.Suite.read(copy) == suite.Suite.read(bench)


def test_the_commands_score_a_folder_and_print_its_page(bench, tmp_path):
    folder = handed_in(tmp_path, {"colour": true_pictures(bench, "colour", ["edited"] * 3)})
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["bench", "score", str(bench), str(folder), "--out", str(out)])
    assert done.exit_code == 0, done.output
    # Every figure's head is whole in a terminal of 80 columns.
    assert not [head for head in result.FIGURES.values() if head not in done.stdout]
    assert str(out / "bench-score.html") in done.stdout.replace("\n", "")
    page = (out / "bench-score.md").read_text()
    missing = "not handed in: drawn-0/some_colour"
    assert f"Scores of {folder.name}" in page and missing in page and missing in done.stderr
    # One row of pictures before the edit, one as handed in.
    shown = [out / name for name in re.findall(r"\]\((pictures/.*?)\)", page)]
    images = [bench / SCENE / "images", folder / SCENE / "colour"]
    files = [f / f"{view}.png" for f in images for view in ("source", "yaw010", "yaw030")]
    assert [path.read_bytes() for path in shown] == [path.read_bytes() for path in files]
    call = ["bench", "score", str(bench), str(tmp_path / "none"), "--out", str(out)]
    nothing = CliRunner().invoke(app, call)
    assert nothing.exit_code == 2 and f"bench run {bench} {tmp_path / 'none'}" in nothing.stderr


def true_warps(bench):
    """The shipped truth by view: float32 places in the source, and what it certainly shows."""
    truth = bench / SCENE / "truth"
    return {
        view: {
            "points": np.load(truth / "source_pixel" / f"{view}.npy"),
            "visible": read_image(truth / "visible" / f"{view}.png")[..., 0] == 255,
        }
        for view in ("yaw010", "yaw030")
    }


def scored_warps(bench, tmp_path, answers):
    folder = tmp_path / "warps" / SCENE
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for view, arrays in answers.items():
        np.savez(folder / f"{view}.npz", **arrays)
    (one,) = score.score(bench, tmp_path / "warps", tmp_path / "out").scores
    return one


def test_true_warps_have_no_error_and_planted_ones_have_theirs(bench, tmp_path):
    true = true_warps(bench)
    one = scored_warps(bench, tmp_path, true)
    figures = one.figures
    assert one.remarks == []
    assert figures["warp.epe_p95"] < 1e-5  # places are stored in float32
    assert figures["occlusion.recall"] == figures["warp.coverage"] == 1
    assert figures["occlusion.hidden_share"] == figures["wrong"] == 0
    moved = {v: a | {"points": a["points"] + np.float32([0, 2])} for v, a in true.items()}
    figures = scored_warps(bench, tmp_path, moved).figures
    np.testing.assert_allclose([figures["warp.epe_median"], figures["warp.epe_p95"]], 2, rtol=1e-5)
    assert figures["wrong"] == 1 and figures["warp.below_1px"] == 0
    # A matcher of few points, each of them right: by default it keeps what it answers.
    few = np.zeros((SIZE, SIZE, 1), bool)
    few[::5, ::7] = True
    kept = {
        v: {"points": np.where(few & a["visible"][..., None], a["points"], np.nan)}
        for v, a in true.items()
    }
    figures = scored_warps(bench, tmp_path, kept).figures
    counts = [(int((few[..., 0] & a["visible"]).sum()), a["visible"].sum()) for a in true.values()]
    recall, wrong = np.mean([(k / n, 1 - 2 * k / (k + n)) for k, n in counts], axis=0)
    assert figures["warp.epe_p95"] < 1e-5 and figures["occlusion.precision"] == 1
    assert figures["occlusion.recall"] == figures["warp.coverage"] == pytest.approx(recall)
    assert figures["wrong"] == pytest.approx(wrong)
    marked = {v: {"points": np.nan_to_num(a["points"], nan=-1)} for v, a in kept.items()}
    assert scored_warps(bench, tmp_path, marked).figures["wrong"] == figures["wrong"]


def test_figures_of_few_pixels_follow_by_hand():
    label = np.array([[VISIBLE, VISIBLE, HIDDEN, AMBIGUOUS]])
    ones, xy = np.ones((1, 4), bool), np.zeros((1, 4, 2))
    truth = TwoView(None, None, Hits(*[None] * 6, ones), xy, ones, ones, label, ones)
    points = np.array([[[0.6, 0.0], [0.0, 3.0], [0.0, 0.0], [0.0, 0.0]]])
    figures = warps.figures(points, ones, truth)
    assert figures["wrong"] == 1 - 2 * 1 / (3 + 2)  # one right, three accepted, two visible
    assert figures["warp.epe_mean"] == (0.6 + 3) / 2 and figures["occlusion.recall"] == 1
    assert figures["occlusion.hidden_share"] == 1 / 3
    nowhere = warps.figures(np.full_like(points, np.nan), ones, truth)
    assert nowhere["warp.coverage"] == nowhere["occlusion.recall"] == 0 and nowhere["wrong"] == 1


def test_depth_leads_to_true_places_and_a_missing_view_has_no_answer(bench, tmp_path):
    views = ("source", "yaw010", "yaw030")
    depth = {v: {"depth": np.load(bench / SCENE / "depth" / f"{v}.npy")} for v in views}
    true = true_warps(bench)
    whole = scored_warps(bench, tmp_path, depth)
    assert whole.remarks == [] and whole.figures["warp.epe_p95"] < 1e-3
    # Depth is not read across edges.
    assert whole.figures["occlusion.recall"] > 0.6
    assert whole.figures["occlusion.hidden_share"] < 0.01
    del depth["yaw030"]
    some = scored_warps(bench, tmp_path, depth)
    assert some.remarks == ["missing: yaw030"]
    assert some.by_view["yaw010"] == whole.by_view["yaw010"]
    assert some.by_view["yaw030"]["occlusion.visible_rejected"] == true["yaw030"]["visible"].sum()
    assert some.by_view["yaw030"]["wrong"] == 1
    del depth["source"]
    known = {"yaw010": depth["yaw010"] | {"visible": true["yaw010"]["visible"]}}
    assert scored_warps(bench, tmp_path, known).by_view["yaw010"]["wrong"] == 0
    with pytest.raises(InputError, match="source.npz: has no depth, which tells"):
        scored_warps(bench, tmp_path, depth)


def test_warps_without_merit_and_slips_of_convention_are_named(bench, tmp_path):
    true = true_warps(bench)
    own = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), -1)

    def turned(a):
        """Places in the view, by the pixel of the source."""
        column, row = a["points"][a["visible"]].astype(int).T
        points = np.full_like(own, np.nan)
        points[row, column] = own[a["visible"]]
        return points

    everywhere, nowhere = np.ones((SIZE, SIZE), bool), np.zeros((SIZE, SIZE), bool)
    cases = {
        "everything is kept": lambda a: a | {"visible": everywhere},
        "nothing is kept": lambda a: a | {"visible": nowhere},
        "every pixel lies at its own place": lambda a: {"points": own},
        "are x and y swapped": lambda a: a | {"points": a["points"][..., ::-1]},
        "do pixel centres lie at integers": lambda a: a | {"points": a["points"] - 0.5},
        "is 0.5 added twice": lambda a: a | {"points": a["points"] + 0.5},
        "are they displacements": lambda a: a | {"points": a["points"] - own},
        "do they lead from the source": lambda a: {"points": turned(a)},
    }
    for said, spoil in cases.items():
        one = scored_warps(bench, tmp_path, {view: spoil(a) for view, a in true.items()})
        assert any(remark.startswith(said) for remark in one.remarks), said
        # A slip of 0.7 px is within the bound of 1 px, and tells in the end-point error alone.
        assert one.figures["wrong"] > 0.1 or "0.5" in one.remarks[0]


def test_arrays_of_another_size_type_or_unit_are_refused_by_name(bench, tmp_path):
    points = true_warps(bench)["yaw010"]["points"]
    for arrays, message in (
        ({"points": points[:24, :24]}, r"points: is float32 \(24, 24, 2\), expected float"),
        ({"points": points, "visible": points[..., 0]}, "visible: is float32 .* expected bool"),
        ({"points": points / SIZE}, "points: lie within 1; give pixels"),
        ({"depth": points}, "depth: is float32"),
        ({"visible": points[..., 0] > 9}, "has neither points nor depth"),
        ({"points": points, "mask": points[..., 0] > 9}, "mask: is unknown, expected points"),
        ({"points": np.array([None])}, "is no .npz of arrays"),
    ):
        with pytest.raises(InputError, match=f"yaw010.npz: {message}"):
            scored_warps(bench, tmp_path, {"yaw010": arrays})


def test_our_warps_through_the_door_have_a_studys_figures(bench, tmp_path):
    path = bench / SCENE / "truth" / "scene.yaml"
    study = {
        "name": "warps", "size": SIZE, "scenes": [str(path)], "spp": SPP, "splats": suite.SPLATS,
        "views": ["yaw010", "yaw030"], "variants": {"one": {"preset": "tolerant"}},
        "probes": {"warp": ["one"]},
    }  # fmt: skip
    (tmp_path / "warps.yaml").write_text(yaml.safe_dump(study))
    loaded = load_study(str(tmp_path / "warps.yaml"))
    scenes = {name: load_scene(name) for name in loaded.scenes}
    cell = next(c for c in cells_of(loaded, scenes) if c.probe == "warp")
    record = compute(probe("warp"), cell, tmp_path)
    made, out = tmp_path / "made", tmp_path / "out"
    run = ["run", str(bench), str(made), "--method", "warp", "--set", "preset=tolerant"]
    stop = made / SCENE / "yaw030.npz"
    stop.mkdir(parents=True)
    assert CliRunner().invoke(app, ["bench", *run]).exit_code == 2
    assert result.Method.read(made / "method.json").seconds > 0  # of the view that it finished
    stop.rmdir()
    for call in (
        run,
        ["score", str(bench), str(made), "--out", str(out)],
        ["table", str(out / "bench-score.json"), "--out", str(out)],
    ):
        done = CliRunner().invoke(app, ["bench", *call])
        assert done.exit_code == 0, done.output
    from_ply = result.Result.read(out / "bench-score.json")
    assert from_ply.method.track == result.WARPS and from_ply.method.seconds > 0
    assert "| warp, tolerant | 1 |" in (out / "bench.md").read_text()
    of, splats = world(str(path), SIZE), sampled(str(path), SIZE, 0, **suite.SPLATS)
    views = {
        v: warp_view(splats, of.source, of.targets[v], PRESETS["tolerant"]) for v in of.targets
    }
    answers = {v: {"points": w.correspondence.xy, "visible": w.mask} for v, w in views.items()}
    one = scored_warps(bench, tmp_path, answers)
    for view in record.views:
        for name in one.by_view[view.name].keys() - {"yaw", "wrong"}:
            np.testing.assert_equal(one.by_view[view.name][name], view.metrics[name])
            # A PLY has splats in float32.
            value = from_ply.scores[0].by_view[view.name][name]
            np.testing.assert_allclose(value, view.metrics[name], rtol=1e-3, atol=1e-6)


MADE_UP = """
import hashlib
def my_editor(picture, words):
    values = np.array(picture).astype(float)
    hue = np.array([hash_of(values.tobytes(), words, k) for k in range(3)])
    return Image.fromarray((0.75 * values + 0.25 * hue).astype(np.uint8))
def hash_of(*parts):
    return hashlib.sha256(repr(parts).encode()).digest()[0]
def alone(scene, out, view, picture, edit):
    return my_editor(picture, edit["instruction"])
edit_all("bench", "alone", alone)
def my_matcher(source, view):
    return [((x + 0.5, y + 0.25), (x + 0.75, y + 0.5)) for y in range(48) for x in range(0, 48, 5)]
"""
"""A method whose tint follows from the picture: views alone get different ones."""


def test_the_page_hands_in_pictures_with_numpy_and_pillow_alone(bench, tmp_path):
    """The page's way from an export to two scored folders, in a process of nothing else."""
    packages = ["attnwarp", "attnwarp_eval", "cv2", "scipy", "skimage", "torch"]
    before = f"import sys\nsys.modules |= dict.fromkeys({packages})\n"
    page = (Path(__file__).parents[3] / "docs" / "measuring" / "bench.md").read_text()
    loop, carry, warp = re.findall(r"```python\n(.*?)```", page, re.S)
    (tmp_path / "bench").symlink_to(bench)
    script = before + loop + "import numpy as np\n" + MADE_UP + carry + warp
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, timeout=120)
    by_name = {}
    for name in ("alone", "edited"):
        made = score.score(bench, tmp_path / name, tmp_path / f"out-{name}").scores
        assert [one.edit for one in made] == list(suite.EDITS)
        by_name[name] = made
    (warped,) = score.score(bench, tmp_path / "warps", tmp_path / "out-warps").scores
    assert warped.remarks == [] and 0.1 < warped.figures["warp.coverage"] < 0.3
    points = np.load(tmp_path / "warps" / SCENE / "yaw010.npz")["points"]
    assert points[7, 10].tolist() == [10.25, 7.25]  # a quarter of a pixel off its own place
    for alone, carried in zip(*by_name.values(), strict=True):
        assert carried.remarks == []
        # One tint of the source's for all that it sees, in place of a tint for each view.
        assert carried.figures["agreement"] < alone.figures["agreement"] - 3
    files = [tmp_path / f"out-{name}" / "bench-score.json" for name in by_name]
    report = result.compare([result.Result.read(path) for path in files])
    assert [section.title for section in report.sections[:2]] == [
        f"Own editor: {edit}" for edit in suite.EDITS
    ]
