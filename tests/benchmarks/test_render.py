"""Statements of the benchmark on its own figures: the fits, against scipy's, and the table."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats

import benchmarks.render
from attnwarp.render import render


def _cases() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    x, z = random.uniform(1, 100, 30), random.uniform(1, 50, 30)
    return x, z, (2 * x + 5 * z) * random.normal(1, 0.05, 30)


def test_fit_agrees_with_scipy_in_factors_and_intervals() -> None:
    x, z, y = _cases()
    result = benchmarks.render.fit({"x": x.tolist(), "z": z.tolist()}, y.tolist())
    assert result is not None
    factors, covariance = optimize.curve_fit(
        lambda d, a, b: a * d[0] + b * d[1], np.stack([x, z]), y, sigma=y
    )
    reach = stats.t.ppf(0.975, 28) * np.sqrt(np.diag(covariance))
    for name, factor, r in zip("xz", factors, reach, strict=True):
        assert result[name] == pytest.approx([factor, factor - r, factor + r], rel=1e-4)
        assert result[name][1] < {"x": 2, "z": 5}[name] < result[name][2]
    residual = y - factors[0] * x - factors[1] * z
    assert result["r2"] == pytest.approx(1 - residual.var() / y.var(), rel=1e-4)
    assert 0.02 < result["typical_error"] < 0.08


def test_fit_refuses_what_cases_do_not_determine() -> None:
    x, z, y = (part.tolist() for part in _cases())
    assert benchmarks.render.fit({"x": x[:2], "z": z[:2]}, y[:2]) is None
    assert benchmarks.render.fit({"x": x, "again": [3 * v for v in x]}, y) is None


def test_a_row_is_worked_out_from_its_measurements() -> None:
    """By hand."""
    case = benchmarks.render.Case(
        "3d",
        512,
        50_000,
        0.1,
        forward=[0.010, 0.011, 0.040],
        forward_cpu=[0.01, 0.02, 0.04],
        both=[0.030, 0.031, 0.032],
        both_cpu=[0.05, 0.06, 0.07],
        counters={"pairs": 8_000_000, "composited": 6_000_000, "contributing": 5_000_000},
    )
    row = benchmarks.render.row(case)
    assert (row["forward_ms"], row["forward_best_ms"], row["forward_cpu_ms"]) == (11, 10, 20)
    assert row["backward_over_forward"] == 2.0
    # 8 million pairs in 11 ms.
    assert row["gigapairs_per_second"] == pytest.approx(0.727, abs=5e-4)


@pytest.mark.slow
def test_a_small_run_ends_in_a_table() -> None:
    sizes = [(16, 40), (16, 80), (32, 40), (32, 160), (48, 100)]
    cases = [benchmarks.render.Case("2d", size, count, 0.1) for size, count in sizes]
    result = benchmarks.render.run(cases, rounds=1)
    assert [row["splats"] for row in result["cases"]] == [count for _, count in sizes]
    for row in result["cases"]:
        assert 0 < row["contributing"] <= row["composited"] <= row["pairs"]
        assert 0 < row["forward_bytes"] < row["forward_backward_bytes"]
    text = benchmarks.render.table(result)
    assert "ns a pair" in text and "bytes a splat" in text and "by pairs alone" in text


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_hardly_a_pair_is_computed_where_a_splat_does_not_show(kind) -> None:
    """Squares are listed by exact outlines: few splats are worked on at 16 pixels and drawn to none
    of them. (That none is left out is what the comparisons with the reference show.)"""
    counters = render(
        benchmarks.render.scene(kind, 500, 0.1), benchmarks.render.camera(128), backend="cpu"
    ).counters
    assert counters["composited"] <= counters["pairs"] <= 1.05 * counters["composited"]
