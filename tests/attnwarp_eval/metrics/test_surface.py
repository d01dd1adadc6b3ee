"""Accuracy of surfaces. Oracles: planes at known distances, distances of all pairs, and harmonic
means by hand.
"""

import math

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from attnwarp_eval import metrics

GRID = np.stack(np.mgrid[0:1:0.02, 0:1:0.02], axis=-1).reshape(-1, 2)
FLAT = np.column_stack([GRID, np.zeros(len(GRID))])
UP = np.tile([0.0, 0.0, 1.0], (len(FLAT), 1))


def test_parallel_planes_are_as_far_apart_as_they_lie_and_right_within_the_threshold():
    for distance, right in ((0.03, 1.0), (0.06, 0.0)):
        error = metrics.surface_error(
            FLAT + np.array([0, 0, distance]), FLAT, threshold=0.05, normal=-UP, true_normal=UP
        )
        for name in ("accuracy", "completeness", "chamfer"):
            assert error[f"surface.{name}"] == pytest.approx(distance, rel=1e-12)
        for name in ("precision", "recall", "f_score"):
            assert error[f"surface.{name}"] == right
        assert error["surface.normal_consistency"] == 1  # of either sign


def test_half_a_plane_is_accurate_and_incomplete():
    half = FLAT[FLAT[:, 0] < 0.5 - 1e-9]
    error = metrics.surface_error(half, FLAT, threshold=0.01)
    assert error["surface.accuracy"] == 0 and error["surface.precision"] == 1
    assert error["surface.recall"] == 0.5
    assert error["surface.f_score"] == pytest.approx(2 / 3)
    # Columns at 0.50 ... 0.98 are 0.02 ... 0.50 from that at 0.48; the others are there.
    assert error["surface.completeness"] == pytest.approx(sum(range(1, 26)) * 0.02 / 50)
    cut = metrics.surface_error(half, FLAT, threshold=0.01, cut=0.11)  # keeps 0.02 ... 0.10
    assert cut["surface.completeness"] == pytest.approx(sum(range(1, 6)) * 0.02 / 30)
    assert cut["surface.recall"] == 0.5


def test_figures_are_those_of_all_pairs():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(300, 3)), rng.normal(size=(200, 3)) + 0.2
    n, m = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 300, 3)))
    m = m[:200]
    error = metrics.surface_error(a, b, threshold=0.4, cut=0.6, normal=n, true_normal=m)
    apart = cdist(a, b)
    there, back = apart.min(1), apart.min(0)
    assert error["surface.accuracy"] == pytest.approx(there[there < 0.6].mean())
    assert error["surface.completeness"] == pytest.approx(back[back < 0.6].mean())
    assert error["surface.chamfer_uncut"] == pytest.approx((there.mean() + back.mean()) / 2)
    p, r = (there < 0.4).mean(), (back < 0.4).mean()
    assert error["surface.f_score"] == pytest.approx(2 * p * r / (p + r))
    cosines = np.abs(n @ m.T)
    rows, columns = np.arange(300), np.arange(200)
    want = (cosines[rows, apart.argmin(1)].mean() + cosines[apart.argmin(0), columns].mean()) / 2
    assert error["surface.normal_consistency"] == pytest.approx(want)


def test_without_points_every_figure_is_undefined_and_counted():
    none = np.zeros((0, 3))
    for a, b in ((none, FLAT), (FLAT, none)):
        n, m = (UP[: len(side)] for side in (a, b))
        error = metrics.surface_error(a, b, threshold=0.1, normal=n, true_normal=m)
        counts = {error.pop("surface.points"), error.pop("surface.true_points")}
        assert counts == {0, len(FLAT)}
        assert all(map(math.isnan, error.values())) and len(error) == 8


def test_one_point_is_a_surface_and_far_points_have_no_chamfer():
    error = metrics.surface_error([[0.0, 0, 3]], [[0.0, 0, 0]], threshold=1.0, cut=2.0)
    assert math.isnan(error["surface.chamfer"]) and error["surface.f_score"] == 0
    near = metrics.surface_error([[0.0, 0, 1]], [[0.0, 0, 0]], threshold=2.0, cut=2.0)
    assert near["surface.chamfer"] == 1 and near["surface.f_score"] == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": [[0.0, 0, np.nan]]}, "points: not finite"),
        ({"points": [[0.0, 0]]}, "points: got"),
        ({"normal": UP}, "normal, true_normal: got one of them"),
    ],
)
def test_bad_input_is_refused_by_name(changes, message):
    given = {"points": FLAT, "true_points": FLAT, "threshold": 0.1} | changes
    with pytest.raises(ValueError, match=message):
        metrics.surface_error(**given)
