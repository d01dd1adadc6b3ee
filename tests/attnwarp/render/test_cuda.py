"""The GPU backend without a GPU: what it refuses, and how it makes the outputs from composited
features.
"""

from __future__ import annotations

import dataclasses
import types

import pytest
import torch

from attnwarp import Camera
from attnwarp.render import api, constants, cuda, reference, render
from attnwarp.render.interface import Inputs
from attnwarp.warp import preset, render_surface


def prepared(splats, camera, depth: str = "center") -> Inputs:
    ndc = (constants.NDC_NEAR, constants.NDC_FAR)
    return api._prepare(
        splats, camera, depth, None, None, None, constants.NEAR, None, None, ndc, on_cpu=False
    )


def square_pixels(camera: Camera) -> Camera:
    """The camera without its skew, which gsplat does not know."""
    K = camera.K.copy()
    K[0, 1] = 0
    return Camera(K, camera.world_to_camera, camera.width, camera.height)


def brute_force(inputs: Inputs, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Stands in for gsplat's kernels: the definition, compositing the same features over
    nothing."""
    zero = torch.zeros(features.shape[1], dtype=torch.float64)
    swapped = dataclasses.replace(inputs, values=features.double(), harmonic=False, background=zero)
    view = reference.render(swapped)
    return view.color, view.alpha


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_outputs_are_made_from_composited_features(kind, make_camera, make_splats) -> None:
    camera = make_camera(3, 18, 14)
    splats = make_splats(3, kind, 30, camera)
    splats = splats.select(torch.tensor([i for i in range(30) if i not in (0, 1, 7)]))
    inputs = prepared(splats, camera)
    made, expected = cuda.composite(inputs, brute_force), reference.render(inputs)
    for name in ("color", "alpha", "depth", "normal", "distortion_l2_ndc", "weight"):
        a, b = getattr(made, name).detach(), getattr(expected, name)
        assert torch.equal(a.isnan(), b.isnan()), name
        # Features pass through float32, as on the GPU.
        assert float((a - b).abs().nan_to_num().max()) < 1e-5, name
    # What the docstrings of the door say is not there.
    for name in ("median_depth", "distortion_ordered", "distortion_l1"):
        assert bool(getattr(made, name).isnan().all()), name
    assert made.counters == {"splats": 27} and not made.weight.requires_grad


def test_weights_need_no_gradients_from_the_caller(make_camera, make_splats) -> None:
    camera = make_camera(3, 18, 14)
    splats = make_splats(3, "3d", 30, camera)
    splats = splats.select(torch.tensor([i for i in range(30) if i not in (0, 1, 7)]))
    inputs = dataclasses.replace(
        prepared(splats, camera), means=splats.means.clone().requires_grad_()
    )
    expected = reference.render(inputs)
    with torch.no_grad():
        made = cuda.composite(inputs, brute_force)
    assert not made.color.requires_grad and not made.weight.requires_grad
    assert float((made.weight - expected.weight.detach()).abs().max()) < 1e-5
    assert float((made.color - expected.color.detach()).abs().max()) < 1e-5
    # With gradients they still reach the splats.
    (grad,) = torch.autograd.grad(cuda.composite(inputs, brute_force).color.sum(), inputs.means)
    assert float(grad.abs().sum()) > 0


def test_what_gsplat_computes_differently_is_refused(make_camera, make_splats, monkeypatch) -> None:
    camera = square_pixels(make_camera(3, 8, 8))
    flat, solid = make_splats(3, "2d", 5, camera), make_splats(3, "3d", 5, camera)
    monkeypatch.delenv(cuda.ACCEPT_2D, raising=False)
    with pytest.raises(
        ValueError,
        match="depth: got 'intersection', but gsplat knows the depth of a splat's centre",
    ):
        render(flat, camera, backend="cuda")
    with pytest.raises(ValueError, match="depth: got 'peak'"):
        render(solid, camera, backend="cuda", depth="peak")
    with pytest.raises(ValueError, match=f"{cuda.ACCEPT_2D}=1"):
        render(flat, camera, backend="cuda", depth="center")
    monkeypatch.setenv(cuda.ACCEPT_2D, "1")
    cuda.refuse(prepared(flat, camera))
    cuda.refuse(prepared(solid, camera))


def test_a_camera_with_skew_is_refused(make_camera, make_splats) -> None:
    skewed = make_camera(3, 8, 8)
    solid = make_splats(3, "3d", 5, skewed)
    assert skewed.K[0, 1] != 0
    # Before it is asked whether there is a GPU: the answer would be the same on one.
    with pytest.raises(
        ValueError,
        match=r"camera: K\[0, 1\], its skew, is [-0-9.]+, but gsplat reads only.*backend 'cpu'",
    ):
        render(solid, skewed, backend="cuda", depth="center")
    cuda.refuse(prepared(solid, square_pixels(skewed)))
    # What the CPU draws depends on it: to leave it out would be a wrong picture, not a detail.
    with_skew, without = (
        render(solid, camera, backend="cpu").color for camera in (skewed, square_pixels(skewed))
    )
    assert float((with_skew - without).abs().max()) > 1e-2


@pytest.mark.door
def test_it_says_why_it_cannot_run(make_camera, make_splats, monkeypatch) -> None:
    camera = square_pixels(make_camera(3, 8, 8))
    solid = make_splats(3, "3d", 5, camera)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(
        RuntimeError, match="backend: 'cuda' needs a GPU that torch can see; or use backend 'cpu'"
    ):
        render(solid, camera, backend="cuda", depth="center")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RuntimeError, match="needs gsplat"):
        render(solid, camera, backend="cuda", depth="center")


def test_auto_is_the_cpu_for_splats_in_main_memory(make_camera, make_splats) -> None:
    camera = make_camera(3, 8, 8)
    assert render(make_splats(3, "2d", 5, camera), camera).backend == "cpu"


def test_a_warp_is_told_that_there_is_no_median_depth(
    make_camera, make_splats, monkeypatch
) -> None:
    """Its mask would be empty, and blame the poses."""
    camera = square_pixels(make_camera(3, 8, 8))
    splats = make_splats(3, "3d", 5, camera)
    made = cuda.composite(prepared(splats, camera), brute_force)
    made = types.SimpleNamespace(**vars(made), backend="cuda")
    monkeypatch.setattr("attnwarp.render.render", lambda *_, **__: made)
    median = preset("corrected", depth="center")
    with pytest.raises(ValueError, match="got 'median', which backend 'cuda' does not have"):
        render_surface(splats, camera, median)
    expected = dataclasses.replace(median, depth_statistic="expected")
    assert torch.equal(render_surface(splats, camera, expected).alpha, made.alpha)
