"""The proof of a plan: its statistics against closed forms, scipy and planted truths; its ladder on
real pictures.
"""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import (
    DROPPABLE,
    FLOOR,
    GLASS,
    LAMP,
    MIRROR,
    SCENES,
    SKY,
    SUN,
    WALL,
    ball,
    make,
    without,
)
from further import further

from attnwarp_eval.effects import proof
from attnwarp_eval.scene.transport import called_for
from attnwarp_eval.statistics.equivalence import equivalence
from attnwarp_eval.truth.mitsuba import render_plan
from attnwarp_eval.truth.passes import Lens
from attnwarp_eval.truth.plan import everything_on, plan

pytestmark = pytest.mark.usefixtures("coarse_textures")

SHAPE = (12, 16, 16, 3)


# Of every second pixel the noise is 1e-8 to 1e-4 of its light, as that of a smooth sky; the pixels
# of one column do not vary at all.
QUIET = np.where(
    np.arange(16)[None, :, None] % 2,
    1.0,
    np.geomspace(1e-7, 1e-3, 16)[:, None, None] * (np.arange(16)[None, :, None] > 0),
)


def grain(rng, kind, shape):
    """Noise of mean 0: normal, skewed like few samples of a bright light (skewness 2), or normal
    with a sky that hardly varies.
    """
    if kind == "skewed":
        return rng.gamma(1.0, 1.0, shape) - 1
    return rng.standard_normal(shape) * (QUIET if kind == "sky" else 1.0)


def noise(rng, kind="normal", size=0.1):
    return 1 + size * grain(rng, kind, SHAPE)


def test_too_few_samples_are_refused():
    with pytest.raises(ValueError, match="seeds: got 9, expected at least 10"):
        proof.prove(SCENES["diffuse"](), seeds=9)


def test_blocks_are_means_over_squares_and_over_what_is_left_at_the_border():
    data = np.random.default_rng(1).random((2, 13, 20, 3))
    got = proof.blocks(data)
    assert got.shape == (2, 2, 3, 3)
    for i, j in np.ndindex(2, 3):
        assert np.allclose(got[:, i, j], data[:, 8 * i : 8 * i + 8, 8 * j : 8 * j + 8].mean((1, 2)))


def test_unequal_noise_on_the_two_sides_does_not_raise_the_rate():
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(200):
        quiet = 1 + 0.01 * rng.standard_normal(SHAPE)
        refused += any(level.differs for level in proof.levels(quiet, noise(rng), alpha=0.05))
    assert refused <= 21  # as above


def test_a_difference_in_one_block_only_is_found_where_the_whole_picture_hides_it():
    rng = np.random.default_rng(5)
    result = 0
    for _ in range(20):
        a, b = noise(rng), noise(rng)
        b[:, :8, :8] += 0.03
        levels = {level.name: level.differs for level in proof.levels(a, b)}
        result += levels["block"]
    assert result == 20


def test_equivalence_certifies_the_equal_and_hardly_ever_what_lies_on_its_margin():
    rng = np.random.default_rng(6)
    equal = [equivalence(noise(rng), noise(rng), margin=proof.MARGIN).equal for _ in range(200)]
    edge = [
        equivalence(1.01 * noise(rng), noise(rng), margin=proof.MARGIN).equal for _ in range(200)
    ]
    # 2.33 is the normal quantile; with 22 degrees of freedom 1.5 % lie beyond it. Binomial, 99.9 %:
    # at most 9.
    assert sum(equal) > 195 and sum(edge) <= 9


def test_noise_too_great_for_the_margin_is_not_certified_though_nothing_differs():
    rng = np.random.default_rng(7)
    a, b = (1 + 3 * rng.standard_normal(SHAPE) for _ in range(2))
    assert not equivalence(a, b, margin=proof.MARGIN).equal and not any(
        level.differs for level in proof.levels(a, b)
    )


def test_the_stated_smallest_difference_is_found_four_times_in_five():
    rng = np.random.default_rng(8)
    stated = np.mean([proof.levels(noise(rng), noise(rng))[-1].detectable for _ in range(50)])
    result = [proof.levels(noise(rng), noise(rng) + stated)[-1].differs for _ in range(200)]
    # 80 % of 200; 99.9 % of binomial counts lie within 140 and 178.
    assert 140 <= sum(result) <= 178


def synthetic(trial, kind="normal", brighter=1.0):
    """Pictures that a renderer hands to the ladder: seeded pictures of mean 1, whose noise falls
    with the samples.
    """

    def pictures(side, spp, first, count):
        out = []
        for k in range(count):
            rng = np.random.default_rng((trial, side, first + k, spp))
            light = 1 + 0.3 / math.sqrt(spp) * grain(rng, kind, SHAPE[1:])
            # Pictures are float32, which rounds the two sides each in its own way.
            out.append((brighter if side else 1.0) * light.astype(np.float32).astype(float))
        return np.stack(out)

    return pictures


@pytest.mark.parametrize(("light", "word"), [(1.25, "20 brighter"), (0.8, "25 darker")])
def test_less_light_is_darker_and_no_negative_brightness(light, word):
    rungs = {rung.name: rung for rung in proof.climb(synthetic(0, brighter=light)).rungs}
    words = rungs["paired bias, 1 spp"].words
    # A share of the light of everything on, in whole percent: (1.25 - 1) / 1.25, (0.8 - 1) / 0.8.
    said = re.match(r"everything on is (\d+\.\d\d)% \+- \d\.\d\d% (\w+) over", words)
    assert said and f"{float(said[1]):.0f} {said[2]}" == word, words


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("normal", marks=pytest.mark.slow),
        "skewed",
        pytest.param("sky", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize(
    ("alpha", "range_"),
    [
        pytest.param(0.01, (0, 8), marks=pytest.mark.slow),
        (0.05, (1, 21)),
        pytest.param(0.2, (14, 59), marks=pytest.mark.slow),
    ],
)
def test_over_200_true_nulls_the_whole_ladder_refuses_at_its_stated_rate(kind, alpha, range_):
    result = [proof.climb(synthetic(trial, kind), alpha=alpha).verdict for trial in range(200)]
    # 99.9 % of binomial counts of 200 trials lie below the upper ends. Levels made of the same
    # pixels refuse together, so that the whole keeps a little below its rate. At 20 %, two rungs at
    # the full rate each would refuse about 70.
    assert range_[0] <= result.count("refused") <= range_[1]
    assert result.count("certified") == 200 - result.count("refused")


@pytest.mark.parametrize("kind", further("skewed", "normal", "sky"))
def test_the_whole_ladder_refuses_two_percent_more_light_every_time(kind):
    result = [proof.climb(synthetic(1000 + trial, kind, 1.02)) for trial in range(100)]
    assert {one.verdict for one in result} == {"refused"}
    assert all(any(rung.passed is False for rung in one.rungs) for one in result)


# On real pictures
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", further("refraction", "diffuse", "medium", "depth_of_field"))
def test_the_plan_of_a_scene_is_certified(name):
    # A budget for a busy machine; a quiet one needs a few seconds of it.
    result = proof.prove(SCENES[name](), seconds=180)
    assert result.of_simulated == "certified", list(result.lines())
    # Glass polarises light, which no picture here shows.
    assert result.verdict == ("can't tell" if name == "refraction" else "certified")
    assert result.rungs[0].name == "structure" and result.detectable


@pytest.mark.parametrize("effect", DROPPABLE)
def test_dropping_an_effect_from_a_scene_that_needs_it_is_refused_by_the_statistics_alone(effect):
    scene = SCENES[effect]()
    result = proof.prove(scene, without(scene, plan(scene), effect), seconds=8, structure=False)
    assert result.verdict == "refused", list(result.lines())


REASONS = {
    "interreflection": "interreflection needs 5 edges",
    "specular": "specular, interreflection needs 5 edges",
    "refraction": "refraction, specular, interreflection needs 9 edges",
    "medium": "a medium needs volpath",
    "subsurface": "a medium needs volpath",
    "caustics": r"the caustic of lights\[0\], a point, needs paths from the light",
    "environment": r"lights\[1\], a sky, shines in no pass",
    "depth_of_field": "depth of field needs a lens",
}


@pytest.mark.parametrize("effect", DROPPABLE)
def test_dropping_what_the_graphs_show_is_refused_before_anything_is_rendered(effect):
    scene = SCENES[effect]()
    result = proof.prove(scene, without(scene, plan(scene), effect))
    assert result.verdict == "refused" and [rung.name for rung in result.rungs] == ["structure"]
    assert re.search(REASONS[effect], result.rungs[0].words), result.rungs[0].words


GLOBE = {
    "name": "globe",
    "shape": {"type": "sphere", "center": [0, 0, 3], "radius": 0.05},
    "emission": {"radiance": 90.0},
}


@pytest.mark.parametrize(
    ("scene", "change", "words"),
    [
        (
            lambda: make([FLOOR, ball(), LAMP], [SUN]),
            lambda p: p[:1],
            "object 'lamp', a lamp, shines in no pass",
        ),
        (
            lambda: make([FLOOR, ball(MIRROR)], [SKY], 6),
            lambda p: [replace(p[0], max_depth=6)],
            "specular.* needs 7 edges",
        ),
        (
            lambda: make([FLOOR, ball()], [SKY], 2),
            lambda p: [replace(p[0], integrator="direct")],
            "direct have 2 edges",
        ),
        (SCENES["caustics"], lambda p: p[:2], "taken away and no paths from the light put it back"),
        (
            lambda: make([FLOOR, ball(GLASS), GLOBE], [], 8),
            lambda p: p[1:],
            "shines in no pass where .* is smooth",
        ),
        (
            lambda: make([FLOOR, ball(GLASS), GLOBE], [], 8),
            lambda p: [replace(p[0], first="any")],
            "caustic of object 'globe'",
        ),
        (
            SCENES["medium"],
            lambda p: [*p, replace(p[0], integrator="path")],
            "volpath, in every pass",
        ),
    ],
)
def test_a_plan_with_something_missing_is_refused_by_its_structure_with_the_reason(
    scene, change, words
):
    made = scene()
    good = plan(made)
    assert not list(proof._lacks(made, good, caustic="caustics" in called_for(made.spec)))
    bad = replace(good, passes=tuple(change(list(good.passes))))
    result = list(proof._lacks(made, bad, caustic="caustics" in called_for(made.spec)))
    assert re.search(words, "; ".join(result)), result


@pytest.mark.parametrize("name", list(SCENES))
def test_no_plan_of_ours_lacks_anything_nor_does_everything_on(name):
    scene = SCENES[name]()
    for made in (plan(scene), everything_on(scene), everything_on(scene, capped=False)):
        assert not list(proof._lacks(scene, made, caustic="caustics" in called_for(scene.spec)))


def test_another_lens_than_the_scenes_is_refused():
    scene = SCENES["depth_of_field"]()
    wrong = replace(plan(scene), lens=Lens(0.3, 3.0))
    assert "the lens is another" in next(proof._lacks(scene, wrong, caustic=False))
    bare = SCENES["diffuse"]()
    assert "says no lens" in next(
        proof._lacks(bare, replace(plan(bare), lens=Lens(0.3, 3.0)), caustic=False)
    )


def test_glass_alone_is_planned_with_paths_through_it_and_anything_else_alone_with_one_bounce():
    assert plan(make([ball(GLASS)], [SKY], 8)).integrator == "path"
    assert plan(make([ball(MIRROR)], [SKY], 8)).integrator == "direct"


def test_a_light_two_percent_too_bright_is_refused():
    right = make([FLOOR, WALL, ball()], [SUN, SKY])
    wrong = make([FLOOR, WALL, ball()], [SUN | {"irradiance": 2.04}, SKY | {"radiance": 0.51}])
    pictures = [
        np.stack([render_plan(scene, scene.source, plan(scene, 16), seed + k) for k in range(12)])
        for scene, seed in ((right, 0), (wrong, 100))
    ]
    assert proof.levels(*pictures)[-1].differs
    assert not equivalence(*pictures, margin=proof.MARGIN).equal


def test_too_little_time_ends_in_cannot_tell_and_says_what_could_have_been_seen():
    scene = SCENES["caustics"]()
    result = proof.prove(scene, seconds=0.1)
    assert result.verdict == "can't tell", list(result.lines())
    assert result.rungs[-1].name == "equivalence" and result.rungs[-1].passed is None
    assert result.detectable["picture"] > 0.01
    assert any("smallest difference" in line for line in result.lines())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["refraction", "diffuse"])
def test_over_200_true_nulls_of_real_pictures_it_refuses_at_its_stated_rate(name):
    scene = SCENES[name]().with_size(16, 16)
    made = plan(
        scene, 16
    )  # the fewest samples and the seeds that the proof itself takes when it has time
    refused = 0
    for trial in range(200):
        a, b = (
            np.stack(
                [render_plan(scene, scene.source, made, first + 12 * trial + i) for i in range(12)]
            )
            for first in (10_000, 20_000)
        )
        refused += any(level.differs for level in proof.levels(a, b, alpha=0.05))
    assert refused <= 21  # binomial, 99.9 %


@pytest.mark.slow
def test_the_caustic_of_a_point_light_is_certified_but_for_what_is_not_simulated_when_there_is_time():
    result = proof.prove(SCENES["caustics"](), seconds=240)
    assert (result.verdict, result.of_simulated) == ("can't tell", "certified"), list(
        result.lines()
    )


def test_everything_on_is_never_volpathmis():
    for make_scene in SCENES.values():
        assert {step.integrator for step in everything_on(make_scene()).passes} <= {
            "volpath",
            "ptracer",
        }
