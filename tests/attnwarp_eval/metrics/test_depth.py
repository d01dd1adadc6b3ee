"""Depth errors by hand, the undefined cases, normals by closed form."""

import math

import numpy as np
import pytest

from attnwarp_eval import metrics


def test_depth_error_of_a_case_by_hand():
    truth = np.array([[2.0, 4.0, 5.0, 10.0, np.nan, 1.0]])
    depth = np.array([[2.0, 3.0, 5.04, 12.6, 7.0, np.nan]])
    got = metrics.depth_error(depth, truth)
    errors = np.array([0, -1, 0.04, 2.6])
    relative = errors / np.array([2.0, 4, 5, 10])
    assert got["depth.abs_rel"] == pytest.approx(np.abs(relative).mean())
    assert got["depth.rmse"] == pytest.approx(math.sqrt((errors**2).mean()))
    assert got["depth.bias"] == pytest.approx(errors.mean())
    assert got["depth.bias_relative"] == pytest.approx(relative.mean())
    assert got["depth.bias_median"] == pytest.approx(np.median(relative))
    # 1, 4/3, 1.008, 1.26 of five pixels with a surface.
    assert got["depth.delta_1_01"] == 2 / 5
    assert got["depth.delta_1_25"] == 2 / 5
    assert got["depth.coverage"] == 4 / 5
    assert got["depth.pixels"] == 5
    assert got["depth.phantom"] == 1


def test_undefined_depth_is_left_out_and_counted():
    truth = np.full((1, 5), 2.0)
    got = metrics.depth_error(np.array([[2.0, 0.0, -1.0, np.inf, np.nan]]), truth)
    assert got["depth.coverage"] == 1 / 5
    assert got["depth.abs_rel"] == 0
    assert got["depth.delta_1_25"] == 1 / 5


def test_nothing_to_measure_is_nan():
    # Hard case 35.
    nan = np.full((2, 2), np.nan)
    got = metrics.depth_error(
        nan, nan, normal=np.full((2, 2, 3), np.nan), true_normal=np.full((2, 2, 3), np.nan)
    )
    assert got["depth.pixels"] == got["depth.phantom"] == 0
    assert all(math.isnan(v) for k, v in got.items() if k not in ("depth.pixels", "depth.phantom"))
    unseen = metrics.depth_error(nan, np.ones((2, 2)))
    assert unseen["depth.coverage"] == unseen["depth.delta_1_01"] == 0
    assert math.isnan(unseen["depth.rmse"])


def test_interior_and_edge_are_told_apart():
    truth = np.full((1, 4), 10.0)
    depth = np.array([[10.0, 10.1, 12.0, 8.0]])
    edge = np.array([[False, False, True, True]])
    got = metrics.depth_error(depth, truth, edge=edge)
    assert got["depth.abs_rel.interior"] == pytest.approx(0.005)
    assert got["depth.abs_rel.edge"] == pytest.approx(0.2)
    assert got["depth.bias.edge"] == pytest.approx(0.0)
    assert got["depth.pixels"] == 4


def test_normal_angles_are_those_the_normals_were_turned_by():
    angles = np.array([[0.0, 1e-6, 10.0, 90.0, 180.0]])
    true_normal = np.broadcast_to([0.0, 0.0, 1.0], (1, 5, 3))
    turned = np.stack([np.sin(np.radians(angles)), 0 * angles, np.cos(np.radians(angles))], axis=-1)
    depth = np.ones((1, 5))
    got = metrics.depth_error(depth, depth, normal=0.3 * turned, true_normal=true_normal)
    assert got["depth.normal_mean"] == pytest.approx(angles.mean(), rel=1e-9)
    assert got["depth.normal_median"] == pytest.approx(10.0, rel=1e-9)
    small = metrics.depth_error(
        depth[:, :2], depth[:, :2], normal=turned[:, :2], true_normal=true_normal[:, :2]
    )
    # An arccosine reads 0 for a millionth of a degree.
    assert small["depth.normal_mean"] == pytest.approx(5e-7, rel=1e-5)


def test_a_normal_needs_its_truth():
    depth = np.ones((1, 1))
    with pytest.raises(ValueError, match="normal, true_normal: got one of them"):
        metrics.depth_error(depth, depth, normal=np.ones((1, 1, 3)))
    with pytest.raises(ValueError, match=r"depth: got shape \(1, 2\), expected \(1, 1\)"):
        metrics.depth_error(np.ones((1, 2)), depth)
