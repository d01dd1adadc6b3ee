"""Oracle: the noncentral t distribution."""

import math

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_eval.report.planning import needed
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
ablations: [{title: Slip, probe: warp, baseline: corrected, variants: [slipped]}]
"""


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
def test_a_dry_run_says_the_scenes_needed_from_the_cells_that_are_done(tmp_path):
    path, out = tmp_path / "mine.yaml", tmp_path / "run"
    path.write_text(STUDY)

    def run(*options):
        done = CliRunner().invoke(app, ["run", str(path), "--out", str(out), *options])
        assert done.exit_code == 0, done.output
        return done.output

    assert "scenes needed" not in run("--dry-run")
    run("--scenes", "drawn-0,drawn-1,drawn-2")
    planned = run("--dry-run")
    assert "scenes needed" in planned and "slipped against corrected" in planned
