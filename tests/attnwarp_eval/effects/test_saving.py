"""Savings of a plan: ratios of planted seconds and noise, and intervals of scipy."""

import numpy as np
import pytest
from effect_scenes import FLOOR, SCENES, SKY, ball, make
from scipy import stats
from typer.testing import CliRunner

from attnwarp_eval import cost
from attnwarp_eval.cli.main import app
from attnwarp_eval.effects import detect, saving
from attnwarp_eval.truth.plan import everything_on, plan

pytestmark = pytest.mark.usefixtures("coarse_textures")


def test_in_fog_the_plan_is_everything_on_within_the_cap_and_never_loses(monkeypatch):
    scene = SCENES["medium"]()
    assert plan(scene).identity() == everything_on(scene).identity()
    rendered = []

    def render(scene, camera, made, seed):
        rendered.append(made)
        return 1 + 0.02 * np.random.default_rng(seed).standard_normal((8, 8, 3))

    monkeypatch.setattr(saving, "render_plan", render)
    measured = saving.measure(scene, size=8, spp=4, rounds=3)
    assert measured.cap.at_equal_error == measured.cap.faster == 1.0
    # The plan twice a round, and everything on without a cap; one more round comes first.
    assert len(rendered) == 3 * 4


def test_what_the_cap_cuts_off_is_told_and_equal_error_is_within_the_cap(monkeypatch):
    # Synthetic renderings: the capped ones have mean 0.8, those without a cap 1; noise and time are
    # planted.
    scene = make([FLOOR, ball()], [SKY], 1, size=8)
    free = saving.everything_on(scene.with_size(8, 8), 4, capped=False)
    full = saving.everything_on(scene.with_size(8, 8), 4)
    clock = [0.0]
    monkeypatch.setattr(cost.time, "perf_counter", lambda: clock[0])

    def render(scene, camera, made, seed):
        mean, noise, seconds = (
            (1.0, 0.04, 3.0)
            if made == free
            else (0.8, 0.03, 2.0)
            if made == full
            else (0.8, 0.02, 1.0)
        )
        clock[0] += seconds * (1 + seed % 5)  # the machine is slow in some rounds, for all alike
        return mean + noise * np.random.default_rng((seed, int(seconds))).standard_normal((8, 8, 3))

    monkeypatch.setattr(saving, "render_plan", render)
    measured = saving.measure(scene, size=8, spp=4, rounds=40)
    low, high = measured.cap.bias_interval
    # 40 pictures of 192 values: the ratio's standard error is sqrt(.025^2 + .04^2) / sqrt(40 * 192)
    # = 0.054 %.
    assert (
        measured.cap.bias == pytest.approx(-0.2, abs=0.0025)
        and low < -0.2 < high
        and high - low < 0.003
    )
    assert measured.faster == pytest.approx(3) and measured.cap.faster == pytest.approx(2)
    assert measured.at_equal_noise == pytest.approx(3 * 4, rel=0.1)
    assert measured.interval[0] < measured.at_equal_noise < measured.interval[1]
    assert (
        measured.cap.at_equal_error == pytest.approx(2 * 2.25, rel=0.1)
        and measured.cap.interval[0] < 4.5 < measured.cap.interval[1]
    )
    about = detect.report(scene, cost=measured) | {"cost": measured.to_dict()}
    text = "\n".join(detect.describe(scene, about))
    assert (
        "not for the same error: the scene's cap of 1 bounces changes the picture's light by -20"
        in text
    )
    endless = saving.measure(
        make([FLOOR, ball()], [SKY], "unlimited", size=8), size=8, spp=4, rounds=3
    )
    assert endless.cap is None


def test_light_cut_off_from_noiseless_or_black_pictures_has_no_interval_to_speak_of():
    bias, (low, high) = saving._cut(np.full(5, 0.5), np.full(5, 1.0))
    assert bias == low == high == pytest.approx(-0.5, rel=1e-12)
    assert saving._cut(np.zeros(5), np.ones(5)) == (None, None)
    assert saving._cut(np.ones(1), np.ones(1)) == (None, None)


def test_a_black_scene_has_a_cost_in_seconds_and_no_noise():
    below = {"type": "point", "position": [0, 0, -2], "intensity": 5}
    measured = saving.measure(make([FLOOR], [below], 1, size=8), size=8, spp=1, rounds=3)
    assert measured.variance == (0.0, 0.0) and measured.at_equal_noise == float("inf")
    assert measured.cap.bias is None and measured.seconds[0] > 0


def test_the_interval_of_the_light_cut_off_is_scipys():
    a, b = (
        np.random.default_rng(0).uniform(0.7, 0.9, 7),
        np.random.default_rng(1).uniform(0.95, 1.05, 9),
    )
    theirs = stats.ttest_ind(np.log(a), np.log(b), equal_var=False).confidence_interval(0.95)
    bias, ours = saving._cut(a, b)
    assert np.allclose(np.expm1(theirs), ours, rtol=1e-9) and ours[0] < bias < ours[1]


def test_seconds_of_a_proof_need_a_proof():
    result = CliRunner().invoke(app, ["scenes", "effects", "spheres", "--budget", "9"])
    assert result.exit_code == 2 and "--budget: needs --prove" in " ".join(result.output.split())
