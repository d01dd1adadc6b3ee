"""`attnwarp-eval metrics --consistency` on a small capture whose edit agrees by construction: the
renders of repainted splats.
"""

import importlib.util
import itertools
import json
import shutil

import cv2
import numpy as np
import pytest
import small_capture
import torch
from few_splats import few_splats
from PIL import Image
from torch_threads import on_one_thread
from typer.testing import CliRunner

from attnwarp.encoders import load_encoder
from attnwarp.io import read_dataset
from attnwarp.render import render
from attnwarp.warp import render_surface, warp_view
from attnwarp_eval import metrics
from attnwarp_eval.cli.main import app
from attnwarp_eval.user_images.measure import read_picture

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)

DEPTH = (
    "consistency.rendered_delta_e",
    "consistency.edit_delta_e",
    "consistency.features",
    "consistency.perceptual",
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    small_capture.write(folder)
    dataset = read_dataset(folder)
    splats = few_splats()
    splats.sh = splats.sh.flip(-1)  # red for blue, the same in all views
    (folder / "renders").mkdir()
    for camera, path in zip(dataset.cameras, dataset.image_paths, strict=True):
        picture = render(splats, camera).color.clamp(0, 1).numpy()
        cv2.imwrite(
            str(folder / "renders" / path.name), np.round(255 * picture[..., ::-1]).astype(np.uint8)
        )
    return folder


def call(*arguments):
    return CliRunner().invoke(app, ["metrics", *map(str, arguments)])


def measured(folder, out, *more):
    done = call("--consistency", folder, "--renders", folder / "renders", "--out", out, *more)
    assert done.exit_code == 0, done.output
    return json.loads((out / "metrics.json").read_text()), done.output


def test_every_figure_is_that_of_its_function(capture, tmp_path):
    result, _ = measured(capture, tmp_path, "--ply", capture / "scene.ply")
    rows = result["metrics"]
    assert all(title.startswith("COLMAP ") for title in result["not_computed"])  # no --colmap
    dataset = read_dataset(capture)
    names = [path.stem for path in dataset.image_paths]
    after = [read_picture(capture / "renders" / path.name) for path in dataset.image_paths]
    before = [read_picture(path) for path in dataset.image_paths]
    pairs = [f"{one} to {two}" for one, two in itertools.pairwise(names)]
    assert all(list(row["views"]) == pairs for row in rows.values())
    flow = metrics.optical_flow(before[0], before[1])
    along = metrics.disagreement_at(after[0], after[1], flow.xy, flow.accepted).delta_e
    assert rows["consistency.flow_delta_e"]["views"][pairs[0]] == pytest.approx(
        np.nanmean(along[::2, ::2]), nan_ok=True
    )
    with torch.no_grad():
        view = warp_view(few_splats(), *dataset.cameras[:2])
    xy, mask = view.correspondence.xy[::2, ::2], view.mask[::2, ::2]
    loss = np.abs(metrics.disagreement_at(after[0], after[1][::2, ::2], xy, mask).srgb)
    assert rows["consistency.rendered_mae_srgb"]["views"][pairs[0]] == pytest.approx(
        np.nanmean(loss), rel=1e-6
    )
    clip = load_encoder("clip-small", "clip").images(after[:2])
    assert rows["embedding.clip_neighbours"]["views"][pairs[0]] == pytest.approx(
        clip[0] @ clip[1] / np.prod(np.linalg.norm(clip, axis=1)), abs=1e-6
    )
    second = slice(None, None, 2)
    edit = metrics.edit_agreement(
        (before[0], before[1][second, second]), (after[0], after[1][second, second]), xy, mask
    )
    assert rows["consistency.edit_delta_e"]["views"][pairs[0]] == pytest.approx(
        edit["consistency.edit_delta_e"], rel=1e-6
    )


def test_depth_from_a_folder_stands_for_rendered_depth(capture, tmp_path):
    dataset = read_dataset(capture)
    folder = tmp_path / "depth"
    folder.mkdir()
    for camera, path in zip(dataset.cameras, dataset.image_paths, strict=True):
        surface = render_surface(few_splats(), camera)
        np.save(folder / f"{path.stem}.npy", surface.depth.numpy())
    off = ("--dino=none", "--clip=none", "--perceptual=none")
    given, _ = measured(capture, tmp_path / "a", "--depth", folder, *off)
    rendered, _ = measured(capture, tmp_path / "b", "--ply", capture / "scene.ply", *off)
    key = "consistency.rendered_mae_srgb"
    own, other = (data["metrics"][key]["value"] for data in (given, rendered))
    assert own == pytest.approx(other, abs=0.01)  # without the test of normals


def test_a_repainted_view_is_seen_and_a_second_call_computes_nothing(capture, tmp_path):
    flawed = tmp_path / "flawed"
    flawed.mkdir()
    for path in sorted((capture / "renders").iterdir()):
        image = cv2.imread(str(path))
        cv2.imwrite(str(flawed / path.name), 255 - image if path.stem == "3" else image)
    right, _ = measured(capture, tmp_path / "a", "--ply", capture / "scene.ply")
    options = ["--consistency", capture, "--renders", flawed, "--ply", capture / "scene.ply"]
    assert call(*options, "--out", tmp_path / "b").exit_code == 0
    wrong = json.loads((tmp_path / "b/metrics.json").read_text())
    for key in DEPTH:
        row, other = (data["metrics"][key]["views"] for data in (right, wrong))
        assert other["2 to 3"] > row["2 to 3"] + 0.01, key
        assert other["0 to 1"] == pytest.approx(row["0 to 1"], abs=1e-6), key
    cells = {path: path.stat().st_mtime_ns for path in (tmp_path / "b").rglob("*.json")}
    assert call(*options, "--out", tmp_path / "b").exit_code == 0
    changed = [path.name for path, time in cells.items() if path.stat().st_mtime_ns != time]
    assert changed == ["metrics.json"]


@pytest.mark.filterwarnings("ignore:.*EXIF")
@pytest.mark.parametrize(
    "tagged", ["images", pytest.param("images renders", marks=pytest.mark.door)]
)
def test_tags_of_posed_pictures_change_no_figure(capture, tmp_path, tagged):
    """Oracle: the same pixels without tags. Posed pictures are taken as stored, and so is a picture
    that has the tag of its pose's.
    """
    tags = Image.Exif()
    tags[0x112] = 3  # half a turn, which no shape gives away
    for name in ("images", "renders"):
        (tmp_path / name).mkdir()
        for path in (capture / name).iterdir():
            exif = tags if name in tagged else None
            Image.open(path).save(tmp_path / name / path.name, exif=exif)
    shutil.copy(capture / "transforms.json", tmp_path)
    options = ("--ply", capture / "scene.ply", "--dino=none", "--clip=none", "--perceptual=none")
    plain, _ = measured(capture, tmp_path / "plain", *options)
    turned, _ = measured(tmp_path, tmp_path / "turned", *options)
    assert plain["metrics"] == turned["metrics"]


def test_what_is_missing_is_named_with_its_figures(capture, tmp_path, monkeypatch):
    done = call("--consistency", capture, "--out", tmp_path)  # edited pictures alone
    assert done.exit_code == 0, done.output
    assert "not computed: Flow warp error: needs --originals and --renders" in done.output
    assert "not computed: Colour at rendered depth: needs --ply" in done.output
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n == "cv2" else find(n))
    _, output = measured(capture, tmp_path / "out", "--perceptual", "none")
    assert "Flow warp error: needs the package cv2" in output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--prompt", "a bear"], "--prompt: figures of single views do not go with --consistency"),
        (["--renders", "nowhere"], "--renders: nowhere is no folder"),
    ],
)
def test_what_does_not_fit_is_refused(capture, tmp_path, options, message):
    done = call("--consistency", capture, *options, "--out", tmp_path)
    assert done.exit_code == 2
    assert message in " ".join(done.output.split())
    done = call("--ply", capture / "scene.ply", "--renders", capture / "renders")
    assert done.exit_code == 2
    assert "--ply: needs --consistency" in " ".join(done.output.split())
