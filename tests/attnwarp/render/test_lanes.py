"""The building blocks of the CPU kernels, against numpy and plain loops."""

from __future__ import annotations

import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from attnwarp.render._kernels import (
    lanes,
    projection,
)


def test_estimates_made_better_and_sums_in_another_order() -> None:
    @numba.njit
    def work(x, y):
        lanes.store(y, 0, lanes.reciprocal(lanes.load(x, 0)))
        lanes.store(y, 16, lanes.approximate_sqrt(lanes.load(x, 0)))
        a, b, c, d = lanes.load(x, 16), lanes.load(x, 32), lanes.load(x, 48), lanes.load(x, 64)
        lanes.store(y, 32, lanes.sum_each(a, b, c, d, b, c, d, a, c, d, a, b, d, a, b, c))
        lanes.store(y, 48, lanes.sum_each8(a, b, c, d, d, c, b, a))

    random = np.random.default_rng(0)
    for scale in (1e-12, 1e-3, 1.0, 1e6):
        x = (scale * random.uniform(0.5, 2, 80)).astype(np.float32)
        y = np.zeros(64, np.float32)
        work(x, y)
        assert np.abs(y[:16] * x[:16].astype(float) - 1).max() < 2e-7
        ratio = y[16:32] / np.sqrt(x[:16].astype(float))
        assert ratio.min() > 1 - 2e-7 and ratio.max() < 1 + 1.4e-4
        a, b, c, d = x[16:].reshape(4, 16).sum(axis=1, dtype=float)
        assert y[32:48] == pytest.approx([a, b, c, d, b, c, d, a, c, d, a, b, d, a, b, c], rel=1e-6)
        assert y[48:] == pytest.approx([a, b, c, d, d, c, b, a] * 2, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("target", ["NUMBA_CPU_NAME=generic", "NUMBA_ENABLE_AVX=0"])
def test_another_processor_than_this_one_gets_no_instructions_that_it_lacks(target: str) -> None:
    name, value = target.split("=")
    program = """
import numba
import numpy as np
from attnwarp.render._kernels import lanes

@numba.njit
def work(x, y, z):
    lanes.store(y, 0, lanes.reciprocal(lanes.load(x, 0)))
    lanes.store(y, 16, lanes.approximate_sqrt(lanes.load(x, 0)))
    lanes.store8(z, 8, lanes.reciprocal_sqrt(lanes.load8(z, 0)))

x, y, z = np.linspace(1, 2, 16).astype(np.float32), np.zeros(32, np.float32), np.linspace(1, 2, 16)
exact = x.astype(float)
root = np.sqrt(z[:8])
work(x, y, z)
assert abs(y[:16] * exact - 1).max() < 2e-7
assert abs(y[16:] / np.sqrt(exact) - 1).max() < 1.4e-4
assert abs(z[8:] * root - 1).max() < 1e-15
assert "zmm" not in "".join(work.inspect_asm().values())
"""
    environment = {**os.environ, name: value}
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr[-500:]


def test_eight_float64_to_the_last_bits() -> None:
    @numba.njit
    def work(x, y):
        given = lanes.load8(x, 0)
        lanes.store8(y, 0, lanes.reciprocal(given))
        lanes.store8(y, 8, lanes.reciprocal_sqrt(given))
        lanes.store8(y, 16, projection._sqrt(given))
        lanes.store8(y, 24, projection._log(given))

    random = np.random.default_rng(0)
    y = np.zeros(32)
    for scale in (1e-200, 1e-12, 1 / 255, 1.0, 255.0, 1e6, 1e200):
        for _ in range(50):
            x = scale * random.uniform(0.5, 2, 8)
            work(x, y)
            for actual, exact in zip(
                y.reshape(4, 8)[:3], (1 / x, 1 / np.sqrt(x), np.sqrt(x)), strict=True
            ):
                assert np.abs(actual / exact - 1).max() < 1e-15
            assert np.abs(y[24:] - np.log(x)).max() < 1e-12 * max(1, np.abs(np.log(x)).max())
    work(np.zeros(8), y)
    assert (y[16:24] == 0).all()
