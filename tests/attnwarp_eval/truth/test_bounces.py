"""The number of bounces that ``bounces: auto`` takes: against light whose sum is known."""

import dataclasses
import json
import re

import numpy as np
import pytest
from effect_scenes import FLOOR, GLASS, MIRROR, SKY, SUN, WALL, ball, make

from attnwarp.camera import Camera
from attnwarp_eval.effects.proof import _complete
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.spec import SceneSpec
from attnwarp_eval.truth import bounces, mitsuba
from attnwarp_eval.truth.bounces import Answer, Shortfall, answer, dealt, search, shortfall
from attnwarp_eval.truth.mitsuba import build
from attnwarp_eval.truth.plan import bounces_of, everything_on, plan
from scripts.record_bounces import SCENES, worlds

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
    return make([FLOOR | {"texture": gray}, WALL | {"texture": gray}], [SKY, SUN], "auto", **rest)


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
    monkeypatch.setattr(bounces, "search", lambda scene: result)
    endless = everything_on(scene, 64, capped=False)
    for number, held in ((result.bounces, True), (result.bounces - 1, False)):
        light = [
            np.mean([mitsuba.render_plan(scene, scene.source, made, seed) for seed in range(8)])
            for made in (plan(scene, 64, bounces=number), endless)
        ]
        assert (light[1] / light[0] - 1 < bounces.MARGIN) == held
        # The ladder's last rung measures again, and refuses what is known to be too few.
        assert _complete(scene, number, 7).passed == held


def test_a_black_world_needs_one_bounce_and_a_mirror_or_glass_what_it_shows(monkeypatch):
    monkeypatch.setattr(bounces, "SIZE", 16)
    assert search(closed("#000000")).bounces == 1
    least = {None: 1, "mirror": 2, "glass": 3}
    for material in (None, MIRROR, GLASS):
        spec = make([FLOOR, ball(material)], [SKY], "auto").spec
        expected = least[material["type"] if material else None]
        assert bounces.transport.fewest_bounces(spec) == expected


def test_an_answer_is_measured_once_and_again_where_anything_it_depends_on_changes(
    monkeypatch, tmp_path
):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    searched = []
    held = Shortfall(3, "source", 16, 0.004, 0.0005, 0.0053, 0.02)
    monkeypatch.setattr(
        bounces, "search", lambda scene: searched.append(scene) or Answer(3, held, None, "m")
    )
    scene = closed("#c0c0c0")
    assert answer(scene) == answer(scene) == Answer(3, held, None, "m") and len(searched) == 1
    assert bounces_of(scene) == 3 and plan(scene).passes[0].max_depth == 4
    assert any("bounces: auto: 3 leave out 0.40 %" in reason for reason in plan(scene).reasons)
    # Of pictures of another size, and with other samples, the answer is the same.
    answer(scene.with_size(64, 48))
    answer(closed("#c0c0c0", spp=4))
    assert len(searched) == 1
    others = [closed("#c0c0c1"), closed("#c0c0c0", cameras={"radius": 3.5})]
    others.append(closed("#c0c0c0", cameras={"targets": [{"yaw": 61, "height": 1.5}]}))
    for count, other in enumerate(others, 2):
        answer(other)
        assert len(searched) == count
    monkeypatch.setattr(build, "TEXELS", build.TEXELS // 2)
    answer(scene)
    assert len(searched) == len(others) + 2
    monkeypatch.setattr(bounces, "variant", lambda: "another")
    answer(scene)
    assert len(searched) == len(others) + 3
    pinned = make([FLOOR, WALL], [SKY], 7)
    assert bounces_of(pinned) == 7 and len(searched) == len(others) + 3


def test_a_pinned_number_and_the_default():
    scene = closed("#c0c0c0")
    data = scene.spec.model_dump(mode="json")
    del data["appearance"]
    assert SceneSpec.model_validate(data).appearance.bounces == "auto"
    with pytest.raises(ValueError, match="bounces"):
        SceneSpec.model_validate(data | {"appearance": {"bounces": "some"}})


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


def recorded():
    return json.loads((SCENES / bounces.RECORD).read_text(encoding="utf-8"))


def test_every_scene_that_leaves_the_number_open_and_every_edit_has_its_answer_recorded(
    monkeypatch, tmp_path
):
    # An empty cache and nothing to measure with: the record alone answers.
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    monkeypatch.setattr(bounces, "search", None)
    scenes = {scene.name: scene for scene in worlds()}
    pinned = re.compile(r"bounces: (\d+|unlimited)")
    files = [path for path in SCENES.glob("*.yaml") if not pinned.search(path.read_text())]
    assert files and {path.stem for path in files} <= set(scenes) == set(recorded())
    for name, entry in recorded().items():
        scene = scenes[name]
        assert entry["key"] == bounces.key(scene)
        result = Answer.from_dict(entry["answer"])
        assert result == answer(scene) and result.bounces == bounces_of(scene)
        assert result.held.holds and result.held.bounces == result.bounces
        assert result.fewer is None or result.fewer.bounces == result.bounces - 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", sorted({path.stem for path in SCENES.glob("*.yaml")} & recorded().keys())
)
def test_a_recorded_answer_is_measured_again(name):
    scene = load_scene(name)
    number = search(scene).bounces
    assert number == answer(scene).bounces
    # With other seeds.
    assert _complete(scene, number, 7).passed
