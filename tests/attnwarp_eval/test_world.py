"""A scene's world. Oracles: angles written out by hand, and what is loaded."""

import gc
import math
import weakref

import numpy as np
import pytest
from ball_scene import ball_scene

from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import SceneSpec
from attnwarp_eval.splats.export import orbit
from attnwarp_eval.study.shared.edit_truth import neighbours
from attnwarp_eval.truth import Geometry, appearance, two_view
from attnwarp_eval.truth.mitsuba import build
from attnwarp_eval.world import World, turned, world


def world_of(*yaws, source=0):
    cameras = {"look_at": [0, 0, 0.8], "radius": 3.5, "targets": yaws}
    data = ball_scene("A ball", 0.9, ("#c0c0c0", "#d0d0d0"), cameras, [])
    data["cameras"]["source"]["yaw"] = source
    return World(Scene(SceneSpec.model_validate(data)), 16)


@pytest.mark.parametrize(
    ("yaws", "source", "expected"),
    [
        (
            (-60, 30, -120, 90, 60, -30, 120, -90),
            0,
            {30: "source", 60: 30, 90: 60, 120: 90, -30: "source", -60: -30, -90: -60, -120: -90},
        ),
        ((20, 60, 0), 40, {20: "source", 60: "source", 0: 20}),
        ((-90, -179, 90), 0, {90: "source", -90: "source", -179: -90}),
        ((170, -175), 0, {170: "source", -175: 170}),  # 15 degrees apart, across the back
        ((330, 300), 0, {330: "source", 300: 330}),
    ],
)
def test_a_views_neighbour_is_the_nearest_by_signed_yaw(yaws, source, expected):
    world = world_of(*yaws, source=source)
    names = dict(zip(yaws, world.targets, strict=True))
    assert neighbours(world, list(world.targets)) == {
        names[yaw]: names.get(other, other) for yaw, other in expected.items()
    }


def test_in_a_scene_of_one_side_each_view_follows_the_one_before():
    world = World(load_scene("spheres"), 16)
    names = ["yaw010", "yaw020", "yaw030", "yaw045", "yaw060", "yaw075", "yaw090", "yaw120",
             "yaw150", "yaw180"]  # fmt: skip
    expected = dict(zip(names, ["source", *names], strict=False))
    assert neighbours(world, names[::-1]) == expected


def test_a_camera_that_is_added_has_the_sign_of_its_side():
    world = world_of(30)
    for camera in orbit(world.scene, 8):
        world.add(camera)
        x, y, _ = camera.position  # the source is on the positive x axis
        assert (world.signed_yaw[camera.name] > 0) == (y > 0)
        assert abs(world.signed_yaw[camera.name]) == world.yaw[camera.name]
        assert world.yaw[camera.name] == pytest.approx(
            math.degrees(math.acos(x / math.hypot(x, y)))
        )


def test_a_turned_source_keeps_its_own_radius_angle_and_point():
    scene = load_scene("spheres")
    around = scene.spec.cameras
    own = around.source.model_copy(update={"radius": 2.0, "fov": 30.0, "look_at": (0.2, 0.1, 0.7)})
    cameras = around.model_copy(update={"source": own})
    scene = Scene(scene.spec.model_copy(update={"cameras": cameras}))
    whole, third = turned(scene, 360), turned(scene, 120)
    np.testing.assert_allclose(whole.position, scene.source.position, atol=1e-12)
    np.testing.assert_allclose(whole.world_to_camera, scene.source.world_to_camera, atol=1e-12)
    np.testing.assert_allclose(third.K, scene.source.K)
    offset = (third.position - np.array(around.look_at))[:2]
    angle = np.radians(own.yaw + 120)
    np.testing.assert_allclose(offset, [2 * np.cos(angle), 2 * np.sin(angle)], atol=1e-12)
    xy, _ = third.project(np.array(own.look_at))
    np.testing.assert_allclose(xy, [third.width / 2, third.height / 2], atol=1e-6)


def test_the_relation_of_any_two_views_is_that_of_their_cameras_and_goes_with_its_scene():
    spheres = world("spheres", 16)
    scene = load_scene("spheres").with_size(16, 16)
    cameras = {camera.name: camera for camera in scene.cameras}
    for first, second in (("yaw060", "yaw030"), ("source", "yaw030")):
        expected = two_view(Geometry(scene), cameras[first], cameras[second])
        pair = spheres.between(first, second)
        np.testing.assert_array_equal(pair.xy, expected.xy)
        np.testing.assert_array_equal(pair.label, expected.label)
        assert spheres.between(first, second) is pair
    former = weakref.ref(pair)
    del spheres, pair
    world("opposed", 16)
    gc.collect()
    assert former() is None


def test_another_scenes_world_forgets_loaded_scenes_and_the_same_scenes_keeps_them(
    coarse_textures,
):
    first = world("spheres", 16)
    appearance(first.scene, first.source, spp=1, seed=123)
    loaded = {*build._loaded}
    assert loaded
    world("spheres", 16)
    assert {*build._loaded} == loaded
    world("opposed", 16)
    assert not build._loaded
