"""Edits with truth: that each one changes what it says, and nothing else."""

import functools

import numpy as np
import pytest
from further import further

import attnwarp_eval.truth.edits
from attnwarp_eval.colors import to_linear
from attnwarp_eval.scene import edits
from attnwarp_eval.scene.base import linear_rgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import Scene, SceneError
from attnwarp_eval.scene.spec import SceneSpec
from attnwarp_eval.truth import Geometry, appearance
from attnwarp_eval.truth.shading import object_albedo

SIX = ["bear", "dinosaur", "face", "garden", "person", "stump"]


shipped = functools.lru_cache(load_scene)


def results(scene):
    for edit in scene.edits:
        for answer in edit.answers or (None,):
            yield edit, answer.name if answer else None


@pytest.mark.parametrize("name", SIX)
def test_each_of_the_six_names_edits_of_surface_light_and_free_choice(name):
    scene = shipped(name)
    assert len(scene.edits) >= 6
    assert any(edit.lights for edit in scene.edits) or any(
        c.object == "ground" for e in scene.edits for c in e.changes
    )
    assert any(change.material for edit in scene.edits for change in edit.changes)
    ambiguous = [edit for edit in scene.edits if edit.ambiguous]
    assert ambiguous and all(len(edit.answers) >= 3 for edit in ambiguous)
    for edit in scene.edits:
        assert edit.instruction and edit.source != edit.target
    hashes = {scene.edited(edit.name, answer).content_hash for edit, answer in results(scene)}
    assert len(hashes | {scene.content_hash}) == 1 + sum(1 for _ in results(scene))


@pytest.mark.parametrize("name", SIX)
def test_edits_are_no_part_of_the_scene_that_they_edit(name):
    scene = shipped(name)
    bare = Scene(scene.spec.model_copy(update={"edits": ()}), scene.path)
    assert bare.content_hash == scene.content_hash and bare.world_hash == scene.world_hash
    edited = scene.edited(scene.edits[0].name)
    assert edited.edits == () and edited.world_hash != scene.world_hash
    assert edited.spec.cameras == scene.spec.cameras


@pytest.mark.parametrize("name", SIX)
def test_an_edit_leaves_shapes_and_every_other_object_as_they_were(name):
    scene = shipped(name)
    for edit, answer in results(scene):
        edited, touched = (
            scene.edited(edit.name, answer),
            attnwarp_eval.truth.edits.touched(scene, edit.name, answer),
        )
        light = (edits.pick(edit, answer) or edit).lights
        assert bool(touched) != (light is not None)
        assert (edited.spec.lights == scene.spec.lights) == (light is None)
        for k, (before, after) in enumerate(
            zip(scene.spec.objects, edited.spec.objects, strict=True)
        ):
            # What the other objects say is equal, so their albedo is, which is a function of it and
            # of the place.
            assert (before == after) == (k not in touched)
            assert before.name == after.name and type(before.shape) is type(after.shape)


@pytest.mark.parametrize(
    ("name", "edit", "answer"),
    further(
        ("bear", "some_colour", "green"),
        ("bear", "polar", None),
        ("bear", "snow", None),
        ("bear", "sunset", None),
    ),
)
def test_outside_the_edited_object_the_albedo_is_identical_and_inside_it_is_not(name, edit, answer):
    scene = shipped(name).with_size(48, 48)
    edited = scene.edited(edit, answer)
    before, after = Geometry(scene), Geometry(edited)
    for camera in (scene.source, scene.camera("yaw120")):
        hits, again = before.trace(camera), after.trace(camera)
        assert np.array_equal(
            hits.depth, again.depth, equal_nan=True
        )  # bit for bit: an edit moves nothing
        assert np.array_equal(hits.primitive_id, again.primitive_id)
        seen = hits.valid
        a, b = (
            object_albedo(s, g, hits.point[seen], hits.primitive_id[seen])
            for s, g in ((scene, before), (edited, after))
        )
        same = (a == b).all(-1)
        mask = attnwarp_eval.truth.edits.edit_mask(scene, edit, hits, answer)[seen]
        if scene.edit(edit).lights:
            assert mask.all() and same.all()
        else:
            assert same[~mask].all() and mask.any() and (~same[mask]).mean() > 0.9


def test_paint_keeps_lightness_and_what_it_is_told_to_keep():
    scene = shipped("bear")
    bear = scene.edited("some_colour", "red").spec.objects[scene.object_names.index("bear")]
    colors = {part.color for part in bear.shape.parts}
    assert colors == {"#ffffff", "#1a1512", "#14100e"}
    old = scene.spec.objects[scene.object_names.index("bear")].texture
    red = np.array(linear_rgb("#c8372d"))
    for before, after in zip(old.colors, bear.texture.colors, strict=True):
        share = (
            edits.LUMINANCE
            @ linear_rgb(before)
            / max(edits.LUMINANCE @ linear_rgb(c) for c in old.colors)
        )
        # Eight bits of sRGB are up to 0.5 / 255, at a slope of at most 2.3 there.
        assert np.abs(np.array(linear_rgb(after)) - share * red).max() < 0.005
    assert to_linear(np.array([1.0]))[0] == 1.0


def test_a_painted_body_is_the_mesh_it_was(monkeypatch):
    from attnwarp_eval.scene import solids

    scene = shipped("bear")
    index = scene.object_names.index("bear")
    before = scene.spec.objects[index].shape.mesh()

    def refuse(*_):
        raise AssertionError("meshed again")

    monkeypatch.setattr(solids, "_march", refuse)
    after = scene.edited("polar").spec.objects[index].shape.mesh()
    assert np.array_equal(before.vertices, after.vertices) and np.array_equal(
        before.faces, after.faces
    )
    assert not np.array_equal(before.tint, after.tint)


SMALL = """\
name: small
title: A ball
objects:
  - name: ball
    shape: {type: sphere, center: [0, 0, 0], radius: 0.5}
    texture: {type: plain, color: '#c04020'}
lights:
  - {type: sky, horizon: '#ffffff', zenith: '#ffffff'}
cameras: {look_at: [0, 0, 0], radius: 3, source: {yaw: 0, height: 1}, targets: [{yaw: 30, height: 1}]}
appearance: {bounces: 1}
edits:
  - name: blue
    instruction: Make it blue
    source: a red ball
    target: a blue ball
    changes: [{object: ball, recolor: {'#c04020': '#2040c0'}}]
"""


def test_an_edited_scene_is_rendered_from_every_camera_as_any_other(tmp_path):
    (tmp_path / "small.yaml").write_text(
        SMALL
        + "  - {name: gold, instruction: i, source: s, target: t, "
        + "changes: [{object: ball, material: {type: metal, metal: Au, roughness: 0.3}}]}\n"
        + "  - {name: dim, instruction: i, source: s, target: t, "
        + "lights: [{type: sky, horizon: '#ff8040', zenith: '#ff8040', radiance: 0.2}]}\n"
    )
    scene = load_scene(tmp_path / "small.yaml").with_size(16, 16)
    pictures = {}
    for name in ("blue", "gold", "dim"):
        for k in (0, 1):
            before = appearance(scene, scene.cameras[k], spp=16)
            after = appearance(scene.edited(name), scene.cameras[k], spp=16)
            assert np.isfinite(after).all() and np.abs(after - before)[6:10, 6:10].mean() > 0.05
            sky = np.abs(after - before)[0, 0].max()
            assert (
                sky > 0.1 if name == "dim" else sky == 0
            )  # an edit of the ball leaves the sky alone
        pictures[name] = after[6:10, 6:10].mean((0, 1))
    # Under an even white sky a diffuse ball in the open shows its albedo: blue is what it says.
    assert np.abs(pictures["blue"] - linear_rgb("#2040c0")).max() < 0.03
    assert pictures["gold"][0] > 1.5 * pictures["gold"][2]


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "object: ball",
            "object: bal",
            r"small.yaml:12: edits\[0\]: edit 'blue': there is no object 'bal'.* ball",
        ),
        ("{'#c04020'", "{'#c04021'", r"recolor: 'ball' has no colour '#c04021'; it has #c04020"),
        (
            "recolor: {'#c04020': '#2040c0'}",
            "keep: []",
            r"changes nothing; add a shape, a texture, a material, recolor or",
        ),
        (
            "recolor: {'#c04020': '#2040c0'}",
            "paint: '#2040c0', texture: {type: plain, color: '#000000'}",
            "keep one",
        ),
        ("    changes: [{object: ball, recolor: {'#c04020': '#2040c0'}}]\n", "", "both or neither"),
        (
            "    changes: [{object: ball, recolor: {'#c04020': '#2040c0'}}]\n",
            "    lights: []\n",
            r"edits\[0\]: makes a scene that contradicts itself: lights: there is none",
        ),
        (
            "recolor: {'#c04020': '#2040c0'}",
            "paint: '#2040c0', keep: ['#101010']",
            "keep: no part of 'ball' has the colour '#101010'; they have none",
        ),
        (
            "recolor: {'#c04020': '#2040c0'}",
            "recolor: {'#c04020': '#2040c0'}, keep: ['#101010']",
            "got keep without paint",
        ),
        (
            "recolor: {'#c04020': '#2040c0'}",
            "texture: {type: plain, color: '#000000'}, material: {type: metal}",
            "texture: 'ball' is metal, which shows no texture; use recolor or material",
        ),
    ],
)
def test_a_mistake_in_an_edit_is_told_with_its_place_and_remedy(tmp_path, old, new, says):
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    assert load_scene(path).edited("blue").spec.objects[0].texture.color == "#2040c0"
    assert old in SMALL
    path.write_text(SMALL.replace(old, new))
    with pytest.raises(SceneError, match=says):
        load_scene(path)


@pytest.mark.parametrize(
    ("surface", "kind"),
    [
        ("emission: {radiance: 1, color: '#c04020'}", "a lamp"),
        ("material: {type: metal, roughness: 0.2, tint: '#c04020'}", "metal"),
    ],
)
def test_paint_that_nothing_would_show_is_refused(tmp_path, surface, kind):
    text = SMALL.replace("texture: {type: plain, color: '#c04020'}", surface)
    path = tmp_path / "small.yaml"
    path.write_text(text)
    load_scene(path)  # a colour is replaced wherever it stands
    path.write_text(text.replace("recolor: {'#c04020': '#2040c0'}", "paint: '#2040c0'"))
    with pytest.raises(SceneError, match=f"paint: 'ball' is {kind}, which shows no texture"):
        load_scene(path)


def test_edits_and_answers_that_are_not_there_are_told_with_what_is():
    scene = shipped("bear")
    with pytest.raises(
        SceneError, match=r"no edit 'polr'; did you mean 'polar'\?; bear has polar, panda"
    ):
        scene.edited("polr")
    with pytest.raises(
        SceneError, match=r"edit 'some_colour': no answer 'pink'; it has red, orange"
    ):
        scene.edited("some_colour", "pink")
    with pytest.raises(
        SceneError, match=r"edit 'polar': no answer 'red'; it has none: its result is the only one"
    ):
        scene.edited("polar", "red")
    assert (
        scene.edited("some_colour").content_hash == scene.edited("some_colour", "red").content_hash
    )


def test_the_command_line_lists_the_edits_of_a_scene():
    from typer.testing import CliRunner

    from attnwarp_eval.cli.main import app

    text = CliRunner().invoke(app, ["scenes", "edits", "bear"])
    assert text.exit_code == 0 and "polar: Turn the bear into a polar bear" in text.stdout
    assert "answer violet: bear (paint)" in text.stdout
    assert (
        CliRunner().invoke(app, ["scenes", "edits", "spheres"]).stdout == "spheres names no edits\n"
    )


def test_an_edited_specification_is_one_that_a_file_could_hold():
    scene = shipped("face")
    for edit, answer in results(scene):
        said = scene.edited(edit.name, answer).spec.model_dump(mode="json", exclude_unset=True)
        assert (
            SceneSpec.model_validate(said).objects == scene.edited(edit.name, answer).spec.objects
        )
