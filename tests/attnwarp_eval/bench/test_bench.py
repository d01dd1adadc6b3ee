"""Oracles: the same pictures in a study, true pictures and pictures spoiled on purpose, COLMAP's own reader."""

import json
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from attnwarp.errors import InputError
from attnwarp.io import read_dataset, read_image
from attnwarp_eval.bench import result, score, suite
from attnwarp_eval.cli.main import app
from attnwarp_eval.files import write_picture
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, EditedScene, Method
from attnwarp_eval.study.work import compute

SIZE, SPP, SCENE = 48, 2, "drawn-0"
ANSWERS = ("red", "blue")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    suite.export(folder, count=1, seed=9, size=SIZE, spp=SPP, targets=2)
    return folder


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
    (one,) = score.score(bench, folder, tmp_path / "out")
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


def test_true_pictures_of_one_answer_have_no_error(bench, tmp_path):
    for edit, answer in (("some_colour", "blue"), ("colour", "edited")):
        one = scored(bench, tmp_path, true_pictures(bench, edit, [answer] * 3), edit)
        assert one.remarks == [] and one.figures["done"] == 1
        # Both sides are rounded to 8 bits.
        assert one.figures["error"] == 0 and one.figures["outside"] < 1
        assert one.figures["amount"] > score.LITTLE


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


@pytest.mark.parametrize("track", result.ORDER)
def test_cheaters_are_named_or_ranked_behind_the_truth(bench, tmp_path, track):
    true, cheats = spoiled(bench)
    figure = result.ORDER[track]
    best = scored(bench, tmp_path, true, track=track)
    assert best.remarks == []
    for content, pictures in cheats.items():
        one = scored(bench, tmp_path, pictures, track=track)
        said = content.partition(":")[0]
        named = any(said in remark for remark in one.remarks)
        assert named != (content in ("one tint", "two answers")), content
        behind = one.figures[figure] > best.figures[figure] + 0.5
        # Agreement of pictures without merit is undefined.
        without = track == result.OWN and one.remarks and "swapped" not in content
        assert math.isnan(one.figures[figure]) if without else behind, content


def test_answers_of_an_own_editor_count_where_the_instruction_names_one(bench, tmp_path):
    for edit, answer, one_right in (("colour", "edited", True), ("some_colour", "blue", False)):
        true = true_pictures(bench, edit, [answer] * 3)
        figures = scored(bench, tmp_path, true, edit, track=result.OWN).figures
        for name in ("error", "done"):
            assert math.isnan(figures[name]) != one_right
        assert figures["apart"] == figures["agreement"] + figures["outside"]


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


def test_an_export_goes_on_where_it_was_and_keeps_other_settings_out(bench, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(bench, copy)
    (copy / suite.FILE).unlink()
    kept = (copy / SCENE / "splats.ply").stat().st_mtime_ns
    again = suite.export(copy, count=1, seed=9, size=SIZE, spp=SPP, targets=2)
    assert again == suite.Suite.read(bench)
    assert (copy / SCENE / "splats.ply").stat().st_mtime_ns == kept
    with pytest.raises(InputError, match="other settings"):
        suite.export(copy, count=1, seed=10, size=SIZE, spp=SPP, targets=2)


def test_the_commands_score_a_folder_and_print_its_page(bench, tmp_path):
    folder = handed_in(tmp_path, {"colour": true_pictures(bench, "colour", ["edited"] * 3)})
    (folder / "method.json").write_text(json.dumps({"name": "truth"}))
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["bench", "score", str(bench), str(folder), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert str(out / "bench-score.html") in done.stdout.replace("\n", "")
    page = (out / "bench-score.md").read_text()
    assert "Scores of truth" in page and "not handed in: drawn-0/some_colour" in page


def test_the_documented_loop_hands_in_pictures_without_this_package(bench, tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "measuring" / "bench.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", page, re.S)
    (tmp_path / "bench").symlink_to(bench)
    without = "import sys\nsys.modules |= dict.fromkeys(['attnwarp', 'attnwarp_eval', 'torch'])\n"
    editor = "def my_editor(picture, words):\n    return picture.point(lambda value: 255 - value)\n"
    script = without + editor + block
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, timeout=120)
    scores = score.score(bench, tmp_path / "edited", tmp_path / "out")
    assert [one.edit for one in scores] == list(suite.EDITS)
    original = read_image(bench / SCENE / "images" / "source.png")
    edited = read_image(tmp_path / "edited" / SCENE / "colour" / "source.png")
    assert np.array_equal(edited, 255 - original)
