"""The table of all scenes: what it says, that it goes on where it was, and pictures that show a
difference.
"""

import functools
import json

import cv2
import numpy as np
import pytest
from effect_scenes import FLOOR, SCENES, SKY, SUN, ball, make
from scipy import stats
from typer.testing import CliRunner

from attnwarp_eval import cost
from attnwarp_eval.cli.main import app
from attnwarp_eval.effects import detect, saving, table
from attnwarp_eval.effects.table import Settings, side_by_side
from attnwarp_eval.experiments import effects
from attnwarp_eval.experiments.effects import collect
from attnwarp_eval.truth.plan import everything_on, plan

pytestmark = pytest.mark.usefixtures("coarse_textures")


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(table, "PICTURE_SIZE", 16)
    monkeypatch.setattr(table, "PLAN_SAMPLES", 16)
    monkeypatch.setattr(table, "FULL_SAMPLES", 16)
    monkeypatch.setattr(table, "measure", functools.partial(saving.measure, size=16, spp=4))


def test_the_table_has_every_scene_and_goes_on_where_it_was(small, monkeypatch, tmp_path):
    made = []
    real = effects.measure_entry
    monkeypatch.setattr(
        effects, "measure_entry", lambda scene, *a: made.append(scene.name) or real(scene, *a)
    )
    quick = Settings(prove=False, rounds=2)
    collect(["opposed", "glass"], tmp_path, quick)
    collect(["opposed", "glass", "mirror"], tmp_path, quick)
    assert made == ["opposed", "glass", "mirror"]
    data = json.loads((tmp_path / "effects.json").read_text())
    by_name = {entry["scene"]: entry for entry in data["scenes"]}
    assert "refraction" in by_name["glass"]["needed"] and "specular" in by_name["mirror"]["needed"]
    assert by_name["opposed"]["left_out"] == ["interreflection"]
    text = (tmp_path / "effects.md").read_text()
    assert (
        "| mirror | interreflection, specular, environment | " in text
        and " | path | not asked | " in text
    )
    assert text.count(".jpg)") == 3 and "3 scenes, 0 of their plans certified" in text
    # Another setting is another entry; a picture that is gone is drawn again.
    collect(["glass"], tmp_path, Settings(prove=False, rounds=3))
    picture = (tmp_path / "mirror.jpg").read_bytes()
    (tmp_path / "mirror.jpg").unlink()
    collect(["glass", "mirror"], tmp_path, quick)
    assert made[3:] == ["glass"] and (tmp_path / "mirror.jpg").read_bytes() == picture


def test_a_proof_stands_in_the_table(small, tmp_path):
    # A budget for a busy machine; a quiet one needs a few seconds of it.
    (entry,) = collect(["opposed"], tmp_path, Settings(rounds=0, pictures=False, budget=240))
    assert entry["proof"]["verdict"] == "certified", entry["proof"]
    ((_, _, _, _, verdict, *times),) = table.table([entry]).rows
    assert verdict == "certified" and times == ["–"] * 2


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
    row = table._times(json.loads(json.dumps(measured.to_dict())))
    assert row[0].startswith("2") and row[1].startswith("4.")
    endless = saving.measure(
        make([FLOOR, ball()], [SKY], "unlimited", size=8), size=8, spp=4, rounds=3
    )
    assert endless.cap is None and len(table._times(endless.to_dict())) == 2


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


def test_a_dropped_light_shows_eight_times_as_strong_about_grey(small, monkeypatch, tmp_path):
    written, encode = [], cv2.imencode
    monkeypatch.setattr(cv2, "imencode", lambda *a: written.append(a[1]) or encode(*a))
    scene = make([FLOOR], [SUN, SKY])
    same = side_by_side(scene, tmp_path / "same.jpg")["largest_difference"]

    # The plan of a careless planner: the sun alone.
    def without_sky(scene, spp=None):
        return table.replace(plan(scene, spp), passes=plan(scene, spp).passes[:1])

    monkeypatch.setattr(table, "plan", without_sky)
    dark = side_by_side(scene, tmp_path / "dark.jpg")["largest_difference"]
    assert same < 0.01 < 0.1 < dark
    # As written, before JPEG: eight times (ours - full) / 2 about grey.
    for rows in written:
        ours, full, difference = (rows[:, k : k + 16, ::-1].astype(float) for k in (0, 20, 40))
        expected = np.clip(127.5 + 4 * (ours - full), 0, 255)
        assert np.abs(difference - expected).max() <= 4.5  # each picture is rounded to a level
    assert len(written) == 2 and np.ptp(written[1][:, 40:56]) > 50
    picture = cv2.imread(str(tmp_path / "dark.jpg"))
    assert picture.shape == (16, 3 * 16 + 8, 3)
    assert (
        picture[:, -16:].mean() < 60
        and abs(cv2.imread(str(tmp_path / "same.jpg"))[:, -16:].mean() - 127.5) < 6
    )


def test_one_scene_or_all_must_be_asked_for_and_no_option_is_passed_over():
    runner = CliRunner()
    for arguments, words in (
        ([], "name one scene, or say --all"),
        (["spheres", "--all"], "name one scene, or say --all"),
        (["--all", "--json"], "--json is of one scene"),
        (["spheres", "--budget", "9"], "--budget: needs --prove"),
        (["spheres", "--out", "table"], "--out: is the folder of --all"),
    ):
        result = runner.invoke(app, ["scenes", "effects", *arguments])
        assert result.exit_code == 2 and words in " ".join(result.output.split())
