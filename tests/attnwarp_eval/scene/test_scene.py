import re

import numpy as np
import pytest

from attnwarp_eval.scene.file import list_scenes, load_scene
from attnwarp_eval.scene.meshes import read_mesh
from attnwarp_eval.scene.scene import Scene, SceneError
from attnwarp_eval.truth import Geometry, two_view

SMALL = """\
name: small
title: A ball on a floor
objects:
  - name: floor
    shape: {type: rectangle, center: [0, 0, 0], size: [8, 8]}
    texture: {type: checker, colors: ['#ffffff', '#202020'], size: 0.5}
  - name: ball
    shape:
      type: sphere
      center: [0, 0, 0.5]
      radius: 0.5
    texture: {color: '#c04020', type: plain}
lights:
  - {type: sun, elevation: 45, azimuth: 30, irradiance: 3}
cameras:
  look_at: [0, 0, 0.5]
  radius: 3
  source: {yaw: 0, height: 1.5}
  targets:
    - {yaw: 30, height: 1}
"""


def write(tmp_path, text, name="small.yaml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_the_scenes_of_the_package_load_by_name_and_by_path(monkeypatch, tmp_path):
    assert {"spheres", "bear", "fence"} <= set(list_scenes())
    monkeypatch.chdir(tmp_path)  # away from the checkout they are still found
    for name in ("spheres", "bear", "fence"):
        scene = load_scene(name)
        assert scene.name == name and len(scene.targets) >= 10
        yaws = [view.yaw for view in scene.spec.cameras.targets]
        assert max(yaws) == 180 and len({c.position[2] for c in scene.cameras}) > 3
        assert load_scene(scene.path).content_hash == scene.content_hash
    (tmp_path / "scenes").mkdir()
    write(tmp_path / "scenes", SMALL.replace("name: small", "name: bear", 1), "bear.yaml")
    assert load_scene("bear").title == "A ball on a floor"  # one's own scenes come first


@pytest.mark.parametrize("name", ["spheres", "bear", "fence"])
def test_most_pixels_show_a_surface_and_far_views_look_behind_the_source(name):
    scene = load_scene(name).with_size(64, 64)
    geometry = Geometry(scene)
    for camera in scene.cameras:
        assert geometry.trace(camera).valid.mean() > 0.75
    pair = two_view(geometry, scene.source, scene.camera("yaw180"))
    assert pair.behind.mean() > 0.1 and (pair.label == 2).mean() > 0.2
    near = two_view(geometry, scene.source, scene.camera("yaw010"))
    assert near.visible.mean() > 0.5 and (near.label == 2).mean() > 0.02


def test_a_camera_stands_on_its_orbit_and_looks_at_the_middle(tmp_path):
    scene = load_scene(write(tmp_path, SMALL))
    target = scene.targets[0]
    a = np.radians(30)
    assert np.allclose(target.position, [3 * np.cos(a), 3 * np.sin(a), 1.0])
    assert np.allclose(target.project([[0, 0, 0.5]])[0], [[256, 256]])
    assert [c.name for c in scene.cameras] == ["source", "yaw030"]
    smaller = scene.with_size(64, 32)
    assert (smaller.source.width, smaller.source.height) == (64, 32)
    assert smaller.source.K[1, 1] * 16 == pytest.approx(
        scene.source.K[1, 1]
    )  # the vertical field of view stays
    assert scene.camera("yaw030").name == "yaw030"
    with pytest.raises(SceneError, match="no camera 'yaw30'; did you mean 'yaw030'"):
        scene.camera("yaw30")


# (what is changed, into what, line of the message, what the message says)
MISTAKES = [
    (
        "radius: 0.5",
        "raduis: 0.5",
        11,
        r"objects\[1\].shape.raduis: unknown key 'raduis'; did you mean 'radius'\?",
    ),
    (
        "radius: 0.5",
        "radius: -1",
        11,
        r"objects\[1\].shape.radius: got -1, but input should be greater than 0",
    ),
    (
        "lights:\n",
        "appearance: {bounces: auto}\nlights:\n",
        13,
        r"appearance.bounces: got 'auto', expected 1 to 64 or unlimited; take it out, and .* calibrate",
    ),
    ("radius: 0.5", "radius: .nan", 11, r"objects\[1\].shape.radius: got nan, but .*finite"),
    ("      radius: 0.5\n", "", 8, r"objects\[1\].shape.radius: is missing"),
    ("type: sphere", "kind: sphere", 8, r"objects\[1\].shape: says no type"),
    (
        "color: '#c04020'",
        "color: #c04020",
        None,
        "not valid YAML.*; line 12 has a colour without quotes, which YAML takes for a comment",
    ),
    (
        "color: '#c04020'",
        "color:",
        12,
        r"objects\[1\].texture.color: got nothing; an unquoted # starts a YAML comment",
    ),
    (
        "color: '#c04020'",
        "color: red",
        12,
        r"texture.color: got 'red', expected an sRGB colour in quotes",
    ),
    (
        "name: ball",
        "name: floor",
        7,
        r"objects\[1\].name: 'floor' is also the name of objects\[0\]; rename one",
    ),
    (
        "{yaw: 30, height: 1}",
        "{yaw: 0, height: 1, name: source}",
        20,
        r"cameras.targets\[0\]: the camera name 'source' is also that of cameras.source",
    ),
    (
        "{yaw: 30, height: 1}",
        "{yaw: 30, height: 0.6, radius: 0.2}",
        20,
        (
            r"cameras.targets.0: the camera 'yaw030' at \(0.1732, 0.1, 0.6\) is inside the object"
            r" 'ball'; change its yaw"
        ),
    ),
    (
        "{yaw: 30, height: 1}",
        "{yaw: 30, height: 1, look_at: [2.598076211353316, 1.5, 0]}",
        20,
        r"cameras.targets\[0\]: no such camera: .*parallel",
    ),
    (
        "  radius: 3\n",
        "  radius: 3\n  radius: 4\n",
        18,
        r"the key 'radius' stands here and on line 17; keep one",
    ),
    (
        "  radius: 3\n",
        "  radius: 3\n  size: [0, 512]\n",
        18,
        r"cameras.size: got \[0, 512\], expected at least",
    ),
    (
        "  - {type: sun",
        "  - {type: spot, position: [0, 0, 3], target: [0, 0, 3], intensity: 1}\n  - {type: sun",
        14,
        r"lights\[0\].target: is the lamp's own position; name a point",
    ),
    ("  radius: 3\n", "\tradius: 3\n", 17, "not valid YAML: .*check indentation and quotes"),
    (
        "checker, colors: ['#ffffff', '#202020']",
        "stripes, direction: [0, 0, 0], colors: ['#ffffff', '#202020']",
        6,
        r"objects\[0\].texture.direction: got \[0, 0, 0\], expected a direction",
    ),
    (SMALL, "- just\n- a list\n", 1, r"the file: got \['just', 'a list'\], but .*dictionary"),
    (
        "size: [8, 8]",
        "size: [8, 8], facing: [0, 0, 0]",
        5,
        r"objects\[0\].shape.facing: got \[0, 0, 0\]",
    ),
]


@pytest.mark.parametrize(("old", "new", "line", "says"), MISTAKES)
def test_a_mistake_is_told_with_file_line_value_and_remedy(tmp_path, old, new, line, says):
    assert old in SMALL
    path = write(tmp_path, SMALL.replace(old, new, 1))
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert re.search(says, message), message
    assert message.startswith(str(path))
    if line is not None:
        assert caught.value.line == line and message.startswith(f"{path}:{line}: "), message


def test_a_scene_that_is_not_there_is_told_with_what_is(tmp_path):
    with pytest.raises(
        SceneError, match=r"no scene named 'beer'; did you mean 'bear'\?; known scenes: .*fence"
    ):
        load_scene("beer")
    write(tmp_path, SMALL)
    with pytest.raises(
        SceneError, match=r"smal.yaml: no such scene file; did you mean 'small.yaml'\?"
    ):
        load_scene(tmp_path / "smal.yaml")
    with pytest.raises(SceneError, match="the file is empty"):
        load_scene(write(tmp_path, "# nothing\n", "empty.yaml"))


OWN = SMALL.replace(
    "shape:\n      type: sphere\n      center: [0, 0, 0.5]\n      radius: 0.5\n",
    "shape: {type: mesh, file: scans/ball.ply, scale: 0.5, position: [0, 0, 0.5], up: y}\n",
)


def octahedron(comment=""):
    corners = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    faces = ["0 2 4", "2 1 4", "1 3 4", "3 0 4", "2 0 5", "1 2 5", "3 1 5", "0 3 5"]
    head = "".join(f"property float {axis}\n" for axis in "xyz")
    return (
        f"ply\nformat ascii 1.0\ncomment {comment}\nelement vertex 6\n{head}"
        "element face 8\nproperty list uchar int vertex_indices\nend_header\n"
        + "".join(f"{x} {y} {z}\n" for x, y, z in corners)
        + "".join(f"3 {face}\n" for face in faces)
    )


def test_shapes_are_built_once_for_a_scene_and_its_other_sizes(tmp_path, monkeypatch):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "ball.ply").write_text(octahedron())
    read = []
    monkeypatch.setattr(
        "attnwarp_eval.scene.scene.read_mesh", lambda path: read.append(path) or read_mesh(path)
    )
    scene = load_scene(write(tmp_path, OWN))
    read.clear()  # loading has checked the file
    built = scene.shapes()
    assert scene.shapes() is built and scene.with_size(8, 8).with_size(9, 9).shapes() is built
    assert len(read) == 1


def test_an_own_mesh_is_read_relative_to_the_file_and_its_bytes_are_part_of_the_content(tmp_path):
    (tmp_path / "scans").mkdir()
    mesh = tmp_path / "scans" / "ball.ply"
    mesh.write_text(octahedron())
    path = write(tmp_path, OWN)
    first = load_scene(path)
    hits = Geometry(first).trace(first.source)
    assert (hits.object_id == 1).sum() > 100
    low, high = first.shapes()[1].bounds()
    assert np.allclose([low, high], [[-0.5, -0.5, 0], [0.5, 0.5, 1.0]], atol=1e-7)
    before = first.content_hash
    mesh.write_text(octahedron("another byte"))
    assert load_scene(path).content_hash != before


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "scans/ball.ply",
            "scans/bal.ply",
            r"there is no file .*scans/bal.ply; did you mean 'ball.ply'\?; the path counts",
        ),
        (
            "position: [0, 0, 0.5]",
            "position: [3, 0, 1.5]",
            r"the camera 'source' at .* is inside the object 'ball'",
        ),
    ],
)
def test_what_is_wrong_with_an_own_mesh_is_told_with_its_line(tmp_path, old, new, says):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "ball.ply").write_text(octahedron())
    with pytest.raises(SceneError, match=says) as caught:
        load_scene(write(tmp_path, OWN.replace(old, new)))
    assert caught.value.line is not None


@pytest.mark.door
@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("radii: [1, 1, 1.0e-4]}], resolution: 16", "too thin|no part is thick enough"),
        (
            "radii: [1.0e-3, 1.0e-3, 1.0e-3]}]",
            "blend 0.1 .* lattice points, more than 1,000,000,000",
        ),
    ],
)
def test_a_body_that_cannot_be_meshed_is_told_with_its_name_and_remedy(tmp_path, body, says):
    shape = f"{{type: body, parts: [{{type: ellipsoid, center: [0, 0, 0], {body}}}"
    text = re.sub(r"shape:\n      type: sphere\n.*\n.*\n", f"shape: {shape}\n", SMALL)
    path = write(tmp_path, text.replace("height: 1}", "height: 200}").replace("1.5}", "200}"))
    with pytest.raises(SceneError, match=f"object 'ball': body: .*({says})"):
        load_scene(path).shapes()


@pytest.mark.door
def test_a_camera_inside_a_body_or_a_box_is_refused(tmp_path):
    for shape in (
        (
            "{type: body, parts: [{type: ellipsoid, center: [0, 0, 0], radii: [1, 1, 1]}],"
            " position: [3, 0, 1.5]}"
        ),
        (
            "{type: box, center: [3, 0, 1.0], size: [0.1, 0.1, 0.2], repeat: {count: 3, step: [0,"
            " 0, 0.25]}}"
        ),
    ):
        text = re.sub(r"shape:\n      type: sphere\n.*\n.*\n", f"shape: {shape}\n", SMALL)
        with pytest.raises(SceneError, match=r"the camera 'source' .* is inside the object 'ball'"):
            load_scene(write(tmp_path, text))


def test_the_content_hash_tells_scenes_apart_and_nothing_else(tmp_path):
    scene = load_scene(write(tmp_path, SMALL))
    again = load_scene(
        write(tmp_path, "# a comment\n" + SMALL.replace("radius: 0.5", "radius: 0.50"), "b.yaml")
    )
    assert scene.content_hash == again.content_hash
    bigger = load_scene(write(tmp_path, SMALL.replace("radius: 0.5", "radius: 0.51"), "c.yaml"))
    assert bigger.content_hash != scene.content_hash and bigger.world_hash != scene.world_hash
    another_camera = load_scene(write(tmp_path, SMALL.replace("yaw: 30", "yaw: 31"), "d.yaml"))
    assert (
        another_camera.content_hash != scene.content_hash
        and another_camera.world_hash == scene.world_hash
    )


def test_a_scene_travels_through_pickle(tmp_path):
    import pickle

    scene = load_scene(write(tmp_path, SMALL))
    back = pickle.loads(pickle.dumps(scene))
    assert isinstance(back, Scene) and back.content_hash == scene.content_hash
