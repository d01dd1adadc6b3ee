"""Photographs without poses become a capture: its cameras against those that took the pictures, up
to the turn, shift and scale that no picture tells.
"""

import cv2
import numpy as np
import pytest
import textured_corner
from PIL import Image
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from attnwarp.cli.main import app
from attnwarp.io import read_dataset

CAMERAS = textured_corner.cameras()


def poses(*words):
    return CliRunner().invoke(app, ["poses", *map(str, words)])


def save(folder, pictures):
    folder.mkdir()
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"IMG_{k}.jpg"), np.rint(255 * picture))


@pytest.fixture(scope="module")
def corner():
    return [textured_corner.picture(0, camera) for camera in CAMERAS]


def test_photographs_become_a_capture_and_one_of_another_place_is_named(corner, tmp_path):
    pytest.importorskip("pycolmap")
    save(tmp_path / "photographs", [*corner, textured_corner.picture(1, CAMERAS[0])])
    # What macOS and Windows put beside them.
    for name in ("._IMG_0.jpg", ".DS_Store", "Thumbs.db"):
        (tmp_path / "photographs" / name).write_bytes(bytes.fromhex("0005160700020000"))
    done = poses(tmp_path / "photographs", "--out", tmp_path / "capture")
    assert done.exit_code == 0, done.output
    assert "1 of 7 photographs have no pose, and are left out: IMG_6.jpg" in done.stderr
    assert "6 of 7 photographs" in done.stdout
    data = read_dataset(tmp_path / "capture")
    assert [camera.name for camera in data.cameras] == [f"images/IMG_{k}.png" for k in range(6)]
    assert data.points is not None and len(data.points) > 100
    true, found = (np.array([c.position for c in cameras]) for cameras in (CAMERAS, data.cameras))
    true, found = true - true.mean(0), found - found.mean(0)
    turn, _ = Rotation.align_vectors(true, found)
    moved = turn.apply(found)
    moved *= (true * moved).sum() / (moved * moved).sum()
    # Circle of radius 0.5, 4 from the corner; features have noise of 0.2 px, of focal length 309.
    np.testing.assert_allclose(moved, true, atol=0.005)
    ratio = data.cameras[0].K[0, 0] / CAMERAS[0].K[0, 0]
    assert ratio == pytest.approx(1, abs=0.01)
    # Matches are kept for the same pictures, and the capture is never overwritten.
    assert (
        "holds a capture" in poses(tmp_path / "photographs", "--out", tmp_path / "capture").stderr
    )


def test_photographs_without_a_common_point_are_refused(tmp_path):
    pytest.importorskip("pycolmap")
    save(tmp_path / "black", [np.zeros((64, 64, 3))] * 3)
    done = poses(tmp_path / "black", "--out", tmp_path / "out")
    assert done.exit_code == 2 and "no 3 of its 3 pictures show enough" in done.stderr


def test_what_cannot_work_is_refused_before_the_work(tmp_path, monkeypatch):
    save(tmp_path / "two", [np.zeros((32, 32, 3))] * 2)
    save(tmp_path / "sizes", [np.zeros((32, 32, 3))] * 2 + [np.zeros((32, 48, 3))])
    save(tmp_path / "three", [np.zeros((32, 32, 3))] * 3)
    (tmp_path / "theirs/colmap").mkdir(parents=True)
    for words, says in (
        (["nowhere"], "nowhere: expected a folder of photographs"),
        (["two"], "two: holds 2 pictures"),
        (["sizes"], "IMG_2.jpg of 48 x 32 px; take those of one camera, or pass --each-camera"),
        (["three", "--out", "three"], "three: is the folder of photographs"),
        (["three", "--out", "theirs"], "colmap: is not of this command"),
    ):
        monkeypatch.chdir(tmp_path)
        done = poses(*words)
        assert done.exit_code == 2 and says in done.stderr, done.stderr
    monkeypatch.setattr("attnwarp.sfm.find_spec", lambda name: None)
    done = poses("three")
    assert done.exit_code == 2 and "needs the package pycolmap" in done.stderr
    assert "pip install" in done.stderr


def test_photographs_on_their_side_are_told(tmp_path, monkeypatch):
    save(tmp_path / "turned", [np.zeros((32, 48, 3))] * 3)
    exif = Image.Exif()
    exif[274] = 6
    Image.new("RGB", (48, 32)).save(tmp_path / "turned/IMG_1.jpg", exif=exif)
    monkeypatch.setattr("attnwarp.sfm.find_spec", lambda name: None)
    said = poses(tmp_path / "turned", "--out", tmp_path / "out").stderr
    assert "1 photographs, IMG_1.jpg first, are turned by an EXIF tag alone" in said
