"""Oracles: the types' definitions of 1, memory addresses, hashlib."""

import hashlib
import json

import numpy as np
import pytest
import torch
from tiny_scenes import cameras

from attnwarp import Camera
from attnwarp.fit import Views
from attnwarp.methods.scene import digests

RANDOM = np.random.default_rng(0)
BYTES = RANDOM.integers(0, 256, (32, 32, 3), dtype=np.uint8)
IMAGES = {
    "uint8": BYTES,
    "uint16": RANDOM.integers(0, 65536, (32, 32, 3), dtype=np.uint16),
    "float32": RANDOM.random((32, 32, 3), dtype=np.float32),
}


@pytest.mark.parametrize("kind", IMAGES)
def test_a_view_is_not_copied_and_is_read_as_float32(kind):
    given = IMAGES[kind]
    scene = Views(cameras(1), [given])
    assert np.shares_memory(scene.images[0], given)
    top = {"uint8": 255, "uint16": 65535, "float32": 1}[kind]
    picture = scene.picture(0)
    assert picture.dtype == np.float32
    assert np.array_equal(picture, (given / np.float64(top)).astype(np.float32))


def test_the_hash_of_views_is_that_of_their_float32_pictures():
    scene = Views(cameras(3), list(IMAGES.values()))
    expected = hashlib.sha256()
    for k in range(3):
        expected.update(b"float32(32, 32, 3)" + scene.picture(k).tobytes())
    assert digests(scene, None)["images"] == expected.hexdigest()
    assert json.dumps(digests(scene, None))


@pytest.mark.parametrize("image", ["read-only", "flipped"])
@pytest.mark.filterwarnings("error")
def test_an_image_that_torch_could_not_share_is_copied(image):
    given = IMAGES["float32"][..., ::-1] if image == "flipped" else IMAGES["float32"].copy()
    given.flags.writeable = image == "flipped"
    picture = Views(cameras(1), [given]).picture(0)
    assert torch.equal(torch.from_numpy(picture), torch.tensor(given.tolist()))


def test_photographs_keep_their_type_and_transparent_ones_lie_over_black():
    view = Camera.look_at((0, 0, 3), (0, 0, 0), width=32, height=32, fov_y=40, up=(0, 1, 0))
    clear = np.dstack([BYTES, np.full((32, 32), 51, np.uint8)])  # a fifth
    views = Views([view, view], [BYTES, clear])
    opaque, over = views.images[0], views.picture(1)
    assert opaque is BYTES
    assert np.allclose(over, BYTES / 255 / 5, rtol=0, atol=1e-7)
