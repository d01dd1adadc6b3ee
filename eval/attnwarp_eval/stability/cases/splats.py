"""Hard cases of rendering: splats edge-on, tiny, huge, opaque, invisible, in great numbers."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp_eval.stability.case import Bound, Case
from attnwarp_eval.stability.rendered import (
    ALPHA,
    RENDERERS,
    Shot,
    against_exact,
    front_camera,
    render_bounds,
    splats,
)

CROSS = [(16, 16), (16, 17), (15, 16), (17, 18), (19, 16), (16, 13)]
"""Pixels around the middle of a picture of 33 x 33."""

MP = "the renderer's formulas in mpmath with 50 digits, gradients by central differences"


def _edge_on(tilt: float) -> Shot:
    angle = math.radians(tilt)
    splat = splats([[0, 0, 4]], 0.1, 0.9, normals=[[math.sin(angle), 0, -math.cos(angle)]])
    pixels = [(10, 10), (10, 11), (9, 10), (12, 9), (10, 9), (13, 10)]
    return Shot(splat, front_camera(21, 100.0), pixels)


def _far_world(offset: float) -> Shot:
    shift = [offset, -offset, offset / 2]
    base = splats([[0, 0, 4], [0.2, 0.1, 5]], 0.3, [0.6, 0.8], normals=[[0.6, 0, -0.8]] * 2)
    return Shot(dataclasses.replace(base, origin=np.array(shift)), front_camera().moved(shift), CROSS)


def _quaternion(length: float) -> Shot:
    turn = np.array([math.cos(0.4), 0, math.sin(0.4), 0]) * length
    return Shot(splats([[0, 0, 4]], [0.5, 0.2], 0.8, quats=[turn]), front_camera(), CROSS)


def _opacity(kind: str):  # type: ignore[no-untyped-def]
    def build(opacity: float) -> Shot:
        made = splats([[0, 0, 3], [0, 0, 4]], 0.3, [opacity, 0.5], kind=kind)
        return Shot(made, front_camera(), CROSS)

    return build


def _needle(thickness: float) -> Shot:
    scales = torch.tensor([thickness, 0.3, thickness], dtype=torch.float64)
    turn = [math.cos(0.2), 0.1, 0.05, math.sin(0.2)]
    return Shot(splats([[0, 0, 4]], scales, 0.8, kind="3d", quats=[turn]), front_camera(), CROSS)


def _floor(sigma: float) -> Shot:
    camera = Camera.look_at([0, 0, 1], [0, 5, 1], width=48, height=40, fov_y=80)
    floor = Gaussians(
        "2d",
        torch.zeros(1, 3, dtype=torch.float64),
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        torch.full((1, 2), sigma, dtype=torch.float64),
        torch.full((1,), 0.9, dtype=torch.float64),
        torch.zeros(1, 1, 3, dtype=torch.float64),
    )
    return Shot(floor, camera, [(19, 24), (20, 24), (21, 10), (25, 40), (39, 24), (0, 24)])


def _faint(opacity: float) -> Shot:
    made = splats([[0, 0, 4], [0.05, 0, 6]], 0.1, opacity, normals=[[0.6, 0, -0.8]] * 2)
    return Shot(made, front_camera(), CROSS)


CASES = [
    Case(
        2,
        "edge_on_splat",
        "A flat splat seen edge-on",
        input="a disc of sigma 0.1 at depth 4, turned away from the camera",
        oracle=MP,
        hardness="tilt, degrees",
        levels=(0, 60, 80, 89, 89.9, 89.99, 89.999, 89.9999, 89.99999),
        required=89.99,
        required_backward=89.9,
        quick=(60, 89, 89.999),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_edge_on, ("alpha",)),
        group="splats",
    ),
    Case(
        2,
        "edge_on_depth",
        "The depth of a flat splat seen edge-on",
        input="the disc of `edge_on_splat`",
        oracle=MP,
        hardness="tilt, degrees",
        levels=(0, 60, 80, 89, 89.9, 89.99, 89.999, 89.9999, 89.99999),
        required=89.9,
        required_backward=89.9,
        quick=(60, 89, 89.999),
        bounds=render_bounds(
            Bound("relative depth", 1e-5, "the tilted plane's slope multiplies rounding errors")
        ),
        ways=RENDERERS,
        measure=against_exact(_edge_on, ("depth",)),
        group="splats",
    ),
    Case(
        9,
        "far_world_splats",
        "Splats in a world far from its origin",
        input="two discs whose origin, and the camera's, are moved",
        oracle=MP,
        hardness="offset of the world, scene units",
        levels=(0, 1e2, 1e4, 1e6, 1e7, 1e8, 1e9, 1e11, 1e13),
        required=1e6,
        quick=(1e2, 1e6, 1e9),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_far_world),
        group="splats",
    ),
    Case(
        16,
        "short_quaternion",
        "A quaternion of length almost 0",
        input="a turned disc whose quaternion is scaled",
        oracle=MP,
        hardness="length of the quaternion",
        levels=(1, 1e-3, 1e-6, 1e-12, 1e-18, 1e-22, 1e-30, 1e-38, 1e-44, 0),
        required=1e-18,
        quick=(1, 1e-12, 0),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_quaternion),
        must_refuse=lambda level, way: level == 0,
        group="splats",
    ),
    *(
        Case(
            18,
            f"opacity_to_0_{kind}",
            f"A {kind.upper()} splat whose opacity goes to 0",
            input="a splat before another one of opacity 0.5",
            oracle=MP,
            hardness="opacity",
            levels=(0.5, 0.1, 0.01, 0.004, 1e-3, 1e-6, 1e-12, 0),
            required=0,
            quick=(0.5, 0.004, 0),
            bounds=render_bounds(),
            ways=RENDERERS,
            measure=against_exact(_opacity(kind)),
            group="splats",
        )
        for kind in ("2d", "3d")
    ),
    *(
        Case(
            19,
            f"opacity_to_1_{kind}",
            f"A {kind.upper()} splat whose opacity goes to 1",
            input="a splat before another one of opacity 0.5",
            oracle=MP,
            hardness="opacity",
            levels=(0.9, 0.98, 0.995, 0.9999, 1),
            required=1,
            quick=(0.9, 1),
            bounds=render_bounds(),
            ways=RENDERERS,
            measure=against_exact(_opacity(kind)),
            group="splats",
        )
        for kind in ("2d", "3d")
    ),
    Case(
        22,
        "faint_depth",
        "Expected depth where alpha is almost 0",
        input="two faint discs, one behind the other",
        oracle=MP,
        hardness="opacity of both",
        levels=(0.5, 0.1, 0.02, 0.008, 0.005, 0.0045, 0.003),
        required=0.003,
        quick=(0.5, 0.005, 0.003),
        bounds=render_bounds(
            Bound("relative depth", 1e-5, "a weight clamped from below would read half of it")
        ),
        ways=RENDERERS,
        measure=against_exact(_faint, ("depth",)),
        group="splats",
    ),
    Case(
        24,
        "needle",
        "A needle, whose covariance is almost singular",
        input="a 3D splat 0.3 long at depth 4",
        oracle=MP,
        hardness="thickness, scene units",
        levels=(0.1, 1e-2, 1e-4, 1e-6, 1e-9, 1e-12, 1e-20, 1e-30),
        required=1e-12,
        quick=(0.1, 1e-6, 1e-12),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_needle),
        group="splats",
    ),
    Case(
        39,
        "crossing_floor",
        "A splat that reaches behind the camera",
        input="a disc on the floor, 1 m under the camera",
        oracle=MP,
        hardness="sigma of the disc, m",
        levels=(1, 10, 100, 1e3, 1e4, 1e6, 1e8),
        required=1e4,
        quick=(1, 100, 1e4),
        bounds=render_bounds(ALPHA),
        ways=RENDERERS,
        measure=against_exact(_floor),
        group="splats",
    ),
]
