import warnings

import numpy as np
import pytest
import trimesh

from attnwarp_eval.scene.shapes import Box, Mesh, MeshNotice, Sphere
from attnwarp_eval.scene.solids import Capsule, Ellipsoid, body_distance, mesh_body

BALL = [Ellipsoid((0.3, -0.2, 1.0), (0.5, 0.5, 0.5))]


def edges_of(mesh):
    pairs = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)


def test_a_meshed_ball_is_a_sphere():
    mesh = mesh_body(BALL, 0.0, 32)
    outward = mesh.vertices - [0.3, -0.2, 1.0]
    # Newton steps put the vertices on the surface; marching cubes alone leaves 1e-3.
    assert np.abs(np.linalg.norm(outward, axis=1) - 0.5).max() < 1e-6
    assert np.abs(mesh.normals - outward / 0.5).max() < 1e-5
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    # Divergence theorem: the volume comes out positive only if the faces look outward.
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(
        4 / 3 * np.pi * 0.125, rel=0.01
    )


def test_a_blended_body_is_closed_and_carries_its_parts_colours():
    parts = [
        Ellipsoid((0, 0, 0.5), (0.4, 0.3, 0.5), pitch=20.0, color=(1.0, 0.5, 0.2)),
        Capsule((0.2, 0, 0.5), (0.9, 0, 0.8), (0.2, 0.1), color=(0.1, 0.2, 0.9)),
        Ellipsoid((0.0, 0, 1.02), (0.08, 0.08, 0.08), color=(0.0, 0.0, 0.0), blend=False),
    ]
    mesh = mesh_body(parts, 0.1, 48)
    _, count = edges_of(mesh)
    # Every edge belongs to two triangles, but for the few beside slivers without area that were
    # dropped; they leave no hole, so that the areas of the triangles, as vectors, still sum to
    # nothing.
    assert (count == 2).mean() > 0.995
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    assert np.abs(area.sum(0)).max() < 1e-9 * np.linalg.norm(area, axis=1).sum()
    tip = mesh.vertices[:, 0] > 0.9
    assert tip.any() and np.abs(mesh.tint[tip] - [0.1, 0.2, 0.9]).max() < 0.02
    top = mesh.vertices[:, 2] > 1.08
    assert top.any() and np.abs(mesh.tint[top]).max() < 1e-12


def test_the_distance_of_a_capsule_is_exact_and_the_smooth_union_lies_below_the_sharp_one():
    points = np.random.default_rng(0).normal(size=(500, 3))
    rod = Capsule((0, 0, 0), (0, 0, 1), (0.2, 0.2))
    gap = np.hypot(np.hypot(points[:, 0], points[:, 1]), points[:, 2] - np.clip(points[:, 2], 0, 1))
    assert np.abs(body_distance([rod], 0.1, points) - (gap - 0.2)).max() < 1e-12
    ball = Ellipsoid((0.3, 0, 0.5), (0.4, 0.4, 0.4))
    sharp = np.minimum(body_distance([rod], 0, points), body_distance([ball], 0, points))
    assert np.array_equal(body_distance([rod, ball], 0.0, points), sharp)
    soft = body_distance([rod, ball], 0.2, points)
    assert (soft <= sharp + 1e-15).all() and (sharp - soft).max() <= 0.2 / 4 + 1e-12


def test_mirrored_copies_and_positions_are_inside_what_contains_them():
    box = Box(
        np.array([1.0, 2, 3]),
        np.array([0.5, 1, 0.25]),
        np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0],
    )
    for shape in (box, box.mesh(), Sphere(box.center, 0.2)):
        assert shape.contains(box.center) and not shape.contains(box.center + np.array([0, 0, 2.0]))
    assert box.contains(box.center + 0.99 * box.axes[:, 1]) and not box.contains(
        box.center + 1.01 * box.axes[:, 1]
    )
    low, high = box.bounds()
    assert np.allclose(box.mesh().vertices.min(0), low) and np.allclose(
        box.mesh().vertices.max(0), high
    )


def test_a_mesh_with_a_hole_and_doubled_faces_still_knows_its_inside():
    mesh = mesh_body(BALL, 0.0, 24)
    holed = Mesh(
        mesh.vertices, np.concatenate([mesh.faces[: -len(mesh.faces) // 8], mesh.faces[:40]])
    )
    assert holed.contains(np.array([0.3, -0.2, 1.0])) and not holed.contains(
        np.array([0.3, -0.2, 1.6])
    )


def test_degenerate_triangles_are_dropped_with_a_notice_that_counts_them():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0.0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2]])
    with pytest.warns(
        MeshNotice, match=r"scan: dropped 2 of 3 triangles without area \(first: face 1\)"
    ):
        assert Mesh(vertices, faces).cleaned("scan").faces.tolist() == [[0, 1, 2]]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Mesh(vertices * 1e-6, faces[:1]).cleaned("a small triangle is not a degenerate one")
    with pytest.raises(ValueError, match="no triangle with an area"):
        Mesh(vertices, faces[1:]).cleaned("scan")
    with pytest.raises(ValueError, match="a face names vertex 4, but there are 4"):
        Mesh(vertices, np.array([[0, 1, 4]])).cleaned("scan")
    with pytest.raises(ValueError, match="vertex 2 is not finite"):
        Mesh(np.where(np.arange(4)[:, None] == 2, np.nan, vertices), faces[:1]).cleaned("scan")


def test_a_body_is_meshed_once_and_read_back_bit_for_bit(monkeypatch, tmp_path):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    first = mesh_body(BALL, 0.0, 16)
    assert len(list((tmp_path / "meshes").iterdir())) == 1
    monkeypatch.setattr("attnwarp_eval.scene.solids._march", lambda *_: pytest.fail("meshed again"))
    second = mesh_body(BALL, 0.0, 16)
    assert np.array_equal(first.vertices, second.vertices) and np.array_equal(
        first.faces, second.faces
    )


def test_a_divided_mesh_is_the_same_closed_surface_in_small_triangles():
    """Oracle: trimesh, on a shape whose triangles have one, two and three long edges."""
    whole = trimesh.creation.capsule(height=2.0, radius=0.2, count=(6, 6))
    given = Mesh(whole.vertices, whole.faces, tint=np.abs(whole.vertices))
    divided = given.divided(0.15)
    other = trimesh.Trimesh(divided.vertices, divided.faces, process=False)
    assert other.is_watertight and other.is_winding_consistent
    assert 0.07 < other.edges_unique_length.max() <= 0.15
    assert other.volume == pytest.approx(whole.volume)
    assert other.area == pytest.approx(whole.area)
    assert np.all(np.einsum("ij,ij->i", other.face_normals, other.triangles_center) > 0)
    assert np.array_equal(divided.vertices[: len(whole.vertices)], whole.vertices)
    assert divided.tint.shape == divided.vertices.shape
    with pytest.raises(ValueError, match="more than 5000000 triangles"):
        given.divided(1e-4)
