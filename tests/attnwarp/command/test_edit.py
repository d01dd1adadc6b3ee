# ruff: noqa: F811  (fixtures that are imported)
"""The command as a person runs it, on a small random editor in a folder; the oracle is the library and the files."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from dataclasses import replace
from functools import partial
from html import unescape
from pathlib import Path

import cv2
import numpy as np
import PIL.ImageOps
import pytest
import torch
from further import further
from loaded_once import editors_are_loaded_once, segmenter_folders, short_orbit  # noqa: F401
from skimage.color import deltaE_ciede2000, rgb2lab
from tiny_editors import pix2pix
from tiny_scenes import cameras, pictures, splats
from typer.testing import CliRunner

from attnwarp import Camera, Gaussians
from attnwarp.cli.main import app
from attnwarp.command.edit import FitPlan, _masks, mask_files
from attnwarp.command.marks import (
    Marks,
    mask_by_words,
    read_mask,
    read_over_black,
    source_mask,
)
from attnwarp.editing.segment import GroundedSam, cut_out, snap
from attnwarp.errors import InputError
from attnwarp.fit.views import to_float
from attnwarp.io import Dataset, read_image, read_ply, write_ply, write_transforms
from attnwarp.io.images import encode_png
from attnwarp.methods.change import net_change
from attnwarp.methods.scene import near_of
from attnwarp.methods.tuning import Tuning
from attnwarp.render import render
from attnwarp.reporting import SILENT
from attnwarp.warp import lift_masks, piece_around

runner = CliRunner()
QUICK = shlex.split(
    "--steps 1 --iterations 1 --stages 2 --views-per-stage 1 --size 32 --threads 1 --no-control"
)
ONE = ("--stages", 1, "--iterations", 0)
"""For what neither tuning nor a second stage tells."""


LEFT = np.arange(32) < np.full((32, 1), 16)
"""(32, 32) mask of the left half."""


def save_mask(mask, *paths):
    """Write a bool mask as PNG files; the first path."""
    picture = 255 * np.repeat(mask[..., None], 3, axis=2).astype(np.uint8)
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(encode_png(picture))
    return paths[0]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A data set, its splats, and an editor."""
    folder = tmp_path_factory.mktemp("edit")
    model, views = splats(), cameras()
    (folder / "data" / "images").mkdir(parents=True)
    paths = []
    for camera, image in zip(views, pictures(model, views), strict=True):
        paths.append(folder / "data" / "images" / camera.name)
        paths[-1].write_bytes(encode_png(np.rint(255 * image).astype(np.uint8)))
    points = model.world_means()
    write_transforms(
        folder / "data", Dataset(views, paths, points, np.full(points.shape, 99, np.uint8))
    )
    write_ply(folder / "splats.ply", model)
    pix2pix(halvings=2).save_pretrained(folder / "editor")
    save_mask(LEFT & False, *(folder / "black" / camera.name for camera in views))
    (folder / "ones").mkdir()
    for camera in views:
        (folder / "ones" / camera.name).write_bytes(encode_png(np.ones((32, 32, 3), np.uint8)))
    save_mask(np.eye(32, dtype=bool) & (np.arange(32) == 16), folder / "pixel.png")
    (folder / "wide.png").write_bytes(encode_png(np.zeros((32, 48, 3), np.uint8)))
    return folder


def run(place, out, *more, instruction="a bear"):
    given = ("--instruction", instruction, "--editor", place / "editor", "--out", out)
    return runner.invoke(app, list(map(str, ("edit", place / "data", *given, *QUICK, *more))))


def test_it_leaves_an_edited_ply_and_a_page(place, tmp_path):
    result = run(place, tmp_path, "--ply", place / "splats.ply", "--source", "v2.png", "--control")
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[-1] == str(tmp_path / "index.html")
    edited = read_ply(tmp_path / "edited.ply")
    assert len(edited) == 60
    other = read_ply(tmp_path / "edited-3dgs.ply", kind="3d")  # as another program reads it
    assert np.array_equal(other.scales[:, :2], edited.scales)
    assert np.allclose(other.scales[:, 2], 1e-6)
    assert not np.array_equal(edited.sh, read_ply(place / "splats.ply").sh)
    assert not (tmp_path / "fit").exists()
    for said in (result.stderr, (tmp_path / "index.html").read_text()):
        assert " area has no surface (sky or empty)" in " ".join(said.split())


@pytest.mark.parametrize(
    "held_out", ["by the fit", pytest.param("by its split", marks=pytest.mark.door)]
)
def test_a_source_that_the_fit_held_out_is_told_on_the_page_too(place, tmp_path, held_out):
    shutil.copytree(place, tmp_path / "place")
    if held_out == "by the fit":
        (tmp_path / "place" / "held_out").mkdir()
        shutil.copy(place / "data/images/v2.png", tmp_path / "place" / "held_out")
    else:
        scene = json.loads((place / "data" / "transforms.json").read_text())
        named = [frame["file_path"] for frame in scene["frames"]]
        splits = {"test_filenames": named[2:3], "train_filenames": named[:2] + named[3:]}
        (tmp_path / "place/data/transforms.json").write_text(json.dumps({**scene, **splits}))
    for source, told in (("v2.png", True), ("v1.png", False)):
        ply = ("--ply", tmp_path / "place" / "splats.ply")
        result = run(tmp_path / "place", tmp_path / source, *ply, "--source", source, *ONE)
        assert result.exit_code == 0, result.output
        page = (tmp_path / source / "index.html").read_text()
        for said in (" ".join(result.stderr.split()), page):
            assert ("was not fitted to the source v2" in said) == told


def test_a_bundled_editor_says_that_photographs_are_not_its_world(place, tmp_path):
    more = ("--editor", "small-plain", *ONE)
    ply = ("--ply", place / "splats.ply")
    done = run(place, tmp_path, *ply, *more, instruction="make it red")
    assert done.exit_code == 0, done.output
    for said in (" ".join(done.stderr.split()), (tmp_path / "index.html").read_text()):
        assert "small-plain was trained on drawn worlds, so photographs are not its world" in said


def test_the_page_is_written_where_the_name_of_a_view_is_no_utf_8(place, tmp_path):
    shutil.copytree(place, tmp_path / "place")
    data, name = tmp_path / "place" / "data", "f\udcfcr.png"  # Latin-1, as Python hands it on
    try:
        (data / "images" / "v0.png").rename(data / "images" / name)
    except OSError:
        pytest.skip("this file system takes UTF-8 names alone")
    scene = json.loads((data / "transforms.json").read_text())
    for frame in scene["frames"]:
        frame["file_path"] = frame["file_path"].replace("v0.png", name)
    (data / "transforms.json").write_text(json.dumps(scene))
    result = run(tmp_path / "place", tmp_path / "edit", "--ply", place / "splats.ply", *ONE)
    assert result.exit_code == 0, result.output
    assert "f?r" in (tmp_path / "edit" / "index.html").read_text(encoding="utf-8")


def test_without_splats_it_fits_them_first_at_the_size_of_a_fit(place, tmp_path, monkeypatch):
    monkeypatch.setattr("attnwarp.fit.views.SIZES", {"cpu": 24, "cuda": 24})
    monkeypatch.setattr("attnwarp.command.edit.FitPlan", partial(FitPlan, 5))
    result = run(place, tmp_path)
    assert result.exit_code == 0, result.output
    assert "pictures of 32 px are shrunk to 24 (--max-size 32: not)" in result.stderr
    assert read_image(tmp_path / "renders/before/v0.png").shape == (24, 24, 3)
    assert (tmp_path / "fit" / "splats.ply").is_file()
    assert (tmp_path / "edited.ply").is_file()


def test_a_captures_own_masks_are_not_written_over_and_no_fit_comes_first(place, tmp_path):
    """Oracle: the bytes of the masks."""
    masks = shutil.copytree(place / "black", tmp_path / "masks")
    before = {path.name: path.read_bytes() for path in masks.iterdir()}
    result = run(place, tmp_path)
    assert result.exit_code == 2 and "has no manifest.json" in result.output
    assert {path.name: path.read_bytes() for path in masks.iterdir()} == before
    assert list(tmp_path.iterdir()) == [masks]


def test_an_interrupt_while_it_fits_leaves_a_checkpoint(place, tmp_path):
    ended = threading.Event()

    def interrupt():
        while not (tmp_path / "fit").is_dir() and not ended.wait(0.05):
            pass
        # Sent after the command's end, it would stop the tests.
        if not ended.wait(0.3):
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    result = run(place, tmp_path, "--store", "cpu")
    ended.set()
    thread.join()
    assert result.exit_code == 130
    # Far less than the 30 seconds between two checkpoints have passed.
    assert (tmp_path / "fit" / "checkpoint.pt").is_file()
    assert "the same command goes on from it" in result.output


def test_a_captures_masks_and_its_fits_exposures_hold_in_the_edit(place, tmp_path, monkeypatch):
    """Oracles: the masks' files, and pictures taken at half and at full exposure."""
    data = shutil.copytree(place / "data", tmp_path / "data")
    for k, path in enumerate(sorted((data / "images").iterdir())):
        path.write_bytes(encode_png(read_image(path) // (1 + k % 2)))
    save_mask(LEFT, data / "mask.png")
    scene = json.loads((data / "transforms.json").read_text())
    scene["frames"][1]["mask_path"] = "mask.png"
    (data / "transforms.json").write_text(json.dumps(scene))
    fitted = ["--iterations", 30, "--hold-out", 0, "--kind", "2dgs",
              "--set", "exposure=true", "--set", "background=random"]  # fmt: skip
    done = runner.invoke(app, ["fit", str(data), "--out", str(tmp_path / "fit"), *map(str, fitted)])
    assert done.exit_code == 0, done.output
    seen, advance = {}, Tuning.advance

    def watched(tuning, begin, end, views, numbers, *more, **options):
        seen.update(zip(numbers, zip(views.masks, views.exposures, strict=True), strict=True))
        advance(tuning, begin, end, views, numbers, *more, **options)

    monkeypatch.setattr(Tuning, "advance", watched)
    ply = ("--ply", tmp_path / "fit" / "splats.ply")
    result = run(tmp_path, tmp_path / "out", *ply, "--editor", place / "editor")
    assert result.exit_code == 0, result.output
    assert len(seen) > 1
    for view, (mask, change) in seen.items():
        assert np.array_equal(mask, LEFT) if view == 1 else mask is None
        grey = np.full(3, 0.5)
        assert ((grey + change[:, :3] @ grey + change[:, 3]).mean() < 0.5) == (view % 2 == 1)
    only_ignored = ("--ply", place / "splats.ply", "--source", 1, "--box", "20,4,30,28")
    refused = run(tmp_path, tmp_path / "none", *only_ignored, "--editor", place / "editor")
    assert refused.exit_code == 2 and "marks only what the capture's mask" in refused.output


def test_a_mask_and_a_picture_by_hand_are_read_from_files(place, tmp_path):
    masks = tmp_path / "masks"
    save_mask(LEFT, *(masks / camera.name for camera in cameras()))
    hand = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    (tmp_path / "hand.png").write_bytes(encode_png(hand))
    result = run(
        place, tmp_path / "out", "--ply", place / "splats.ply", "--masks", masks, "--source-picture", tmp_path / "hand.png",
        *ONE,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    source = read_image(tmp_path / "out" / "views/v0.png")
    original = read_image(place / "data" / "images" / "v0.png")
    assert np.array_equal(source[:, :16], hand[:, :16])
    assert np.array_equal(source[:, 16:], original[:, 16:])


def test_words_are_asked_of_the_source_alone_and_lifted_as_its_mask_is(
    place, segmenter_folders, tmp_path
):
    """Oracle: SAM and Grounding DINO called directly, and the same edit with ``--mask``."""
    ply = ("--ply", place / "splats.ply")
    segmenter = ("--segmenter", ",".join(map(str, segmenter_folders)))
    result = run(place, tmp_path / "words", *ply, "--where", "bear", *segmenter, *ONE)
    assert result.exit_code == 0, result.output
    (made,) = (tmp_path / "words" / "words").rglob("*.png")
    source = read_image(place / "data" / "images" / "v0.png").astype(np.float32) / 255
    direct = GroundedSam.from_folders(*segmenter_folders)
    assert np.array_equal(read_image(made)[..., 0] > 127, direct.segment(source, "bear"))
    result = run(place, tmp_path / "file", *ply, "--mask", made, *ONE)
    assert result.exit_code == 0, result.output
    assert "--mask marks" in result.stderr and "lifted through the splats" in result.stderr
    for name in ("views/v0.png", "edited.ply", "segments/v1.png"):
        assert (tmp_path / "words" / name).read_bytes() == (tmp_path / "file" / name).read_bytes()


def test_a_mask_of_the_source_is_lifted_into_every_view(place, tmp_path):
    """Oracle: the library's lifting, and the photographs where it marks nothing."""
    out, mask = tmp_path / "out", save_mask(LEFT, tmp_path / "mask.png")
    result = run(place, out, "--ply", place / "splats.ply", "--mask", mask, *ONE)
    assert result.exit_code == 0, result.output
    model, views = read_ply(place / "splats.ply"), cameras()
    lifted = lift_masks(model, views[:1], [LEFT], near=near_of(views, model))
    for k, view in enumerate(views):
        share = read_image(out / "segments" / f"v{k}.png")[..., 0] / 255
        raw = lifted.render(view)
        assert not share[raw < 0.49].any() and (share[raw > 0.76] == 1).all()
    original = read_image(place / "data" / "images" / "v0.png")
    unmarked = read_image(out / "segments" / "v0.png")[..., 0] == 0
    edited = read_image(out / "views" / "v0.png")
    assert np.array_equal(edited[unmarked], original[unmarked])
    assert (edited[~unmarked] != original[~unmarked]).any()


@pytest.mark.parametrize(("option", "value"), [("--box", "4,4,28,28"), ("--at", "8,20")])
def test_a_box_marks_what_opencv_cuts_out_and_a_click_its_surface(place, tmp_path, option, value):
    """Oracle: the cut of the source's picture, or of the piece around the point, given as a file."""
    source = read_image(place / "data" / "images" / "v0.png").astype(np.float32) / 255
    if option == "--box":
        mask = cut_out(source, box=(4, 4, 28, 28))
    else:
        mask = snap(source, piece_around(read_ply(place / "splats.ply"), cameras()[0], (8, 20)))
    file, ply = save_mask(mask, tmp_path / "mask.png"), ("--ply", place / "splats.ply")
    done = run(place, tmp_path / "a", *ply, option, value, *ONE)
    assert done.exit_code == 0
    assert f"{option} {value} of 32 x 32 px marks" in " ".join(done.stderr.split())
    lit = read_image(tmp_path / "a" / "marked.png").astype(float)
    shown = 255 * source * np.where(mask, 1, 0.3)[..., None]
    drawn = (np.abs(lit - shown) > 1).any(-1)  # the box or the cross
    assert 0 < drawn.mean() < 0.5 and drawn[:4].sum() < 60
    assert run(place, tmp_path / "b", *ply, "--mask", file, *ONE).exit_code == 0
    for k in range(len(cameras())):
        one, two = ((tmp_path / f / "segments" / f"v{k}.png").read_bytes() for f in "ab")
        assert one == two


@pytest.mark.parametrize(("rows", "columns", "said"), [
    (slice(20, 32), slice(0, 9), "reaches 2 edges"), (slice(4, 31), slice(1, 30), "covers half"),
    (slice(20, 32), slice(4, 20), ""),
])  # fmt: skip
def test_a_click_that_marks_hardly_one_thing_says_so(tmp_path, rows, columns, said):
    mask = np.zeros((32, 32), bool)
    mask[rows, columns] = True
    marks = Marks(mask=save_mask(mask, tmp_path / "mask.png"))
    image, camera = np.full((32, 32, 3), 0.5), cameras()[0]
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        patch.setattr("attnwarp.command.marks.snap", lambda image, piece: piece)
        for one, piece in ((Marks(at=(8, 25)), mask), (marks, None)):
            source_mask(one, camera, image, tmp_path / "mask.png", (64, 64), tmp_path, "cpu",
                        SILENT, [piece])  # fmt: skip
    texts = [str(one.message) for one in warned]
    assert len(texts) == bool(said)  # of the click alone
    assert all(said in text and "--box" in text and "marked.png" in text for text in texts)


def test_clicks_add_up(tmp_path):
    """Oracle: the squares' own pixels."""
    one, two = (np.zeros((32, 32), bool) for _ in range(2))
    one[4:12, 4:12], two[16:28, 16:28] = True, True
    image = np.where((one | two)[..., None], [0.8, 0.1, 0.1], [0.2, 0.2, 0.2])
    marks = Marks(at=(8, 8, 22, 22))
    mask = source_mask(
        marks, cameras()[0], image, None, (32, 32), tmp_path, "cpu", SILENT, [one, two]
    )
    assert np.array_equal(mask, one | two)


def test_clicks_of_the_command_reach_two_things(place, tmp_path):
    clicks = ["--at", "8,20", "--at", "20,8"]
    done = run(place, tmp_path / "a", "--ply", place / "splats.ply", *clicks, *ONE)
    assert done.exit_code == 0, done.output
    said = " ".join(done.stderr.split())
    assert "--at 8,20 20,8 of 32 x 32 px marks" in said
    assert "if a part is missing, give --at X,Y again" in said


MASKS = {
    "with their folders": ("train/r_0", "test/r_0", "frame.001", "frame.002"),
    "numbered": ("0000-r_0", "0001-r_0", "0002-frame", "0003-frame"),
}
"""Names of masks of the views below."""


def views_of_one_name():
    names = ("./train/r_0", "../test/r_0", "frame.001", "frame.002")
    view = {"width": 32, "height": 32, "fov_y": 40}
    return [Camera.look_at((3, 0, 0), (0, 0, 0), name=name, **view) for name in names]


@pytest.mark.parametrize("how", MASKS)
def test_views_of_one_name_have_masks_of_their_own(how, tmp_path):
    """Oracle: each file has another number of white rows."""
    for k, name in enumerate(MASKS[how]):
        rows = np.zeros((32, 32, 3), np.uint8)
        rows[: k + 1] = 255
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.png").write_bytes(encode_png(rows))
    views = views_of_one_name()
    files = mask_files(tmp_path, views)
    masks = [read_mask(file, view) for file, view in zip(files, views, strict=True)]
    assert [mask.sum() for mask in masks] == [32, 64, 96, 128]


@pytest.mark.door
def test_a_mask_that_could_be_that_of_two_views_is_taken_for_neither(tmp_path):
    for name in ("r_0", "frame"):
        (tmp_path / f"{name}.png").write_bytes(encode_png(np.zeros((32, 32, 3), np.uint8)))
    with pytest.raises(InputError, match=r"--masks: .*0000-r_0\.png is missing; expected one PNG"):
        mask_files(tmp_path, views_of_one_name())


@pytest.mark.door
def test_a_mask_of_another_shape_is_refused_and_one_of_another_size_is_not(tmp_path):
    view = Camera.look_at((3, 0, 0), (0, 0, 0), width=48, height=32, fov_y=40)
    path = tmp_path / "mask.png"
    upper = np.zeros((16, 24, 3), np.uint8)
    upper[:8] = 255
    path.write_bytes(encode_png(upper))
    mask = read_mask(path, view)
    assert mask.shape == (32, 48)
    assert mask[:16].all() and not mask[16:].any()
    path.write_bytes(encode_png(np.zeros((48, 32, 3), np.uint8)))  # turned
    with pytest.raises(ValueError, match=r"--masks: .*mask\.png: got 48 x 32 .* ratio of 32 x 48"):
        read_mask(path, view)


@pytest.mark.parametrize(("of_view", "of_mask"), [(1, 3), (3, 3), (3, 1), (6, 6), (1, 2), (6, 3)])
def test_a_mask_with_the_tag_of_its_view_lies_as_the_view_does(tmp_path, of_view, of_mask):
    """Oracle: the stored pixels where both have the tag, and else Pillow's own turning."""
    stored = np.zeros((12, 20), np.uint8)
    stored[:3, :5] = 255
    for name, turn in (("photo.png", of_view), ("photo.mask.png", of_mask)):
        tags = PIL.Image.Exif()
        tags[0x112] = turn
        PIL.Image.fromarray(stored).save(tmp_path / name, exif=tags)
    (tmp_path / "masks").mkdir()
    (tmp_path / "photo.mask.png").rename(tmp_path / "masks/photo.png")
    with PIL.Image.open(tmp_path / "masks/photo.png") as picture:
        shown = np.asarray(PIL.ImageOps.exif_transpose(picture))
    view = Camera.look_at((3, 0, 0), (0, 0, 0), width=20, height=12, fov_y=40, name="photo.png")
    (mask,) = _masks(tmp_path / "masks", [view], [tmp_path / "photo.png"], print)
    np.testing.assert_array_equal(mask, (stored if of_view == of_mask else shown) > 0)


def test_transparent_pixels_of_a_mask_or_a_picture_by_hand_are_black(tmp_path):
    """Oracle: the alpha, in numbers that 8 bits hold exactly."""
    colour = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    alpha = np.repeat(np.repeat(np.uint8([0, 51, 204, 255]), 8)[None], 32, axis=0)
    (tmp_path / "hand.png").write_bytes(encode_png(np.dstack([colour, alpha])))
    pixels, white = read_over_black(tmp_path / "hand.png")
    share = np.repeat([0, 0.2, 0.8, 1], 8)[None, :, None]
    assert np.allclose(pixels / white, colour / 255 * share, rtol=0, atol=1e-12)
    # White everywhere, and opaque enough in its right half alone.
    mask = np.dstack([np.full((32, 32, 3), 255, np.uint8), alpha])
    (tmp_path / "mask.png").write_bytes(encode_png(mask))
    edited = read_mask(tmp_path / "mask.png", cameras(1)[0])
    assert edited[:, 16:].all() and not edited[:, :16].any()


@pytest.mark.door
@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--source", "v9"), "--source: got 'v9', expected a view's name or a number below 5"),
        (("--source", "²"), "--source: got '²', expected a view's name or a number below 5"),
        (("--preset", "corected"), "; did you mean 'corrected'?"),
        (("--set", "steps=3"), "--set: steps has an option of its own, --steps"),
        (("--masks", "nowhere"), "--masks: nowhere is no folder"),
        (("--masks", "editor"), "--masks: editor/v0.png is missing"),
        (
            ("--masks", "ones"),
            "v0.png has no value above 1 of 255, so all of it is black; multiply",
        ),
        (("--masks", ".", "--where", "bear"), "--where: got --masks too, expected one of the two"),
        (("--masks", "data/images"), "v0.png is coloured, expected a grey picture"),
        (("--at", "3,4", "--box", "1,2,3,4"), "--at: got --box too, expected one of the two"),
        (("--at", "33,4"), "--at: got 33,4, expected px inside the picture of 32 x 32"),
        (("--box", "5,3,5,9"), "--box: got 5,3,5,9, expected X0,Y0,X1,Y1 with X0 < X1"),
        (("--at", "3"), "--at: got '3', expected X,Y in px, such as 64,68"),
        (("--where", " "), "--where: got ' ', expected words such as 'bear'"),
        (("--where", "bear", "--segmenter", "dino"), "segmenter 'dino': unknown, expected"),
        (("--segmenter", "clip-parts"), "--segmenter: needs --where, the words that it looks for"),
        (("--masks", "black"), "--masks: every mask in black is black, so nothing may change"),
        (("--source-picture", "no.png"), "no.png: no such file"),
        (
            ("--source-picture", "wide.png"),
            "--source-picture: wide.png: got 32 x 48 (height x width), expected the aspect ratio of 32 x 32;",
        ),
        (("--ply", "no.ply"), "no.ply: no such file"),
    ],
)
def test_what_cannot_be_used_is_one_clear_line(more, message, place, tmp_path, monkeypatch):
    ply = () if "--ply" in more else ("--ply", place / "splats.ply")
    monkeypatch.chdir(place)
    result = run(place, tmp_path / "out", *ply, *more)
    assert result.exit_code == 2
    assert message in result.output
    assert len(result.output.strip().splitlines()) == 1


@pytest.mark.door
def test_a_source_whose_picture_is_missing_is_said_to_be(place, tmp_path):
    shutil.copytree(place, tmp_path / "copy")
    (tmp_path / "copy/data/images/v2.png").unlink()
    more = ("--ply", place / "splats.ply", "--missing-images", "none", "--source", "v2")
    result = run(tmp_path / "copy", tmp_path / "out", *more)
    assert result.exit_code == 2
    assert "--source: the picture of 'v2' is missing; name another view" in result.output


@pytest.mark.door
@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("perceptual_encoder=bogus", "encoder 'bogus': unknown"),
        ("perceptual_encoder=clip-small", "is of kind 'clip', expected 'perceptual'"),
        ('branches=["bogus"]', "branches: got 'bogus', expected one of 'text', 'image', 'uncond'"),
        ("branches=[]", "branches: got none, expected some of text, image, uncond"),
        ("start=[0, 0]", "start, steps: got 0, 2, expected at least one step and start"),
    ],
)
def test_settings_that_an_edit_cannot_have_are_refused_before_the_fit(
    setting, message, place, tmp_path
):
    result = run(place, tmp_path, "--steps", 2, "--set", setting)
    assert result.exit_code == 2
    assert message in result.output
    assert not any(tmp_path.iterdir())


def test_a_mark_of_which_nothing_is_left_is_named_by_its_option(place, tmp_path):
    result = run(place, tmp_path, "--ply", place / "splats.ply", "--mask", place / "pixel.png")
    assert result.exit_code == 2
    assert "--mask: lifted through the splats, what it marks covers no pixel" in result.output


def test_a_box_whose_lifted_mask_leaves_its_middle_out_is_warned_of(place, tmp_path):
    """Splats that have a ball's rim and not its middle, where the wall shows through."""
    angle = torch.linspace(0, 2 * torch.pi, 60)
    rim = torch.stack([0.6 * angle.cos(), 0.6 * angle.sin(), 0 * angle], dim=1)
    colors = torch.tensor([[0.8, 0.1, 0.1]] + [[0.1, 0.8, 0.2]] * 60)
    model = Gaussians(
        "2d", torch.cat([torch.tensor([[0.0, 0, -0.1]]), rim]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(61, 1),
        torch.tensor([0.9, *[0.05] * 60])[:, None].repeat(1, 2), torch.full((61,), 0.99),
        Gaussians.sh_from_rgb(colors),
    )  # fmt: skip
    write_ply(tmp_path / "target.ply", model)
    shutil.copytree(place / "data", tmp_path / "data")
    shutil.copytree(place / "editor", tmp_path / "editor")
    photograph = 255 * render(model, cameras()[2]).color.clamp(0, 1).numpy()
    cv2.circle(photograph, (16, 16), 9, (25, 204, 51), -1)
    path = tmp_path / "data" / "images" / "v2.png"
    path.write_bytes(encode_png(np.rint(photograph).astype(np.uint8)))
    result = run(
        tmp_path, tmp_path / "out", "--ply", tmp_path / "target.ply", "--box", "5,5,27,27",
        "--source", "v2.png",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "the splats do not fit the mask well" in " ".join(result.output.split())


def test_an_edit_begins_with_how_much_it_changed_inside_the_mask(place, tmp_path):
    """Oracle: scikit-image on the files of the folder."""
    mask = save_mask(LEFT, tmp_path / "mask.png")
    out, ply = tmp_path / "out", ("--ply", place / "splats.ply")
    result = run(place, out, *ply, "--mask", mask, *ONE)
    assert result.exit_code == 0, result.output
    inside = read_image(out / "segments" / "v0.png")[..., 0] > 127
    source = read_image(place / "data" / "images" / "v0.png")
    edited = read_image(out / "views" / "v0.png")
    expected = deltaE_ciede2000(rgb2lab(source), rgb2lab(edited))[inside].mean()
    change = json.loads((out / "result.json").read_text())["change"]
    assert change["scene"] == 0  # not tuned
    assert change["source view"] == pytest.approx(expected, abs=0.01)
    line = (
        "inside the mask the scene changed by 0.0 dE00, net of tuning, the source view by"
        f" {expected:.1f}: the scene took 0 % of that; 0 % of the mask changed"
    )
    assert result.stdout.splitlines()[0].startswith(line)
    page = (out / "index.html").read_text()
    first = re.search(r"</h1>\s*<p>(.*?)</p>", page)[1]
    assert line[1:] in first
    for said in (result.stderr, page):
        assert "the splats hardly took the edit" in " ".join(said.split())


@pytest.mark.parametrize(("edit", "taken", "scene", "changed", "worst"), [
    (0, 0, 0, 0, None),  # nothing was edited: tuning alone removes the splats' misfit of 11 dE
    (20, 1, 20, 1, ["b", 1.0]), (20, 0.4, 8, 1, ["b", 0.4]), (20, 0, 0, 0, ["b", 0.0]),
])  # fmt: skip
def test_the_change_of_a_scene_is_net_of_what_tuning_alone_changes(
    edit, taken, scene, changed, worst
):
    draw, views = np.random.default_rng(0), {}
    for name in ("source", "a", "b"):
        photograph = draw.uniform([30, 0, 0], [50, 1, 1], (400, 3))
        misfit = draw.normal(size=(400, 3)) * [11, 0, 0]  # of the splats, before tuning
        step = np.array([edit, 0, 0])
        views[name] = photograph, photograph + step, photograph + misfit, photograph + taken * step
    change = net_change(views, "source")
    brighter = deltaE_ciede2000(views["a"][0], views["a"][1]).mean() / (edit or 1)
    assert change["scene"] == pytest.approx(scene * brighter, rel=0.01, abs=1e-6)
    assert change["changed"] == changed
    assert (change["worst"] is None) == (worst is None)
    assert worst is None or change["worst"][1] == pytest.approx(worst[1], abs=0.01)


def test_an_edit_of_other_settings_or_words_is_refused_before_a_picture_is_read(place, tmp_path):
    shutil.copytree(place, tmp_path / "copy")
    ply = ("--ply", place / "splats.ply")
    first = run(tmp_path / "copy", tmp_path / "out", *ply, *ONE)
    assert first.exit_code == 0, first.output
    for picture in (tmp_path / "copy/data/images").iterdir():
        picture.write_bytes(b"")
    for more, message in (
        (("--instruction", "a cat"), 'other instruction ("a bear", now "a cat")'),
        (("--seed", 3), "other settings.seed (0, now 3). Go on with the same ones, or name"),
        (("--at", "8,20"), 'other options.at (null, now "8,20")'),
        (("--source", 1), 'other options.source (null, now "1")'),
        (("--max-size", 16), 'other options.max_size (null, now "16")'),
    ):
        again = run(tmp_path / "copy", tmp_path / "out", *ply, *ONE, *more)
        message = f"holds an edit of {message}"
        assert again.exit_code == 2 and message in again.output


@pytest.mark.door
def test_splats_that_no_camera_sees_are_refused_by_name_before_the_edit(place, tmp_path):
    """Oracle: the cameras' own projection; all centres lie outside every picture."""
    model = splats()
    write_ply(tmp_path / "far.ply", replace(model, means=model.means + torch.tensor([50.0, 0, 0])))
    for camera in cameras():
        xy, _ = camera.project(read_ply(tmp_path / "far.ply").world_means())
        assert not ((xy > 0) & (xy < 32)).all(axis=-1).any()
    result = run(place, tmp_path / "out", "--ply", tmp_path / "far.ply")
    assert result.exit_code == 2
    assert f"{tmp_path / 'far.ply'}: its splats cover less than 0.2% of each view" in result.output
    assert "same coordinates and the same units" in result.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("how", ["as they are", *further("turned", "scaled")])
def test_splats_that_do_not_show_the_pictures_are_warned_about(how, place, tmp_path):
    """Oracle: PSNR over what the splats cover, and that of one colour a view, in numpy."""
    model, views = splats(), cameras()
    c, s = np.cos(1.6), np.sin(1.6)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float32)
    means = {"turned": model.means @ turn.T, "scaled": 0.4 * model.means}.get(how, model.means)
    moved = replace(model, means=means)
    write_ply(tmp_path / "moved.ply", moved)
    errors, spreads = [], []
    for camera, image in zip(views, pictures(model, views), strict=True):
        view = render(read_ply(tmp_path / "moved.ply"), camera)
        alpha = view.alpha.numpy()
        true = (np.rint(255 * image) / 255)[alpha > 0.5]
        errors.append((view.color.numpy()[alpha > 0.5] / alpha[alpha > 0.5, None] - true) ** 2)
        spreads.append((true - true.mean(0)) ** 2)
    psnr, plain = (-10 * np.log10(np.concatenate(x).mean()) for x in (errors, spreads))
    assert (psnr < min(plain, 18)) == (how != "as they are")
    result = run(place, tmp_path / "out", "--ply", tmp_path / "moved.ply", *ONE)
    assert result.exit_code == 0, result.output
    said = f"are unlike them ({psnr:.1f} dB; one colour a view would have {plain:.1f})"
    assert (said in result.stderr) == (how != "as they are")


def test_the_kind_that_a_person_names_is_that_of_the_splats_that_are_given(place, tmp_path):
    """Oracle: the PLY that the edit leaves; its splats have a third scale that no rule takes for
    flat."""
    flat = splats()
    assert flat.kind == "2d"
    write_ply(tmp_path / "thick.ply", flat, third_scale=float(flat.scales.max()) / 2)
    text = (tmp_path / "thick.ply").read_bytes()
    head, body = text.split(b"end_header\n", 1)
    lines = [line for line in head.splitlines() if not line.startswith(b"comment")]
    (tmp_path / "thick.ply").write_bytes(b"\n".join([*lines, b"end_header\n"]) + body)
    for kind, ending in (("2dgs", "2d"), ("3dgs", "3d")):
        out = tmp_path / kind
        result = run(place, out, "--ply", tmp_path / "thick.ply", "--kind", kind, *ONE)
        assert result.exit_code == 0, result.output
        assert read_ply(out / "edited.ply").kind == ending
    result = run(place, tmp_path / "none", "--no-antialiased")
    assert result.exit_code == 2 and "--antialiased: says how a PLY is read" in result.output


def test_stages_and_a_size_that_cannot_be_had_are_said_in_one_line_each(place, tmp_path):
    """Oracle: the manifest and the pictures that the edit leaves."""
    more = ("--ply", place / "splats.ply", "--stages", 9, "--views-per-stage", 2, "--size", 31)
    result = run(place, tmp_path, *more)
    assert result.exit_code == 0, result.output
    stages = json.loads((tmp_path / "manifest.json").read_text())["rounds"]
    longest = max(read_image(tmp_path / "views/v0.png").shape)
    assert (len(stages), longest) == (2, 32)
    assert "stages: 2 in place of 9, as 5 views leave no more to edit\n" in result.stderr
    assert "size: 32 px in place of 31, as this editor's sides are multiples of" in result.stderr


def test_an_edit_whose_targets_got_no_features_says_so(place, tmp_path):
    """Oracle: the masks leave no pixel of a view but the source's to be edited."""
    masks = tmp_path / "masks"
    for k, camera in enumerate(cameras()):
        save_mask(np.full((32, 32), k == 2), masks / camera.name)
    ply = ("--ply", place / "splats.ply", "--source", 2, "--set", "warp.segment=true")
    result = run(place, tmp_path / "out", *ply, "--masks", masks, *ONE)
    assert result.exit_code == 0, result.output
    names = ", ".join(f"images/v{k}.png" for k in (0, 1, 3, 4))
    assert f"--masks: 4 of 5 are black, so nothing is edited in {names}\n" in result.stderr
    assert "warning: each view was edited alone, as none got features" in result.stderr
    assert "perhaps the splats do not fit the photographs" in result.stderr
    page = unescape((tmp_path / "out" / "index.html").read_text())
    warned = re.findall(r"^attnwarp: warning: (.*)$", result.stderr, re.MULTILINE)
    assert len(warned) >= 2 and all(f"<b>Warning:</b> {text}." in page for text in warned)
    result = run(place, tmp_path / "all", *ply, *ONE)
    assert result.exit_code == 0 and "edited alone" not in result.stderr
    assert "in place of" not in result.stderr


def test_a_mask_by_words_is_made_once_and_others_write_over_none(
    place, segmenter_folders, tmp_path, monkeypatch
):
    """Oracle: the segmenter itself, and how often it is loaded."""
    camera = cameras()[0]
    image = read_image(place / "data" / "images" / camera.name)
    segmenter, loaded = GroundedSam.from_folders(*segmenter_folders), []
    monkeypatch.setattr(
        "attnwarp.command.marks.load_segmenter",
        lambda name, *, device: loaded.append(name) or segmenter,
    )
    bear = Marks(words="bear", segmenter="dino,sam")
    out = tmp_path / "edit"
    for _ in range(2):
        mask = mask_by_words(bear, camera, image, out, "cpu")
        assert np.array_equal(mask, segmenter.segment(to_float(image), "bear"))
    assert loaded == ["dino,sam"]
    others = [replace(bear, words="Bear"), replace(bear, words="a bear / b")]
    others += [replace(bear, segmenter="dino,sam2")]
    for marks in others:
        mask_by_words(marks, camera, image, out, "cpu")
    mask_by_words(bear, camera, image[:, ::-1].copy(), out, "cpu")
    assert len(loaded) == len(list((out / "words").iterdir())) == 5


def test_words_that_no_view_shows_are_one_clear_line(place, tmp_path):
    result = run(place, tmp_path, "--ply", place / "splats.ply", "--where", "snowman")
    assert result.exit_code == 2
    assert "no 'snowman' was detected in view images/v0.png" in result.output
    assert not (tmp_path / "edited.ply").exists()


@pytest.mark.parametrize(
    ("editor", "more", "steps"),
    [
        ("small-plain", (), 10),
        ("small-plain", ("--preset", "corrected"), 20),
        ("small-plain", ("--method", "by_view"), 20),
        ("small-plain", ("--steps", "7"), 7),
        ("small-depth", (), 20),  # nobody has measured fewer of it
        (None, (), 20),  # Stable Diffusion's published number
    ],
)
def test_extended_takes_half_of_the_steps_of_small_plain_and_all_else_its_own_number(
    place, tmp_path, monkeypatch, editor, more, steps
):
    def chosen(method, preset, **changes):
        raise ValueError(f"steps: {changes['steps']}")

    monkeypatch.setattr("attnwarp.methods.preset", chosen)
    given = (place / "data", "--instruction", "make it red", "--editor", editor or place / "editor")
    result = runner.invoke(app, ["edit", *map(str, given), "--out", str(tmp_path), *more])
    assert f"steps: {steps}\n" in result.output


def test_a_refused_edit_leaves_the_masks_of_the_edit_that_is_there(place, tmp_path):
    ply = ("--ply", place / "splats.ply")
    masks, segments = tmp_path / "masks", tmp_path / "out" / "segments"
    save_mask(LEFT, *(masks / camera.name for camera in cameras()))
    given = {path.name: path.read_bytes() for path in masks.iterdir()}
    assert run(place, tmp_path / "out", *ply, "--masks", masks, *ONE).exit_code == 0
    assert {path.name: path.read_bytes() for path in segments.iterdir()} == given
    save_mask(~LEFT, masks / cameras()[0].name)
    result = run(place, tmp_path / "out", *ply, "--masks", masks, *ONE)
    assert result.exit_code == 2
    assert "holds an edit of other inputs.segments" in result.output
    assert {path.name: path.read_bytes() for path in segments.iterdir()} == given


@pytest.mark.slow
def test_a_process_that_is_killed_and_started_again_leaves_the_same_bytes(place, tmp_path):
    def command(out):
        arguments = [
            "edit", place / "data", "--instruction", "a bear", "--editor", place / "editor", "--out", out, "--ply",
            place / "splats.ply", *QUICK, "--iterations", 60,
        ]  # fmt: skip
        return [sys.executable, "-m", "attnwarp", *map(str, arguments)]

    def files(out):
        # The page shows the seconds.
        skipped = {"times.json", "index.html"}
        paths = [path for path in sorted(Path(out).rglob("*")) if path.is_file()]
        return {str(p.relative_to(out)): p.read_bytes() for p in paths if p.name not in skipped}

    subprocess.run(command(tmp_path / "whole"), check=True, capture_output=True)
    expected = files(tmp_path / "whole")
    marks = ["manifest.json", "rounds/1/v0.json", "rounds/1/.*json", "rounds/1.pt", "rounds/2.ply"]
    for mark in marks:
        process = subprocess.Popen(command(tmp_path / "killed"), stderr=subprocess.DEVNULL)
        while process.poll() is None:
            names = [
                p.relative_to(tmp_path / "killed").as_posix()
                for p in (tmp_path / "killed").rglob("*")
            ]
            if any(re.fullmatch(mark, name) for name in names):
                os.kill(process.pid, signal.SIGKILL)
            time.sleep(0.005)
    subprocess.run(command(tmp_path / "killed"), check=True, capture_output=True)
    assert files(tmp_path / "killed") == expected
