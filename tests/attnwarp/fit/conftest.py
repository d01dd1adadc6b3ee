"""A scene small enough to be fitted in a second: blobs of colour seen by a ring of cameras."""

import math

import numpy as np
import pytest
import torch
from torch_threads import on_one_thread

from attnwarp import Camera, Gaussians
from attnwarp.fit import Views
from attnwarp.render import render

SIZE = 32


def ring(count=10, size=SIZE, offset=(0.0, 0.0, 0.0)):
    cameras = []
    for k in range(count):
        yaw = 2 * math.pi * k / count
        position = np.array([3 * math.cos(yaw), 3 * math.sin(yaw), 0.5 + 0.3 * (k % 3)]) + offset
        name = f"{k:02d}.png"
        cameras.append(
            Camera.look_at(position, offset, width=size, height=size, fov_y=40, name=name)
        )
    return cameras


def blobs(count=40, seed=3, offset=(0.0, 0.0, 0.0)):
    random = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=random) * 0.35
    color = torch.rand(count, 3, generator=random)
    quats = torch.randn(count, 4, generator=random)
    scales = 0.08 + 0.1 * torch.rand(count, 3, generator=random)
    opacities = torch.full((count,), 0.9)
    return Gaussians(
        "3d", means, quats, scales, opacities, Gaussians.sh_from_rgb(color), origin=np.array(offset)
    )


def pictures(splats, cameras, *, alpha=False):
    images = []
    for camera in cameras:
        view = render(splats, camera)
        rgb = view.color.clamp(0, 1).numpy()
        if alpha:
            a = view.alpha.clamp(0, 1).numpy()[..., None]
            rgb = np.concatenate([np.clip(rgb / np.maximum(a, 1e-6), 0, 1), a], axis=2)
        images.append(rgb)
    return Views(cameras, images)


@pytest.fixture(scope="session")
def scene():
    """Views to fit on, views held out, and rough points with their colours."""
    truth, cameras = blobs(), ring()
    points = truth.world_means() + np.random.default_rng(0).normal(0, 0.05, (len(truth), 3))
    colors = np.full((len(truth), 3), 128, np.uint8)
    train = [c for k, c in enumerate(cameras) if k % 5]
    test = [c for k, c in enumerate(cameras) if k % 5 == 0]
    return pictures(truth, train), pictures(truth, test), points, colors


one_thread = pytest.fixture(on_one_thread, autouse=True, scope="package")
