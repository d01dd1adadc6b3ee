"""Ground, what is strewn on it, and the parts that bodies are made of."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from attnwarp_eval.scene import solids
from attnwarp_eval.scene.bodies import BodySpec
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import SceneError
from attnwarp_eval.scene.solids import Block, Capsule, Disc, Ellipsoid, Relief, Torus, body_distance
from attnwarp_eval.scene.terrain import ScatterSpec, TerrainSpec


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def body(*parts, **rest):
    return BodySpec.model_validate({"type": "body", "parts": parts, "blend": 0, **rest})


@pytest.mark.parametrize(
    ("part", "point", "distance"),
    [
        (Torus((0, 0, 0), (1.0, 0.2)), (2.0, 0, 0), 0.8),
        (Torus((0, 0, 0), (1.0, 0.2)), (0, 0, 0), 0.8),
        (Torus((0, 0, 0), (1.0, 0.2)), (0, 1.0, 0.5), 0.3),
        (Block((0, 0, 0), (2, 1, 0.5)), (1.3, 0.9, 0.25), 0.5),
        (Block((0, 0, 0), (2, 1, 0.5)), (0, 0, 0.1), -0.15),
        (Block((0, 0, 0), (2, 2, 2), 0.5), (2.5, 2.5, 0), 2 * np.sqrt(2) - 0.5),
        (Disc((0, 0, 0), 0.5, 2.0), (0.3, 0.4, 1.25), 0.25),
        (Disc((0, 0, 0), 0.5, 2.0), (0.8, 0, 1.4), 0.5),
        (Disc((0, 0, 0), 0.5, 2.0, 0.1), (0, 0.75, 0), 0.25),
    ],
)
def test_distances_of_parts_are_those_of_their_geometry(part, point, distance):
    assert body_distance([part], 0, [point])[0] == pytest.approx(distance, abs=1e-12)


@pytest.mark.parametrize("make", [
    lambda **turn: Ellipsoid((0.2, -0.3, 0.5), (0.6, 0.3, 0.1), **turn),
    lambda **turn: Torus((0.2, -0.3, 0.5), (0.5, 0.1), **turn),
    lambda **turn: Block((0.2, -0.3, 0.5), (1.0, 0.6, 0.2), 0.05, **turn),
    lambda **turn: Disc((0.2, -0.3, 0.5), 0.4, 0.3, 0.05, **turn),
])  # fmt: skip
def test_a_turned_part_is_the_part_turned(make):
    points = np.random.default_rng(3).normal(size=(200, 3))
    center = np.array([0.2, -0.3, 0.5])
    # Rolled about x, pitched about y, then turned about z, all of them fixed axes.
    R = Rotation.from_euler("xyz", [25, -40, 110], degrees=True).as_matrix()
    turned = body_distance([make(roll=25, pitch=-40, yaw=110)], 0, (points - center) @ R.T + center)
    assert np.abs(turned - body_distance([make()], 0, points)).max() < 1e-12


def test_what_is_carved_is_gone():
    ball = {"type": "ellipsoid", "center": [0, 0, 0], "radii": [1, 1, 1]}
    hole = {"type": "ellipsoid", "center": [0, 0, 0], "radii": [0.5, 0.5, 0.5], "carve": True}
    shell = body(ball, hole, resolution=64).mesh()
    # Inscribed triangles lose 1 - O(h^2): 0.2 % at this resolution.
    assert volume(shell) == pytest.approx(4 / 3 * np.pi * (1 - 0.125), rel=3e-3)
    assert body(ball, hole).contains(np.array([0.75, 0, 0])) and not body(ball, hole).contains(
        np.zeros(3)
    )
    with pytest.raises(ValueError, match="first part carves"):
        body(hole)


def test_a_cut_shows_what_was_cut_unless_it_has_a_colour():
    ball = {"type": "ellipsoid", "center": [0, 0, 0], "radii": [1, 1, 1], "color": "#ff0000"}
    cut = {"type": "block", "center": [0, 0, 1], "size": [3, 3, 1.4], "carve": True}
    for color, expected in (("#ffffff", [1, 0, 0]), ("#0000ff", [0, 0, 1])):
        mesh = body(ball, cut | {"color": color}, resolution=48).mesh()
        flat = (np.abs(mesh.vertices[:, 2] - 0.3) < 1e-9) & (
            np.linalg.norm(mesh.vertices[:, :2], axis=-1) < 0.8
        )
        assert flat.sum() > 100 and np.allclose(mesh.tint[flat], expected)


def test_a_ring_repeats_its_part_about_the_upright():
    rod = {"type": "capsule", "start": [1.5, 1, 0], "end": [2, 1, 0.5], "radii": [0.1, 0.05]}
    parts = body(rod | {"ring": {"count": 4, "about": [1, 1]}}).solid()
    starts = np.array([part.start for part in parts])
    assert np.allclose(starts, [[1.5, 1, 0], [1, 1.5, 0], [0.5, 1, 0], [1, 0.5, 0]])
    # Half a turn has a copy at both ends; jitter moves them, the same way every time.
    half = body(rod | {"ring": {"count": 3, "about": [1, 1], "sweep": 180}}).solid()
    assert np.allclose(half[-1].start, [0.5, 1, 0])
    loose = {"count": 9, "jitter": 0.5, "seed": 4}
    assert body(rod | {"ring": loose}).solid() == body(rod | {"ring": loose}).solid()
    assert body(rod | {"ring": loose}).solid() != body(rod | {"ring": loose | {"seed": 5}}).solid()


def test_a_tube_is_its_rods_and_a_mirrored_turned_part_mirrors_its_turn():
    tube = {"type": "tube", "points": [[0, 0, 0], [1, 0, 0], [1, 0, 1]], "radii": [0.3, 0.2, 0.1]}
    assert body(tube).solid() == [
        Capsule((0, 0, 0), (1, 0, 0), (0.3, 0.2)),
        Capsule((1, 0, 0), (1, 0, 1), (0.2, 0.1)),
    ]
    with pytest.raises(ValueError, match="got 3 radii for 2 points"):
        body(tube | {"points": [[0, 0, 0], [1, 0, 0]]})
    wing = {
        "type": "ellipsoid",
        "center": [0, 1, 0],
        "radii": [0.6, 0.2, 0.1],
        "yaw": 30,
        "roll": 20,
        "pitch": 10,
    }
    two = body(wing | {"mirror": True}).solid()
    points = np.random.default_rng(1).normal(size=(100, 3))
    mirrored = body_distance(two[1:], 0, points * [1, -1, 1])
    assert np.abs(mirrored - body_distance(two[:1], 0, points)).max() < 1e-12


def test_relief_stays_within_its_depth_and_is_felt():
    ball = [Ellipsoid((0, 0, 0), (1, 1, 1))]
    mesh = solids.mesh_body(ball, 0, 48, Relief(0.05, 0.3, 3, 2))
    radius = np.linalg.norm(mesh.vertices, axis=-1)
    assert radius.min() > 0.95 - 1e-3 and radius.max() < 1.05 + 1e-3 and np.ptp(radius) > 0.04


def test_sampling_near_the_surface_alone_gives_the_mesh_of_sampling_everywhere(monkeypatch):
    parts = load_scene("face").spec.objects[2].shape.solid()
    sparse = solids._march(parts, 0.09, 64, None)
    monkeypatch.setattr(solids, "BLOCK", 10**4)  # one block, which is near the surface
    full = solids._march(parts, 0.09, 64, None)
    for name, values in full.items():
        assert np.array_equal(sparse[name], values), name


GROUND = TerrainSpec(
    type="terrain",
    center=(1, -2, 0.5),
    size=(8, 6),
    height=0.4,
    feature=1.5,
    level=(0.5, 2),
    seed=3,
)


def test_a_terrain_is_level_in_the_middle_and_within_its_height_everywhere():
    mesh = GROUND.mesh()
    assert np.allclose(mesh.bounds()[:, :2], [[-3, -5], [5, 1]])
    away = np.linalg.norm(mesh.vertices[:, :2] - [1, -2], axis=-1)
    assert (mesh.vertices[away < 0.5, 2] == 0.5).all()
    rise = np.abs(mesh.vertices[:, 2] - 0.5)
    assert rise.max() <= 0.4 and rise.max() > 0.1
    assert np.array_equal(mesh.vertices[:, 2], GROUND.height_at(mesh.vertices[:, :2]))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    assert (flat[:, 2] > 0).all() and flat[:, 2].sum() / 2 == pytest.approx(
        48
    )  # it faces up and covers its size
    flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
    assert np.percentile(np.einsum("ij,ij->i", flat, mesh.normals[mesh.faces[:, 0]]), 1) > 0.99
    assert GROUND.below(np.array([1, -2, 0.49])) and not GROUND.below(np.array([1, -2, 0.51]))
    assert not GROUND.below(np.array([9, -2, -5]))


@pytest.mark.parametrize("kind", ["stones", "grass", "flowers", "leaves"])
def test_strewn_things_lie_in_their_ring_on_the_ground_and_where_they_lay_before(kind):
    spec = ScatterSpec(
        type="scatter",
        kind=kind,
        count=300,
        size=(0.05, 0.1),
        radius=(0.5, 2.0),
        center=(1, -2, 0),
        avoid=((2.0, -2, 0.5),),
        seed=9,
    )
    places = spec.places()
    away = np.linalg.norm(places - [1, -2], axis=-1)
    assert away.min() >= 0.5 and away.max() <= 2.0
    assert np.linalg.norm(places - [2, -2], axis=-1).min() > 0.5 and 200 < len(places) < 300
    mesh = spec.mesh(GROUND.height_at)
    assert (
        np.isfinite(mesh.vertices).all() and mesh.cleaned(kind) is mesh
    )  # no triangle without area
    ground = GROUND.height_at(mesh.vertices[:, :2])
    assert (mesh.vertices[:, 2] - ground).max() < 0.3 and (
        mesh.vertices[:, 2] - ground
    ).min() > -0.15
    assert np.array_equal(mesh.vertices, spec.mesh(GROUND.height_at).vertices)
    other = spec.model_copy(update={"seed": 10})
    assert not np.array_equal(other.places()[:10], places[:10])


SCATTERED = """\
name: small
title: Stones
objects:
  - name: floor
    shape: {type: terrain, size: [8, 8], height: 0.1, feature: 1, resolution: 16}
    texture: {type: plain, color: '#808080'}
  - name: stones
    shape: {type: scatter, kind: stones, count: 5, size: [0.1, 0.2], radius: [0, 2], 'on': floor}
    texture: {type: plain, color: '#808080'}
lights:
  - {type: sky, horizon: '#ffffff', zenith: '#ffffff'}
cameras: {look_at: [0, 0, 0], radius: 3, source: {yaw: 0, height: 1}, targets: [{yaw: 30, height: 1}]}
"""


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "'on': floor",
            "'on': flor",
            r"small.yaml:8: objects\[1\].shape.on: got 'flor'; did you mean 'floor'",
        ),
        ("radius: [0, 2]", "radius: [0, 2], avoid: [[0, 0, 3]]", "leaves no room for any of the 5"),
        ("feature: 1,", "feature: 1, level: [2, 1],", r"got level \[2.0, 1.0\], expected"),
        (
            "source: {yaw: 0, height: 1}",
            "source: {yaw: 0, height: -1}",
            "is inside the object 'floor'",
        ),
        (
            "{type: terrain, size: [8, 8], height: 0.1, feature: 1, resolution: 16}",
            "{type: rectangle, center: [0, 0, 0], size: [8, 8], facing: [1, 0, 2]}",
            "got 'floor'; expected the name of a terrain or a level rectangle .*: there is none",
        ),
    ],
)
def test_a_mistake_in_ground_or_clutter_is_told_with_its_remedy(tmp_path, old, new, says):
    path = tmp_path / "small.yaml"
    path.write_text(SCATTERED)
    load_scene(path)
    assert old in SCATTERED
    path.write_text(SCATTERED.replace(old, new))
    with pytest.raises(SceneError, match=says):
        load_scene(path)
