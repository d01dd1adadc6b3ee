"""Mesh files from people: what other programs write comes in whole, and what is damaged does not."""

import cProfile
import json
import struct
import warnings
from pathlib import Path

import matplotlib.path
import numpy as np
import pytest

from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.meshes import MESH_SUFFIXES, read_mesh, read_mesh_file
from attnwarp_eval.scene.meshes.polygons import triangulate
from attnwarp_eval.scene.scene import SceneError
from attnwarp_eval.scene.shapes import Box, MeshNotice

trimesh = pytest.importorskip("trimesh")

FILES = Path(__file__).parent / "files"
CUBE = Box(np.array([0.5, 0.25, -1]), np.array([1, 2, 3.0])).mesh()


def corners(mesh):
    return mesh.vertices[mesh.faces]


def area(mesh):
    a, b, c = np.moveaxis(corners(mesh), 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum()


def volume(mesh):
    a, b, c = np.moveaxis(corners(mesh), 1, 0)
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6


# What other programs write
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
@pytest.mark.parametrize("colored", [False, True])
def test_what_trimesh_writes_is_what_trimesh_reads(tmp_path, suffix, colored):
    ball = trimesh.creation.icosphere(2)
    if colored:
        dice = np.random.default_rng(0).integers(0, 256, (len(ball.vertices), 4))
        dice[:, 3] = 255
        ball.visual.vertex_colors = dice
    path = tmp_path / f"ball{suffix}"
    ball.export(path)
    result = read_mesh_file(path)
    theirs = trimesh.load(path, process=False, force="mesh")
    assert result.polygons == len(result.mesh.faces) == len(theirs.faces) == 320
    assert np.array_equal(corners(result.mesh), corners(theirs))
    assert (result.mesh.tint is not None) == colored
    if result.mesh.tint is not None:
        share = dice[:, :3] / 255
        # IEC 61966-2-1; in .glb colours are linear already (glTF 2.0, section 3.7.2.1).
        linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        expected = share if suffix == ".glb" else linear
        assert np.abs(result.mesh.tint - expected).max() < 1e-6


def test_what_vtk_writes_comes_in_whole(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    path = tmp_path / "ball.ply"
    pyvista.ParametricEllipsoid(1, 2, 3, u_res=30, v_res=20).triangulate().save(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MeshNotice)  # VTK's poles have triangles without area
        result = read_mesh_file(path)
        theirs = trimesh.load(path, process=False, force="mesh")
    assert result.polygons == len(theirs.faces)
    assert area(result.mesh) == pytest.approx(theirs.area, rel=1e-12)


# Polygons
# --------------------------------------------------------------------------------------------------

STAR = np.array([[np.cos(a), np.sin(a)] for a in np.arange(10) * np.pi / 5])
STAR[1::2] *= 0.4
COMB = np.array(
    [(x, y) for k in range(6) for x, y in ((2 * k, 3), (2 * k + 1, 0))] + [(11, -1), (0, -1)]
)
SPIRAL = np.array(
    [(r * np.cos(3 * r), r * np.sin(3 * r)) for r in np.linspace(1, 4, 40)]
    + [((r - 0.3) * np.cos(3 * r), (r - 0.3) * np.sin(3 * r)) for r in np.linspace(4, 1, 40)]
)
STRAIGHT = np.array([(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)])


def shoelace(outline):
    x, y = outline.T
    return 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    "outline", [STAR, COMB, SPIRAL, STRAIGHT], ids=["star", "comb", "spiral", "straight"]
)
def test_a_polygon_becomes_triangles_that_fill_it_and_nothing_else(outline, turned):
    outline = outline[::-1] if turned else outline
    rng = np.random.default_rng(1)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = np.c_[outline, np.zeros(len(outline))] @ R.T + [5, -3, 2]
    faces, crossed = triangulate(points, np.arange(len(points)), np.array([len(points)]))
    assert len(faces) == len(points) - 2 and not len(crossed)
    # In the plane of the outline each triangle turns as it does, and together they have its area.
    flat = outline[faces]
    (ax, ay), (bx, by), (cx, cy) = np.moveaxis(flat, 0, -1)
    signed = 0.5 * ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    assert (np.sign(shoelace(outline)) * signed >= -1e-12).all()
    assert signed.sum() == pytest.approx(shoelace(outline), rel=1e-12)
    middles = flat.mean(1)[np.abs(signed) > 1e-9]
    assert matplotlib.path.Path(outline).contains_points(middles).all()


PLY = """\
ply
format ascii 1.0
element vertex {}
property float x
property float y
property float z
element face {}
property list uchar int vertex_indices
end_header
"""


def ply(vertices, faces):
    rows = [*vertices, *([len(face), *face] for face in faces)]
    head = PLY.format(len(vertices), len(faces))
    return head + "".join(" ".join(map(str, row)) + "\n" for row in rows)


def test_many_polygons_keep_their_order_and_a_crossed_one_is_left_out(tmp_path):
    vertices = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.4, 0.5, 0)]
    bow_tie = (0, 2, 1, 3)
    text = ply(vertices, [(0, 1, 2, 3), (0, 1, 4), bow_tie, (3, 4, 0, 1, 2)])
    with pytest.warns(
        MeshNotice,
        match=r"some.ply: 4 polygons in, 6 triangles out; left out: 1 polygons that cross",
    ):
        mesh = read_text(tmp_path, "some.ply", text)
    assert mesh.faces[:3].tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4]]
    # The last polygon is the square with a notch.
    assert area(mesh) == pytest.approx(1 + 0.25 + (1 - 0.2))


# Damage
# --------------------------------------------------------------------------------------------------


def read_text(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    return read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.ply", ply([(0, 0, 0)], [(0, 0)]), "face 0 has 2 corners"),
        ("a.ply", ply([(0, 0, 0)], [(0, 1, 2)]), "a face names vertex 1, but there are 1"),
        ("a.ply", ply([(0, 0, "nan")] * 3, [(0, 1, 2)]), "vertex 0 is not finite"),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n",
            "holds no faces",
        ),
        pytest.param(
            "a.ply",
            "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\n"
            "element face 200000000\nproperty list uchar int vertex_indices\nend_header\n",
            "the body ends in row 0 of the 200000000 that the header announces",
            id="a header that announces what would take gigabytes",
        ),
        ("a.glb", "glTF", "begins with no glTF header"),
        (
            "a.obj",
            "",
            "format '.obj' is not read; use one of .ply, .glb; trimesh writes one: trimesh",
        ),
    ],
)
def test_what_is_damaged_is_refused_with_its_place(tmp_path, name, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        read_text(tmp_path, name, text)
    assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
@pytest.mark.parametrize("share", [0.3, 0.55, 0.9])
def test_a_part_of_a_file_is_never_a_mesh(tmp_path, suffix, share):
    path = tmp_path / f"ball{suffix}"
    trimesh.creation.icosphere(2).export(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match="repair"):
        read_mesh(path)


# glTF
# --------------------------------------------------------------------------------------------------


def glb(vertices, faces, more=None, **node):
    """The bytes of a minimal glTF 2.0 binary file; ``more`` changes the document."""
    points, index = vertices.astype("<f4"), faces.astype("<u2")
    blob = points.tobytes() + index.tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(blob)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": points.nbytes},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": index.nbytes},
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": len(points),
                "type": "VEC3",
                "min": points.min(0).tolist(),
                "max": points.max(0).tolist(),
            },
            {"bufferView": 1, "componentType": 5123, "count": index.size, "type": "SCALAR"},
        ],
    }
    if more:
        more(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(blob))
    return (
        head
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(blob), b"BIN\0")
        + blob
    )


def read_glb(tmp_path, more=None, faces=CUBE.faces, **node):
    (tmp_path / "cube.glb").write_bytes(glb(CUBE.vertices, faces, more, **node))
    return read_mesh(tmp_path / "cube.glb")


HALF = np.sqrt(0.5)


@pytest.mark.parametrize(
    "node",
    [
        {"translation": [10, 0, 0], "scale": [2, 2, 2]},
        {"rotation": [0, HALF, 0, HALF], "translation": [1, 2, 3]},
        {"scale": [-1, 1, 2]},  # a mirror
        {"matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 4, 5, 6, 1]},
    ],
)
def test_the_transform_of_a_node_is_applied_as_trimesh_does(tmp_path, node):
    mesh = read_glb(tmp_path, **node)
    theirs = trimesh.load(tmp_path / "cube.glb", process=False, force="mesh")
    assert np.allclose(mesh.vertices, theirs.vertices, rtol=0, atol=1e-6)
    assert area(mesh) == pytest.approx(theirs.area, rel=1e-6)
    assert volume(mesh) == pytest.approx(abs(theirs.volume), rel=1e-6)  # outward, mirrored or not


@pytest.mark.parametrize(("mode", "order"), [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_strips_and_fans_are_triangles(tmp_path, mode, order):
    def change(document):
        document["meshes"][0]["primitives"][0]["mode"] = mode

    with pytest.warns(MeshNotice, match="20 vertices of no polygon"):
        mesh = read_glb(tmp_path, change, np.array(order))
    # The cube's first face, 4 x 6, seen from the same side by both triangles.
    a, b, c = np.moveaxis(corners(mesh), 1, 0)
    assert np.allclose(np.cross(b - a, c - a), [[-24, 0, 0]] * 2, atol=1e-5)


def test_a_file_of_gltfpack_is_read_when_quantised_and_refused_by_name_when_compressed():
    # Box of 1 x 2 x 3 by trimesh 5.2, through gltfpack 1.3 without options and with -c.
    path = FILES / "gltfpack-quantised.glb"
    mesh, theirs = read_mesh(path), trimesh.load(path, process=False, force="mesh")
    assert b"KHR_mesh_quantization" in path.read_bytes()
    assert np.allclose(corners(mesh), corners(theirs), rtol=0, atol=1e-7)
    assert np.allclose(mesh.bounds(), [[-0.5, -1, -1.5], [0.5, 1, 1.5]], atol=1e-4)  # 14 bits
    assert np.abs(mesh.tint - np.array([200, 100, 50]) / 255).max() < 1e-6
    with pytest.raises(
        ValueError, match="needs the glTF extension 'EXT_meshopt_compression', which is not read"
    ):
        read_mesh(FILES / "gltfpack-meshopt.glb")


def test_colours_beyond_one_are_clamped_as_gltf_says(tmp_path):
    """Oracle: glTF 2.0, section 3.7.2.1. The colours are the positions, from -2 to 1.5."""

    def change(document):
        document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 0

    mesh = read_glb(tmp_path, change)
    assert CUBE.vertices.min() < 0 and CUBE.vertices.max() > 1
    assert np.array_equal(mesh.tint, np.clip(mesh.vertices, 0, 1))


@pytest.mark.parametrize("node", [{}, {"translation": [1, 0, 0]}])
def test_a_node_costs_few_calls(tmp_path, node):
    """Counted, as seconds vary; deep copies of each node's defaults took 100."""

    def calls(count):
        def change(document):
            document["nodes"] += [node] * count
            document["scenes"][0]["nodes"] = list(range(1 + count))

        with cProfile.Profile() as profile:
            read_glb(tmp_path, change)
        return sum(entry.callcount for entry in profile.getstats())

    assert calls(300) - calls(0) < 300 * 30


def test_textures_and_animations_are_told(tmp_path):
    def change(document):
        document |= {"textures": [{}, {}], "animations": [{}], "materials": [{}]}
        document["meshes"][0]["primitives"][0]["material"] = 0
        document["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 1})

    with pytest.warns(
        MeshNotice, match="not used: 1 primitives of lines, 2 textures, 1 animations, materials"
    ):
        read_glb(tmp_path, change)


def accessor(key, value):
    return lambda document: document["accessors"][0].update({key: value})


@pytest.mark.door
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda d: d["accessors"][1].update(count=3, componentType=5125),
            "a face names vertex 196610, but its part has 24",
        ),
        (accessor("sparse", {}), "accessor 0 is sparse, which is not read"),
        (accessor("count", True), "accessors.0.count: Input should be a valid integer"),
        (lambda d: d["nodes"][0].update(mesh=7), "names what it does not hold"),
        (lambda d: d["nodes"][0].update(children=[0]), "node 0 is reached twice"),
        (lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 2]), "rotation has length 2"),
        (lambda d: d["buffers"][0].update(uri="cube.bin"), "keeps data outside its binary chunk"),
        (
            lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]),
            "'KHR_draco_mesh_compression'",
        ),
    ],
)
def test_a_glb_that_cannot_be_is_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        read_glb(tmp_path, change)


# Scenes with meshes, and damage at random
# --------------------------------------------------------------------------------------------------

SCENE = """\
name: thing
title: A thing
objects:
  - name: thing
    shape: {{type: mesh, file: {file}, scale: {scale}}}
    texture: {{type: plain, color: '#c04020'}}
lights: [{{type: sky, horizon: '#ffffff', zenith: '#ffffff'}}]
appearance: {{bounces: 1}}
cameras: {{look_at: [0, 0, 0], radius: 9, source: {{yaw: 0, height: 1}}, targets: [{{yaw: 30, height: 1}}]}}
"""


@pytest.mark.door
def test_a_scene_names_the_object_that_reaches_too_far(tmp_path):
    trimesh.creation.icosphere(1).export(tmp_path / "ball.ply")
    path = tmp_path / "thing.yaml"
    path.write_text(SCENE.format(file="ball.ply", scale=1e9))
    with pytest.raises(SceneError, match=r"object 'thing' reaches 1e\+09|inside the object"):
        load_scene(path).shapes()
    path.write_text(SCENE.format(file="ball.ply", scale="1e30"))
    with pytest.raises(
        SceneError,
        match=r"thing.yaml:5: .*shape.scale: got 1e\+30, but input should be less than or equal to 1000000000",
    ):
        load_scene(path)


def test_a_mesh_is_found_by_the_name_that_windows_wrote(tmp_path):
    (tmp_path / "parts").mkdir()
    trimesh.creation.icosphere(1).export(tmp_path / "parts/ball.ply")
    path = tmp_path / "thing.yaml"
    path.write_text(SCENE.format(file=r"'.\parts\ball.ply'", scale=1))
    scene = load_scene(path)
    assert scene.mesh_path(scene.spec.objects[0].shape).samefile(tmp_path / "parts/ball.ply")


def test_a_stray_triangle_is_told_by_a_scene_and_its_truth(tmp_path):
    from attnwarp_eval.scene.extent import ExtentNotice, extent
    from attnwarp_eval.truth import Geometry
    from attnwarp_eval.truth.show import contents

    ball = trimesh.creation.icosphere(3)
    stray = trimesh.Trimesh(np.eye(3) * 0.01 + [1e5, 0, 0], [[0, 1, 2]])
    for name, parts in (("whole", [ball]), ("stray", [ball, stray])):
        trimesh.util.concatenate(parts).export(tmp_path / f"{name}.ply")
        (tmp_path / f"{name}.yaml").write_text(SCENE.format(file=f"{name}.ply", scale=1))
    whole = load_scene(tmp_path / "whole.yaml")
    assert extent(whole).notice is None and extent(whole).makers == ("thing",)
    Geometry(whole)  # warnings are errors here
    assert "extent: 2 x 2 x 2 metres, made by thing" in contents(whole)
    assert "whole.ply: 1280 polygons in, 1280 triangles out" in contents(whole)
    strayed = load_scene(tmp_path / "stray.yaml")
    with pytest.warns(ExtentNotice, match=r"makes the scene 1e\+05 wide instead of 2 \(thing\)"):
        Geometry(strayed)
    assert "a thousandth of the surface" in contents(strayed)


def test_a_mesh_turned_inside_out_is_told(tmp_path):
    ball, sheet = trimesh.creation.icosphere(2), trimesh.creation.box((1, 1, 1e-5))
    sheet.invert()
    for name, mesh in (("ball", ball), ("sheet", sheet)):
        mesh.export(tmp_path / f"{name}.ply")
        read_mesh(tmp_path / f"{name}.ply")  # warnings are errors here
    ball.invert()
    ball.apply_translation([1e4, 0, 0])
    ball.faces = ball.faces[1:]  # a small hole
    ball.export(tmp_path / "turned.ply")
    with pytest.warns(MeshNotice, match="its faces look inward, so that it gets no splats"):
        turned = read_mesh(tmp_path / "turned.ply")
    assert len(turned.faces) == 319  # as they are in the file


def test_a_texture_finer_than_its_mesh_is_told_where_pictures_are_made(tmp_path):
    from attnwarp_eval.truth.mitsuba.build import load_shapes

    square = trimesh.Trimesh(
        [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]]
    )
    square.export(tmp_path / "square.ply")
    path = tmp_path / "thing.yaml"
    text = SCENE.format(file="square.ply", scale=1)
    path.write_text(text)
    load_shapes(load_scene(path), 1.0)  # one colour needs no vertices
    checker = "type: checker, colors: ['#ffffff', '#000000'], size: 0.5"
    path.write_text(text.replace("type: plain, color: '#c04020'", checker))
    # Every corner is white, capped at 0.9, and half of the square is black: 0.45.
    with pytest.warns(MeshNotice, match=r"albedo of 0.4[3-7] on .* \(2 triangles\); give"):
        load_shapes(load_scene(path), 1.0)
