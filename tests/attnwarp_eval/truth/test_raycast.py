"""Geometry.trace against closed forms, mpmath and a brute-force Moeller-Trumbore in float64."""

import numpy as np
import pytest

from attnwarp.camera import Camera
from attnwarp_eval.scene.shapes import Box, Mesh, Rectangle, Sphere
from attnwarp_eval.scene.solids import Ellipsoid, mesh_body
from attnwarp_eval.truth import Geometry
from attnwarp_eval.truth.analytic import nearest_hit

GROUND = Rectangle(np.zeros(3), np.array([8.0, 0, 0]), np.array([0, 8.0, 0]))


def camera(position=(4.0, 1.0, 2.0), target=(0.0, 0.0, 0.4), size=48, fov=45):
    return Camera.look_at(position, target, width=size, height=size, fov_y=fov)


def moeller_trumbore(mesh, origin, directions):
    """Nearest t of each ray by testing every triangle in float64, without any tolerance.

    Returns:
        t (inf for a miss), the index of the triangle (-1), and the smallest of its three
        barycentric coordinates there.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    best = np.full(len(directions), np.inf)
    which, inside = np.full(len(directions), -1), np.zeros(len(directions))
    for i, d in enumerate(directions):
        p = np.cross(d, e2)
        det = (e1 * p).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origin - a
            u = (s * p).sum(1) / det
            q = np.cross(s, e1)
            v = (q @ d) / det
            t = (e2 * q).sum(1) / det
            hit = (det != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        if hit.any():
            which[i] = k = np.flatnonzero(hit)[t[hit].argmin()]
            best[i], inside[i] = t[k], min(u[k], v[k], 1 - u[k] - v[k])
    return best, which, inside


def test_a_plane_has_the_depth_of_its_equation_down_to_grazing_incidence():
    for height in (2.0, 0.05, 0.005):
        view = camera((6.0, 0, height), (0, 0, 0), size=65)
        hits = Geometry([GROUND]).trace(view)
        rays = view.directions() @ view.rotation
        with np.errstate(divide="ignore"):
            expected = -view.position[2] / rays[..., 2]
        seen = hits.valid
        assert seen.any()
        # Hard case 1: relative error below 1e-6 / cos; float64 does far better.
        error = np.abs(hits.depth / expected - 1)[seen] * hits.cosine[seen]
        assert error.max() < 1e-12
        assert np.isnan(hits.depth[~seen]).all() and (hits.object_id[~seen] == -1).all()


def test_a_ray_that_starts_inside_a_sphere_leaves_on_the_other_side():
    t, _ = nearest_hit(
        np.zeros((1, 3)), np.array([[0, 0, 2.0]]), np.array([[0, 0, 0.5, 2.0]]), np.zeros((0, 12))
    )
    assert t[0] == pytest.approx(1.25, abs=1e-15)


def test_a_box_of_triangles_and_a_box_of_closed_forms_are_one_box():
    box = Box(np.array([0.2, -0.1, 0.5]), np.array([0.4, 0.6, 0.5]), object_id=3)
    view = camera(size=96)
    meshed, exact = Geometry([box]).trace(view), Geometry(box.rectangles()).trace(view)
    both = meshed.valid & exact.valid
    # Embree decides hit or miss in float32: rays within 1e-7 of an outline may differ.
    assert (meshed.valid != exact.valid).sum() <= 2
    same = both & (np.abs(np.einsum("hwi,hwi->hw", meshed.normal, exact.normal) - 1) < 1e-9)
    assert same.sum() >= both.sum() - 4
    # Open3D's own depth is off by up to 1.6e-5; on the triangle's plane in float64 only rounding is
    # left.
    assert np.abs(meshed.depth - exact.depth)[same].max() < 1e-13
    assert np.abs(meshed.depth - exact.depth)[both].max() < 1e-5
    assert (meshed.object_id[both] == 3).all()


def test_an_organic_mesh_is_hit_where_brute_force_hits_it():
    mesh = mesh_body(
        [Ellipsoid((0, 0, 0.5), (0.5, 0.8, 0.4)), Ellipsoid((0.3, 0, 1), (0.3, 0.3, 0.3))], 0.2, 20
    )
    view = camera(size=40)
    hits = Geometry([mesh]).trace(view)
    brute, which, inside = (
        a.reshape(40, 40)
        for a in moeller_trumbore(
            mesh, view.position, (view.directions() @ view.rotation).reshape(-1, 3)
        )
    )
    assert (np.isfinite(brute) == hits.valid).all()
    # Where float32 picks the neighbouring triangle, the two planes differ by a rounding error times
    # their angle.
    assert np.nanmax(np.abs(hits.depth - brute)[hits.valid]) < 1e-6
    assert np.nanpercentile(np.abs(hits.depth - brute)[hits.valid], 95) < 1e-13
    assert (hits.cosine[hits.valid] > 0).all()
    # Away from its edges a triangle is the only one that can be hit; 1e-3 of it is far more than
    # float32 is off.
    clear = hits.valid & (inside > 1e-3)
    assert clear.sum() > 0.9 * hits.valid.sum() and len(np.unique(which[clear])) > 100
    assert np.array_equal(hits.primitive_id[clear], which[clear])
    assert (hits.primitive_id[~hits.valid] == -1).all()
    assert np.allclose(np.linalg.norm(hits.normal[hits.valid], axis=-1), 1, atol=1e-12)


def test_duplicated_faces_and_holes_leave_the_rest_of_a_mesh_exact():
    mesh = Box(np.zeros(3), np.ones(3)).mesh()
    holed = Mesh(mesh.vertices, np.concatenate([mesh.faces[2:], mesh.faces[2:5], mesh.faces[2:5]]))
    view = camera((5, 1, 1.5), (0, 0, 0))
    a, b = Geometry([mesh]).trace(view), Geometry([holed]).trace(view)
    assert np.array_equal(a.depth, b.depth, equal_nan=True)
    # Through the hole, the first two triangles (the -x face), the inside of the far face shows.
    back = Camera.look_at((-5, 0.1, 0.1), (0, 0, 0), width=9, height=9, fov_y=10)
    assert np.nanmin(Geometry([holed]).trace(back).depth) == pytest.approx(6, abs=0.1)


def test_a_way_is_free_unless_something_stands_in_it():
    card = Rectangle(np.array([0, 0, 0.005]), np.array([0.5, 0, 0]), np.array([0, 0.5, 0]))
    geometry = Geometry([GROUND, card, Sphere(np.array([3.0, 0, 1]), 0.5)])
    points = np.array([[0.1, 0, 0.005], [0.1, 0, 0.0], [0.8, 0, 0], [3.0, 0, 1.5], [3.0, 0, 0.5]])
    primitive = np.array([2, 1, 1, 0, 0])  # spheres first, then rectangles
    up, away = np.tile([0, 0, 1.0], (5, 1)), np.array([0.5, 0.3, 4.0])
    up[4] = [0, 0, -1]
    # Under a card 5 mm above it the ground is hidden, beside it is not; the sphere's underside
    # faces away.
    assert geometry.visible_from(points, up, primitive, away).tolist() == [
        True,
        False,
        True,
        True,
        False,
    ]


def test_the_sides_of_a_mesh_face_are_told_apart():
    card = Box(np.array([0, 0, 1.0]), np.array([1, 1, 0.01])).mesh()
    view = camera((0.3, 0.2, 4), (0, 0, 0), size=8)
    hits = Geometry([card]).trace(view)
    flat = [a.reshape(-1, *a.shape[2:]) for a in (hits.point, hits.normal, hits.primitive_id)]
    seen = hits.valid.ravel()
    point, normal, primitive = (a[seen] for a in flat)
    assert Geometry([card]).visible_from(point, normal, primitive, np.array([0.5, 0, 3])).all()
    assert not Geometry([card]).visible_from(point, normal, primitive, np.array([0.5, 0, -3])).any()


def test_an_empty_geometry_is_refused():
    with pytest.raises(ValueError, match="scene: got no shapes"):
        Geometry([])
