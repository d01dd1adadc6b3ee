"""Labels of edits that change shapes. Oracle: rays cast here, through spheres, boxes and planes."""

from pathlib import Path

import numpy as np
import pytest

from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import Scene, SceneError
from attnwarp_eval.study.shared.edit_truth import edit_truth
from attnwarp_eval.truth import AMBIGUOUS
from attnwarp_eval.truth.shapes import NEW, UNCOVERED, UNTOUCHED, ShapeEdit, kept_objects

FILE = Path(__file__).parents[3] / "docs/truth/shapes.yaml"
KINDS = ["added-0", "removed-1", "replaced-1", "moved-0", "grown-1"]


@pytest.fixture(scope="module")
def scene():
    return load_scene(FILE).with_size(48, 48)


def ray_depth(shape, origin, rays):
    """Ways (N,) along rays to a shape of a file, infinite where they miss."""
    if shape["type"] == "sphere":
        to, r = origin - np.array(shape["center"]), shape["radius"]
        a, b, c = (rays**2).sum(-1), rays @ to, to @ to - r * r
        root = b * b - a * c
        t = (-b - np.sqrt(np.where(root >= 0, root, np.nan))) / a
        return np.where(t > 0, t, np.inf)
    half = np.array(shape["size"]) / 2
    if shape["type"] == "box":  # slabs, in the box's own axes
        s, c = np.sin(np.radians(shape["yaw"])), np.cos(np.radians(shape["yaw"]))
        axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        o, d = axes @ (origin - np.array(shape["center"])), rays @ axes.T
        with np.errstate(divide="ignore"):
            near, far = np.sort([(-half - o) / d, (half - o) / d], axis=0)
        t, out = near.max(-1), far.min(-1)
        return np.where((t < out) & (t > 0), t, np.inf)
    n = np.array(shape["facing"], float)  # a rectangle, facing +z or +x
    with np.errstate(divide="ignore"):
        t = (np.array(shape["center"]) - origin) @ n / (rays @ n)
    at = origin + t[:, None] * rays - np.array(shape["center"])
    across = at[:, :2] if n[2] else at[:, 1:]
    return np.where((t > 0) & (np.abs(across) <= half).all(-1), t, np.inf)


def cast(scene, camera, shift):
    """By pixel: depth and shape of the first surface, at a place (x, y) within the pixel."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.0
    x = (columns + shift[0] - camera.K[0, 2]) / camera.K[0, 0]
    y = (rows + shift[1] - camera.K[1, 2]) / camera.K[1, 1]
    local = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    rays = local @ camera.rotation
    shapes = [item.shape.model_dump() for item in scene.spec.objects]
    ways = np.stack([ray_depth(shape, camera.position, rays) for shape in shapes])
    first = ways.argmin(0)
    named = [f"{item.name} {item.shape}" for item in scene.spec.objects]
    shown = np.where(np.isfinite(ways.min(0)), np.array(named)[first], "")
    return ways.min(0).reshape(x.shape), shown.reshape(x.shape), set(named)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("view", ["source", "yaw030"])
def test_labels_and_depth_of_each_kind_of_edit_are_those_of_own_rays(scene, kind, view):
    after, camera = scene.edited(kind), scene.camera(view)
    told = ShapeEdit(scene, after).labels(camera)
    labels, gone = [], []
    for shift in [(0.5, 0.5), (0, 0), (0, 1), (1, 0), (1, 1)]:
        _, old, before_names = cast(scene, camera, shift)
        depth, now, after_names = cast(after, camera, shift)
        if shift == (0.5, 0.5):
            assert np.allclose(told.after.depth, np.where(now == "", np.nan, depth), equal_nan=True)
        new = np.isin(now, sorted(after_names - before_names)) & (now != "")
        gone.append(np.isin(old, sorted(before_names - after_names)) & (old != ""))
        labels.append(np.where(new, NEW, np.where(gone[-1], UNCOVERED, UNTOUCHED)))
    sure = np.all(
        [(a == labels[0]) & (b == gone[0]) for a, b in zip(labels, gone, strict=True)], axis=0
    )
    # A corner on the very edge of a shape may go either way.
    expected = np.where(sure, labels[0], AMBIGUOUS)
    assert (told.label != expected).sum() <= 2
    assert (told.gone != (sure & gone[0])).sum() <= 2
    shows = {UNTOUCHED, *({NEW} if kind != "removed-1" else ())}
    shows |= {UNCOVERED} if kind[:5] in ("remov", "repla", "moved") else set()
    assert set(np.unique(told.label)) - {AMBIGUOUS} == shows


def test_pictures_change_where_something_is_new_and_keep_what_light_does_not_reach(scene):
    truth = edit_truth(str(FILE), 48, 4, "removed-1", ("source",))
    labels = ShapeEdit(scene, scene.edited("removed-1")).labels(scene.source)
    change = np.abs(truth.answers["edited"]["source"] - truth.originals["source"]).max(-1)
    assert change[labels.gone].mean() > 0.1 > 10 * np.median(change[labels.label == UNTOUCHED])
    assert (truth.masks["edited"]["source"] >= labels.gone).all()


def test_an_added_thing_is_in_the_mask_of_its_edit(scene):
    truth = edit_truth(str(FILE), 48, 1, "added-0=crate", ("yaw030",))
    labels = ShapeEdit(scene, scene.edited("added-0", "crate")).labels(scene.camera("yaw030"))
    assert labels.new.any()
    assert (truth.masks["crate"]["yaw030"] == labels.new).all()


def test_an_object_that_is_only_painted_keeps_its_surface(tmp_path):
    text = FILE.read_text().replace(
        "{type: sphere, center: [0.2, 0.8, 0.45], radius: 0.45}",
        "{type: body, resolution: 8, position: [0.2, 0.8, 0.45],"
        " parts: [{type: ellipsoid, center: [0, 0, 0], radii: [0.4, 0.4, 0.4], color: '#a0a0a0'}]}",
    )
    text = text.replace(
        "    remove: [ball]\n  - name: rep",
        "    changes: [{object: ball, paint: '#ff0000'}]\n  - name: rep",
    )
    (tmp_path / "shapes.yaml").write_text(text)
    scene = load_scene(tmp_path / "shapes.yaml")
    painted = scene.edited("removed-1")
    assert painted.spec.objects[3].shape != scene.spec.objects[3].shape  # its part's colour
    assert kept_objects(scene, painted) == set(scene.object_names)


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ("remove: [bal]", "there is no object 'bal'"),
        ("add: [{name: box, shape: {type: sphere, center: [0, 0, 2], radius: 0.1},"
         " texture: {type: plain, color: '#ffffff'}}]", "adds a second object 'box'"),
        ("remove: [ground, wall, box, ball]", "removes every object"),
    ],
)  # fmt: skip
def test_an_edit_that_cannot_be_applied_is_refused_by_name(tmp_path, entry, says):
    text = FILE.read_text().replace(
        "remove: [ball]\n  - name: replaced", f"{entry}\n  - name: replaced"
    )
    (tmp_path / "shapes.yaml").write_text(text)
    with pytest.raises(SceneError, match=says):
        load_scene(tmp_path / "shapes.yaml")


def test_an_edited_scene_has_what_was_added_last_and_nothing_that_was_removed(scene):
    after = scene.edited("replaced-1")
    assert isinstance(after, Scene)
    assert after.object_names == ["ground", "wall", "box", "crate"]
