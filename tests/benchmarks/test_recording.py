"""The benchmark of recording, on a small UNet."""

import math
from pathlib import Path

import pytest
from tiny_editors import unet

from benchmarks import recording


@pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(),
    reason="peak memory is reset through Linux's /proc/self/clear_refs, which is not here",
)
def test_every_run_is_timed_and_a_recording_holds_what_was_announced():
    plan, rows = recording.measure(unet(8), size=8)
    assert [row.run for row in rows] == ["plain", "recorded", "injected"]
    assert all(row.cpu_s > 0 and row.wall_s > 0 and math.isfinite(row.peak_gib) for row in rows)
    values = sum(math.prod(layer.size((8, 8))) * layer.channels for layer in plan.layers)
    assert plan.bytes == values * 2 * 2 * 4  # two branches, two steps, float32
    assert recording.table(rows).count("\n") == 4
