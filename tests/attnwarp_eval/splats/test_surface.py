import numpy as np
import pytest
import torch
from direct_light import direct
from scipy.spatial import cKDTree

from attnwarp.errors import InputError
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.shapes import Box, Rectangle, Sphere
from attnwarp_eval.splats.surface import (
    _eliminate,
    quaternions_from_normals,
    sample_surface,
    surface_splats,
)
from attnwarp_eval.truth import Geometry, appearance, edge_band
from attnwarp_eval.truth.shading import buried, frames

pytestmark = pytest.mark.usefixtures("coarse_textures")


@pytest.fixture(scope="module")
def scene():
    return load_scene("spheres").with_size(96, 96)


@pytest.fixture(scope="module")
def geometry(scene):
    return Geometry(scene)


def test_samples_lie_on_the_surface_with_its_normal(geometry, scene):
    s = sample_surface(geometry, 4000, center=scene.center, focus=2.0, seed=0)
    objects = geometry.object_of(s.primitive_id)
    shapes = scene.shapes()
    assert len(s.point) == 4000 and len(np.unique(objects)) == len(scene.object_names)
    for k in np.unique(objects):
        mine, shape = objects == k, shapes[k]
        if isinstance(shape, Sphere):
            outward = (s.point[mine] - shape.center) / shape.radius
            assert np.abs(np.linalg.norm(outward, axis=1) - 1).max() < 1e-12
            assert np.abs(outward - s.normal[mine]).max() < 1e-12
        else:
            assert np.abs((s.point[mine] - shape.center) @ shape.normal).max() < 1e-12
            assert np.abs(s.normal[mine] - shape.normal).max() < 1e-12


def test_blue_noise_keeps_its_distance_and_covers():
    square = Rectangle(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    s = sample_surface(Geometry([square]), 2000, center=(0, 0, 0), focus=1e6, seed=1)
    assert np.allclose(s.spacing, np.sqrt(4 / 2000))  # each point stands for its share of the area
    nearest = cKDTree(s.point).query(s.point, k=2)[0][:, 1] / s.spacing
    # Random points: 1st percentile 0.06, median 0.47. The densest packing has 1.07 everywhere.
    assert np.percentile(nearest, 1) > 0.55 and np.median(nearest) > 0.72
    grid = np.stack(np.meshgrid(*[np.linspace(-0.95, 0.95, 200)] * 2), -1).reshape(-1, 2)
    hole = cKDTree(s.point[:, :2]).query(grid)[0].max() / s.spacing[0]
    assert hole < 1.2  # random points leave holes of 1.7


def test_rounding_does_not_choose_which_samples_are_kept():
    random = np.random.default_rng(0)
    points = random.uniform(0, 1, (4000, 3)) * (1, 1, 0)
    normals, spacing = np.tile([0.0, 0, 1], (4000, 1)), np.full(4000, 0.03)
    # Other processors add in another order, and so differ in the last digits.
    other = points * (1 + random.uniform(-4e-16, 4e-16, points.shape))
    kept = _eliminate(points, normals, spacing, 400)
    np.testing.assert_array_equal(_eliminate(other, normals, spacing, 400), kept)


def test_the_density_falls_from_the_middle_outward_as_documented():
    square = Rectangle(np.zeros(3), np.array([6.0, 0, 0]), np.array([0, 6.0, 0]))
    s = sample_surface(Geometry([square]), 8000, center=(0, 0, 0), focus=1.5, seed=0)
    r = np.linalg.norm(s.point, axis=1)
    edges = np.array([0, 1, 2, 3, 4.5, 6])
    count, _ = np.histogram(r, edges)
    area = np.pi * np.diff(edges**2)
    density = 8000 / _mass(1.5, 6.0)
    middle = np.sqrt((edges[1:] ** 2 + edges[:-1] ** 2) / 2)
    # Within rings: patches of focus / 4 have one density each, and rings are wide.
    assert np.allclose(count / area, density / (1 + (middle / 1.5) ** 2), rtol=0.12)
    assert np.allclose(s.spacing**-2, density / (1 + (r / 1.5) ** 2), rtol=0.02)


def test_a_plane_to_the_horizon_is_sampled_by_its_density():
    # Patches of a quarter of the focus would be 200 million.
    plane = Rectangle(np.array([1000.0, 0, 0]), np.array([900.0, 0, 0]), np.array([0, 900.0, 0]))
    s = sample_surface(Geometry([plane]), 2000, center=(0, 0, 0), focus=1.0, seed=0)
    x = 100 + (np.arange(1800) + 0.5)
    # Of 1 / (1 + r^2) over y from -900 to 900.
    reach = np.sqrt(1 + x**2)
    mass = 2 * np.arctan(900 / reach) / reach
    edges = np.array([100, 200, 400, 800, 1900])
    share, _ = np.histogram(x, edges, weights=mass / mass.sum())
    count, _ = np.histogram(s.point[:, 0], edges)
    assert np.allclose(count / 2000, share, atol=0.015)


def test_a_sphere_that_takes_too_many_cells_is_refused_with_what_to_do():
    planet = Sphere(np.array([0.0, 0, -6e6]), 6e6)
    with pytest.raises(
        ValueError, match="focus: got 1 for a sphere of radius 6e.06.*at least 3.37e"
    ):
        sample_surface(Geometry([planet]), 100, center=(0, 0, 0), focus=1.0, seed=0)


def _mass(focus, half):
    x = (np.arange(800) + 0.5) / 800 * 2 * half - half
    return (1 / (1 + (x[:, None] ** 2 + x**2) / focus**2)).sum() * (2 * half / 800) ** 2


def test_nothing_is_put_where_two_things_touch_or_one_is_inside_the_other():
    outer, inner = Box(np.zeros(3), np.ones(3)), Sphere(np.zeros(3), 0.5)
    standing = Box(np.array([0, 0, 1.5]), np.full(3, 0.5))
    shapes = [outer, inner, standing]
    s = sample_surface(Geometry(shapes), 1500, center=(0, 0, 0), focus=10, seed=0)
    assert (np.linalg.norm(s.point, axis=1) > 0.6).all()  # none on the ball inside the box
    under = (np.abs(s.point[:, :2]) < 0.49).all(1) & (np.abs(s.point[:, 2] - 1) < 1e-9)
    assert not under.any()
    points, up = np.array([[0, 0, 1.0], [0.8, 0.8, 1.0]]), np.tile([0, 0, 1.0], (2, 1))
    hits = Geometry([outer]).trace_rays(points + 2 * up, -up)
    assert buried(Geometry(shapes), points, up, hits.primitive_id).tolist() == [True, False]


def test_a_closed_room_is_refused_with_what_to_do():
    room = [
        Rectangle(2 * sign * axis, np.roll(axis, 1) * 2, sign * np.roll(axis, 2) * 2)
        for axis in np.eye(3)
        for sign in (-1, 1)
    ]
    inward = [Rectangle(wall.center, wall.v, wall.u) for wall in room]
    sample_surface(Geometry(room), 50, center=np.zeros(3), focus=2.0, seed=0)
    with pytest.raises(InputError, match="seen from outside the scene; open what encloses it"):
        sample_surface(Geometry(inward), 50, center=np.zeros(3), focus=2.0, seed=0)


def test_quaternions_turn_z_into_the_normal_straight_down_too():
    random = np.random.default_rng(0).normal(size=(1000, 3))
    hard = [
        [0, 0, 1],
        [0, 0, -1],
        [1e-9, 0, -1],
        [0, -1e-12, -1],
        [1, 0, 0],
        [0, 1, 0],
        [1, 0, -1e-17],
    ]
    n = np.concatenate([random, np.array(hard, dtype=float)])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    w, x, y, z = quaternions_from_normals(n).T
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    assert np.abs(third - n).max() < 1e-15 * 4
    t, b = frames(n)
    assert (
        np.abs(np.cross(t, b) - n).max() < 1e-14
        and np.abs(np.einsum("ij,ij->i", t, n)).max() < 1e-14
    )


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_splats_are_flat_on_the_surface_and_sized_by_the_spacing(scene, geometry, kind):
    g = surface_splats(scene, kind, 3000, geometry=geometry, size=0.7, thickness=0.2)
    s = sample_surface(
        geometry, 3000, center=scene.center, focus=scene.spec.cameras.radius / 3, seed=0
    )
    assert g.kind == kind and len(g) == 3000 and g.means.dtype == torch.float32
    assert np.array_equal(g.origin, scene.center)
    assert np.abs(g.world_means() - s.point).max() < 1e-6
    assert np.abs(np.abs(np.einsum("ij,ij->i", g.normals().numpy(), s.normal)) - 1).max() < 1e-6
    assert np.allclose(g.scales[:, :2].numpy(), 0.7 * s.spacing[:, None], rtol=1e-6)
    if kind == "3d":
        assert np.allclose(g.scales[:, 2].numpy(), 0.2 * s.spacing, rtol=1e-6)


def test_noise_has_the_asked_size_and_leaves_sampling_and_colours_alone(scene, geometry):
    clean = surface_splats(scene, "2d", 4000, geometry=geometry)
    noisy = surface_splats(
        scene, "2d", 4000, geometry=geometry, position_noise=0.5, normal_noise=10.0
    )
    spacing = clean.scales[:, :1].numpy() / 0.6
    moved = (noisy.means - clean.means).numpy() / spacing
    assert np.abs(moved.std(0) - 0.5).max() < 0.03 and np.abs(moved.mean(0)).max() < 0.03
    angle = np.degrees(
        np.arccos(np.clip((noisy.normals() * clean.normals()).sum(-1).numpy(), -1, 1))
    )
    # Two tangents with 10 degrees each: a Rayleigh distribution, whose median is 10 sqrt(2 ln 2).
    assert np.median(angle) == pytest.approx(11.8, abs=0.6)
    assert torch.equal(clean.sh, noisy.sh) and torch.equal(clean.scales, noisy.scales)


def test_the_same_seed_gives_the_same_splats_and_another_seed_others(scene, geometry):
    a, b = (
        surface_splats(scene, "2d", 500, geometry=geometry, position_noise=0.1, seed=3)
        for _ in range(2)
    )
    c = surface_splats(scene, "2d", 500, geometry=geometry, position_noise=0.1, seed=4)
    for name in ("means", "quats", "scales", "sh"):
        assert torch.equal(getattr(a, name), getattr(b, name))
    assert not torch.equal(a.means, c.means)


@pytest.mark.parametrize("name", [pytest.param("bear", marks=pytest.mark.slow), "fence"])
def test_colours_are_those_of_rendered_views_that_see_the_splats(name):
    # Splats have the colours of direct light.
    scene = direct(name).with_size(128, 128)
    geometry = Geometry(scene)
    g = surface_splats(scene, "2d", 6000, geometry=geometry)
    camera = scene.source
    image = to_srgb(appearance(scene, camera, spp=36))
    s = sample_surface(
        geometry, 6000, center=scene.center, focus=scene.spec.cameras.radius / 3, seed=0
    )
    xy, z = camera.project(s.point)
    inside = (z > 0) & (xy > 1).all(1) & (xy < 127).all(1)
    inside[inside] = geometry.visible_from(
        s.point[inside], s.normal[inside], s.primitive_id[inside], camera
    )
    # Beside an outline a pixel shows two surfaces.
    column, row = np.floor(xy[inside]).astype(int).T
    inside[inside] = ~edge_band(geometry, camera)[row, column]
    column, row = np.floor(xy[inside]).astype(int).T
    seen = image[row, column]
    own = (g.sh[:, 0].numpy() * 0.28209479177387814 + 0.5)[inside]
    assert inside.sum() > 400
    # A pixel averages over its area and has noise, a splat is a point: most agree closely, the mean
    # very closely.
    assert np.abs((seen - own).mean(0)).max() < 0.01
    assert np.percentile(np.abs(seen - own).max(1), 60) < 0.08


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"count": 0}, "count: got 0, expected at least 1"),
        ({"size": 0.0}, "size: got 0.0, expected a positive number"),
        ({"position_noise": -1.0}, "position_noise: got -1.0, expected a finite number >= 0"),
        ({"normal_noise": float("inf")}, "normal_noise: got inf, expected a finite number >= 0"),
        ({"focus": float("nan")}, "focus: got nan, expected a positive number"),
        ({"kind": "4d"}, "kind: got '4d', expected one of '2d', '3d'"),
    ],
)
def test_values_that_make_no_sense_are_refused(scene, geometry, arguments, says):
    with pytest.raises(ValueError, match=says):
        surface_splats(scene, geometry=geometry, **({"count": 100} | arguments))
