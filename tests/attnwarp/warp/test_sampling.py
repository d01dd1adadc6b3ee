"""Sampling against closed forms, OpenCV, torch and float64."""

import cv2
import numpy as np
import pytest
import torch
from closed_forms import apply, homography, orbit, plane_depth, sphere

from attnwarp.warp.correspondence import Correspondence, correspond, correspond_at, in_bounds
from attnwarp.warp.sampling import sample, sample_at, sample_depth


@pytest.mark.parametrize("size", [(64, 64), (32, 32), (32, 64)])
def test_features_of_any_size_are_read_at_u_times_s(size):
    # Hard case 28: a linear ramp over the image is the same ramp at every size; warping it gives
    # the position itself.
    source, target = orbit(0, size=512, height=1), orbit(20, size=512, height=1)
    depth = plane_depth(target, (1, 0, 0), 0.0)
    h, w = size
    ramp = torch.from_numpy(np.moveaxis(source.resize(w, h).pixel_centers() / [w, h], -1, 0).copy())
    full = correspond(source, target, depth)
    layer = correspond_at(source, target, depth, size)
    margin = 0.5 / min(h, w)  # nearer the border than half a pixel the ramp is clamped
    # A stretched map belongs to a stretched view alone.
    for c in (full, layer) if h == w else (layer,):
        warped, mask = sample(ramp, c)
        position = (c.xy / torch.tensor([c.source.width, c.source.height])).permute(2, 0, 1)
        inner = mask & (position > margin).all(0) & (position < 1 - margin).all(0)
        assert inner.float().mean() > 0.5
        assert (warped - position)[:, inner].abs().max() < 1e-5
    # And the layer's own positions are the image's, at the same rays.
    exact = apply(
        homography(source, target, (1, 0, 0), 0.0),
        target.resize(w, h).pixel_centers() * [512 / w, 512 / h],
    )
    answered = layer.defined.numpy()
    assert np.abs(layer.xy.numpy() * [512 / w, 512 / h] - exact)[answered].max() < 1e-6


def test_nan_in_a_grid_is_masked_before_sampling():
    # Hard case 36.
    xy = torch.tensor(
        [[[1.5, 1.5], [torch.nan, 1.5], [1.5, torch.inf], [-torch.inf, 2.5]]], dtype=torch.float64
    )
    features = torch.full((1, 3, 3), 7.0)
    for mode in ("bilinear", "nearest"):
        assert sample_at(features, xy, mode=mode).tolist() == [[[7, 0, 0, 0]]]


def test_a_tap_of_no_weight_may_hold_anything():
    features = torch.tensor([[[1.0, torch.inf], [torch.nan, torch.nan]]])
    xy = torch.tensor([[[0.5, 0.5]]], dtype=torch.float64)
    assert sample_at(features, xy).item() == 1.0


@pytest.mark.door
def test_integer_features_are_refused_unless_nearest():
    labels = torch.tensor([[[1, 2], [3, 4]]])
    xy = torch.tensor([[[0.2, 0.4], [1.9, 1.1]]], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"features: got torch\.int64.*mode='nearest'"):
        sample_at(labels, xy)
    assert sample_at(labels, xy, mode="nearest").tolist() == [[[1, 4]]]
    with pytest.raises(ValueError, match=r"features: got shape \(2, 2\)"):
        sample(labels[0], correspond(orbit(0), orbit(0), np.full((64, 64), 4.0)))


def test_sampling_agrees_with_opencv_remap():
    source, target = orbit(0, size=96, height=1), orbit(30, size=96, height=1.3)
    c = correspond(source, target, np.fmin(sphere(target)[0], 5.0))
    image = np.random.default_rng(0).random((96, 96, 3)).astype(np.float32)
    warped, mask = sample(torch.from_numpy(image).permute(2, 0, 1), c)
    # OpenCV counts pixel centres as integers, and rounds positions to 1/32 px: its own error is up
    # to half of that.
    index = np.nan_to_num(c.xy.numpy() - 0.5, nan=-10).astype(np.float32)
    expected = cv2.remap(
        image, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    difference = np.abs(warped.permute(1, 2, 0).numpy() - expected)[mask.numpy()]
    assert mask.float().mean() > 0.5
    assert difference.max() < 2 / 64
    assert difference.mean() < 0.005


def test_sampling_agrees_with_grid_sample_and_so_does_its_gradient():
    source, target = orbit(0, size=40, height=1, width=56), orbit(30, size=40, height=1.3, width=56)
    c = correspond(source, target, np.full((40, 56), 4.2))
    features = torch.randn(
        2, 3, 20, 28, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    features.requires_grad_(True)
    warped, mask = sample(features, c)
    grid = 2 * c.xy / torch.tensor([56, 40]) - 1
    expected = torch.nn.functional.grid_sample(
        features, grid[None].expand(2, -1, -1, -1), padding_mode="border", align_corners=False
    )
    assert mask.float().mean() > 0.5
    assert (warped - expected).abs().max() < 1e-6  # SNAP moves a position by up to 1e-7 px
    ours, theirs = (
        torch.autograd.grad(v.square().sum(), features, retain_graph=True)[0]
        for v in (warped, expected)
    )
    assert (ours - theirs).abs().max() < 1e-5


def test_integer_centres_are_align_corners_on_indices():
    # The published slip, replayed with the calls it was made of: unproject at j, project to u,
    # grid_sample with align_corners=True, on the layer's own grid.
    source, target = orbit(0, size=64, height=1), orbit(30, size=64, height=1.3)
    depth = np.fmin(sphere(target)[0], 5.0)
    c = correspond(source, target, depth, pixel_centers="integer")
    j, i = np.meshgrid(np.arange(64.0), np.arange(64.0))
    u, _ = source.project(target.unproject(np.stack([j, i], axis=-1), depth))
    assert np.abs(c.xy.numpy() - 0.5 - u).max() < 1e-9
    for h, w in ((64, 64), (32, 33)):
        features = torch.randn(
            3, h, w, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
        )
        grid = torch.from_numpy(2 * u / 63 - 1)[None]
        expected = torch.nn.functional.grid_sample(
            features[None], grid, padding_mode="border", align_corners=True
        )[0]
        warped, mask = sample(features, c)
        assert (warped - expected).abs().max() < 1e-5
        inside = (u >= 0).all(-1) & (u < 64).all(-1)
        assert np.array_equal(mask.numpy(), inside)


def test_a_position_on_the_border_is_in_and_beyond_it_takes_the_borders_value():
    c = correspond(orbit(0, size=4), orbit(0, size=4), np.full((4, 4), 4.0))
    xy = c.xy.clone()
    xy[0, 0] = torch.tensor([0.0, 0.0])
    xy[0, 1] = torch.tensor([4.0, 4.0])
    xy[0, 2] = torch.tensor([-1e-9, 2.0])
    xy[0, 3] = torch.tensor([1e300, 0.0], dtype=torch.float64)
    moved = Correspondence(c.source, c.target, xy, c.points, c.target_depth)
    features = torch.arange(16.0).reshape(1, 4, 4)
    warped, mask = sample(features, moved)
    assert mask[0].tolist() == [True, True, False, False]
    assert warped[0, 0].tolist() == [0, 15, 6, 3]
    assert in_bounds(moved, (8, 8))[0].tolist() == [True, True, False, False]
    assert in_bounds(moved, (2, 2)).sum() == 3  # the corner, and the two centres of the second row


@pytest.mark.door
def test_maps_of_other_proportions_than_the_source_are_refused_by_name():
    wide = orbit(0, size=16, width=32)
    c = correspond(wide, wide, np.full((16, 32), 4.0))
    for call, name in (
        (lambda: sample(torch.ones(3, 32, 16), c), "features"),
        (lambda: sample_depth(np.full((32, 16), 4.0), c), "source_depth"),
    ):
        with pytest.raises(ValueError, match=f"{name}: got 32 x 16 .* aspect ratio of 16 x 32"):
            call()
    # The picture of 16 x 32 reduced by three, each side rounded: 5 x 11.
    assert sample(torch.ones(3, 5, 11), c)[0].min() == 1


def test_the_sources_own_depth_answers_where_its_taps_do():
    source, target = orbit(0, size=128, height=1), orbit(20, size=128, height=1)
    depth, source_depth = (plane_depth(camera, (0, 0, 1), -1.0) for camera in (target, source))
    c = correspond(source, target, depth)
    seen = sample_depth(source_depth, c)
    inside = in_bounds(c)
    assert torch.isnan(seen[~inside]).all()
    answered = torch.isfinite(seen)
    assert answered.sum() > 0.3 * inside.sum()
    # Inverse depth is linear on a plane, except where the border clamps a tap: within half a pixel
    # of the image's end.
    inner = answered & ((c.xy > 0.5) & (c.xy < 127.5)).all(-1)
    assert (seen / c.z - 1)[inner].abs().max() < 1e-9
