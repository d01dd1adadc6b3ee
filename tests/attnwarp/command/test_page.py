"""The page of an edit. Oracles: files of the run's folder, closed forms, and methods of the library."""

import re
import shutil
from base64 import b64decode
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from attnwarp import Camera
from attnwarp.command import page as pages
from attnwarp.command.page.measured import disagreement
from attnwarp.command.page.turntable import check_film, focus_of, orbit, write_film
from attnwarp.errors import InputError
from attnwarp.fit import Views
from attnwarp.io import read_image, read_splat
from attnwarp.io.names import file_stems
from attnwarp.methods import METHODS, attention_warping, by_view, preset
from attnwarp.methods.base import workdir_of
from attnwarp.trial import disc

QUICK = {"steps": 2, "iterations": 1}


class Page(HTMLParser):
    """Pictures of a page by what they say they show, and its other links."""

    def __init__(self, text):
        super().__init__()
        self.pictures, self.other = {}, []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        if tag == "img" and "src" in values:
            data = np.frombuffer(b64decode(values["src"].split(";base64,")[1]), np.uint8)
            self.pictures[values["alt"]] = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
        elif "src" in values or "href" in values:
            self.other.append(values)


@pytest.fixture(scope="module")
def edits(scene, editor, tmp_path_factory):
    """Folder of an edit by each kind of method, with its page."""

    def made(method, images=scene[2], segments=None, **changes):
        folder = tmp_path_factory.mktemp(method)
        model, cameras, pictures = scene
        settings = preset(method, **{**QUICK, **changes})
        METHODS[method](
            model, cameras, pictures, editor, "red", settings, folder=folder, segments=segments
        )
        path = pages.show_edit(workdir_of(folder), model, Views(cameras, images), editor=editor)
        return folder, path.read_text()

    return made


@pytest.fixture(scope="module")
def warped(edits, scene):
    # Photographs that are no renders, to tell the two apart.
    return edits("attention_warping", [1 - picture for picture in scene[2]], stages=1)


def test_one_page_serves_every_method_and_needs_no_other_file(edits, warped):
    _, by_view_page = edits("by_view")
    for text in (by_view_page, warped[1]):
        assert Page(text).other == [] and not re.search(r"(src|href)=.?(https?:|//)", text)
        assert "Do the views agree?" in text and 'id="splats"' in text


def test_its_pictures_are_those_of_the_folder(warped, scene):
    folder, text = warped
    pictures = Page(text).pictures
    shown = {name.split(",")[0] for name in pictures if name.endswith(", edited")}
    assert shown == set(file_stems(scene[1]))
    of_folder = {
        "edited": "views", "edited alone": "control", "scene before": "renders/before",
        "edited scene": "renders/after", "where features came from": "masks",
    }  # fmt: skip
    found = 0
    for what, part in of_folder.items():
        for path in (folder / part).glob("*.png"):
            assert np.array_equal(read_image(path), pictures[f"{path.stem}, {what}"])
            found += 1
    assert found == 5 * 4 + 4  # the source has no mask
    negative = np.rint(255 * (1 - scene[2][0]))
    assert np.array_equal(pictures["v0, photograph"], negative)


def test_views_are_told_by_their_degrees_from_the_source(warped, scene):
    """Oracle: the axes of level cameras that meet in one point, three steps behind the discs."""
    for k, camera in enumerate(scene[1][1:], 1):
        angle = np.degrees(np.arccos(camera.forward @ scene[1][0].forward))
        assert f"v{k}, {angle:.0f}°" in warped[1]
    assert "v0 (source)" in warped[1]


def test_a_mask_is_lit_on_the_photograph(edits, scene):
    marked = np.zeros(scene[2][0].shape[:2], bool)
    marked[10:20, 5:30] = True
    _, text = edits("by_view", segments=[marked] * len(scene[1]))
    lit = np.where(marked[..., None], 255, 51) * scene[2][0]
    assert np.abs(Page(text).pictures["mask of v0"] - lit).max() <= 0.5


def test_the_splats_on_the_page_are_the_edited_ones(warped, tmp_path):
    folder, text = warped
    data = b64decode(re.search(r'id="splat-bytes">(.*?)<', text)[1])
    (tmp_path / "page.splat").write_bytes(data)
    on_page = read_splat(tmp_path / "page.splat")
    edited = pages.read_ply(folder / "edited.ply")
    ours = edited.means[torch.argsort(edited.means[:, 0])]
    theirs = on_page.means[torch.argsort(on_page.means[:, 0])]
    assert torch.allclose(ours, theirs)


def test_of_too_many_splats_those_that_cover_most_are_on_the_page(warped, scene, monkeypatch):
    folder, _ = warped
    monkeypatch.setattr(pages, "MOST_SPLATS", 7)
    text = pages.show_edit(workdir_of(folder), scene[0], Views(*scene[1:])).read_text()
    assert "7 of 60 splats" in text
    data = b64decode(re.search(r'id="splat-bytes">(.*?)<', text)[1])
    assert len(data) == 7 * 32


def test_a_view_edited_alone_is_the_one_of_the_method_that_edits_every_view_alone(
    warped, scene, editor
):
    folder, _ = warped
    model, cameras, images = scene
    inverted = [1 - image for image in images]
    settings = preset("by_view", **{**QUICK, "iterations": 0, "batch": 1}, noise="shared")
    result = by_view(model, cameras, inverted, editor, "red", settings)
    for view, picture in list(result.edited.items())[1:]:  # the source's is the edit's own
        alone = read_image(folder / "control" / f"v{view}.png").astype(int)
        # Views that share a pass differ in the last bits from views one by one.
        assert np.abs(alone - picture).max() <= 1


def test_the_control_has_the_noise_of_the_surface_where_the_edit_has_it(edits, scene, editor):
    chosen = {**QUICK, "stages": 1, "noise": "surface"}
    folder, _ = edits("attention_warping", **chosen)
    model, cameras, images = scene
    settings = preset("attention_warping", **{**chosen, "iterations": 1}, a0=0.0)
    result = attention_warping(model, cameras, images, editor, "red", settings)
    for view, picture in result.edited.items():
        alone = read_image(folder / "control" / f"v{view}.png").astype(int)
        assert np.abs(alone - picture).max() <= 1


RELEASED = preset("attention_warping", "released", stages=2, views_per_stage=2, a0=0.0).to_dict()


@pytest.mark.parametrize(
    ("method", "changes", "edits_alone"),
    [
        ("attention_warping", {**RELEASED, **QUICK}, "views"),
        ("fused", {"grid": "scheduler", "perceptual": 0.0}, "rounds/1"),
    ],
)
def test_the_control_of_an_edit_that_carries_nothing_is_the_edit(
    method, changes, edits_alone, edits, scene
):
    """Guidance, noise, start, grid and splats of each stage are those of the edit."""
    folder, _ = edits(method, **changes)
    for name in file_stems(scene[1]):
        alone = read_image(folder / "control" / f"{name}.png").astype(int)
        # A round's splats come from a PLY, which keeps logarithms of what the edit was made with.
        assert np.abs(alone - read_image(folder / edits_alone / f"{name}.png")).max() <= 4


@pytest.mark.parametrize("agree", [True, False])
def test_the_page_says_so_where_views_edited_alone_agree_as_well(warped, scene, tmp_path, agree):
    folder = shutil.copytree(warped[0], tmp_path / "edit")
    noise = np.random.default_rng(0)
    for path in (folder / "control").glob("*.png"):
        shape = read_image(path).shape
        flat, noisy = np.full(shape, 90, np.uint8), noise.integers(0, 256, shape, np.uint8)
        Image.fromarray(flat if agree else noisy).save(path)
    text = pages.show_edit(workdir_of(folder), scene[0], Views(*scene[1:])).read_text()
    assert "each edited alone" in text
    assert ("the views agree as well" in text) == agree


@pytest.mark.parametrize("method", ["by_view", "igs2gs"])
def test_a_method_that_edits_views_alone_or_from_renders_has_no_control(method, edits):
    folder, text = edits(method, steps=1)
    assert not (folder / "control").exists() and "edited alone" not in text


def test_views_disagree_by_the_difference_of_shifted_pictures():
    """Two cameras before a wall, 4 px apart: the closed form is a shift."""
    wall = disc(50.0)
    K = np.array([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]])
    cameras = {}
    for k in (0, 1):
        pose = np.eye(4)
        pose[:3, 3] = [0.5 * k, 0, 4]  # 4 = 32 / 4 * 0.5 px
        cameras[k] = Camera(K, pose, 32, 32)
    random = np.random.default_rng(0)
    pictures = {k: random.integers(0, 256, (32, 32, 3), dtype=np.uint8) for k in cameras}
    # The second camera's frame is moved to the left: its pixel x shows what the first has at x - 4.
    one, two = pictures[0].astype(float), pictures[1].astype(float)
    expected = np.abs(one[:, :28] - two[:, 4:]).mean() / 255
    same = {0: pictures[0], 1: np.roll(pictures[0], 4, axis=1)}
    values = disagreement(wall, cameras, {"random": pictures, "same": same})
    assert values["random"] == pytest.approx(expected, abs=2e-3)
    assert values["same"] == pytest.approx(0, abs=1e-6)
    half = np.zeros((32, 32), bool)
    half[:, 8:16] = True
    within = disagreement(wall, cameras, {"random": pictures}, {0: half, 1: half})["random"]
    both = np.abs(one[:, 4:12] - two[:, 8:16]).mean() + np.abs(one[:, 8:16] - two[:, 12:20]).mean()
    assert within == pytest.approx(both / 2 / 255, abs=1e-6)


def ring(degrees, height=1.0):
    return [
        Camera.look_at(
            (3 * np.cos(a), 3 * np.sin(a), height), (0, 0, 0), width=40, height=30, fov_y=50
        )
        for a in np.radians(degrees)
    ]


def test_an_orbit_goes_all_around_where_the_cameras_do_and_to_and_fro_elsewhere():
    points = np.zeros((1, 3))
    for degrees, expected in ((range(0, 360, 30), 180), (range(-40, 41, 20), 40)):
        turn = orbit(ring(degrees), points, first=0)
        places = np.stack([camera.position for camera in turn])
        assert np.allclose(np.linalg.norm(places[:, :2], axis=1), 3, atol=0.03)
        assert np.allclose(places[:, 2], 1, atol=0.03)
        angles = np.degrees(np.arctan2(places[:, 1], places[:, 0]))
        assert np.abs(angles).max() == pytest.approx(expected, abs=10)
        # Each step is small, the last one too.
        steps = np.linalg.norm(np.diff(places, axis=0, append=places[:1]), axis=1)
        assert steps.max() < 0.6
        for camera in turn:
            assert np.allclose(camera.project([0.0, 0, 0])[0], (20, 15))


def test_parallel_cameras_turn_about_what_they_see():
    pose = np.eye(4)
    K = np.array([[20.0, 0, 10], [0, 20, 10], [0, 0, 1]])
    cameras = []
    for x in (-1, 0, 1):
        pose[0, 3] = x
        cameras.append(Camera(K, pose, 20, 20))
    points = np.array([[0.0, 0, 5], [0.1, 0, 5], [0, 0, -70]])
    assert np.allclose(focus_of(cameras, points), (0, 0, 5))


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_has_both_scenes_side_by_side(tmp_path, suffix):
    before = [np.full((32, 48, 3), (200, 30, 30), np.uint8)] * 5
    after = [np.full((32, 48, 3), (30, 30, 30 + 40 * k), np.uint8) for k in range(5)]
    path = tmp_path / "new" / f"turn{suffix}"
    write_film(path, before, after)
    if suffix == ".gif":
        with Image.open(path) as film:
            frames = []
            for k in range(film.n_frames):
                film.seek(k)
                frames.append(np.asarray(film.convert("RGB")))
    else:
        capture, frames = cv2.VideoCapture(str(path)), []
        while (read := capture.read())[0]:
            frames.append(read[1][..., ::-1])
    assert len(frames) == 5
    for k, frame in enumerate(frames):
        assert frame.shape == (32, 96, 3)
        assert np.abs(frame[16, 24].astype(int) - before[0][0, 0]).max() < 20
        assert np.abs(frame[16, 72].astype(int) - after[k][0, 0]).max() < 20


def test_a_film_of_another_format_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r"--turntable: got .*turn.avi, expected .*\.gif or \.mp4"):
        check_film(tmp_path / "turn.avi")
