"""The door: every argument is checked, small cases work, and a backend is chosen without
surprises."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from backends import GPU

from attnwarp import Camera, Gaussians
from attnwarp.render import api, render


def gaussians(n: int = 3, kind: str = "2d", dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    return Gaussians(
        "2d" if kind == "2d" else "3d",
        torch.randn(n, 3, generator=generator).to(dtype) * 0.3,
        torch.randn(n, 4, generator=generator).to(dtype),
        torch.full((n, 2 if kind == "2d" else 3), 0.2, dtype=dtype),
        torch.full((n,), 0.5, dtype=dtype),
        torch.zeros(n, 4, 3, dtype=dtype),
    )


def camera(width: int = 12, height: int = 10) -> Camera:
    return Camera.look_at([0, -3, 0], [0, 0, 0], width=width, height=height, fov_y=50)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"backend": "cppu"}, "backend: got 'cppu'.*did you mean 'cpu'"),
        ({"depth": "centre"}, "depth: got 'centre'.*did you mean 'center'"),
        ({"depth": "peak"}, "depth: 'peak' is for kind '3d'"),
        ({"near": 0.0}, "near: got 0.0, expected a positive depth"),
        ({"near": float("nan")}, "near: got nan"),
        (
            {"background": [1.0, 0.0]},
            r"background: got shape \(2\), expected \(3\)|background: got shape \(2,\)",
        ),
        ({"background": [1.0, 0.0, float("inf")]}, "background: inf at index"),
        ({"features": torch.zeros(2, 5)}, "features: got shape"),
        ({"features": torch.zeros(3, 0)}, "features: got 0 channels"),
        ({"features": torch.zeros(3, 2, dtype=torch.float16)}, "features: got torch.float16"),
        ({"features": torch.full((3, 2), torch.nan)}, "features: nan at index"),
        (
            {"features": torch.zeros(3, 2), "sh_degree": 1},
            "sh_degree: has no meaning beside features",
        ),
        ({"sh_degree": 2}, "sh_degree: got 2, expected 0 to 1"),
        ({"antialiased": True}, "antialiased: applies to kind '3d' only"),
        ({"pose": torch.zeros(3, 4)}, "pose: got shape"),
        ({"pose": torch.eye(4) * 2}, "pose: got last row"),
        (
            {"pose": torch.diag(torch.tensor([1.0, 1, 1.001, 1]))},
            "pose: its rotation is mirrored or not orthonormal",
        ),
        ({"pose": torch.diag(torch.tensor([1.0, 1, -1, 1]))}, "pose: its rotation is mirrored"),
    ],
)
def test_a_bad_argument_is_named_with_what_came_and_what_was_expected(
    arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        render(gaussians(), camera(), **arguments)


@pytest.mark.door
def test_intersection_of_3d_splats_is_refused_with_the_remedy() -> None:
    with pytest.raises(ValueError, match="use 'peak'"):
        render(gaussians(kind="3d"), camera(), depth="intersection")


@pytest.mark.door
def test_other_types_are_refused() -> None:
    with pytest.raises(TypeError, match="gaussians: got int"):
        render(3, camera())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="camera: got str"):
        render(gaussians(), "front")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="pose: got list"):
        render(gaussians(), camera(), pose=np.eye(4).tolist())  # type: ignore[arg-type]


@pytest.mark.door
@pytest.mark.parametrize("background", ["white", ["1", "1", "1"], [1.0, None, 1.0], object()])
def test_a_background_that_is_no_numbers_is_named_with_how_many_are_expected(
    background: Any,
) -> None:
    # Four features, so that the number is not that of colours.
    with pytest.raises(TypeError, match=r"background: got .*expected .* sequence of 4 numbers"):
        render(gaussians(), camera(), background=background, features=torch.zeros(3, 4))
    with pytest.raises(TypeError, match="background: got .*, expected a tensor or .* 3 numbers"):
        render(gaussians(), camera(), background=background)


@pytest.mark.parametrize("backend", ["cpu", "reference", GPU])
@pytest.mark.parametrize("kind", ["2d", "3d"])
@pytest.mark.parametrize("size", [(1, 1), (7, 1), (1, 9), (9, 17)])
def test_no_splats_and_small_images_work(backend: str, kind: str, size: tuple[int, int]) -> None:
    for n in (0, 1, 3):
        splats = gaussians(n, kind)
        splats.means.requires_grad_()
        view = render(splats, camera(*size), backend=backend, background=[0.1, 0.2, 0.3])
        assert view.color.shape == (size[1], size[0], 3)
        assert view.normal_from_depth.shape == (size[1], size[0], 3)
        assert view.weight.shape == (n,)
        view.color.sum().backward()
        if n == 0:
            assert not bool(view.valid.any())
            assert torch.allclose(view.color, torch.tensor([0.1, 0.2, 0.3]).to(view.color.dtype))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_precisions_are_taken(dtype: torch.dtype) -> None:
    view = render(gaussians(dtype=dtype), camera())
    assert view.color.dtype == torch.float32
    assert (
        render(gaussians(dtype=dtype), camera(), backend="reference").color.dtype == torch.float64
    )


def test_a_pose_replaces_the_cameras() -> None:
    other = Camera.look_at([1, -2, 0.5], [0, 0, 0], width=12, height=10, fov_y=50)
    moved = render(gaussians(), camera(), pose=torch.tensor(other.world_to_camera))
    assert torch.equal(moved.color, render(gaussians(), other).color)
    assert np.array_equal(moved.camera.world_to_camera, other.world_to_camera)


def test_features_replace_colour_in_any_number_of_channels() -> None:
    rgb = torch.rand(3, 7, generator=torch.Generator().manual_seed(2))
    seven = render(gaussians(), camera(), features=rgb, background=torch.arange(7) / 7)
    assert seven.color.shape == (10, 12, 7)
    for k in range(7):
        one = render(gaussians(), camera(), features=rgb[:, k : k + 1], background=[k / 7])
        assert torch.equal(one.color[..., 0], seven.color[..., k])


def test_counters_say_what_was_done() -> None:
    counters = render(gaussians(), camera()).counters
    assert counters["splats"] == counters["visible"] == 3
    assert counters["tiles"] == 1
    assert render(gaussians(), camera(17, 33)).counters["tiles"] == 2 * 3
    assert 0 < counters["contributing"] <= counters["composited"] <= counters["pairs"]
    assert counters["pairs"] % 16 == counters["composited"] % 16 == 0


@pytest.mark.door
def test_normal_from_depth_refuses_a_depth_of_another_size() -> None:
    with pytest.raises(ValueError, match="depth: got shape"):
        api.normal_from_depth(torch.ones(3, 3), camera())


def test_normals_lie_where_their_depth_does() -> None:
    # The device of shapes alone takes no tensor of the CPU beside its own, as a GPU takes none.
    view = camera()
    depth = torch.ones(view.height, view.width, device="meta")
    normal = api.normal_from_depth(depth, view)
    assert normal.device == depth.device
    assert normal.shape == (view.height, view.width, 3)


@pytest.mark.door
@pytest.mark.parametrize("features", [[[1.0], [2.0], [3.0]], "red"])
def test_features_that_are_no_array_are_refused_by_name(features) -> None:
    with pytest.raises(TypeError, match=r"features: got \w+, expected a torch.Tensor"):
        render(gaussians(), camera(), features=features)
