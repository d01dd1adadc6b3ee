"""Bounds of a float32 picture of splats, from what the float64 reference gives when rounded.

An error is the distance to what the reference may give when its thresholds move by their rounding,
as a share of the value where that is above 1. With displacements each splat is also moved by what
float32 may round of a pixel's position: that part of an error is conditioning, which no renderer
escapes.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.render import api, constants, cpu, reference
from attnwarp.render.interface import OUTPUTS, Inputs

MODES = [
    ("2d", "intersection", None),
    ("2d", "center", None),
    ("3d", "center", False),
    ("3d", "peak", True),
]
"""Kind, depth, antialiased."""

ROUNDED_PIXELS = 21 * 2.0**-24
"""Distance by which float32 moves a splat in the picture, px.

A splat's u at a pixel is u_0 + u_x x + u_y y in float32, with (x, y) within 3.5 px of the middle of
8 x 8 pixels. Three coefficients, two products and two sums are rounded, of numbers up to |u_x x| +
|u_y y|, as u itself is about 1 where the splat is drawn: at most 6 x 2^-24 of that, 6 x 3.5 x 2^-24
px.
"""


def prepared(splats: Gaussians, camera: Camera, **options: object) -> Inputs:
    """Inputs of a backend, with the defaults of `render`."""
    given = dict.fromkeys(("depth", "background", "features", "sh_degree", "antialiased", "pose"))
    given |= {"near": constants.NEAR}
    return api._prepare(splats, camera, **(given | options), on_cpu=True)  # type: ignore[arg-type]


def leaves_of(splats: Gaussians) -> list[Tensor]:
    """Copies of the splats' parameters that take gradients."""
    parts = (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    return [part.clone().requires_grad_() for part in parts]


def maps_and_gradients(splats: Gaussians, camera: Camera, backend: str) -> list[Tensor]:
    """All outputs, and the gradients of their sum in all parameters and in the pose."""
    leaves = [*leaves_of(splats), torch.tensor(camera.world_to_camera).requires_grad_()]
    moved = Gaussians(splats.kind, *leaves[:5])
    view = api.render(moved, camera, pose=leaves[5], backend=backend)
    sum(getattr(view, name).nan_to_num().sum() for name in OUTPUTS).backward()
    maps = [getattr(view, name).detach().nan_to_num(-1) for name in OUTPUTS]
    return [*maps, *(leaf.grad for leaf in leaves)]


def mixed_scales(splats: Gaussians, seed: int, ratio: float) -> Gaussians:
    """The splats with each scale drawn anew, log-uniform about 1 over a ``ratio``; in float32, as
    files have them."""
    rng = np.random.default_rng(seed)
    reach = math.log(ratio) / 2
    scales = torch.tensor(np.exp(rng.uniform(-reach, reach, splats.scales.shape)))
    return dataclasses.replace(splats, scales=scales).to(dtype=torch.float32)


def displaced(inputs: Inputs, seed: int) -> Inputs:
    """Each splat moved across the picture by :data:`ROUNDED_PIXELS` in x and in y, to a random
    side."""
    rng = np.random.default_rng(seed)
    means, pose = inputs.means.double(), inputs.pose.detach().double()
    rotation = pose[:3, :3]
    depth = (means @ rotation.T + rotation @ inputs.origin.double() + pose[:3, 3])[:, 2].abs()
    signs = torch.tensor(rng.choice((-1.0, 1.0), (len(means), 2)))
    focal = torch.stack([inputs.K[0, 0], inputs.K[1, 1]]).double()
    step = ROUNDED_PIXELS * signs * depth[:, None] / focal
    return dataclasses.replace(inputs, means=means + step @ rotation[:2])


def bracket(inputs: Inputs, displacements: int = 0) -> dict[str, tuple[Tensor, Tensor]]:
    """Smallest and largest value of each output when every threshold is moved by what float32 may
    round.

    A pixel whose alpha is 1/255 to seven digits is drawn or not by rounding, in any renderer; what
    must hold is that the float32 answer is one of the two.

    Args:
        inputs: the scene.
        displacements: how many times the splats are moved, see :func:`displaced`.
    """
    t = reference.Thresholds()
    versions = [reference.render(inputs)]
    for sign in (-1, 1):
        versions += [
            reference.render(
                inputs, dataclasses.replace(t, alpha_min=t.alpha_min * (1 + sign * 2e-6))
            ),
            # Transmittance is a product of up to 40 factors, each with its own rounding.
            reference.render(inputs, dataclasses.replace(t, stop=t.stop * (1 + sign * 2e-5))),
            reference.render(inputs, dataclasses.replace(t, median=t.median * (1 + sign * 5e-6))),
            reference.render(dataclasses.replace(inputs, near=inputs.near * (1 + sign * 2e-6))),
        ]
    versions += [reference.render(displaced(inputs, seed)) for seed in range(displacements)]
    result = {}
    for name in OUTPUTS:
        stack = torch.stack([getattr(v, name) for v in versions])
        absent = stack.isnan()
        low = torch.where(absent, torch.inf, stack).amin(0)
        high = torch.where(absent, -torch.inf, stack).amax(0)
        low = torch.where(absent.any(0), -torch.inf, low)
        high = torch.where(absent.any(0), torch.inf, high)
        # NaN everywhere is an answer as well.
        result[name] = (
            torch.where(absent.all(0), torch.nan, low),
            torch.where(absent.all(0), torch.nan, high),
        )
    return result


def excess(inputs: Inputs, displacements: int = 0, backend: str = "cpu") -> dict[str, float]:
    """Distance by which each output of backend "cpu" or "gpu" lies outside of its bounds.

    Raises:
        AssertionError: an output is NaN where it is defined, or the other way round.
    """
    if backend == "cpu":
        actual = cpu.render(inputs)
    else:
        from attnwarp.render import gpu

        actual = gpu.render(inputs)
    expected = bracket(inputs, displacements)
    worst = {}
    for name in OUTPUTS:
        value, (low, high) = getattr(actual, name).double(), expected[name]
        assert not bool((value.isnan() & torch.isfinite(low)).any()), name
        assert bool(value.isnan()[low.isnan()].all()), name
        # Absolute on shares of a pixel; of the value's own size where it has a scale (depth in
        # scene units, weight in pixels, features of any size).
        beyond = torch.maximum(low - value, value - high) / value.abs().clamp(min=1)
        beyond = beyond[torch.isfinite(beyond)]
        worst[name] = max(0.0, float(beyond.max())) if beyond.numel() else 0.0
    return worst
