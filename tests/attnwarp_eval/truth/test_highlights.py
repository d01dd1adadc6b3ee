"""The six scenes that stand for the field's own have highlights, where optics puts them."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from direct_light import direct

from attnwarp_eval.effects import detect
from attnwarp_eval.scene.base import linear_rgb
from attnwarp_eval.scene.materials import DiffuseMaterial, PlasticMaterial
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import SphereSpec
from attnwarp_eval.scene.textures import albedo
from attnwarp_eval.truth import Geometry
from attnwarp_eval.truth.mitsuba import render_plan
from attnwarp_eval.truth.plan import plan
from attnwarp_eval.truth.shading import sun_direction

SIX = ["bear", "dinosaur", "face", "garden", "person", "stump"]
PARTLY_SLOW = [
    pytest.param(name, marks=[] if name == "bear" else [pytest.mark.slow]) for name in SIX
]
SIZE = 160
pytestmark = pytest.mark.usefixtures("coarse_textures")
LARGE = 80  # pixels that a ball covers; on smaller ones a highlight is less than a pixel


@functools.lru_cache(maxsize=6)
def world(name):
    # One bounce, so that the sun has a pass of its own.
    scene = direct(name).with_size(SIZE, SIZE)
    return scene, Geometry(scene)


def glossy_balls(scene):
    return [
        k
        for k, item in enumerate(scene.spec.objects)
        if isinstance(item.material, PlasticMaterial) and isinstance(item.shape, SphereSpec)
    ]


def matt(scene):
    """Copy of a scene without any coat."""
    objects = tuple(
        item.model_copy(update={"material": DiffuseMaterial()}) for item in scene.spec.objects
    )
    return Scene(scene.spec.model_copy(update={"objects": objects}), scene.path)


def sunlit(scene, camera):
    """The sun's part of the picture, which has no noise but that of the pixel's area."""
    made = plan(scene, 16)
    assert [scene.spec.lights[k].type for k in made.passes[0].lights] == ["sun"]
    return render_plan(scene, camera, replace(made, passes=made.passes[:1]), 1)


def spot(scene, geometry, ball, camera):
    """(x, y) where optics puts the sun's highlight on a ball, None where it is in the shade, hidden
    or outside.

    There the normal halves the angle between the ways to the sun and to the camera.
    """
    shape, sun = scene.spec.objects[ball].shape, sun_direction(scene.spec.lights[0])
    center, normal = np.array(shape.center), sun
    for _ in range(50):
        view = camera.position - (center + shape.radius * normal)
        half = sun + view / np.linalg.norm(view)
        normal = half / np.linalg.norm(half)
    point = center + shape.radius * normal
    if normal @ sun < 0.1 or normal @ (camera.position - point) <= 0:
        return None
    seen = geometry.trace_rays(camera.position, (point - camera.position)[None])
    lit = geometry.trace_rays(point + 1e-4 * normal, sun[None])
    x, y, z = camera.K @ (camera.rotation @ (point - camera.position))
    inside = z > 0 and 2 < x / z < camera.width - 2 and 2 < y / z < camera.height - 2
    return (x / z, y / z) if abs(seen.t[0] - 1) < 1e-6 and not lit.valid[0] and inside else None


@pytest.mark.parametrize("name", PARTLY_SLOW)
def test_the_six_call_for_gloss_and_no_edit_takes_it_away(name):
    scene, _ = world(name)
    result = detect.detect(scene)["glossy"]
    assert result.needed and result.simulated and result.source == "detected"
    assert "is plastic" in result.evidence[0] and any(
        "BSDF flag Glossy" in e for e in result.evidence
    )
    shiny = {item.name for item in scene.spec.objects if item.material.type == "plastic"}
    assert 1 <= len(shiny) <= 4
    for edit in scene.edits:
        changes = list(edit.changes) + [
            change for answer in edit.answers for change in answer.changes
        ]
        assert not shiny & {change.object for change in changes}


@pytest.mark.parametrize("name", PARTLY_SLOW)
def test_a_highlight_is_seen_from_the_source_and_most_targets(name):
    scene, geometry = world(name)
    balls = glossy_balls(scene)
    seen = [any(spot(scene, geometry, k, camera) for k in balls) for camera in scene.cameras]
    assert seen[0] and sum(seen[1:]) >= 6, [
        c.name for c, s in zip(scene.cameras, seen, strict=True) if not s
    ]


@pytest.mark.parametrize("name", PARTLY_SLOW)
def test_the_highlight_is_brighter_than_any_paint_and_lies_where_optics_puts_it(name):
    scene, geometry = world(name)
    owner = geometry.trace(scene.source).object_id
    fine = geometry.trace(scene.source.resize(3 * SIZE, 3 * SIZE))
    sun = scene.spec.lights[0]
    light = sun.irradiance * np.array(linear_rgb(sun.color)) / np.pi
    shiny, dull = sunlit(scene, scene.source), sunlit(matt(scene), scene.source)
    checked = 0
    for k in glossy_balls(scene):
        at = spot(scene, geometry, k, scene.source)
        mine = owner == k
        if at is None or mine.sum() < LARGE:
            continue
        # A diffuse surface cannot show more than its albedo times what a surface that faces the sun
        # receives, over pi.
        bound = (
            albedo(scene.spec.objects[k].texture, fine.point[fine.object_id == k]).max(axis=0)
            * light
        )
        inner = (
            mine
            & np.roll(mine, 1, 0)
            & np.roll(mine, -1, 0)
            & np.roll(mine, 1, 1)
            & np.roll(mine, -1, 1)
        )
        assert (dull[inner] <= 1.05 * bound).all()
        assert (shiny[inner] > 1.2 * bound).all(axis=-1).any()
        y, x = np.unravel_index(np.where(inner, shiny.sum(-1), -1).argmax(), inner.shape)
        assert np.hypot(x + 0.5 - at[0], y + 0.5 - at[1]) < 1.5
        checked += 1
    assert checked
