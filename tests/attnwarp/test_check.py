"""Numbers and sizes that public functions take, against Python's own values."""

import json

import numpy as np
import pytest
import torch

from attnwarp import Camera, check
from attnwarp.fit import FitSettings
from attnwarp.methods import Budget
from attnwarp.methods import preset as method_preset
from attnwarp.warp import (
    Surface,
    correspond_at,
    layer_size,
    preset,
    resize_depth,
    resize_mask,
    warp_surfaces,
)


@pytest.mark.parametrize(
    ("of_numpy", "plain"),
    [
        (lambda: FitSettings(iterations=np.int64(20), ssim=np.float32(0.5)),
         lambda: FitSettings(iterations=20, ssim=0.5)),
        (lambda: preset("corrected", normal_angle=np.int32(60)),
         lambda: preset("corrected", normal_angle=60)),
        (lambda: method_preset("attention_warping", steps=np.int16(10), a0=np.float32(0.25), start=(np.int64(500), np.int64(900)), feature_steps=(np.float32(0), np.float32(0.5))),
         lambda: method_preset("attention_warping", steps=10, a0=0.25, start=(500, 900), feature_steps=(0.0, 0.5))),
        (lambda: method_preset("dge", views=np.int64(4), starts=(np.int64(998), np.int64(299)), epipolar=np.float32(1.5)),
         lambda: method_preset("dge", views=4, starts=(998, 299), epipolar=1.5)),
    ],
    ids=["fit", "warp", "propagate", "baseline"],
)  # fmt: skip
def test_settings_take_numpys_numbers_as_pythons_own(of_numpy, plain):
    assert of_numpy() == plain()
    # An int64 has no JSON, a float32 no float's text.
    assert json.dumps(of_numpy().to_dict()) == json.dumps(plain().to_dict())


def test_a_budget_takes_them_too():
    budget = Budget(seconds=np.float32(2), network_rows=np.int64(600))
    assert repr(budget) == "Budget(seconds=2.0, network_rows=600)"


@pytest.mark.parametrize(
    "size", [(8, 2.5), (0, 8), (8,), 8, "88", (True, 8), np.ones((2, 2)), np.array(5), b"ab"]
)
def test_a_size_that_is_no_pair_of_whole_numbers_is_named(size):
    camera = Camera(np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), np.eye(4), 8, 8)
    depth = np.full((8, 8), 2.0)
    wall = Surface(depth, np.broadcast_to([0.0, 0, -1], (8, 8, 3)))
    view = warp_surfaces(camera, camera, wall, wall)
    for ask in (
        lambda: resize_depth(depth, size),
        lambda: resize_mask(torch.ones(8, 8, dtype=torch.bool), size),
        lambda: correspond_at(camera, camera, depth, size),
        lambda: correspond_at(camera, camera, depth, (4, 4), source_size=size),
        lambda: layer_size(camera, camera, size),
        lambda: view.at(size),
        lambda: view.at((4, 4), source_size=size),
    ):
        with pytest.raises(
            ValueError, match=r"(?s)size: got .*expected \(height, width\) of whole"
        ):
            ask()


def test_a_size_of_numpy_or_torch_is_one_of_whole_numbers():
    for size in (np.array([4, 6]), torch.zeros(4, 6).shape, [np.int64(4), 6]):
        assert check.size(size, "size") == (4, 6)
        assert all(type(side) is int for side in check.size(size, "size"))


@pytest.mark.door
@pytest.mark.parametrize("value", [10**400, np.longdouble("1e4000"), np.nan, True])
def test_a_number_that_no_float_holds_is_named(value):
    with pytest.raises(ValueError, match=r"a0: got .*, expected a number in \[0, 1\]"):
        check.number(value, 0, 1, "a0")
