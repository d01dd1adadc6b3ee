"""Hard cases of docs: views and meshes that break truth where it is computed carelessly. The
numbers are the cases'.
"""

import mpmath
import numpy as np
import pytest

from attnwarp.camera import Camera
from attnwarp_eval.scene.bodies import BodySpec
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.shapes import Box, Mesh, MeshNotice, Rectangle, Sphere
from attnwarp_eval.splats.surface import surface_splats
from attnwarp_eval.truth import AMBIGUOUS, Geometry, appearance, two_view

GROUND = Rectangle(np.zeros(3), np.array([50.0, 0, 0]), np.array([0, 50.0, 0]))
WORLD = [
    GROUND,
    Sphere(np.array([0, 0.8, 0.6]), 0.6),
    Box(np.array([0, -0.9, 0.4]), np.full(3, 0.4)),
]


def camera(position=(3.0, 0.2, 1.5), look_at=(0, 0, 0.4), K=None, width=32, height=32):
    view = Camera.look_at(position, look_at, width=width, height=height, fov_y=45)
    return view if K is None else Camera(np.array(K), view.world_to_camera, width, height)


def on_the_ground(view):
    """Depth of z = 0 and the source of it, by the whole inverse of K and of the pose."""
    grid = np.stack(np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5), axis=-1)
    rays = np.concatenate([grid, np.ones((*grid.shape[:2], 1))], axis=-1) @ np.linalg.inv(view.K).T
    pose = np.linalg.inv(view.world_to_camera)
    rays = rays @ pose[:3, :3].T
    return -pose[2, 3] / rays[..., 2], pose[:3, 3] + rays * (-pose[2, 3] / rays[..., 2])[..., None]


@pytest.mark.parametrize("focal", [1.0, 30.0, 1e3, 1e5])
def test_case_11_focal_lengths_from_1_to_1e5_px_see_the_plane_where_it_is(focal):
    K = [[focal, 0, 16], [0, focal, 16], [0, 0, 1]]
    source, target = camera(K=K), camera((3.0, 0.2 + 0.3 / focal, 1.5), K=K)
    pair = two_view(Geometry([GROUND]), source, target)
    depth, point = on_the_ground(target)
    seen = pair.hits.valid
    assert seen.sum() > 100
    assert np.abs(pair.hits.depth / depth - 1)[seen].max() < 1e-9
    p = (point @ source.rotation.T + source.translation) @ source.K.T
    inside = seen & np.isfinite(pair.xy[..., 0])
    assert np.abs(p[..., :2] / p[..., 2:] - pair.xy)[inside].max() < 1e-4  # the bound of the case


@pytest.mark.parametrize(
    "K",
    [
        [[30.0, 0, 80], [0, 30, -25], [0, 0, 1]],
        [[45.0, 6, 16], [0, 25, 16], [0, 0, 1]],
        [[45.0, -9, -40], [0, 25, 50], [0, 0, 1]],
    ],
    ids=["case_12_principal_point_outside", "case_13_fx_fy_skew", "both"],
)
def test_any_intrinsics_see_the_plane_where_it_is_and_nothing_wraps(K):
    target = camera((2.0, 0.2, 2.5), (0, 0, 0), K)
    hits = Geometry([GROUND]).trace(target)
    depth, point = on_the_ground(target)
    seen = hits.valid
    assert seen.sum() > 100 and np.array_equal(
        seen, (depth > 0) & (np.abs(point[..., :2]) <= 50).all(-1)
    )
    assert np.abs(hits.depth / depth - 1)[seen].max() < 1e-9
    assert np.abs(hits.point - point)[seen].max() < 1e-6


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 1), (1, 5)])
def test_case_14_images_of_one_pixel_or_one_row_have_truth(width, height):
    geometry = Geometry(WORLD)
    source, target = (camera((3.0, y, 1.5), width=width, height=height) for y in (0.0, 0.3))
    pair = two_view(geometry, source, target)
    assert pair.label.shape == pair.edge.shape == (height, width)
    directions = (target.directions() @ target.rotation).reshape(-1, 3)
    single = geometry.trace_rays(target.position, directions)
    assert np.array_equal(single.t.reshape(height, width), pair.hits.depth, equal_nan=True)


def test_case_7_a_tiny_baseline_keeps_its_digits():
    source, target = camera(), camera((3.0, 0.2 + 1e-9, 1.5))
    pair = two_view(Geometry([GROUND]), source, target)
    assert pair.hits.valid[20, 10]
    mpmath.mp.dps = 40
    K, S, T = (
        mpmath.matrix(m.tolist())
        for m in (source.K, source.world_to_camera, target.world_to_camera)
    )
    eye = T**-1
    ray = eye[:3, :3] * (K**-1 * mpmath.matrix([10.5, 20.5, 1]))
    t = -eye[2, 3] / ray[2]
    point = mpmath.matrix([eye[k, 3] + t * ray[k] for k in range(3)] + [1])
    p = K * (S * point)[:3]
    exact = np.array([float(p[0] / p[2]), float(p[1] / p[2])])
    # The case asks for 1e-3 px; the shift itself is about 1e-8 px and float64 positions of 30 px
    # hold 1e-14.
    assert np.abs(pair.xy[20, 10] - exact).max() < 1e-10
    assert (pair.visible | (pair.label == AMBIGUOUS))[pair.hits.valid & pair.in_source_image].all()


SCAN = """\
name: scan
title: A scanned figure
objects:
  - name: floor
    shape: {type: rectangle, center: [0, 0, 0], size: [8, 8]}
    texture: {type: checker, colors: ['#d9cfb8', '#8a7f6c'], size: 0.5}
  - name: figure
    shape: {type: mesh, file: figure.ply}
    texture: {type: plain, color: '#ffffff'}
lights:
  - {type: sun, elevation: 50, azimuth: -30, irradiance: 2.5}
  - {type: sky, horizon: '#d0d8e0', zenith: '#80a0e0', radiance: 0.8}
appearance: {bounces: 1, spp: 4}
cameras: {look_at: [0, 0, 0.6], radius: 3, size: [64, 64], source: {yaw: 0, height: 1.2}, targets: [{yaw: 40, height: 1.5}]}
"""


def figure():
    parts = [
        {
            "type": "ellipsoid",
            "center": [0, 0, 0.55],
            "radii": [0.4, 0.45, 0.5],
            "color": "#c08040",
        },
        {
            "type": "ellipsoid",
            "center": [0.1, 0, 1.15],
            "radii": [0.3, 0.32, 0.28],
            "color": "#e0b070",
        },
        {
            "type": "capsule",
            "start": [0.1, 0.3, 0.9],
            "end": [0.5, 0.5, 0.6],
            "radii": [0.12, 0.1],
            "mirror": True,
        },
    ]
    return BodySpec.model_validate({"type": "body", "parts": parts, "resolution": 48}).mesh()


def write_scan(folder, mesh):
    """Write a mesh as scanners do: float32, vertex colours, faces of any kind."""
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    head += [f"property float {c}" for c in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    head += [
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    vertices = np.zeros(len(mesh.vertices), dtype=[("p", "<f4", 3), ("c", "u1", 3)])
    vertices["p"], vertices["c"] = mesh.vertices, np.clip(255 * mesh.tint, 0, 255)
    faces = np.zeros(len(mesh.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, mesh.faces
    (folder / "figure.ply").write_bytes(
        "\n".join(head).encode() + vertices.tobytes() + faces.tobytes()
    )
    (folder / "scan.yaml").write_text(SCAN)
    return folder / "scan.yaml"


def test_a_scan_with_a_hole_doubled_faces_and_a_sliver_goes_through_the_whole_chain(tmp_path):
    whole = figure()
    (tmp_path / "whole").mkdir()
    (tmp_path / "torn").mkdir()
    clean = load_scene(write_scan(tmp_path / "whole", whole))
    middle = whole.vertices[whole.faces].mean(1)
    hole = np.linalg.norm(middle - [0.3, 0.2, 0.75], axis=-1) < 0.12
    assert 10 < hole.sum() < 0.1 * len(hole)
    faces = np.concatenate(
        [whole.faces[~hole], whole.faces[~hole][:200], [[5, 5, 9]]]
    )  # doubled; no area
    path = write_scan(tmp_path / "torn", Mesh(whole.vertices, faces, None, whole.tint))
    with pytest.warns(
        MeshNotice, match=r"figure.ply: .* triangles out; left out: 1 triangles without area"
    ):
        torn = load_scene(path)
    with pytest.warns(MeshNotice):
        geometry = Geometry(torn)
    before = Geometry(clean)
    assert torn.content_hash != clean.content_hash
    rays = before.trace(clean.source), geometry.trace(clean.source)
    # Where the first hit is on the torn mesh as on the whole one, all is as before; through the
    # hole one sees deeper.
    same = np.isclose(rays[0].depth, rays[1].depth, rtol=1e-9, equal_nan=True)
    assert same.mean() > 0.97 and not same.all()
    assert (rays[1].depth > rays[0].depth)[~same & rays[1].valid].all()
    pair = two_view(geometry, torn.source, torn.targets[0])
    assert pair.visible.mean() > 0.2
    # Its shapes are built once, and noticed once.
    image = appearance(torn, torn.source)
    splats = surface_splats(torn, "2d", 500)
    assert np.isfinite(image).all() and image.mean() > 0.05
    assert len(splats.means) > 300 and np.isfinite(np.asarray(splats.means)).all()
