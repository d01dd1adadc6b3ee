"""Curves of fits. Oracles: the seconds that the records hold, and SciPy's t over the scenes' means."""

from dataclasses import replace

import numpy as np
import pytest
import written_runs
from scipy import stats

from attnwarp_eval.document import charts
from attnwarp_eval.study.probe_report import Layout, report_of
from attnwarp_eval.study.probes.fit.measure import Point

SECONDS = {10: 0.5, 20: 1.0}
PSNR = {"bear": [20.0, 20.1, 20.2], "fence": [30.0, 30.2, 30.4], "glass": [26.0, 26.0, 26.3]}
FIGURES = {"depth.abs_rel": 0.01, "depth.normal_median": 2.0}
NAMES = ["first", "second", "third", "fourth", "fifth"]


@pytest.fixture
def results():
    """Three scenes with three seeds each, of five fits that take equally long."""
    cells = []
    for scene, by_seed in PSNR.items():
        for seed, psnr in enumerate(by_seed):
            points = [
                Point(k, s, s, 100, 0.1, psnr, psnr, FIGURES).to_json() for k, s in SECONDS.items()
            ]
            data = written_runs.record([("v0", 0.0, {})], curve=points)
            cell = written_runs.outcome("fit", scene, NAMES, data)
            cells.append(replace(cell, seed=seed))
    study = {
        "name": "fits",
        "scenes": list(PSNR),
        "seeds": [0, 1, 2],
        "variants": {name: {} for name in NAMES},
        "probes": {"fit": NAMES},
    }
    return written_runs.results(study, cells)


def test_curves_are_drawn_at_their_seconds(results, tmp_path, monkeypatch):
    drawn = []

    def lines(axes, *arguments, **options):
        draw(axes, *arguments, **options)
        drawn.extend(container.lines[0].get_xdata() for container in axes.containers)

    draw = charts.lines
    monkeypatch.setattr(charts, "lines", lines)
    report_of("fit")._curves(results, Layout(tmp_path), NAMES)
    assert len(drawn) > 2 * len(NAMES)
    for x in drawn:
        np.testing.assert_allclose(x, [*SECONDS.values()], rtol=1e-12)


def test_intervals_of_curves_are_over_scenes_and_not_over_seeds(results):
    _, values = report_of("fit")._curve(results, NAMES[0], lambda point: point.psnr)
    means = [np.mean(v) for v in PSNR.values()]
    expected = stats.t.interval(0.95, 2, np.mean(means), stats.sem(means))
    for value in values:
        assert (value.low, value.high) == pytest.approx(expected, rel=1e-9)
        assert (value.scenes, value.views) == (3, 9)
