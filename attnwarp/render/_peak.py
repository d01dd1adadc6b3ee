# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""The yardstick of the benchmark: as many fused multiply-adds a second as this machine does from registers."""

from __future__ import annotations

import numba as nb
import numpy as np

LANES = 256
"""Independent chains: 16 vectors of 16, enough to hide the latency of both multiply-add units."""


@nb.njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def multiply_add(rounds, result):
    """64 ``rounds`` times a = a b + c in each of LANES numbers; their sum goes to ``result``, so none is left out."""
    # Its own array: LLVM then keeps it in registers from one round to the next.
    a = np.zeros(256, np.float32)
    b, c = np.float32(0.999999), np.float32(1e-6)
    for _ in range(rounds):
        for _ in range(64):
            for j in range(256):
                a[j] = a[j] * b + c
    result[0] = a.sum()
