"""A file of each format whose second half is lost: one line that names it, never a crash."""

import numpy as np
import pytest
import torch
from PIL import Image

from attnwarp import Camera, Gaussians
from attnwarp.errors import InputError
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


def splats():
    turns = torch.nn.functional.normalize(torch.ones(12, 4), dim=1)
    return Gaussians(
        "3d", torch.eye(12, 3), turns, torch.ones(12, 3), torch.ones(12), torch.ones(12, 4, 3)
    )


def write_capture(path):
    view = {"width": 8, "height": 6, "fov_y": 40}
    cameras = [Camera.look_at((3, i, 1), (0, 0, 0), name=f"{i}.png", **view) for i in range(4)]
    write_transforms(path.parent, Dataset(cameras, [None] * 4))


def write_model(path):
    (write_text if path.suffix == ".txt" else write_binary)(path.parent)
    pictures(path.parent / "images")


def write_picture(path):
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)).save(path)


def of_folder(path):
    return read_dataset(path.parent, missing_images="none")


FORMATS = {
    "splats.ply": (lambda path: write_ply(path, splats()), read_ply),
    "points.ply": (lambda path: write_points(path, np.eye(20, 3), None), read_points),
    "a.splat": (lambda path: write_splat(path, splats()), read_splat),
    "transforms.json": (write_capture, of_folder),
    **{f"{name}.bin": (write_model, of_folder) for name in ("cameras", "images", "points3D")},
    "images.txt": (write_model, of_folder),
    **{f"a.{suffix}": (write_picture, read_image) for suffix in ("png", "jpg", "webp", "tif")},
}


@pytest.mark.parametrize("name", FORMATS)
def test_half_a_file_is_refused_in_one_line_that_names_it(tmp_path, name):
    write, read = FORMATS[name]
    path = tmp_path / name
    write(path)
    read(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2 + 1])  # rows of a .splat are even
    with pytest.raises(InputError, match=name) as refusal:
        read(path)
    assert "\n" not in str(refusal.value)
