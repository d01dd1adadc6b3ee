# ruff: noqa: F811  (fixtures that are imported)
"""The command as a person runs it, on a small random editor in a folder."""

import cv2
import numpy as np
import pytest
from loaded_once import editors_are_loaded_once, segmenter_folders  # noqa: F401
from PIL import Image, ImageOps
from tiny_editors import pix2pix
from typer.testing import CliRunner

from attnwarp.cli.edit_image import _read
from attnwarp.cli.main import app
from attnwarp.editing.editor import edit
from attnwarp.editing.segment import GroundedSam
from attnwarp.editing.small import load_editor

runner = CliRunner()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("editor")
    pix2pix(halvings=2).save_pretrained(place)
    return place


@pytest.fixture
def photo(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 64, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), pixels[..., ::-1])
    return tmp_path / "photo.png", pixels


def run(*args):
    return runner.invoke(app, ["edit-image", *map(str, args)])


def test_it_writes_what_the_library_gives(folder, photo, tmp_path):
    path, pixels = photo
    out = tmp_path / "new" / "red.png"
    result = run(
        path, "--instruction", "a bear", "--editor", folder, "--out", out, "--steps", 3, "--size", 64, "--seed", 4,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "warning" not in result.output
    expected = edit(
        load_editor(str(folder)), [pixels.astype(np.float32) / 255], "a bear", steps=3, seed=4
    ).images[0]
    written = cv2.imread(str(out))[..., ::-1]
    assert np.array_equal(written, np.rint(255 * expected).astype(np.uint8))


def test_a_photograph_keeps_its_size_and_gets_the_change_of_the_edit(folder, tmp_path):
    """Oracle: the library's small edit, its change enlarged by OpenCV."""
    pixels = np.random.default_rng(0).integers(0, 256, (80, 128, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), pixels[..., ::-1])
    out = tmp_path / "out.png"
    words = ("--instruction", "a bear", "--editor", folder, "--steps", 1, "--size", 64)
    result = run(tmp_path / "photo.png", *words, "--out", out)
    assert result.exit_code == 0, result.output
    whole = pixels.astype(np.float32) / 255
    small = cv2.resize(whole, (64, 40), interpolation=cv2.INTER_AREA)
    edited = edit(load_editor(str(folder)), [small], "a bear", steps=1).images[0]
    change = cv2.resize(edited - small, (128, 80), interpolation=cv2.INTER_LINEAR)
    expected = np.rint(255 * np.clip(whole + change, 0, 1))
    assert np.abs(cv2.imread(str(out))[..., ::-1] - expected).max() <= 1


def test_transparent_pixels_are_laid_over_black(folder, photo, tmp_path):
    """Oracle: the same edit of the picture laid over black by hand."""
    _, rgb = photo
    alpha = np.full((40, 64, 1), 255, np.uint8)
    alpha[:, 20:] = 0
    cv2.imwrite(str(tmp_path / "clear.png"), np.dstack([rgb[..., ::-1], alpha]))
    cv2.imwrite(str(tmp_path / "black.png"), rgb[..., ::-1] * (alpha > 0))
    results = []
    for name in ("clear", "black"):
        out = tmp_path / f"{name}-out.png"
        done = run(
            tmp_path / f"{name}.png", "--instruction", "a bear", "--editor", folder, "--steps", 1, "--out", out,
        )  # fmt: skip
        assert done.exit_code == 0, done.output
        results.append(out.read_bytes())
    assert results[0] == results[1]


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("shape", [(4, 6), (5, 5)])
def test_colour_and_alpha_are_turned_together_as_exif_asks(turn, shape, tmp_path):
    """Oracle: Pillow's own turning, and laid over black by hand."""
    random = np.random.default_rng(turn)
    rgba = random.integers(0, 256, (*shape, 4), dtype=np.uint8)
    rgba[..., 3] = 255 * random.integers(0, 2, shape)
    tag = Image.Exif()
    tag[0x112] = turn
    Image.fromarray(rgba).save(tmp_path / "turned.png", exif=tag)
    with Image.open(tmp_path / "turned.png") as stored:
        seen = np.asarray(ImageOps.exif_transpose(stored))
    expected = seen[..., :3] / 255 * (seen[..., 3:] > 0)
    assert np.allclose(_read(tmp_path / "turned.png"), expected, rtol=0, atol=1e-6)


def test_words_edit_what_they_name_alone(folder, segmenter_folders, tmp_path, monkeypatch):
    """Oracle: SAM and Grounding DINO called directly, and the edit without a mask."""
    models = segmenter_folders
    monkeypatch.setattr("attnwarp.cli.edit_image.SEGMENTER", ",".join(map(str, models)))
    pixels = np.random.default_rng(0).integers(0, 256, (40, 64, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), pixels[..., ::-1])
    out = tmp_path / "out.png"
    common = (
        tmp_path / "photo.png", "--instruction", "a bear", "--editor", folder, "--out", out, "--steps", 1, "--size", 64,
    )  # fmt: skip
    result = run(*common, "--where", "bear")
    assert result.exit_code == 0, result.output
    masked = cv2.imread(str(out))
    mask = GroundedSam.from_folders(*models).segment(pixels.astype(np.float32) / 255, "bear")
    assert 0 < mask.mean() < 1
    assert run(*common).exit_code == 0
    everywhere = cv2.imread(str(out))
    assert np.array_equal(masked[mask], everywhere[mask])
    assert np.array_equal(masked[~mask], pixels[..., ::-1][~mask])


def test_a_marked_thing_alone_is_edited(folder, tmp_path):
    """Oracle: the edit without a mask inside, the picture outside."""
    pixels = np.full((40, 64, 3), 60, np.uint8)
    pixels[10:30, 20:44] = (40, 60, 220)
    cv2.imwrite(str(tmp_path / "photo.png"), pixels)
    thing = np.zeros((40, 64), bool)
    thing[10:30, 20:44] = True
    cv2.imwrite(str(tmp_path / "m.png"), 255 * thing.astype(np.uint8))
    common = (
        tmp_path / "photo.png", "--instruction", "a bear", "--editor", folder, "--out", tmp_path / "o.png", "--steps", 1,
        "--size", 64,
    )  # fmt: skip
    assert run(*common).exit_code == 0
    everywhere = cv2.imread(str(tmp_path / "o.png"))
    expected = np.where(thing[..., None], everywhere, pixels)
    for marks in (("--at", "32,20"), ("--mask", tmp_path / "m.png")):
        result = run(*common, *marks)
        assert result.exit_code == 0, result.output
        assert np.array_equal(cv2.imread(str(tmp_path / "o.png")), expected)


def test_what_is_not_marked_stays_where_only_rounding_resizes_the_picture(folder, tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (42, 64, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), pixels)
    marked = np.zeros((42, 64), np.uint8)
    marked[:, 32:] = 255
    cv2.imwrite(str(tmp_path / "m.png"), marked)
    result = run(
        tmp_path / "photo.png", "--instruction", "a bear", "--editor", folder, "--out", tmp_path / "o.png", "--steps", 1,
        "--size", 64, "--mask", tmp_path / "m.png",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    edited = cv2.imread(str(tmp_path / "o.png"))
    assert np.array_equal(edited[:, :32], pixels[:, :32])
    assert not np.array_equal(edited[:, 32:], pixels[:, 32:])


def test_words_that_the_picture_does_not_show_are_one_clear_line(folder, tmp_path):
    cv2.imwrite(str(tmp_path / "photo.png"), np.full((40, 64, 3), 128, np.uint8))
    result = run(
        tmp_path / "photo.png", "--instruction", "a bear", "--editor", folder, "--out", tmp_path / "a.png", "--where", "snowman",
        "--size", 64,
    )  # fmt: skip
    assert result.exit_code == 2
    assert "no 'snowman' was detected in the picture" in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"picture": "nowhere.png"}, "nowhere.png: no such file"),
        ({"picture": "text.png"}, "text.png: cannot be read as an image"),
        ({"out": "red.jpg"}, "red.jpg: expected a name that ends in .png"),
        ({"picture": "."}, "is a folder, expected a file"),
        ({"out": "photo.png"}, "photo.png: is the picture to edit; choose another name"),
        ({"instruction": " "}, "instruction: is empty, expected words such as 'make it red'"),
        ({"instruction": "make it red " * 40}, "prompt: 'make it red make it red"),
        ({"more": ("--device", "gpu")}, "device 'gpu': unknown, expected cpu or cuda"),
        ({"more": ("--text-guidance", "nan")}, "text_guidance: got nan, expected a number"),
    ],
)
def test_what_cannot_be_used_is_one_clear_line(
    change, message, folder, photo, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.png").write_text("no picture")
    picture = tmp_path / change["picture"] if "picture" in change else photo[0]
    before = photo[0].read_bytes()
    result = run(
        picture, "--instruction", change.get("instruction", "a bear"), "--editor", folder, "--out",
        tmp_path / change.get("out", "a.png"), *change.get("more", ()),
    )  # fmt: skip
    assert result.exit_code == 2
    assert message in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert photo[0].read_bytes() == before


def test_a_size_beyond_all_memory_is_refused_as_it_is_typed(folder, photo, tmp_path):
    result = run(
        photo[0], "--instruction", "a bear", "--editor", folder, "--out", tmp_path / "a.png", "--size", 100_000,
    )  # fmt: skip
    assert result.exit_code == 2 and "--size" in result.output


@pytest.mark.door
def test_a_missing_extra_is_one_clear_line(photo, tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "diffusers", None)
    result = run(photo[0], "--instruction", "make it red", "--out", tmp_path / "a.png")
    assert result.exit_code == 2
    assert (
        "editors need diffusers, which is not installed; in the checkout: pip install -c"
        " constraints.txt -e '.[edit]'" in result.output
    )
