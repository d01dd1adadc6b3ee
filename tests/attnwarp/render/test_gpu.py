"""The GPU backend on Warp's CPU device. What its pictures and gradients are is tested beside the CPU
backend's, against the same oracles."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from rounding import excess, maps_and_gradients, prepared

from attnwarp.render import render


@pytest.mark.usefixtures("one_thread")
def test_a_picture_agrees_with_the_definition(make_camera, make_splats) -> None:
    camera = make_camera(7, 21, 18)
    assert (
        max(excess(prepared(make_splats(7, "2d", 20, camera), camera), backend="gpu").values())
        < 1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize("architecture", [80, 90])
def test_every_kernel_compiles_for_a_gpu_that_is_not_here(architecture: int, tmp_path) -> None:
    from attnwarp.render import gpu

    for module in gpu.MODULES:
        (binary,) = gpu.wp.compile_aot_module(
            module, arch=architecture, module_dir=tmp_path, use_ptx=False
        )
        assert binary.name.endswith(f".sm{architecture}.cubin")
        assert binary.read_bytes()[:4] == b"\x7fELF"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_two_runs_have_the_same_bits(kind: str, make_camera, make_splats) -> None:
    camera = make_camera(2, 67, 45)
    start = make_splats(2, kind, 500, camera)
    runs = [maps_and_gradients(start, camera, "gpu") for _ in range(2)]
    assert all(map(torch.equal, *runs))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_splats_equal_in_depth_and_centre_are_ordered_by_the_rest(
    dtype: torch.dtype, facing, front_camera
) -> None:
    """Oracle: the reference, which orders them by all that they are."""
    splats = facing([[0.0, 0, 3]] * 5 + [[-0.0, 0, 3]], 0.3, [0.5, 0.3, 0.5, 0.4, 0.5, 0.5])
    splats.sh[:, 0] = torch.arange(18, dtype=torch.float64).reshape(6, 3) / 9
    splats.scales[2, 1] = 0.25
    splats = splats.to(dtype=dtype)
    expected = render(splats, front_camera(9), backend="reference").color
    for seed in range(4):
        shuffled = splats.select(torch.randperm(6, generator=torch.Generator().manual_seed(seed)))
        color = render(shuffled, front_camera(9), backend="gpu").color
        assert float((color - expected).abs().max()) < 1e-6


@pytest.mark.slow
def test_a_picture_changed_in_place_keeps_its_gradients(make_camera, make_splats) -> None:
    camera = make_camera(4, 16, 16)
    splats = make_splats(4, "2d", 20, camera)

    def gradient(change: bool) -> torch.Tensor:
        means = splats.means.clone().requires_grad_()
        view = render(dataclasses.replace(splats, means=means), camera, backend="gpu")
        outputs = [view.depth, view.distortion_ordered]
        if change:
            with torch.no_grad():
                view.alpha.zero_()
                view.depth.zero_()
        (grad,) = torch.autograd.grad(outputs, means, [torch.ones(16, 16)] * 2)
        return grad

    assert torch.equal(gradient(True), gradient(False))
