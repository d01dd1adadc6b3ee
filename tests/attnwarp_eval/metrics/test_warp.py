"""Endpoint and feature error by hand, and the solid field as its own oracle."""

import math

import cv2
import numpy as np
import pytest
import torch
from scipy import fft

from attnwarp import Camera
from attnwarp.warp import correspond_at, sample
from attnwarp_eval import metrics
from attnwarp_eval.metrics.registry import metric
from attnwarp_eval.truth.features import SolidField


def test_endpoint_error_of_a_case_by_hand():
    truth = np.zeros((2, 3, 2))
    xy = truth.copy()
    xy[0] = [[0.3, 0.0], [0.0, 0.9], [3.0, 4.0]]
    xy[1] = [[np.nan, 0.0], [0.0, 0.0], [100.0, 0.0]]
    visible = np.array([[True, True, True], [True, True, False]])
    truth[1, 2] = np.nan  # not visible: what truth says there does not count
    got = metrics.endpoint_error(xy, truth, visible)
    errors = [0.3, 0.9, 5.0, 0.0]
    assert got["warp.epe_median"] == pytest.approx(0.6)
    assert got["warp.epe_mean"] == pytest.approx(sum(errors) / 4)
    assert got["warp.epe_p95"] == pytest.approx(np.percentile(errors, 95))
    # Of five visible pixels: the one without a position is within nothing.
    assert got["warp.below_half_px"] == 2 / 5
    assert got["warp.below_1px"] == got["warp.below_2px"] == 3 / 5
    assert got["warp.coverage"] == 4 / 5
    assert got["warp.visible"] == 5


def test_layer_errors_are_in_layer_pixels_and_image_errors_in_image_pixels():
    truth = np.zeros((1, 2, 2))
    xy = np.array([[[0.1, 0.0], [0.0, 0.1]]])
    got = metrics.endpoint_error(xy, truth, np.ones((1, 2), bool), image_px=8)
    assert got["warp.epe_median_layer"] == pytest.approx(0.1)
    assert got["warp.epe_median"] == pytest.approx(0.8)
    stretched = metrics.endpoint_error(xy, truth, np.ones((1, 2), bool), image_px=(8, 4))
    assert stretched["warp.epe_mean"] == pytest.approx(0.6)


def test_interior_and_edge_are_told_apart():
    truth = np.zeros((1, 4, 2))
    xy = np.array([[[0.1, 0], [0.1, 0], [3.0, 0], [3.0, 0]]])
    edge = np.array([[False, False, True, True]])
    got = metrics.endpoint_error(xy, truth, np.ones((1, 4), bool), edge)
    assert got["warp.epe_median.interior"] == pytest.approx(0.1)
    assert got["warp.epe_median.edge"] == pytest.approx(3.0)
    assert got["warp.visible.edge"] == 2


def test_nothing_to_measure_is_nan_and_counted():
    # Hard case 35.
    truth = np.full((2, 2, 2), np.nan)
    none = np.zeros((2, 2), bool)
    got = metrics.endpoint_error(truth, truth, none) | metrics.feature_error(
        np.zeros((3, 2, 2)), np.zeros((3, 2, 2)), none, none
    )
    counts = {name: value for name, value in got.items() if metric(name).unit == "pixels"}
    assert counts == {"warp.visible": 0, "warp.feature_pixels": 0}
    assert all(math.isnan(value) for name, value in got.items() if name not in counts)


def test_truth_that_does_not_belong_to_its_labels_is_refused():
    truth = np.full((1, 1, 2), np.nan)
    with pytest.raises(ValueError, match="true_xy: not finite in a visible pixel"):
        metrics.endpoint_error(np.zeros((1, 1, 2)), truth, np.ones((1, 1), bool))
    with pytest.raises(ValueError, match=r"visible: got float64, expected bool"):
        metrics.endpoint_error(np.zeros((1, 1, 2)), np.zeros((1, 1, 2)), np.ones((1, 1)))
    with pytest.raises(ValueError, match=r"xy: got shape \(2, 1, 2\), expected \(1, 1, 2\)"):
        metrics.endpoint_error(np.zeros((2, 1, 2)), np.zeros((1, 1, 2)), np.ones((1, 1), bool))


def test_feature_error_of_a_case_by_hand():
    exact = np.array([[[3.0, 1.0, 2.0, np.nan]], [[4.0, 0.0, 0.0, np.nan]]])
    warped = np.array([[[3.0, 2.0, 9.0, 7.0]], [[4.5, 0.0, 0.0, 7.0]]])
    accepted = np.array([[True, True, True, True]])
    visible = np.array([[True, True, False, False]])
    got = metrics.feature_error(warped, exact, accepted, visible)
    assert got["warp.feature_accepted"] == pytest.approx(math.sqrt((0.25 + 1) / (25 + 1)))
    assert got["warp.feature_all_accepted"] == pytest.approx(
        math.sqrt((0.25 + 1 + 49) / (25 + 1 + 4))
    )
    rejected = metrics.feature_error(
        warped, exact, np.array([[True, False, False, False]]), visible
    )
    assert rejected["warp.feature_accepted"] == pytest.approx(math.sqrt(0.25 / 25))
    assert rejected["warp.feature_visible"] == got["warp.feature_accepted"]
    assert rejected["warp.feature_pixels"] == 1


def test_the_field_is_band_limited_and_of_unit_variance():
    # Sampled along a line over many extents, its spectrum ends at the bandwidth (a Hann window's
    # leakage aside).
    field = SolidField((1.0, 2.0, 3.0), extent=2.0, channels=16, cycles=4.0, seed=3)
    n, length = 8192, 64.0
    t = np.arange(n) / n * length
    direction = np.array([0.6, 0.0, 0.8])
    values = field(np.array([1.0, 2.0, 3.0]) + t[:, None] * direction)
    power = np.abs(fft.rfft(values * np.hanning(n)[:, None], axis=0)) ** 2
    frequency = np.arange(len(power)) / length
    assert power[frequency > 4.0 / 2.0 + 3 / length].sum() < 1e-6 * power.sum()
    assert np.linalg.norm(field.frequencies, axis=-1).max() <= 2.0
    cloud = np.random.default_rng(0).uniform(-50, 50, (100_000, 3))
    assert (
        np.abs(field(cloud).var(axis=0) - 1).max() < 0.03
    )  # far above the sampling error of 1e5 points
    assert np.abs(field(cloud).mean(axis=0)).max() < 0.03


def test_the_field_belongs_to_the_point():
    field = SolidField((0, 0, 0), extent=3.0, seed=1)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    # A brute-force sum, term by term in Python floats.
    for i in (0, 17):
        for c in (0, 7):
            value = sum(
                math.sin(
                    2
                    * math.pi
                    * (float(np.dot(field.frequencies[c, k], points[i])) + field.phases[c, k])
                )
                for k in range(4)
            )
            assert field(points)[i, c] == pytest.approx(value / math.sqrt(2), abs=1e-12)
    shift = np.array([1e6, -1e6, 2e6])
    moved = SolidField(shift, extent=3.0, seed=1)
    assert np.abs(moved(points + shift) - field(points)).max() < 1e-8
    assert SolidField(shift, extent=3.0, seed=1) == moved
    assert np.abs(SolidField((0, 0, 0), extent=3.0, seed=2)(points) - field(points)).max() > 0.5
    points[3] = np.nan
    assert np.isnan(field(points)[3]).all()
    grid = field.on_grid(points.reshape(5, 10, 3))
    assert grid.shape == (8, 5, 10)
    assert (grid[:, 0, 3] == 0).all()
    with pytest.raises(ValueError, match=r"extent: got 0"):
        SolidField((0, 0, 0), extent=0.0)


def floor(camera):
    """Depth and points of the plane z = -1."""
    rays = camera.directions() @ camera.rotation
    with np.errstate(divide="ignore"):
        depth = (-1.0 - camera.position[2]) / rays[..., 2]
    depth = np.where(depth > 0, depth, np.nan)
    return depth, camera.unproject(camera.pixel_centers(), depth)


@pytest.mark.parametrize(("size", "bound"), [(256, 2e-3), (64, 0.03), (32, 0.1)])
def test_an_exact_warp_of_the_field_errs_by_bilinear_interpolation_alone(size, bound):
    # Scene seen from above, its extent the image's width: wavelengths of at least size / 4 px. Half
    # way between taps a sinusoid of f cycles a pixel loses 1 - cos(pi f) of its amplitude, on
    # average over positions less.
    source = Camera.look_at((0.4, 0, 3), (0, 0, -1), width=256, height=256, fov_y=50, up=(0, 1, 0))
    target = Camera.look_at(
        (-0.5, 0.6, 2.9), (0, 0, -1), width=256, height=256, fov_y=50, up=(0, 1, 0)
    )
    field = SolidField((0, 0, -1), extent=2 * 4 * math.tan(math.radians(25)), channels=4)
    depth, _ = floor(target)
    small = [camera.resize(size, size) for camera in (source, target)]
    features = torch.from_numpy(field.on_grid(floor(small[0])[1]))
    exact = field.on_grid(floor(small[1])[1], background=np.nan)
    layer = correspond_at(source, target, depth, (size, size))
    warped, mask = sample(features, layer)
    got = metrics.feature_error(warped, exact, mask, mask)
    assert got["warp.feature_accepted"] < bound
    # The half-pixel slip at the same size: the field notices it.
    slipped, kept = sample(
        features, correspond_at(source, target, depth, (size, size), pixel_centers="integer")
    )
    worse = metrics.feature_error(slipped, exact, mask & kept, mask & kept)
    assert worse["warp.feature_accepted"] > 1.5 * got["warp.feature_accepted"]
    # OpenCV's warp of the same map along the exact positions errs as much: the figure is the
    # interpolation's.
    xy, _ = small[0].project(floor(small[1])[1])
    index = (xy - 0.5).astype(np.float32)
    channels = np.ascontiguousarray(np.moveaxis(features.numpy(), 0, -1), dtype=np.float32)
    theirs = cv2.remap(
        channels, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    ours = metrics.feature_error(warped, exact, mask, mask)["warp.feature_accepted"]
    cv = metrics.feature_error(np.moveaxis(theirs, -1, 0), exact, mask, mask)[
        "warp.feature_accepted"
    ]
    # It rounds positions to 1/32 px.
    assert ours <= cv * 1.05
    assert cv - ours < 2 * math.pi * 4 / size / 64 + 0.05 * ours
