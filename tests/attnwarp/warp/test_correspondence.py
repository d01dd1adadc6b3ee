"""Correspondences against closed forms."""

import numpy as np
import pytest
import torch
from closed_forms import apply, homography, orbit, plane_depth, rolled, skewed, sphere

from attnwarp import Camera
from attnwarp.warp.correspondence import correspond, correspond_at, layer_size
from attnwarp.warp.depth import resize_depth
from attnwarp.warp.sampling import sample, sample_at


@pytest.mark.parametrize(
    "change", [lambda c: c, skewed], ids=["plain", "skew_fx_fy_principal_point_outside"]
)
def test_a_plane_moves_by_its_homography(change):
    # Hard cases 12 and 13: the whole K^-1, and no wrap for a principal point outside the image.
    source, target = change(orbit(0, height=1)), change(orbit(25, height=1.5))
    normal, offset = (0.6, 0.3, 0.2), -0.3
    depth = plane_depth(target, normal, offset)
    c = correspond(source, target, depth)
    expected = apply(homography(source, target, normal, offset), target.pixel_centers())
    defined = c.defined.numpy()
    assert defined.sum() > 1000
    # 1e-4 px is the bound of the hard case; float64 leaves about 1e-11.
    assert np.abs(c.xy.numpy() - expected)[defined].max() < 1e-9


def test_points_at_and_behind_the_camera_are_masked_before_the_divide():
    # Hard case 4: the source stands in the row of surface, so that points lie before, in and behind
    # its plane.
    target = Camera(np.array([[1.0, 0, 2.5], [0, 1.0, 0.5], [0, 0, 1]]), np.eye(4), 5, 1)
    depth = np.array([[1.0, 2.0, 3.0, 4.0, 5.0]])
    source = Camera(
        target.K, np.block([[np.eye(3), np.array([[0.0], [0], [-3]])], [np.zeros((1, 3)), 1]]), 5, 1
    )
    c = correspond(source, target, depth)
    assert c.z.tolist() == [[-2, -1, 0, 1, 2]]
    assert c.defined.tolist() == [[False, False, False, True, True]]
    mirrored = correspond(source, target, depth, in_front=False)
    assert mirrored.defined.tolist() == [[True, True, False, True, True]]
    # x = (j - 2) * depth at z: (-2 * 1) / -2 + 2.5
    assert mirrored.xy[0, 0, 0] == 3.5


def test_undefined_depth_is_masked_and_never_filled():
    # Hard case 5.
    camera = orbit(0, size=3)
    depth = np.full((3, 3), 4.0, dtype=np.float32)
    depth[0] = [0, np.nan, np.inf]
    depth[1] = [-1, -np.inf, -0.0]
    for in_front in (True, False):
        c = correspond(orbit(10, size=3), camera, depth, in_front=in_front)
        assert c.defined.tolist() == [[False] * 3, [False] * 3, [True] * 3]
        assert torch.isnan(c.target_depth[:2]).all()
        assert torch.isnan(c.points[:2]).all()
    warped, mask = sample(torch.ones(1, 3, 3), c)
    assert not mask[:2].any()
    assert (warped[0, :2] == 0).all()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 9), (9, 1)])
@pytest.mark.parametrize("centers", ["half", "integer"])
def test_images_of_one_pixel_or_one_row_work(height, width, centers):
    # Hard case 14. A translation along the axis by half the depth doubles offsets from the centre.
    K = np.array([[10.0, 0, width / 2], [0, 10.0, height / 2], [0, 0, 1]])
    near = np.eye(4)
    near[2, 3] = -1.0
    target, source = Camera(K, np.eye(4), width, height), Camera(K, near, width, height)
    c = correspond(source, target, np.full((height, width), 2.0), pixel_centers=centers)
    slip = 0.5 if centers == "integer" else 0.0
    middle = np.array([width, height]) / 2
    expected = 2 * (target.pixel_centers() - slip - middle) + middle + slip
    assert np.abs(c.xy.numpy() - expected).max() < 1e-12
    features = torch.arange(float(height * width)).reshape(1, height, width)
    warped, mask = sample(features, c)
    assert torch.isfinite(warped).all()
    assert warped.shape == (1, height, width)
    assert mask.any() or centers == "integer"
    assert resize_depth(np.full((height, width), 2.0), (1, 1)).tolist() == [[pytest.approx(2.0)]]


@pytest.mark.parametrize(
    ("turn", "expected"),
    [(lambda d: orbit(30, distance=d), 0.14), (lambda d: rolled(orbit(0, distance=d), 90), 1.0)],
    ids=["yaw_30", "roll_90"],
)
@pytest.mark.parametrize("size", [64, 32])
def test_the_half_pixel_slip_costs_a_share_of_the_layers_own_pixel(turn, expected, size):
    # A unit sphere 3 radii from both cameras: median slip 0.14 px of the layer at yaw 30, exactly 1
    # px at roll 90, whatever the layer; 8 times that in a 512 image at 64, 16 times at 32.
    source, target = orbit(0, distance=3.0).resize(size, size), turn(3.0).resize(size, size)
    depth, normal = sphere(target)
    slipped = correspond(source, target, depth, pixel_centers="integer")
    exact, _ = source.project(target.unproject(target.pixel_centers(), depth))
    seen = ((source.position - normal) * normal).sum(-1) > 0
    slip = np.linalg.norm(slipped.xy.numpy() - exact, axis=-1)[seen]
    # 5e-3: the figure is quoted to two digits.
    assert abs(np.median(slip) - expected) < 5e-3
    corrected = correspond(source, target, depth)
    assert np.abs(corrected.xy.numpy() - exact)[seen].max() < 1e-9


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda c, d: correspond(c, c, d[:5]),
            r"target_depth: got shape \(5, 64\), expected \(64, 64\).*correspond_at",
        ),
        (lambda c, d: correspond(c, c, d.astype(int)), r"target_depth: got torch\.int64"),
        (
            lambda c, d: correspond(c, c, d[0]),
            r"target_depth: got shape \(64,\), expected \(H, W\)",
        ),
        (lambda c, d: correspond(c, c, d, pixel_centers="integers"), r"did you mean 'integer'"),
        (lambda c, d: resize_depth(d, (0, 4)), r"size: got \(0, 4\)"),
        (
            lambda c, d: resize_depth(d, (4, 4), interpolation="cubic"),
            r"interpolation: got 'cubic'",
        ),
        (
            lambda c, d: layer_size(c.resize(50, 50), c, (32, 30)),
            r"feature grid 25 x 23\.4375; give source_size",
        ),
        (
            lambda c, d: sample_at(torch.ones(1, 4, 4), torch.ones(4, 4, 3)),
            r"xy: got shape \(4, 4, 3\)",
        ),
    ],
)
def test_the_doors_say_what_came_and_what_was_expected(call, message):
    with pytest.raises(ValueError, match=message):
        call(orbit(0), np.full((64, 64), 4.0))


def test_views_of_different_sizes_keep_their_fractions():
    source, target = orbit(0, size=100, width=200), orbit(15, size=64)
    depth = plane_depth(target, (1, 0, 0), 0.0)
    layer = correspond_at(source, target, depth, (16, 16))
    assert (layer.source.height, layer.source.width) == (25, 50)
    full = correspond(
        source, target.resize(16, 16), plane_depth(target.resize(16, 16), (1, 0, 0), 0.0)
    )
    assert torch.allclose(layer.xy * 4, full.xy, rtol=0, atol=1e-6)
