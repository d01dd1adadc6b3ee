"""Damaged files of every format: a right result or one line, never a crash.

Each format has an oracle of its own for what is read in spite of the damage. A failure is repeated
by its label: the name of the format and the seed of :mod:`damage_files`.
"""

import io
import json
import re
import struct
import warnings

import damage_files
import numpy as np
import pytest
import torch
from PIL import Image

from attnwarp import Camera, Gaussians
from attnwarp.errors import InputError, InputWarning
from attnwarp.io import (
    Dataset,
    read_dataset,
    read_image,
    read_ply,
    read_points,
    read_splat,
    write_ply,
    write_points,
    write_splat,
    write_transforms,
)

from .test_colmap import pictures, write_binary, write_text

FAST, SLOW = 9, 150

SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4,
         "double": 8, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4,
         "float32": 4, "float64": 8}  # fmt: skip


def splats():
    rng = np.random.default_rng(0)

    def tensor(*shape):
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    return Gaussians(
        "3d", tensor(12, 3), tensor(12, 4), tensor(12, 3).exp(), tensor(12).sigmoid(),
        tensor(12, 4, 3),
    )  # fmt: skip


def rows_of_ply(data):
    """Rows that a PLY holds, by its size and its header alone; None if the header is unusual."""
    head, _, body = data.partition(b"end_header")
    lines = [line.strip() for line in head.decode("ascii").splitlines()]
    body = body.lstrip(b"\r").removeprefix(b"\n")
    elements = [line for line in lines if line.startswith("element")]
    if len(elements) != 1:
        return None
    if any(line.startswith("format ascii") for line in lines):
        return sum(1 for line in body.splitlines() if line.strip())
    size = sum(SIZES[line.split()[1]] for line in lines if line.startswith("property"))
    assert len(body) % size == 0, f"{len(body)} bytes are no whole number of rows of {size}"
    return len(body) // size


class Ply:
    read = staticmethod(read_ply)
    ascii = False

    def original(self, folder):
        write_ply(folder / "a.ply", splats())
        data = (folder / "a.ply").read_bytes()
        if not self.ascii:
            return data
        head, body = data.split(b"end_header\n", 1)
        width = len(re.findall(rb"^property", head, re.MULTILINE))
        rows = np.frombuffer(body, "<f4").reshape(-1, width)
        text = "".join(" ".join(map(repr, row.tolist())) + "\n" for row in rows)
        return head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + text.encode()

    def use(self, folder, data):
        (folder / "a.ply").write_bytes(data)
        result = self.read(folder / "a.ply")
        means = result.means.numpy() if isinstance(result, Gaussians) else result[0]
        assert np.isfinite(means).all()
        assert rows_of_ply(data) in (None, len(means))


class AsciiPly(Ply):
    ascii = True


class Points(Ply):
    read = staticmethod(read_points)

    def original(self, folder):
        rng = np.random.default_rng(0)
        colors = rng.integers(0, 256, (20, 3), dtype=np.uint8)
        write_points(folder / "a.ply", rng.normal(size=(20, 3)), colors)
        return (folder / "a.ply").read_bytes()


class Splat:
    def original(self, folder):
        write_splat(folder / "a.splat", splats())
        return (folder / "a.splat").read_bytes()

    def use(self, folder, data):
        (folder / "a.splat").write_bytes(data)
        g = read_splat(folder / "a.splat")
        rows = list(struct.iter_unpack("<6f8B", data))
        assert [row[:3] for row in rows] == [tuple(mean) for mean in g.means.tolist()]


class Transforms:
    def original(self, folder):
        cameras = [
            Camera.look_at((3, i, 1), (0, 0, 0), width=8, height=6, fov_y=40, name=f"{i}.png")
            for i in range(4)
        ]
        splits = ["train", "train", "test", None]
        colors = np.full((5, 3), 7, np.uint8)
        data = Dataset(cameras, [None] * 4, np.eye(5, 3), colors, splits)
        write_transforms(folder, data)
        for i in range(3):
            Image.new("RGB", (8, 6)).save(folder / f"{i}.png")
        return (folder / "transforms.json").read_bytes()

    def use(self, folder, data):
        (folder / "transforms.json").write_bytes(data)
        result = read_dataset(folder, missing_images="none", distorted="keep")
        assert len(result) == len(json.loads(data)["frames"])
        assert all(np.isfinite(camera.world_to_camera).all() for camera in result.cameras)


class Colmap:
    write = staticmethod(write_binary)
    suffix = ".bin"

    def original(self, folder):
        self.write(folder)
        pictures(folder / "images")
        return (folder / f"cameras{self.suffix}").read_bytes()

    def use(self, folder, data):
        (folder / f"cameras{self.suffix}").write_bytes(data)
        self.check(read_dataset(folder, missing_images="none", distorted="keep"))

    def check(self, result):
        assert len(result) == 3
        assert all(np.isfinite(camera.K).all() for camera in result.cameras)


class ColmapImages(Colmap):
    def original(self, folder):
        super().original(folder)
        return (folder / f"images{self.suffix}").read_bytes()

    def use(self, folder, data):
        (folder / f"images{self.suffix}").write_bytes(data)
        self.check(read_dataset(folder, missing_images="none"))

    def check(self, result):
        assert all(np.isfinite(camera.world_to_camera).all() for camera in result.cameras)


class ColmapText(ColmapImages):
    write = staticmethod(write_text)
    suffix = ".txt"


class ColmapPoints(ColmapImages):
    def original(self, folder):
        super().original(folder)
        return (folder / "points3D.bin").read_bytes()

    def use(self, folder, data):
        (folder / "points3D.bin").write_bytes(data)
        result = read_dataset(folder, missing_images="none")
        (count,) = struct.unpack_from("<Q", data)
        assert np.isfinite(result.points).all() and len(result.points) == count


class Picture:
    def __init__(self, suffix):
        self.suffix = suffix
        self.pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)

    def original(self, folder):
        buffer = io.BytesIO()
        Image.fromarray(self.pixels).save(buffer, format=self.suffix)
        return buffer.getvalue()

    def use(self, folder, data):
        (folder / "a.img").write_bytes(data)
        pixels = read_image(folder / "a.img")
        # PNG alone has a checksum of every part.
        assert self.suffix != "png" or np.array_equal(pixels, self.pixels)


FORMATS = {
    "ply": Ply(),
    "ascii ply": AsciiPly(),
    "points": Points(),
    "splat": Splat(),
    "transforms": Transforms(),
    "colmap cameras": Colmap(),
    "colmap images": ColmapImages(),
    "colmap text": ColmapText(),
    "colmap points": ColmapPoints(),
    **{suffix: Picture(suffix) for suffix in ("png", "jpeg", "webp", "tiff")},
}
TEXTS = ("ascii ply", "transforms", "colmap text")


def failures(name, folder, seeds):
    form = FORMATS[name]
    data = form.original(folder)

    def read(given):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            form.use(folder, given)

    refusals = (InputError, FileNotFoundError)
    return damage_files.failures(name, data, read, seeds, refusals=refusals, text=name in TEXTS)


@pytest.mark.parametrize("name", FORMATS)
@damage_files.seeds_of(FAST, SLOW)
def test_damage_ends_in_a_right_result_or_in_one_line(tmp_path, name, seeds):
    assert not (failed := failures(name, tmp_path, seeds)), "\n".join(failed)
