"""The number of bounces that a scene calls for: against light whose sum is known."""

import dataclasses

import numpy as np
import pytest
import yaml
from effect_scenes import FLOOR, GLASS, MIRROR, SKY, SUN, WALL, ball, make
from typer.testing import CliRunner

from attnwarp.camera import Camera
from attnwarp_eval.cli.main import app
from attnwarp_eval.scene.file import list_scenes, load_scene
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import SceneSpec
from attnwarp_eval.study import Store, parse_study
from attnwarp_eval.study.run import plan as plan_run
from attnwarp_eval.truth import bounces, mitsuba
from attnwarp_eval.truth.bounces import dealt, search, shortfall, worlds
from attnwarp_eval.truth.plan import bounces_of, everything_on, open_bounces, plan

pytestmark = pytest.mark.usefixtures("coarse_textures")

VIEW = Camera.look_at((0, 0, 3), (0, 0, 0), width=8, height=8, fov_y=45, up=(0, 1, 0))


def furnace(albedo, noise, seed=0):
    """Pictures inside a white furnace: n bounces show 1 - albedo ** n of its light."""

    def pictures(number, view, spp):
        light = 1.0 if number == "unlimited" else 1 - albedo**number
        key = 0 if number == "unlimited" else number
        random = np.random.default_rng((seed, key, spp))
        spread = noise / np.sqrt(spp)
        return light + random.normal(0, spread, (bounces.PAIRS, 8, 8, 3))

    return pictures


def fewest(pictures):
    return next(n for n in range(1, 13) if shortfall(pictures, n, VIEW).holds)


@pytest.mark.parametrize(("albedo", "expected"), [(0.005, 1), (0.05, 2), (0.2, 3), (0.5, 7)])
def test_the_number_is_the_first_whose_missing_light_is_below_one_percent(albedo, expected):
    # albedo ** n < 0.01: 0.005 < 0.01; 0.0025; 0.008; 0.0078.
    assert fewest(furnace(albedo, 1e-3)) == expected
    held = shortfall(furnace(albedo, 1e-3), expected, VIEW)
    assert held.difference == pytest.approx(albedo**expected, abs=5 * max(held.error, 1e-6))


def test_noise_calls_for_more_samples_and_never_passes_for_light_that_is_there():
    quiet, loud = (shortfall(furnace(0.08, noise), 2, VIEW) for noise in (0.01, 2.0))
    assert quiet.holds and quiet.spp == bounces.SAMPLES[0] and loud.spp > quiet.spp
    # 1.2 % is missing: however loud the noise, each of three looks accepts that with a chance below
    # 1 %; 100 trials, the 99.9 % range of a binomial of 3 %.
    accepted = sum(shortfall(furnace(0.012, 0.7, seed), 1, VIEW).holds for seed in range(100))
    assert accepted <= 9


def closed(albedo, **rest):
    """A floor and a wall of one gray, which light each other."""
    gray = {"type": "plain", "color": albedo, "variation": 0.0, "grain": 0.1}
    return make([FLOOR | {"texture": gray}, WALL | {"texture": gray}], [SKY, SUN], None, **rest)


def test_pictures_dealt_from_one_expect_the_same_pixels():
    # A ramp across the cells of every pixel, and no noise. Dealt by place, the pictures would differ
    # by the ramp; by chance, their means differ as those of as many draws from it.
    side, pixels = 4, 40
    ramp = np.tile(np.arange(side * side).reshape(side, side), (pixels, pixels)).astype(float)
    pictures = dealt(np.repeat(ramp[..., None], 3, axis=-1))
    assert pictures.shape == (bounces.PAIRS, pixels, pixels, 3)
    assert (np.sort(pictures, axis=0)[:, ..., 0] == np.arange(16)[:, None, None]).all()
    means = pictures.mean((1, 2, 3))
    expected = np.sqrt((16**2 - 1) / 12) / pixels
    assert 0.5 * expected < means.std(ddof=1) < 1.5 * expected


def test_a_corner_of_two_walls_needs_the_bounces_that_everything_on_shows(monkeypatch, tmp_path):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    monkeypatch.setattr(bounces, "SIZE", 16)
    scene = closed("#c0c0c0", size=16)
    result = search(scene)
    assert isinstance(result.bounces, int) and result.held.holds and not result.fewer.holds
    assert result.held.bounces == result.bounces == result.fewer.bounces + 1
    # Everything on (another integrator, other seeds) says the same of the light that is missing.
    endless = everything_on(scene, 64, capped=False)
    for number, held in ((result.bounces, True), (result.bounces - 1, False)):
        light = [
            np.mean([mitsuba.render_plan(scene, scene.source, made, seed) for seed in range(8)])
            for made in (plan(scene, 64, bounces=number), endless)
        ]
        assert (light[1] / light[0] - 1 < bounces.MARGIN) == held
        # With other seeds, too.
        assert shortfall(bounces.pictures_of(scene, 7), number, scene.source).holds == held


def test_a_black_world_needs_one_bounce_and_a_mirror_or_glass_what_it_shows(monkeypatch):
    monkeypatch.setattr(bounces, "SIZE", 16)
    assert search(closed("#000000")).bounces == 1
    least = {None: 1, "mirror": 2, "glass": 3}
    for material in (None, MIRROR, GLASS):
        spec = make([FLOOR, ball(material)], [SKY], None).spec
        expected = least[material["type"] if material else None]
        assert bounces.transport.fewest_bounces(spec) == expected


FILE = """\
name: corner
title: A corner  # of two walls
objects:
  - {name: floor, shape: {type: rectangle, center: [0, 0, 0], size: [6, 6], facing: [0, 0, 1]},
     texture: {type: plain, color: '#c0c0c0', variation: 0}}
  - {name: wall, shape: {type: rectangle, center: [0, 2, 1], size: [6, 2], facing: [0, -1, 0]},
     texture: {type: plain, color: '#c0c0c0', variation: 0}}
lights: [{type: sky, horizon: '#ffffff', zenith: '#ffffff', radiance: 1}]
appearance: {spp: 4}
cameras:
  look_at: [0, 0, 0.4]
  radius: 3
  source: {yaw: -80, height: 2}
  targets: [{yaw: -60, height: 1.5}]
edits:
  # No light leaves a black surface.
  - name: night
    instruction: Make it black
    source: a corner
    target: a black corner
    changes: [{object: floor, recolor: {'#c0c0c0': '#000000'}}, {object: wall, recolor: {'#c0c0c0': '#000000'}}]
"""


def test_calibrating_prints_lines_that_the_file_takes(monkeypatch, tmp_path):
    monkeypatch.setattr(bounces, "SIZE", 16)
    path = tmp_path / "corner.yaml"
    path.write_text(FILE)
    done = CliRunner().invoke(app, ["scenes", "calibrate", str(path)])
    assert done.exit_code == 0, done.output
    own, night = done.stdout.splitlines()
    number = yaml.safe_load(own)["bounces"]
    # The two surfaces reflect half of the light and see each other.
    assert f"# corner: {number} leave out " in own and 1 < number <= bounces.MOST
    assert path.read_text() == FILE
    text = FILE.replace("appearance: {spp: 4}", f"appearance:\n  {own}")
    path.write_text(text.replace("name: night\n", f"name: night\n    {night}\n"))
    assert load_scene(path).spec.appearance.bounces == number
    assert bounces_of(load_scene(path).edited("night")) == 1


def test_a_file_without_a_number_has_all_bounces_and_says_so_in_one_line(tmp_path):
    data = closed("#c0c0c0").spec.model_dump(mode="json")
    del data["appearance"]
    scene = Scene(SceneSpec.model_validate(data))
    (line,) = open_bounces(scene)
    assert "scenes calibrate" in line and "\n" not in line and plan(scene).reasons[0] == line
    assert bounces_of(scene) == "unlimited" and plan(scene).passes[0].max_depth == -1
    # A single convex surface never lights itself.
    alone = make([ball()], [SKY], None)
    assert bounces_of(alone) == 1 and open_bounces(alone) == []
    named = make([FLOOR, WALL], [SKY], 7)
    assert bounces_of(named) == 7 and open_bounces(named) == []
    for wrong in ("auto", "some", 0):
        with pytest.raises(ValueError, match="bounces"):
            SceneSpec.model_validate(data | {"appearance": {"bounces": wrong}})
    path = tmp_path / "corner.yaml"
    path.write_text(FILE)
    study = {"name": "s", "scenes": [str(path)], "size": 16, "variants": {"a": {}}}
    study = parse_study(study | {"probes": {"depth": ["a"]}})
    assert plan_run(study, Store(tmp_path / "run")).notices == {"corner": [line]}
    options = ["--size", "16", "--spp", "1", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, ["scenes", "render", str(path), *options])
    assert done.exit_code == 0 and done.stderr == f"attnwarp-eval: corner: {line}\n"


def test_rays_of_the_materials_find_the_same_sky_as_rays_toward_it():
    # One pass of both: equal means, and less noise where only materials look for the sky.
    scene = make([FLOOR, WALL, ball()], [SUN, SKY], 4)
    (ours,) = plan(scene, 16).passes
    assert not ours.aims_at_sky
    whole = plan(scene, 16)
    aimed = dataclasses.replace(whole, passes=(dataclasses.replace(ours, aims_at_sky=True),))
    a, b = (
        np.stack([mitsuba.render_plan(scene, scene.source, made, k) for k in range(8)])
        for made in (whole, aimed)
    )
    means = [p.mean((1, 2, 3)) for p in (a, b)]
    error = np.sqrt(sum(m.var(ddof=1) / 8 for m in means))
    assert abs(means[0].mean() - means[1].mean()) < 4 * error
    assert a.var(0, ddof=1).mean() < 0.7 * b.var(0, ddof=1).mean()
    # Without another light to aim at, and where a mirror shows the sky, rays toward it stay.
    for other in ([FLOOR, WALL], [SKY]), ([FLOOR, WALL, ball(MIRROR)], [SUN, SKY]):
        (only,) = [p for p in plan(make(*other, 4)).passes if p.integrator == "path"][:1]
        assert only.aims_at_sky


# The package's scenes
# --------------------------------------------------------------------------------------------------


CHOSEN = ("caustic", "fog", "glass", "mirror")
"""Scenes that are about long paths."""


def test_every_scene_of_the_package_and_every_edit_has_a_number():
    for name in list_scenes():
        for scene in worlds(load_scene(name)):
            assert isinstance(scene.spec.appearance.bounces, int), scene.name


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*list_scenes()} - {*CHOSEN}))
def test_the_number_of_a_scene_of_the_package_is_measured_again(name):
    scene = load_scene(name)
    number = search(scene).bounces
    assert number == scene.spec.appearance.bounces
    # With other seeds.
    assert shortfall(bounces.pictures_of(scene, 7), number, scene.source).holds
