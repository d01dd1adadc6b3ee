"""The one door for pictures: what the file holds comes in, and a damaged file does not."""

import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from attnwarp.io import FileFormatError, image_size, read_image, read_upright
from attnwarp.io.images import upright_size


def test_a_tag_that_asks_to_turn_a_picture_is_not_followed(tmp_path):
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[:, :3] = 255
    tags = Image.Exif()
    tags[0x0112] = 6  # "turn by 90 degrees"
    Image.fromarray(pixels).save(tmp_path / "a.jpg", exif=tags, quality=100)
    image = read_image(tmp_path / "a.jpg")
    assert image.shape == (4, 6, 3)
    assert image[:, 0].min() > 200 and image[:, -1].max() < 50


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.webp"])
def test_an_upright_picture_is_what_viewers_show(tmp_path, turn, name):
    """Oracle: Pillow's own turning."""
    pixels = np.random.default_rng(turn).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    tags = Image.Exif()
    tags[0x112] = turn
    path = tmp_path / name
    Image.fromarray(pixels).save(path, exif=tags)
    with Image.open(path) as stored:
        seen = np.asarray(ImageOps.exif_transpose(stored).convert("RGB"))
    np.testing.assert_array_equal(read_upright(path), seen)
    assert upright_size(path) == seen.shape[1::-1]
    # A tag that the picture of a pose has too turns neither.
    np.testing.assert_array_equal(read_upright(path, beside=path), read_image(path))


@pytest.mark.door
def test_a_tiff_whose_pixels_pillow_would_turn_is_refused(tmp_path):
    path = tmp_path / "a.tif"
    Image.new("RGB", (4, 3)).save(path, tiffinfo={274: 3})
    for read in (read_image, image_size):
        with pytest.raises(FileFormatError, match=r"a\.tif: asks to be turned .* PNG"):
            read(path)


@pytest.mark.parametrize("shape", [(4, 6, 3), (5, 5, 4)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_an_upright_tiff_is_read_in_its_depth(tmp_path, shape, dtype):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype=dtype)
    pixels[..., 3:] = np.iinfo(dtype).max
    order = [2, 1, 0, 3][: shape[2]]
    cv2.imwrite(str(tmp_path / "a.tif"), pixels[..., order])
    image = read_image(tmp_path / "a.tif")
    np.testing.assert_array_equal(image, pixels)
    assert image.dtype == dtype and image_size(tmp_path / "a.tif") == shape[1::-1]


def test_files_come_as_rgb_in_their_own_depth(tmp_path):
    rgb = np.array([[[60000, 3, 500]]], np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), rgb[..., ::-1])
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), rgb)
    cv2.imwrite(str(tmp_path / "grey.png"), np.array([[7, 8]], np.uint8))
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png"), [[[7] * 3, [8] * 3]])
    rgba = np.array([[[1, 2, 3, 4]]], np.uint8)
    Image.fromarray(rgba).save(tmp_path / "clear.png")
    np.testing.assert_array_equal(read_image(tmp_path / "clear.png"), rgba)


@pytest.mark.parametrize(
    ("name", "mode", "options"),
    [
        ("rgba.tif", "RGBA", {}),
        ("rgba.png", "RGBA", {}),
        ("grey.tif", "LA", {}),
        ("grey.png", "LA", {}),
        ("value.png", "L", {"transparency": 200}),
    ],
)
def test_alpha_comes_straight_from_every_format(tmp_path, name, mode, options):
    values = {"RGBA": (200, 100, 50, 128), "LA": (200, 128), "L": 200}
    expected = {"RGBA": (200, 100, 50, 128), "LA": (200, 200, 200, 128), "L": (200, 200, 200, 0)}
    Image.new(mode, (3, 2), values[mode]).save(tmp_path / name, **options)
    np.testing.assert_array_equal(read_image(tmp_path / name)[1, 2], expected[mode])


def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


@pytest.mark.door
def test_a_file_that_is_no_picture_is_refused_by_path(tmp_path):
    (tmp_path / "a.png").write_bytes(b"nothing")
    with pytest.raises(FileFormatError, match=r"a\.png: cannot be read as an image"):
        read_image(tmp_path / "a.png")


def noise(path, size=(64, 48), **options):
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path, **options)
    return path


@pytest.mark.door
@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_picture_that_breaks_off_is_refused_by_path(tmp_path, name, share):
    path = noise(tmp_path / name)
    whole = path.read_bytes()
    assert read_image(path).shape == (48, 64, 3)
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(FileFormatError, match=rf"{name}: .*(damaged|cannot be read)"):
        read_image(path)


def test_every_flipped_bit_of_a_png_is_seen_or_changes_no_pixel(tmp_path):
    path = noise(tmp_path / "a.png", (8, 8))
    pixels, whole = read_image(path), path.read_bytes()
    refused = 0
    for position in range(len(whole)):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << (position % 8)
        path.write_bytes(damaged)
        try:
            assert np.array_equal(read_image(path), pixels)
        except FileFormatError:
            refused += 1
    assert refused > 0.9 * len(whole)


@pytest.mark.door
def test_a_picture_beyond_pillows_limit_is_refused_in_one_line(tmp_path):
    header = struct.pack(">IIBBBBB", 40_000, 40_000, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0"))
    (tmp_path / "big.png").write_bytes(data + chunk(b"IEND", b""))
    for read in (read_image, image_size):
        with pytest.raises(FileFormatError, match=r"big\.png: the picture has more than [\d,]+ px"):
            read(tmp_path / "big.png")


@pytest.mark.door
def test_what_is_not_there_or_empty_is_said(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.png: no such file"):
        read_image(tmp_path / "none.png")
    (tmp_path / "empty.png").write_bytes(b"")
    with pytest.raises(FileFormatError, match=r"empty\.png: the file is empty"):
        image_size(tmp_path / "empty.png")


def test_a_folder_whose_name_is_no_utf8_is_read(tmp_path):
    """An old archive leaves such a name; OpenCV crashes at such a path."""
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes UTF-8 alone")
    pixels = np.random.default_rng(0).integers(0, 256, (5, 4, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(folder / "a.png")
    assert np.array_equal(read_image(folder / "a.png"), pixels)
