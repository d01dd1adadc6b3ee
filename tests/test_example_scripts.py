"""The scripts of examples/ run as they stand. Oracles: closed forms, scikit-image, the names of views."""

import contextlib
import io
import re
import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import small_capture
from skimage.metrics import mean_squared_error

from attnwarp.io import read_dataset, read_ply

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name, *arguments, folder):
    said, path = io.StringIO(), EXAMPLES / f"{name}.py"
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.chdir(folder)
        patch.setattr(sys, "argv", [str(path), *arguments])
        runpy.run_path(str(path), run_name="__main__")
    return said.getvalue()


def test_every_example_is_tested():
    tested = re.findall(r'^    (?:\w+ = )?.*run\(\s*"(\w+)"', Path(__file__).read_text(), re.M)
    assert sorted(tested) == sorted(path.stem for path in EXAMPLES.glob("*.py"))


def test_a_warp_by_own_depth_shows_what_the_left_view_sees(tmp_path):
    said = run("warp_own_depth", folder=tmp_path)
    x = (np.arange(256) + 0.5 - 128) / 200
    post = np.abs(0.5 + 2 * x) < 0.2
    point = np.where(post, 0.5 + 2 * x, 0.5 + 4 * x)
    column = 200 * point / np.where(post, 2, 4) + 128
    hidden = ~post & (np.abs(point / 2) < 0.2)  # the left camera's ray meets the post first
    seen = (column >= 0) & (column <= 256) & ~hidden
    share = int(re.search(r"(\d+)%", said)[1])
    assert abs(share - 100 * seen.mean()) <= 3  # pixels at the post's edges are left out
    green_of_post = cv2.imread(str(tmp_path / "warped.png"))[96, post, 1]
    assert np.median(green_of_post) == round(0.2 * 255)


def test_a_study_of_ones_own_is_measured(tmp_path):
    assert "3 cells, 0 failed" in run("own_study", "out", folder=tmp_path)
    assert (tmp_path / "out" / "report.html").is_file()


def test_renders_are_scored_as_scikit_image_does(tmp_path):
    rng, errors = np.random.default_rng(0), []
    for folder in ("renders", "edited"):
        (tmp_path / folder).mkdir()
    for k in range(3):
        pair = rng.integers(0, 256, (2, 16, 20, 3), dtype=np.uint8)
        for folder, picture in zip(("renders", "edited"), pair, strict=True):
            cv2.imwrite(str(tmp_path / folder / f"{k}.png"), picture)
        errors.append(mean_squared_error(*(pair / 255)))
    said = run("score_pictures", "renders", "edited", folder=tmp_path)
    assert f"3 views: {-10 * np.log10(np.mean(errors)):.2f} dB" in said


@pytest.mark.slow
def test_a_capture_is_edited(tmp_path):
    small_capture.write(tmp_path)
    said = run("edit_a_scene", "my_capture", "make it red", "edited.ply", folder=tmp_path)
    assert f"{len(read_dataset(tmp_path / 'my_capture').cameras)} edited views" in said
    assert read_ply(tmp_path / "edited.ply").kind == "2d"


@pytest.mark.slow
def test_a_changed_algorithm_edits_near_views_first(tmp_path):
    small_capture.write(tmp_path)
    said = run("own_method", "my_capture", "make it red", folder=tmp_path)
    first, second = (eval(part) for part in re.findall(r"\([^)]*\)", said))
    places = [c.position for c in read_dataset(tmp_path / "my_capture").cameras]
    far = [np.linalg.norm(place - places[0]) for place in places]
    assert sorted((*first, *second)) == list(range(len(places)))
    assert max(far[k] for k in first) <= min(far[k] for k in second) + 1e-9
