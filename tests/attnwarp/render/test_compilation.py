"""Kernels are compiled once, however many processes begin together."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit

from attnwarp.render._kernels.compilation import by_one_process

COMPILE = """
import json
import numpy as np
from attnwarp.render._kernels.ordering import radix_order
print("ready", flush=True)
input()
keys = np.array([3, 1, 2], np.float32)
room = [np.zeros(3, kind) for kind in ("i4", "i4", "u4", "u4")]
order = radix_order(keys, *room)[0].tolist()
stats = radix_order.stats
counts = [sum(each.values()) for each in (stats.cache_misses, stats.cache_hits)]
print(json.dumps([order, *counts]))
"""


@pytest.mark.slow
def test_of_processes_that_begin_together_one_compiles_and_the_others_read(tmp_path):
    """Oracle: numba's own counts of what was compiled, and of what came from disk."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", COMPILE], env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )
        for _ in range(2)
    ]  # fmt: skip
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        process.stdin.write("\n")
        process.stdin.flush()
    results = [json.loads(process.communicate()[0]) for process in processes]
    assert [result[0] for result in results] == [[1, 2, 0]] * 2
    assert sorted(result[1:] for result in results) == [[0, 1], [1, 0]]


def test_a_file_system_without_locks_keeps_no_kernel_from_compiling(monkeypatch):
    def refuse(*_):
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    doubled = by_one_process(njit(cache=True)(_doubled))
    assert doubled(np.float32(3)) == 6


def _doubled(value):
    return value + value
