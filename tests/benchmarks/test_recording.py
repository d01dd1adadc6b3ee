"""The benchmark of recording, on a small UNet."""

import math
from pathlib import Path

import numpy as np
import pytest
from tiny_editors import unet

from attnwarp.editing.layers import Layer
from attnwarp.editing.recording import RecordingPlan
from attnwarp_eval.cost import peak_memory_mb
from benchmarks import recording

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(),
    reason="peak memory is reset through Linux's /proc/self/clear_refs, which is not here",
)


def test_every_run_is_timed_and_a_recording_holds_what_was_announced():
    plan, rows = recording.measure(unet(8), size=8, timesteps=(981, 481))
    assert [row.run for row in rows] == ["plain", "recorded", "injected"]
    assert all(row.cpu_s > 0 and row.wall_s > 0 and math.isfinite(row.peak_mib) for row in rows)
    assert [row.above_mib for row in rows] == [row.peak_mib - rows[0].peak_mib for row in rows]
    values = sum(math.prod(layer.size((8, 8))) * layer.channels for layer in plan.layers)
    assert plan.bytes == values * 2 * 2 * 4  # two branches, two steps, float32
    assert recording.table(rows).count("\n") == 4


def test_the_rise_of_the_peak_stands_beside_what_was_announced():
    """Oracle: 96 channels at 32 x 32, two branches, four steps, float32, are 3 MiB, and peaks that are made up."""
    layer = Layer("up_blocks.0.attentions.0.transformer_blocks.0.attn1", "self", 0, 96)
    plan = RecordingPlan((layer,), (32, 32), ("text", "image"), ("text", "image"), steps=4)
    peaks = {"plain": 100.0, "recorded": 103.3, "injected": 103.0}
    rows = [recording.Row(run, 1, 1, peak, peak - 100) for run, peak in peaks.items()]
    assert recording.verdict(plan, rows) == (
        "announced 3.0 MiB; recorded, the peak rose by 3.3 MiB, 1.100 of it"
    )


def test_memory_that_was_freed_is_no_part_of_a_later_peak():
    held = np.ones(2**23)  # 64 MiB
    recording.reset_peak()
    before = peak_memory_mb()
    more = np.ones(2**22)
    assert abs((peak_memory_mb() - before) / 32 - 1) < 0.1
    del held, more
    recording.reset_peak()
    assert peak_memory_mb() < before
