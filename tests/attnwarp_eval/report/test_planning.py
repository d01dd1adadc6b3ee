"""Oracles: sums worked out by hand, the noncentral t distribution."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_eval.report.planning import cost_of, needed
from attnwarp_eval.statistics.contrasts import contrast

STUDY = """\
name: mine
size: 32
scenes: {drawn: 12, generator: 1, seed: 7}
views: [yaw030]
spp: 1
splats: {kind: 2d, count: 500}
variants: {corrected: {preset: corrected}, slipped: {set: {pixel_centers: integer}}}
probes: {warp: [corrected, slipped]}
ablations: [{title: Slip, baseline: corrected, variants: [slipped]}]
"""


def _cell(probe, variants, seconds):
    record = SimpleNamespace(cost=SimpleNamespace(seconds={"set-up": seconds, "steady": 99.0}))
    return SimpleNamespace(probe=probe, variants=variants, record=record)


def test_the_cost_of_cells_is_the_mean_of_those_of_their_kind(tmp_path):
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / "a.json").write_bytes(b"x" * 3000)
    done = [_cell("warp", ("a",), 10.0), _cell("warp", ("a",), 20.0), _cell("depth", ("a",), 2.0)]
    results = SimpleNamespace(cells=done, measured=3)
    kinds = [("warp", ("a",))] * 4 + [("depth", ("a",))] + [("warp", ("b",))]
    cost = cost_of(kinds, (results, tmp_path))
    # Seconds of the first view and of the others are within the rest.
    assert cost.hours == pytest.approx((4 * 15 + 2) / 3600)
    assert cost.gigabytes == pytest.approx(5 * 1000 / 1e9) and cost.unknown == 1
    nothing = cost_of(kinds, None)
    assert (nothing.hours, nothing.unknown) == (0, 6)


def test_scenes_needed_have_the_power_of_the_noncentral_t_and_are_at_least_six():
    spread = np.array([-1.0, -0.5, 0.0, 0.5, 1.0, 0.3, -0.3, 0.0])
    a = {f"s{k}": {"v": 0.0} for k in range(8)}
    b = {f"s{k}": {"v": x} for k, x in enumerate(spread)}
    count = needed(contrast(a, b, "plain"), 0.4)

    def power(scenes):
        shift = 0.4 / spread.std(ddof=1) * math.sqrt(scenes)
        return stats.nct.sf(stats.t.ppf(0.975, scenes - 1), scenes - 1, shift)

    assert power(count) >= 0.8 > power(count - 1)
    assert needed(contrast(a, b, "plain"), 100.0) == 6


@pytest.mark.slow
def test_a_dry_run_says_scenes_hours_and_gigabytes_from_the_cells_that_are_done(tmp_path):
    path, out = tmp_path / "mine.yaml", tmp_path / "run"
    path.write_text(STUDY)

    def run(*options):
        done = CliRunner().invoke(app, ["run", str(path), "--out", str(out), *options])
        assert done.exit_code == 0, done.output
        return done.output

    assert "hours: not known before" in run("--dry-run")
    run("--scenes", "drawn-0,drawn-1,drawn-2")
    planned = run("--dry-run")
    assert "scenes needed" in planned and "slipped against corrected" in planned
    assert "hours of one worker" in planned
