"""The hard cases themselves, what judges them, and the command that sweeps them.

The oracles of the cases share no code with the library, so that a case that holds is a test that
passes; every sweep to its end is slow.
"""

import dataclasses
import math
import re
from pathlib import Path

import mpmath
import numpy as np
import pytest
import torch
import yaml
from typer.testing import CliRunner

from attnwarp import Camera
from attnwarp_eval.cli.main import app
from attnwarp_eval.cli.shell import Regression
from attnwarp_eval.compare.judge import compare
from attnwarp_eval.compare.snapshot import snapshot
from attnwarp_eval.report import write_report
from attnwarp_eval.report.results import read_results
from attnwarp_eval.stability import Outcome, Way, bilinear, hard_case, hard_cases, visibility
from attnwarp_eval.stability.cases import editing
from attnwarp_eval.stability.exact import FIELDS, ExactSplats
from attnwarp_eval.stability.rendered import front_camera, splats
from attnwarp_eval.study.probes.stability.measure import Swept, read_sweeps
from attnwarp_eval.study.probes.stability.report import verdict_lines
from attnwarp_eval.study.run import execute, plan, verify
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.study import load_study

CASES = [pytest.param(case, id=case.name) for case in hard_cases().values()]


def here(case):
    """The ways that need no GPU."""
    return [way for way in case.ways if way.backend != "gpu"]


def describe(case, way, outcome):
    return f"{case.name} / {way.name} at {outcome.level:g}: {outcome}"


@pytest.mark.parametrize("case", CASES)
def test_a_hard_case_holds_where_it_must(case):
    # Of every backend the way with the fewest digits, at the hardest level that must hold, and what
    # must be refused. Gradients of splats have tests of their own.
    first = case.ways[0].direction
    ways = {way.backend: way for way in here(case) if way.direction == first}
    refused = [level for level in case.levels if case.must_refuse(level, here(case)[0])]
    for way in ways.values():
        for level in {case.required, *refused[:1]}:
            outcome = case.outcome(level, way)
            assert outcome.verdict == "holds", describe(case, way, outcome)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_hard_case_holds_at_every_level_that_it_must_by_every_way(case):
    # Without a GPU its backend runs on Warp's CPU device.
    for way in case.ways:
        for level in case.levels:
            outcome = case.outcome(level, way)
            if outcome.required or outcome.must_refuse:
                assert outcome.verdict == "holds", describe(case, way, outcome)


@pytest.mark.parametrize("name", ["edge_on_splat", "opacity_to_1_2d", "needle"])
def test_gradients_of_hard_splats_are_those_of_50_digits(name):
    case = hard_case(name)
    level = case.levels[0] if case.required_backward else case.required
    for backend in ("reference", "cpu"):
        way = Way(backend, "float64", "backward")
        outcome = case.outcome(level, way)
        assert outcome.verdict == "holds", describe(case, way, outcome)


def test_the_committed_report_names_every_case_by_its_number_and_its_sweeps():
    text = (Path(__file__).parents[3] / "reports/stability/report.md").read_text("utf-8")
    rows = set(re.findall(r"^\| (\d+) \| `(\w+)`: ", text, re.MULTILINE))
    assert {int(number) for number, _ in rows} == set(range(1, 67))
    cases = hard_cases().values()  # later ones are younger than the report
    now = {(str(case.number), case.name) for case in cases if case.number <= 66}
    # Cases of metrics that are gone.
    gone = {("64", "epipolar_baseline"), ("65", "few_matches"), ("66", "dark_pictures")}
    assert rows == now | gone


def test_every_row_of_the_tables_is_a_case():
    tables = sorted((Path(__file__).parents[3] / "eval").glob("attnwarp_*/*/cases.yaml"))
    assert len(tables) == 2
    rows = [name for table in tables for name in yaml.safe_load(table.read_text("utf-8"))]
    assert sorted(rows) == sorted(hard_cases())


def test_a_record_of_a_level_that_a_case_no_longer_has_is_a_failure_and_no_crash(
    tmp_path, monkeypatch
):
    _, store, _, _ = run(tmp_path, cases=["masked_psnr"])
    case = hard_case("masked_psnr")
    other = dataclasses.replace(case, levels=(4096, 1), quick=(1,))
    monkeypatch.setitem(hard_cases(), case.name, other)
    results = read_results(store)
    assert results.measured == 0
    assert "hard case 'masked_psnr' has no level 1024 today" in results.failures[0].error


@pytest.mark.parametrize(
    ("name", "level", "message"),
    [
        ("not_a_rotation", 1e-3, r"not orthonormal.*= 0\.001 .*orthonormalise it"),
        ("short_quaternion", 0, "quats: zero quaternion at index 0"),
        ("grid_type", 8, r"xy: got torch\.\w*float16, expected float32 or float64"),
        ("long_embedding", 1e20, "embeddings are NaN or infinite, row 0 first"),
    ],
)
def test_what_is_refused_says_why(name, level, message):
    case = hard_case(name)
    way = next(way for way in reversed(case.ways) if way.backend != "gpu")
    assert re.search(message, case.outcome(level, way).refusal)


# The oracle


def test_the_oracle_draws_a_facing_disc_by_its_closed_form():
    sigma, opacity, depth, focal = 0.3, 0.8, 4.0, 40.0
    exact = ExactSplats(splats([[0, 0, depth]], sigma, opacity), front_camera(33, focal))
    for dx, dy in ((0, 0), (2, 0), (3, 4)):
        pixel = exact.pixel(16.5 + dx, 16.5 + dy)
        # (dx z / f)^2 + ... over sigma^2; the screen filter is narrower than the disc.
        square = (dx**2 + dy**2) * mpmath.mpf(depth) ** 2 / mpmath.mpf(focal) ** 2
        closed = opacity * mpmath.exp(-square / mpmath.mpf(sigma) ** 2 / 2)
        assert abs(pixel.alpha - closed) < 1e-16
        assert abs(pixel.depth - depth) < 1e-40


def test_the_oracle_draws_a_ball_by_its_closed_form_and_has_its_gradient():
    sigma, opacity, depth, focal = 0.2, 0.7, 5.0, 30.0
    ball = splats([[0, 0, depth]], sigma, opacity, kind="3d")
    exact = ExactSplats(ball, front_camera(33, focal))
    variance = (focal * sigma / depth) ** 2 + 0.3
    alpha = opacity * math.exp(-(3**2) / variance / 2)
    assert float(exact.pixel(19.5, 16.5).alpha) == pytest.approx(alpha, rel=1e-14)
    gradient = exact.gradient([(19.5, 16.5)], [(1.0, 0.0)])
    assert set(gradient) == set(FIELDS)
    assert gradient["opacities"][0, 0] == pytest.approx(alpha / opacity, rel=1e-14)
    # d/dx of the centre: f / z px a unit, toward the pixel.
    assert gradient["means"][0, 0] == pytest.approx(alpha * 3 / variance * focal / depth, rel=1e-14)
    # d/d sigma_x of exp(-9 / (2 v)), v = (f sigma / z)^2 + 0.3.
    slope = alpha * 9 / (2 * variance**2) * 2 * sigma * (focal / depth) ** 2
    assert gradient["scales"][0, 0] == pytest.approx(slope, rel=1e-14)


def test_the_oracle_composites_front_to_back_whatever_the_order_in_memory():
    pair = splats([[0, 0, 5], [0, 0, 3]], 0.5, [0.4, 0.5])
    pixel = ExactSplats(pair, front_camera()).pixel(16.5, 16.5)
    assert float(pixel.alpha) == pytest.approx(0.5 + 0.5 * 0.4, rel=1e-15)
    assert float(pixel.depth) == pytest.approx((0.5 * 3 + 0.2 * 5) / 0.7, rel=1e-15)


def test_the_bound_of_one_view_is_what_the_sums_of_its_tokens_allow():
    # Five roundings of a token's largest sum of magnitudes, six of the largest token, each by half
    # a step.
    case, needed = hard_case("one_view"), []
    for way in case.ways:
        for views in case.levels:
            unet, latents = editing.one_view_tokens(int(views), way)
            weight, bias, x = (
                np.abs(value.detach().double().numpy())
                for value in (unet.attn1.weight, unet.attn1.bias, latents.flatten(2).mT)
            )
            sums = (x @ weight.T + bias).max()
            with torch.no_grad():
                largest = float(unet(latents, 0.0).abs().max())
            needed.append((5 * sums / largest + 6) / 2)
    assert 0.99 * editing.ONE_VIEW.at(1) < max(needed) < editing.ONE_VIEW.at(1)


def test_the_oracle_of_sampling_reads_ramps_borders_and_holes_by_their_closed_form():
    x = np.array([0.2, 0.5, 1.25, 3.4999999999, 3.75, 9.0, np.nan], np.longdouble)
    xy = np.stack([x, np.full(7, 1.5, np.longdouble)], axis=-1)
    shares = bilinear.sampling_matrix(xy, 3, 5)
    ramp = np.arange(15) % 5 + np.longdouble(0.5)
    # Positions read themselves; the border's value is taken beyond it, a tap within 1e-7 px.
    assert shares[:6] @ ramp == pytest.approx([0.5, 0.5, 1.25, 3.5, 3.75, 4.5], abs=1e-18)
    assert not shares[6].any() and shares[:6].sum(1) == pytest.approx(1, abs=1e-18)
    rows = np.arange(15) // 5
    assert (shares[:6] @ rows == 1).all()


def test_the_oracle_of_the_rules_labels_walls_by_their_closed_form():
    K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
    shift = np.eye(4)
    shift[0, 3] = 0.5  # 8 * 0.5 / 2 = 2 px at depth 2
    target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
    depth, before = np.full((8, 8), 2.0), np.full((8, 8), 2.0)
    depth[0, 0] = np.nan
    before[:, 4:] = 1.9  # stands before the wall
    normal = np.broadcast_to([0.0, 0, -1], (8, 8, 3)).copy()
    normal[3] = [1.0, 0, 0]
    labels = visibility.exact_labels(
        source, target, before, depth, normal, relative=1e-4, slope=0.0, spread=0.05
    )
    column = np.arange(8)
    rules = labels.rules
    assert not rules["defined"][0, 0] and rules["defined"].sum() == 63
    assert (rules["in_bounds"][1:] == (column < 6)).all()
    assert (rules["depth_agrees"][1:] == (column < 2)).all()  # the source shows x + 2
    assert rules["facing"][4:].all()
    # The planes x = X separate the cameras at x = 0 and x = -0.5 for X in between.
    X = (column + 0.5 - 4) / 8 * 2
    assert (rules["facing"][3] == ~((X > -0.5) & (X < 0))).all()


# What judges


def test_margins_count_decades_and_know_what_must_hold_and_what_must_be_refused():
    def margin(error, *, required=True, refusal="", must_refuse=False):
        return Outcome(1.0, required, error, 1e-5, refusal, must_refuse).margin

    assert margin(1e-6) == pytest.approx(1)
    assert margin(1e-4) == pytest.approx(-1)
    assert margin(0.0) == 3 and margin(1e-20) == 3  # rounding far below a tolerance tells nothing
    assert margin(math.inf) == -3 and margin(1e9) == -3
    assert margin(math.nan, refusal="no", must_refuse=True) == 3
    assert margin(math.nan, refusal="no") == -3
    assert math.isnan(margin(math.nan, refusal="no", required=False))
    assert margin(0.0, must_refuse=True) == -3  # computed what it should have refused


def shifted(case, pixels):
    """The case as it would be if the code were off by so many pixels."""
    return dataclasses.replace(case, measure=lambda level, way: case.measure(level, way) + pixels)


def test_a_loss_of_digits_is_named_with_its_error_and_its_tolerance():
    broken = shifted(hard_case("focal_length"), 0.5)
    way = Way("reference")
    sweep = Swept(broken, way, tuple(broken.outcome(level, way) for level in (1, 1e12)))
    # 1e12 px need not hold, so its loss is no failure.
    assert verdict_lines([sweep]) == [
        "focal_length / reference float64 forward: error 5.0e-01 at focal length, px 1, expected at"
        " most 0.00010 (px)"
    ]


def test_a_result_that_is_not_finite_breaks_and_an_error_of_another_kind_is_not_taken_for_a_refusal():
    case = hard_case("focal_length")
    nothing = dataclasses.replace(case, measure=lambda level, way: math.nan)
    assert nothing.outcome(1, Way("cpu")).error == math.inf

    def crash(level, way):
        raise IndexError("out of range")

    with pytest.raises(IndexError):
        dataclasses.replace(case, measure=crash).outcome(1, Way("cpu"))


# The study


def run(folder, **sweep):
    study = load_study("stability", stability={"levels": "quick", **sweep})
    store = Store(folder)
    planned = plan(study, store)
    return study, store, planned, execute(planned, store)


def test_the_study_needs_no_scene_resumes_reports_and_is_gated(tmp_path, monkeypatch):
    names = ["not_a_rotation", "masked_psnr", "short_embedding"]
    _, store, planned, summary = run(tmp_path, cases=names)
    assert summary.complete and len(planned.cells) == 4 + 2 + 2
    assert {cell.scene for cell in planned.cells} == set(names)
    assert verify(store).ok
    assert not run(tmp_path, cases=names)[2].todo  # every cell is reused

    results = read_results(store)
    sweeps = read_sweeps(results)
    assert not verdict_lines(sweeps)
    ended = next(s for s in sweeps if s.case.name == "not_a_rotation").outcomes[-1]
    assert ended.must_refuse and "not orthonormal" in ended.refusal
    write_report(store, timings=False)
    text = (tmp_path / "report.md").read_text()
    assert "Every required level holds." in text
    assert "| 1e-06 dB |" in text and "scenes" not in text.splitlines()[2]

    before = snapshot(results)
    assert not compare(before, snapshot(read_results(store))).regressed
    case = hard_case("masked_psnr")
    monkeypatch.setitem(hard_cases(), case.name, shifted(case, 0.1))
    _, other, _, _ = run(tmp_path / "worse", cases=names)
    worse = compare(before, snapshot(read_results(other)))
    assert worse.regressed
    assert {row.metric for row in worse.rows if row.verdict == "worse"} == {"stability.margin"}


def test_other_studies_do_not_change_by_this_one():
    assert "stability" not in load_study("quick").model_dump(mode="json")


# The command


def test_the_command_lists_cases_sweeps_one_and_fails_where_it_breaks(tmp_path, monkeypatch):
    runner = CliRunner()
    listed = runner.invoke(app, ["stability", "--list"])
    assert listed.exit_code == 0
    assert len(listed.output.splitlines()) == len(hard_cases())
    monkeypatch.chdir(tmp_path)
    swept = runner.invoke(app, ["stability", "--case", "not_a_rotation", "--quick"])
    assert swept.exit_code == 0, swept.output
    run = tmp_path / "runs/stability-not_a_rotation-quick"
    assert "1 sweeps of 1 hard cases" in (run / "report.md").read_text()
    assert runner.invoke(app, ["report", str(run), "--long"]).exit_code == 0
    text = (run / "report.md").read_text()
    assert "Oracle: pinhole projection in mpmath" in text
    assert "| 0.001 | refused |" in text
    unknown = runner.invoke(app, ["stability", "--case", "nedle"])
    assert unknown.exit_code == 2 and "did you mean 'needle'" in unknown.output

    case = hard_case("masked_psnr")
    monkeypatch.setitem(hard_cases(), case.name, shifted(case, 0.1))
    broken = runner.invoke(app, ["stability", "--case", case.name, "--quick"])
    assert broken.exit_code == 1 and isinstance(broken.exception, Regression)
    assert "masked_psnr / metrics float64 forward: error 1.0e-01" in broken.output
