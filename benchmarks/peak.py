# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""The yardstick of the benchmark: as many fused multiply-adds a second as this machine does from
registers.
"""

from __future__ import annotations

import numpy as np

from attnwarp.render._kernels.compilation import jit
from attnwarp.render._kernels.lanes import fma, load, store

CHAINS = 12
"""Independent chains of 16 lanes: enough to hide the latency of both multiply-add units, few enough
for registers of either width (LLVM splits a vector of 16 in two where the machine's are
shorter)."""


@jit
def multiply_add(rounds, result):
    """64 ``rounds`` times a = a b + c in each of CHAINS vectors; what becomes of them goes to
    ``result`` (16), so that none is left out.

    In explicit vectors: left to itself LLVM uses half of the width on processors that it believes
    to be slower with all of it, and a peak measured so is half of the true one.
    """
    b, c = load(result, 0), load(result, 16)
    a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = a8 = a9 = a10 = a11 = c
    for _ in range(rounds):
        for _ in range(64):
            a0, a1, a2, a3 = fma(a0, b, c), fma(a1, b, c), fma(a2, b, c), fma(a3, b, c)
            a4, a5, a6, a7 = fma(a4, b, c), fma(a5, b, c), fma(a6, b, c), fma(a7, b, c)
            a8, a9, a10, a11 = fma(a8, b, c), fma(a9, b, c), fma(a10, b, c), fma(a11, b, c)
    store(result, 0, a0 + a1 + a2 + a3 + a4 + a5 + a6 + a7 + a8 + a9 + a10 + a11)


def start():
    """Start of ``result`` for ``multiply_add``: the factor, then the addend."""
    return np.repeat(np.array([0.999999, 1e-6], np.float32), 16)
