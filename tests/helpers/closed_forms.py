"""Cameras, spheres and planes whose views have a closed form."""

import numpy as np
import torch

from attnwarp import Camera, Gaussians
from attnwarp_eval.stability.closed_forms import orbit, plane_depth, sphere

__all__ = [
    "apply",
    "area",
    "faces",
    "homography",
    "orbit",
    "plane_depth",
    "rolled",
    "shell",
    "skewed",
    "sphere",
]


def faces(camera, points, normals):
    """(...) bool: a point of a convex body is seen exactly where its outward normal looks at the
    camera.
    """
    return ((camera.position - points) * normals).sum(-1) > 0


def rolled(camera, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return Camera(camera.K, turn @ camera.world_to_camera, camera.width, camera.height)


def homography(source, target, normal, offset):
    """The source position of target pixels on the plane normal . X = offset: K_s (R + t n^T / d)
    K_t^-1.
    """
    relative = source.world_to_camera @ np.linalg.inv(target.world_to_camera)
    n = target.rotation @ np.asarray(normal, float)
    d = offset - np.dot(normal, target.position)
    return (
        source.K @ (relative[:3, :3] + np.outer(relative[:3, 3], n) / d) @ np.linalg.inv(target.K)
    )


def apply(H, xy):
    p = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1) @ H.T
    return p[..., :2] / p[..., 2:]


def skewed(camera):
    """The camera with fx != fy, skew and a principal point outside the image."""
    K = camera.K.copy()
    K[0] = [1.3 * K[0, 0], 0.1 * K[0, 0], -0.4 * camera.width]
    return Camera(K, camera.world_to_camera, camera.width, camera.height)


def area(camera, normal):
    """Area of the unit sphere behind each pixel, up to a constant: z^3 / (distance cos), distance
    and cos as there.
    """
    ray = camera.position - normal
    z = -(ray @ camera.rotation.T)[..., 2]
    return z**3 / (ray * normal).sum(-1)


def shell(n=20_000, kind="2d"):
    """A unit sphere of surfels (Fibonacci lattice)."""
    k = np.arange(n) + 0.5
    polar, turn = np.arccos(1 - 2 * k / n), np.pi * (1 + 5**0.5) * k
    p = np.stack(
        [np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=-1
    )
    # The rotation that takes z to p: about z x p, half the angle in the quaternion.
    q = np.stack([1 + p[:, 2], -p[:, 1], p[:, 0], np.zeros(n)], axis=-1)
    spacing = float(np.sqrt(4 * np.pi / n))
    scales = torch.full((n, 2), 0.6 * spacing)
    if kind == "3d":
        scales = torch.cat([scales, torch.full((n, 1), 0.05 * spacing)], dim=1)
    return Gaussians(
        kind,
        torch.from_numpy(p).float(),
        torch.from_numpy(q).float(),
        scales,
        torch.full((n,), 0.99),
        Gaussians.sh_from_rgb(torch.from_numpy(0.5 + 0.4 * p).float()),
    )
