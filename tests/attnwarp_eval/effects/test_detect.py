"""Effects that a scene needs, what is planned for them, and materials, lamps, fog and lens against
closed forms.
"""

import functools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import FLOOR, GLASS, LAMP, MIRROR, PLAIN, POINT, SCENES, SKY, SUN, ball, make
from typer.testing import CliRunner

from attnwarp.camera import Camera
from attnwarp_eval.cli.main import app
from attnwarp_eval.effects import detect, proof, saving
from attnwarp_eval.scene import transport
from attnwarp_eval.scene.base import linear_rgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import SceneError
from attnwarp_eval.truth import Geometry, mitsuba
from attnwarp_eval.truth.mitsuba import build
from attnwarp_eval.truth.passes import Pass, Plan, beam
from attnwarp_eval.truth.plan import plan
from attnwarp_eval.truth.shading import emitted, irradiance, object_albedo

pytestmark = pytest.mark.usefixtures("coarse_textures")

EXPECTED = {
    "diffuse": ("direct", "perspective"),
    "interreflection": ("path", "perspective"),
    "specular": ("path", "perspective"),
    "refraction": ("path", "perspective"),
    "medium": ("volpath", "perspective"),
    "subsurface": ("volpath", "perspective"),
    "caustics": ("path + ptracer", "perspective"),
    "environment": ("direct", "perspective"),
    "depth_of_field": ("direct", "thinlens"),
}


@pytest.mark.parametrize("name", list(SCENES))
def test_each_effect_is_found_in_the_scene_that_calls_for_it_and_planned(name):
    scene = SCENES[name]()
    result = detect.detect(scene)
    if name != "diffuse":
        assert result[name].needed and result[name].simulated and result[name].source == "detected"
    made = plan(scene)
    assert (made.integrator, made.sensor) == EXPECTED[name]
    # Nothing is needed that the scene has no cause for.
    for other in (
        "medium",
        "subsurface",
        "depth_of_field",
        "caustics",
        "glossy",
        "motion",
        "dispersion",
    ):
        assert result[other].needed == (other == name)


def test_evidence_names_the_words_of_the_file_and_what_mitsuba_made_of_them():
    result = detect.detect(SCENES["refraction"]())
    assert "object 'ball' is glass" in result["refraction"].evidence
    assert any("plugin dielectric" in e for e in result["refraction"].evidence)
    assert any("BSDF flag Delta" in e for e in result["specular"].evidence)
    assert any(
        "ThinLens" in e or "thinlens" in e
        for e in detect.detect(SCENES["depth_of_field"]())["depth_of_field"].evidence
    )


def test_a_file_and_a_loaded_scene_that_disagree_are_refused(monkeypatch):
    scene, real = SCENES["refraction"](), transport.called_for
    monkeypatch.setattr(
        transport,
        "called_for",
        lambda spec: {k: v for k, v in real(spec).items() if k != "refraction"},
    )
    with pytest.raises(SceneError, match=r"shows refraction .* that the file does not"):
        detect.detect(scene)


def test_glossy_things_smooth_shading_and_textures_are_told_apart():
    gold = ball({"type": "metal", "metal": "Au", "roughness": 0.2})
    result = detect.detect(make([FLOOR, gold], [SUN, SKY]))
    assert (
        result["glossy"].needed and not result["specular"].needed and not result["caustics"].needed
    )
    assert not result["textures"].needed
    checked = FLOOR | {
        "texture": {"type": "checker", "colors": ["#ffffff", "#404040"], "size": 0.5}
    }
    result = detect.detect(make([checked, ball()], [SUN, SKY]))
    assert result["textures"].needed and any("Bitmap" in e for e in result["textures"].evidence)


def test_what_is_not_simulated_is_named():
    moving = ball() | {"velocity": [1, 0, 0]}
    prism = ball(GLASS | {"abbe": 30}, (1, 1, 0.4), 0.3, "prism")
    result = detect.detect(make([FLOOR, moving, prism], [SKY], 8))
    for name in ("motion", "dispersion", "polarisation"):
        assert result[name].needed and not result[name].simulated
    text = "\n".join(
        detect.describe(make([FLOOR, moving], [SKY]), detect.report(make([FLOOR, moving], [SKY])))
    )
    assert "NOT SIMULATED" in text and "motion" in text


def test_a_caustic_behind_a_lens_is_named_as_not_simulated():
    scene = make([FLOOR, ball(GLASS)], [POINT], 8, cameras={"lens": {"aperture": 0.1}})
    result = detect.detect(scene)
    assert result["caustics"].needed and not result["caustics"].simulated
    structure = proof.prove(scene, seconds=0.1).rungs[0]
    assert "caustics" in structure.words and "not proved" in structure.words


def test_a_scene_that_calls_for_what_is_not_simulated_is_never_certified():
    # Both sides are the same plan, so that every picture is equal: the comparison alone certifies
    # each time.
    lens = make([FLOOR, ball(GLASS)], [POINT], 8, cameras={"lens": {"aperture": 0.1}})
    moving = make([FLOOR, ball() | {"velocity": [1, 0, 0]}], [SKY])
    mirrors = make([FLOOR, ball(MIRROR)], [POINT], 4)
    for scene, missing in (
        (lens, "caustics"),
        (moving, "motion"),
        (SCENES["refraction"](), "polarisation"),
        (mirrors, "caustics seen in mirrors and through glass"),
    ):
        result = proof.prove(scene, against=plan(scene), size=8)
        assert result.of_simulated in ("certified", "can't tell"), list(result.lines())
        assert result.verdict == "can't tell" and missing in result.not_simulated
    still = make([FLOOR, ball()], [SKY])
    result = proof.prove(still, against=plan(still), size=8)
    assert (result.verdict, result.of_simulated, result.not_simulated) == (
        "certified",
        "certified",
        (),
    )
    # A difference is a difference whatever else is missing.
    lit = make([FLOOR, ball() | {"velocity": [1, 0, 0]}], [SUN, SKY])
    refused = proof.prove(lit, replace(plan(lit), passes=plan(lit).passes[:1]), size=8)
    assert refused.verdict == "refused"


def test_ideal_mirrors_alone_polarise_nothing_and_metal_and_glass_do():
    mirrors = [ball(MIRROR, name="a"), ball(MIRROR, (1.5, 0, 0.7), name="b")]
    metal = ball({"type": "metal", "metal": "Al"}, (0, 1.5, 0.7), name="c")

    def calls(objects):
        return "polarisation" in transport.called_for(make([FLOOR, *objects], [SKY], 8).spec)

    assert not calls(mirrors) and not calls([metal])
    assert calls([*mirrors, metal]) and calls([ball(GLASS)])


def test_the_command_line_ends_with_3_and_names_what_is_not_simulated(monkeypatch):
    scene = make([FLOOR, ball() | {"velocity": [1, 0, 0]}], [SKY], size=8)
    monkeypatch.setattr("attnwarp_eval.scene.file.load_scene", lambda name: scene)
    monkeypatch.setattr(
        saving, "measure", functools.partial(saving.measure, size=8, spp=4, rounds=2)
    )
    result = CliRunner().invoke(app, ["scenes", "effects", "moving", "--prove"])
    assert result.exit_code == 3, result.output
    assert "not simulated: motion" in " ".join(result.output.split())


def test_only_geometry_needs_no_light():
    made = plan(SCENES["refraction"](), want="geometry")
    assert made.passes == () and made.integrator == "raycast"


def test_a_single_convex_surface_needs_one_bounce_only():
    assert plan(make([ball()], [SKY], "unlimited")).integrator == "direct"
    assert plan(make([FLOOR, ball()], [SKY], "unlimited")).integrator == "path"


def test_a_large_lamp_is_left_to_camera_paths_and_a_small_one_is_not():
    lamp = lambda size: LAMP | {"shape": LAMP["shape"] | {"size": [size, size]}}  # noqa: E731
    assert plan(make([FLOOR, ball(GLASS), lamp(1.5)], [], 8)).integrator == "path"
    assert plan(make([FLOOR, ball(GLASS), lamp(0.1)], [], 8)).integrator == "path + ptracer"


# The words of a file
# --------------------------------------------------------------------------------------------------


def refused(match, *args, **kwargs):
    with pytest.raises(SceneError, match=match):
        plan(make(*args, **kwargs))


def test_contradictions_are_refused_with_the_remedy():
    fog = {"sigma_t": 0.1}
    refused(
        "'medium' is forbidden, but the scene calls for it .*take away 'medium'",
        [FLOOR],
        [SKY],
        medium=fog,
        effects={"forbid": ["medium"]},
    )
    refused(
        "'medium' is pinned, but nothing here causes it",
        [FLOOR],
        [SKY],
        effects={"pin": ["medium"]},
    )
    refused(
        "'dispersion' is not simulated, so it cannot be pinned",
        [FLOOR, ball(GLASS | {"abbe": 30})],
        [SKY],
        8,
        effects={"pin": ["dispersion"]},
    )
    refused("is pinned as well", [FLOOR], [SKY], effects={"pin": ["direct"], "forbid": ["direct"]})
    refused("every picture needs the geometry", [FLOOR], [SKY], effects={"forbid": ["geometry"]})
    refused(
        "bounces: got 1, but object 'ball' is glass: .*say at least 3", [FLOOR, ball(GLASS)], [SKY]
    )
    blob = {
        "type": "body",
        "parts": [{"type": "ellipsoid", "center": [0, 0, 1], "radii": [1, 1, 1]}],
    }
    plastic = ball({"type": "plastic"})
    refused("'ball' is plastic and its shape a body; plastic can be a sphere, a box or a rectangle",
            [FLOOR, plastic | {"shape": blob}], [SKY])  # fmt: skip
    assert plan(make([FLOOR, plastic], [SKY]))
    allowed = make(
        [FLOOR, ball()],
        [SKY],
        effects={"pin": ["environment"], "forbid": ["medium", "interreflection"]},
    )
    assert detect.detect(allowed)["environment"].source == "pinned"


def test_a_contradiction_in_a_file_names_its_line(tmp_path):
    text = """\
name: wrong
title: t
objects:
  - name: floor
    shape: {type: rectangle, center: [0, 0, 0], size: [4, 4]}
    texture: {type: plain, color: '#808080'}
lights: [{type: sky, horizon: '#ffffff', zenith: '#ffffff'}]
medium: {sigma_t: 0.2}
effects:
  pin: [medium]
  forbid:
    - caustics
    - depth_of_field
    - medium
cameras: {look_at: [0, 0, 0], radius: 3, source: {yaw: 0, height: 1}, targets: [{yaw: 30, height: 1}]}
"""
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(
        SceneError, match=r"wrong\.yaml:14: effects\.forbid: 'medium' is pinned as well"
    ):
        load_scene(path)
    path.write_text(text.replace("medium: {sigma_t: 0.2}", "medium: {sigma: 0.2}"))
    with pytest.raises(
        SceneError,
        match=r"wrong\.yaml:8: medium\.sigma: unknown key 'sigma'; did you mean 'sigma_t'\?",
    ):
        load_scene(path)
    path.write_text(
        text.replace("lights: [{type: sky, horizon: '#ffffff', zenith: '#ffffff'}]", "lights: []")
    )
    with pytest.raises(SceneError, match="lights: there is none, and no object has an 'emission'"):
        load_scene(path)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"material": MIRROR, "texture": PLAIN}, "mirror shows none; use the material's 'tint'"),
        ({}, "got no texture, but diffuse things need one"),
        ({"material": MIRROR, "emission": {"radiance": 1}}, "what shines has no other material"),
        ({"material": GLASS | {"thin": True, "roughness": 0.1}}, "a thin pane has neither"),
        ({"material": GLASS | {"roughness": 0.001}}, r"expected 0 \(smooth\) or at least 0.01"),
    ],
)
def test_materials_that_cannot_be_are_refused(said, message):
    item = {"name": "x", "shape": {"type": "sphere", "center": [0, 0, 1], "radius": 1}} | said
    with pytest.raises(ValueError, match=message):
        make([item], [SKY])


def test_keys_that_say_what_was_meant_anyway_change_no_hash_and_others_do():
    bare = make([FLOOR], [SKY])
    same = make(
        [FLOOR | {"material": {"type": "diffuse"}, "emission": None}],
        [SKY],
        medium=None,
        effects={"pin": []},
    )
    assert same.content_hash == bare.content_hash and same.world_hash == bare.world_hash
    lens = make([FLOOR], [SKY], cameras={"lens": {"aperture": 0.1}})
    assert lens.content_hash != bare.content_hash and lens.world_hash == bare.world_hash
    assert make([FLOOR], [SKY], medium={"sigma_t": 1}).world_hash != bare.world_hash


# Materials, lamps, fog and lens against closed forms
# --------------------------------------------------------------------------------------------------


def looking_down(objects, lights, *, size=8, height=4.0, fov=5.0, **rest):
    """A narrow view of the origin from above, and the mean of its picture."""
    scene = make(objects, lights, spp=64, **rest)
    camera = Camera.look_at((0, 0, height), (0, 1e-6, 0), width=size, height=size, fov_y=fov)
    return mitsuba.render_plan(scene, camera, plan(scene), 0).mean((0, 1))


WHITE = FLOOR | {"texture": {"type": "plain", "color": "#bcbcbc"}}
ALBEDO = linear_rgb("#bcbcbc")[0]


def test_a_point_light_gives_intensity_over_squared_distance_and_a_spot_the_same_in_its_beam():
    at = [1.0, 0, 2.0]
    expected = ALBEDO / math.pi * 3.0 * (2 / math.sqrt(5)) / 5
    point = looking_down([WHITE], [{"type": "point", "position": at, "intensity": 3.0}])
    spot = looking_down(
        [WHITE], [{"type": "spot", "position": at, "target": [0, 0, 0], "intensity": 3.0}]
    )
    # The view is 0.35 wide, over which the light changes by a few percent and evenly: the mean is
    # that of the middle.
    assert np.allclose(point, expected, rtol=0.01) and np.allclose(spot, expected, rtol=0.01)
    away = {"type": "spot", "position": at, "target": [3, 0, 0], "intensity": 3.0, "cutoff": 20}
    assert (looking_down([WHITE], [away]) == 0).all()


def test_a_square_lamp_gives_the_irradiance_of_its_form_factor():
    # Point below the middle of a parallel rectangle: four corner rectangles of a x b at height h,
    # each (1 / 2 pi) (A atan(B') + B atan(A')), Howell's catalogue of configuration factors, B-3.
    a = b = 0.75 / 3
    corner = a / math.hypot(1, a) * math.atan(b / math.hypot(1, a)) + b / math.hypot(
        1, b
    ) * math.atan(a / math.hypot(1, b))
    factor = 4 * corner / (2 * math.pi)
    scene = make([WHITE, LAMP], [], spp=256)
    camera = Camera.look_at((2, 0, 1), (0, 0, 0), width=8, height=8, fov_y=1)
    got = mitsuba.render_plan(scene, camera, plan(scene), 0).mean()
    assert got == pytest.approx(
        ALBEDO * 4.0 * factor, rel=0.01
    )  # 16,384 samples of a lamp seen whole: noise 0.1 %


def test_a_lamp_shines_where_it_faces_and_is_black_behind():
    scene = make([FLOOR, LAMP], [], spp=16)
    up = Camera.look_at((0, 0, 0.5), (0, 1e-3, 3), width=8, height=8, fov_y=5)
    assert np.allclose(mitsuba.render_plan(scene, up, plan(scene), 0), 4.0, rtol=1e-5)
    down = Camera.look_at((0, 0, 5), (0, 1e-3, 0), width=8, height=8, fov_y=5)
    assert (mitsuba.render_plan(scene, down, plan(scene), 0) == 0).all()


def test_fog_takes_light_as_beer_and_lambert_say():
    black = WHITE | {"emission": {"radiance": 2.0}}
    del black["texture"]
    fog = {"sigma_t": 0.5, "albedo": 0.0, "box": {"center": [0, 0, 1], "size": [20, 20, 2.5]}}
    # The camera stands outside at 4; the fog reaches from -0.25 to 2.25, the lamp at 0 shines up
    # through 2.25 of it.
    got = looking_down([black], [], bounces=4, medium=fog)
    assert np.allclose(got, 2.0 * math.exp(-0.5 * 2.25), rtol=0.03)
    inside = looking_down([black], [], bounces=4, height=1.5, medium=fog)
    assert np.allclose(inside, 2.0 * math.exp(-0.5 * 1.5), rtol=0.03)


def test_without_a_box_fog_holds_all_objects_and_cameras():
    scene = make([FLOOR, ball()], [POINT], 4, medium={"sigma_t": 0.1})
    low, high = build.fog_box(scene)
    assert (low < [-3, -3, 0]).all() and (high > [3, 3, 2.8]).all()
    for camera in scene.cameras:
        assert ((camera.position > low) & (camera.position < high)).all()


def test_a_pane_lets_through_what_fresnel_says():
    lamp = {k: v for k, v in FLOOR.items() if k != "texture"} | {"emission": {"radiance": 1.0}}
    pane = {
        "name": "pane", "shape": {"type": "rectangle", "center": [0, 0, 1], "size": [4, 4]},
        "material": GLASS | {"thin": True},
    }  # fmt: skip
    r = ((1.5 - 1) / (1.5 + 1)) ** 2
    # Of a pane, with all reflections inside: T = (1 - r) / (1 + r); the lamp reflects nothing.
    assert np.allclose(looking_down([lamp, pane], [], bounces=8), (1 - r) / (1 + r), rtol=0.01)
    # In fog there are 3 of it before the pane and 1 behind; of 4096 samples the noise is 2 %.
    fog = {"sigma_t": 0.2, "albedo": 0.0, "box": {"center": [0, 0, 2], "size": [20, 20, 6]}}
    foggy = looking_down([lamp, pane], [], bounces=8, medium=fog)
    assert np.allclose(foggy, math.exp(-0.2 * 4) * (1 - r) / (1 + r), rtol=0.08)


def test_glass_that_light_could_not_leave_is_refused():
    solid = {k: v for k, v in FLOOR.items() if k != "texture"} | {"material": GLASS}
    with pytest.raises(SceneError, match="is glass and its shape a rectangle, .* say thin: true"):
        plan(make([solid, ball()], [SKY], 4))


def test_a_mirror_shows_what_stands_before_it_times_its_tint():
    mirror = {k: v for k, v in FLOOR.items() if k != "texture"} | {
        "material": MIRROR | {"tint": "#bcbcbc"}
    }
    lamp = LAMP | {
        "shape": {"type": "rectangle", "center": [0, 0, 6], "size": [8, 8], "facing": [0, 0, -1]}
    }
    assert np.allclose(looking_down([mirror, lamp], [], bounces=4), 4.0 * ALBEDO, rtol=1e-3)


def test_a_glass_ball_bends_rays_as_snell_says():
    # Through the middle of a ball nothing is bent; elsewhere it turns the picture upside down: a
    # ball lens focuses at n r / 2 (n - 1) = 1.5 r from its centre, far before the wall.
    left = {
        "name": "left",
        "shape": {
            "type": "rectangle",
            "center": [-8, -20, 0],
            "size": [40, 80],
            "facing": [1, 0, 0],
        },
    }
    scene = make([left | {"emission": {"radiance": 1.0}}, ball(GLASS, (0, 0, 0), 0.5)], [], 8)
    camera = Camera.look_at((4, 0, 0), (0, 0, 0), width=64, height=64, fov_y=30)
    image = mitsuba.render_plan(scene, camera, plan(scene, 16), 0).mean(-1)
    owner = Geometry(scene).trace(camera).object_id
    bright = image > 0.5
    # Seen directly the lit half is the one toward -y; through the ball it is the other.
    columns = np.arange(64)[None] + np.zeros((64, 1))
    through, direct = owner == 1, owner == 0
    assert direct.any() and through.sum() > 400
    side = np.sign(np.median(columns[bright & direct]) - 31.5)
    near = (
        through & (np.abs(columns - 31.5) > 3) & (np.hypot(columns - 31.5, columns.T - 31.5) < 12)
    )
    assert (bright == (np.sign(columns - 31.5) == -side))[near].mean() > 0.97


def test_a_lens_blurs_a_far_dot_over_its_circle_of_confusion():
    dot = {
        "name": "dot",
        "shape": {"type": "sphere", "center": [0, 0, 0], "radius": 0.01},
        "emission": {"radiance": 1.0},
    }
    # The middle of 64 px under 20 degrees, twice as wide as the circle.
    camera = Camera.look_at((6, 0, 0), (0, 0, 0), width=24, height=24, fov_y=7.6)
    f, aperture = camera.K[0, 0], 0.2

    def spread(focus):
        scene = make([dot], [], cameras={"lens": {"aperture": aperture, "focus": focus}})
        image = mitsuba.render_plan(scene, camera, plan(scene, 1024), 0).mean(-1)
        rows, columns = np.nonzero(image)
        return (np.ptp(columns) + 1 + np.ptp(rows) + 1) / 2, image.sum()

    sharp, light = spread(6.0)
    wide, same = spread(3.0)
    # Radius of the circle: f A |1/z - 1/focus| px; the dot itself is 2 * 0.01 / 6 * f = 0.6 px
    # wide.
    assert sharp <= 2 and wide == pytest.approx(2 * f * aperture * (1 / 3 - 1 / 6) + 0.6, abs=1.5)
    assert light == pytest.approx(same, rel=0.15)  # light is spread, not lost


def test_without_a_focus_what_the_cameras_look_at_is_sharp():
    scene = make([FLOOR, ball()], [SUN], cameras={"lens": {"aperture": 0.1}})
    for camera in scene.cameras:
        expected = np.linalg.norm(camera.position - scene.center)
        assert build.focus_distance(scene, camera) == pytest.approx(expected, rel=1e-9)


def test_a_lens_refuses_a_principal_point_off_the_middle():
    scene = make([FLOOR], [SUN], cameras={"lens": {"aperture": 0.1}})
    K = scene.source.K.copy()
    K[0, 2] += 3
    with pytest.raises(ValueError, match=r"principal point .* but a lens needs it there"):
        mitsuba.render_plan(
            scene, Camera(K, scene.source.world_to_camera, 32, 32), plan(scene, 1), 0
        )


def test_light_paths_and_camera_paths_agree_on_a_caustic_that_both_can_find():
    # A large lamp through a ball of glass: camera paths find its caustic too, without any of the
    # machinery of light paths, of which pixels they are for, and of adding the two up.
    scene = make([FLOOR, ball(GLASS), LAMP], [], 8, size=16)
    camera_paths = plan(scene, 64)
    assert camera_paths.integrator == "path"
    both = Plan(
        (
            Pass((), "path", 9, 1, 1, 64, True, 10, "smooth"),
            Pass((), "ptracer", 9, 1, 1, 256, True, 10),
        ),
        (),
    )
    a, b = (
        np.stack([mitsuba.render_plan(scene, scene.source, made, first + k) for k in range(12)])
        for made, first in ((both, 0), (camera_paths, 100))
    )
    assert not any(level.differs for level in proof.levels(a, b, alpha=0.001))
    assert proof.equivalence(a, b, margin=0.02).equal


def test_a_cone_upon_the_smooth_objects_holds_them():
    axis, angle = beam(SCENES["caustics"](), 0)
    position, center, radius = np.array(POINT["position"]), np.array([0, 0, 0.7]), 0.6
    distance = np.linalg.norm(center - position)
    assert np.allclose(axis, center - position)
    assert angle > np.degrees(np.arcsin(radius / distance))
    assert beam(make([FLOOR, ball(GLASS)], [SUN], 8), 0) is None
    inside = POINT | {"position": [0.5, 0, 1.3]}
    assert beam(make([FLOOR, ball(GLASS)], [inside], 8), 0) is None
    middle = POINT | {"position": center.tolist()}
    assert beam(make([FLOOR, ball(GLASS)], [middle], 8), 0) is None


@pytest.mark.parametrize("name", ["point", "spot", "square", "globe"])
def test_pictures_lit_by_lamps_converge_to_the_light_that_ray_casting_finds(name):
    globe = {
        "name": "globe",
        "shape": {"type": "sphere", "center": [1, 1, 2.5], "radius": 0.4},
        "emission": {"radiance": 9.0},
    }
    spot = {
        "type": "spot",
        "position": [1, 1, 3],
        "target": [0, 0, 0],
        "intensity": 8.0,
        "cutoff": 40,
        "beam": 10,
    }
    objects, lights = {
        "point": ([], [POINT]),
        "spot": ([], [spot]),
        "square": ([LAMP], []),
        "globe": ([globe], []),
    }[name]
    scene = make([FLOOR, ball(), *objects], lights, size=32)
    geometry, camera = Geometry(scene), scene.source
    image = mitsuba.render_plan(scene, camera, plan(scene, 64), 0)
    hits = geometry.trace(camera)
    flat = [
        a.reshape(-1, *a.shape[2:])[hits.valid.ravel()]
        for a in (hits.point, hits.normal, hits.primitive_id)
    ]
    light = irradiance(scene, geometry, *flat, rays=64)
    expected = np.zeros_like(image, dtype=np.float64)
    expected[hits.valid] = object_albedo(scene, geometry, flat[0], flat[2]) / np.pi * light
    expected[hits.valid] += emitted(scene, geometry, flat[2])
    # Rays go through the middles of pixels only and 64 points stand for a lamp: edges of shadows
    # differ, means do not.
    assert image.mean() == pytest.approx(expected.mean(), rel=0.02)
    assert np.corrcoef(image.ravel(), expected.ravel())[0, 1] > 0.98


def test_geometry_of_glass_is_its_first_surface():
    plain, glass = make([FLOOR, ball()], [SKY]), make([FLOOR, ball(GLASS)], [SKY], 8)
    a, b = (Geometry(scene).trace(scene.source) for scene in (plain, glass))
    assert np.array_equal(a.object_id, b.object_id) and np.array_equal(
        a.depth, b.depth, equal_nan=True
    )
    foggy = make([FLOOR, ball()], [SKY], medium={"sigma_t": 0.1})
    position, object_id = mitsuba.position_and_shape(foggy, foggy.source)
    assert np.array_equal(object_id, a.object_id) or (object_id == a.object_id).mean() > 0.995
    assert np.isfinite(position[object_id >= 0]).all()


# The command line
# --------------------------------------------------------------------------------------------------


def test_the_command_line_prints_effects_and_plan_for_people_and_as_json(monkeypatch):
    monkeypatch.setattr(
        saving, "measure", functools.partial(saving.measure, size=16, spp=4, rounds=2)
    )
    runner = CliRunner()
    out = json.loads(runner.invoke(app, ["scenes", "effects", "opposed", "--json"]).stdout)
    assert out["effects"]["textures"]["needed"] and not out["effects"]["medium"]["needed"]
    assert out["plan"]["integrator"] == "direct" and out["plan"]["sensor"]["type"] == "perspective"
    assert out["everything_on"]["integrator"] == "volpath" and out["cost"]["seconds"][0] > 0
    text = runner.invoke(app, ["scenes", "effects", "opposed", "--prove"]).stdout
    assert (
        "plan: direct" in text
        and "because the sky is smooth" in text
        and "everything on: volpath" in text
    )
    assert "proof: certified" in text and "smallest difference that could have been seen" in text
    assert runner.invoke(app, ["scenes", "effects", "sphere"]).exit_code == 2


@pytest.mark.slow
def test_file_and_loaded_scene_agree_on_every_scene_that_ships():
    from attnwarp_eval.scene.file import list_scenes

    for name in list_scenes():
        detect.detect(load_scene(name))
