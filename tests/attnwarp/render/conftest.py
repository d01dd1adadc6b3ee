"""Scenes that the render tests share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch_threads import on_one_thread

from attnwarp import Camera, Gaussians
from attnwarp_eval.stability.rendered import front_camera, quaternion_to, splats


def camera_of(seed: int, width: int, height: int) -> Camera:
    """A camera near (0, -3, 0.3) with unequal focal lengths, skew and an off-centre principal
    point.
    """
    rng = np.random.default_rng(seed)
    position = np.array([0.0, -3.0, 0.3]) + rng.uniform(-0.3, 0.3, 3)
    view = Camera.look_at(position, rng.uniform(-0.2, 0.2, 3), width=width, height=height, fov_y=55)
    focal = rng.uniform(0.7, 1.4, 2) * max(width, height)
    center = rng.uniform(0.2, 0.8, 2) * [width, height]
    K = np.array([[focal[0], rng.uniform(-2, 2), center[0]], [0, focal[1], center[1]], [0, 0, 1]])
    return Camera(K, view.world_to_camera, width, height)


def splats_of(seed: int, kind: str, count: int, camera: Camera, degree: int = 3) -> Gaussians:
    """Random splats before a camera; among them, when there are enough: one crossing the camera
    plane, one behind it, edge-on ones, a needle, opacities 0 and 1, equal depths, duplicates, one
    far off the image."""
    rng = np.random.default_rng(seed + 1000)
    means = rng.normal(size=(count, 3)) * 0.5
    quats = rng.normal(size=(count, 4))
    scales = np.exp(rng.uniform(np.log(0.01), np.log(0.3), size=(count, 2 if kind == "2d" else 3)))
    opacities = rng.uniform(0.02, 1, size=count)
    sh = rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.4
    R, position = camera.rotation, camera.position
    if count >= 12:
        means[0] = position + R.T @ np.array([0.1, 0.3, 0.05])  # its disc reaches behind the camera
        scales[0] = 0.5
        means[1] = position + R.T @ np.array([0.2, -0.2, -0.1])  # centre behind, edge in front
        scales[1] = 0.4
        opacities[2], opacities[3] = 0.0, 1.0
        means[4:7] = (
            position + (R.T @ np.array([[0.1, 0.2, 2.5], [-0.2, 0.1, 2.5], [0.05, -0.1, 2.5]]).T).T
        )
        for name in (means, quats, scales, opacities, sh):
            name[7] = name[8]
        quats[9] = edge_on(means[9], camera, rng.uniform(0, 2 * np.pi), 1e-9)
        quats[10] = edge_on(means[10], camera, rng.uniform(0, 2 * np.pi), 1e-3)
        scales[11] = 2e-3
        scales[11, 0] = 0.5
    tensors = [torch.tensor(a) for a in (means, quats, scales, opacities, sh)]
    return Gaussians("2d" if kind == "2d" else "3d", *tensors)


def edge_on(mean: np.ndarray, camera: Camera, roll: float, tilt: float) -> np.ndarray:
    """Quaternion (wxyz) of a splat at ``mean`` whose normal makes pi/2 - ``tilt`` with the ray to
    it.
    """
    ray = mean - camera.position
    ray = ray / np.linalg.norm(ray)
    side = np.cross(ray, [0.3, 0.5, 0.8])
    side = side / np.linalg.norm(side)
    up = np.cross(ray, side)
    normal = np.cos(tilt) * (np.cos(roll) * side + np.sin(roll) * up) + np.sin(tilt) * ray
    return quaternion_to(normal)


one_thread = pytest.fixture(on_one_thread)


@pytest.fixture
def make_camera() -> Callable[..., Camera]:
    return camera_of


@pytest.fixture
def make_splats() -> Callable[..., Gaussians]:
    return splats_of


@pytest.fixture
def facing() -> Callable[..., Gaussians]:
    """Discs or balls at chosen points, facing a camera at the origin that looks along +z."""
    return splats


@pytest.fixture(name="front_camera")
def front_camera_fixture() -> Callable[..., Camera]:
    """Camera at the origin looking along +z, principal point at the middle."""
    return front_camera
