"""Meshes of depth maps. Oracle: the depth of a sphere in closed form, and areas."""

import math

import numpy as np

from attnwarp.camera import Camera
from attnwarp_eval._open3d import open3d
from attnwarp_eval.splats.mesh import fused_mesh, mesh_points, thinned

RADIUS, CENTER, VOXEL = 0.5, np.array([0.3, -0.2, 0.1]), 0.02


def sphere_depth(camera):
    """(H, W) depth of a sphere, NaN beside it."""
    rays = camera.directions() @ camera.rotation  # of depth 1
    toward = CENTER - camera.position
    a, b = (rays**2).sum(-1), rays @ toward
    root = b**2 - a * (toward @ toward - RADIUS**2)
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.nan)


def around(count):
    for k in range(count):
        yaw, height = 2 * math.pi * k / count, (-1) ** k * 1.2
        at = CENTER + np.array([2 * math.cos(yaw), 2 * math.sin(yaw), height])
        yield Camera.look_at(at, CENTER, width=96, height=96, fov_y=35)


def test_a_sphere_has_its_radius_to_within_a_voxel():
    cameras = list(around(12))
    mesh = fused_mesh([sphere_depth(c) for c in cameras], cameras, voxel=VOXEL)
    points, normals = mesh_points(mesh, VOXEL / 2)
    offset = points - CENTER
    distance = np.linalg.norm(offset, axis=1)
    assert abs(np.median(distance) - RADIUS) < VOXEL / 8
    assert np.quantile(np.abs(distance - RADIUS), 0.95) < VOXEL
    # |x|^2 = 2 c x + (r^2 - |c|^2), by least squares. Half a pixel is 0.008, and would move it.
    rows = np.column_stack([2 * points, np.ones(len(points))])
    found = np.linalg.lstsq(rows, (points**2).sum(1), rcond=None)[0]
    np.testing.assert_allclose(found[:3], CENTER, atol=VOXEL / 8)
    cosine = np.abs((normals * offset).sum(1)) / distance
    assert np.median(cosine) > 0.98
    area = mesh.get_surface_area()
    assert len(points) == round(area / (VOXEL / 2) ** 2)
    assert abs(area / (4 * math.pi * RADIUS**2) - 1) < 0.1


def test_depth_that_is_nowhere_defined_gives_an_empty_mesh():
    camera = next(around(1))
    for empty in (np.full((96, 96), np.nan), np.zeros((96, 96)), np.full((96, 96), -np.inf)):
        mesh = fused_mesh([empty], [camera], voxel=VOXEL)
        points, normals = mesh_points(mesh, VOXEL)
        assert points.shape == normals.shape == (0, 3)


def test_one_pixel_of_depth_is_no_error():
    camera = next(around(1))
    depth = np.full((96, 96), np.nan)
    depth[40, 40] = 2.0
    points, _ = mesh_points(fused_mesh([depth], [camera], voxel=VOXEL), VOXEL / 2)
    assert len(points) < 20


def test_points_of_a_mesh_are_spread_by_area():
    box = open3d().geometry.TriangleMesh.create_box(2, 1, 1)  # 2 + 2 + 4 * 2 = 10
    points, normals = mesh_points(box, 0.05, seed=3)
    assert len(points) == 4000
    ends = np.abs(normals[:, 0]) > 0.5  # two sides of area 1
    assert abs(ends.mean() - 0.2) < 4 * math.sqrt(0.2 * 0.8 / 4000)
    assert np.array_equal(points, mesh_points(box, 0.05, seed=3)[0])


def test_thinned_points_have_a_cube_each():
    points = np.random.default_rng(0).uniform(-1, 1, size=(5000, 3))
    kept = thinned(points, 0.25)
    cubes = {tuple(cube) for cube in np.floor(points / 0.25).astype(int)}
    assert len(kept) == len(cubes) == len({tuple(c) for c in np.floor(points[kept] / 0.25)})
