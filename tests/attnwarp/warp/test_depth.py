"""Depth between the centres of pixels, against closed forms."""

import numpy as np
import pytest
import torch
from closed_forms import orbit, plane_depth, sphere

from attnwarp.warp.depth import depth_slope, resize_depth


def test_taps_across_an_edge_are_rejected():
    # Hard case 26: a step from 2 to 3; the row of centres that falls between the two sides has no
    # depth.
    depth = torch.full((6, 6), 2.0)
    depth[:, 3:] = 3.0
    halved = resize_depth(depth, (2, 2))
    assert halved.tolist() == [[2, 3], [2, 3]]
    between = resize_depth(depth, (6, 3))  # centres at 1, 3, 5: the middle one on the edge itself
    assert torch.isnan(between[:, 1]).all()
    assert torch.isfinite(between[:, [0, 2]]).all()
    blended = resize_depth(depth, (6, 3), spread=None)
    assert torch.allclose(
        blended[:, 1], torch.tensor(2.4, dtype=torch.float64)
    )  # harmonic mean of 2 and 3
    hole = depth.clone()
    hole[0, 1] = torch.nan
    assert torch.isnan(resize_depth(hole, (6, 3))[0, 0])
    assert resize_depth(depth, (6, 3), interpolation="nearest")[0].tolist() == [2, 3, 3]


def test_depth_on_a_grid_never_lies_between_two_surfaces():
    # Hard case 26 on an outline: every answer is the sphere's or the wall's own depth at the exact
    # centre.
    camera = orbit(20, size=512, height=0.5)
    ball, wall = sphere(camera)[0], plane_depth(camera, (1, 0, 0), -2.0)
    small = camera.resize(64, 64)
    exact = [sphere(small)[0], plane_depth(small, (1, 0, 0), -2.0)]
    z = resize_depth(np.fmin(ball, wall), (64, 64)).numpy()
    off = np.fmin(*(np.abs(z / surface - 1) for surface in exact))
    answered = np.isfinite(z)
    assert answered.mean() > 0.9
    # A quarter of the tap spread bounds what blending on the curved sphere can do between
    # neighbours at 512.
    assert np.nanmax(off[answered]) < 0.005
    nearest = np.nanmin(np.stack(exact), axis=0)
    wrong = np.abs(z / nearest - 1) > 0.02
    # At the outline itself the 512 image's pixel beside the centre may show the other surface: a
    # handful.
    assert wrong.sum() <= 8


@pytest.mark.parametrize("size", [(64, 64), (32, 32), (48, 40)])
def test_depth_of_a_slanted_plane_is_exact_in_1_over_z(size):
    # Hard case 27.
    camera = orbit(0, size=256, height=2)
    depth = plane_depth(camera, (0, 0.2, 1), -1.0)
    exact = plane_depth(camera.resize(size[1], size[0]), (0, 0.2, 1), -1.0)
    got = resize_depth(depth, size).numpy()
    answered = np.isfinite(got)
    assert answered.sum() > 0.3 * answered.size
    assert np.abs(got / exact - 1)[answered].max() < 1e-6
    in_z = resize_depth(depth, size, interpolation="bilinear", spread=None).numpy()
    assert np.nanmax(np.abs(in_z / exact - 1)) > 1e-6


def test_slope_is_the_planes_own_on_both_sides_of_a_step():
    x = torch.arange(8.0, dtype=torch.float64)
    depth = (2 + 0.1 * x)[None, :] + 0.05 * x[:, None]
    depth[:, 4:] += 3
    slope = depth_slope(depth)
    assert torch.allclose(slope, torch.full_like(depth, 0.15))
    hole = depth.clone()
    hole[3, 3] = torch.nan
    assert torch.isnan(depth_slope(hole)[3, 3])
    assert torch.isfinite(depth_slope(hole)).sum() == 63
    assert depth_slope(torch.full((1, 1), 2.0)).item() == 0


@pytest.mark.parametrize("hole", [torch.nan, torch.inf, 0.0, -1.0])
def test_a_hole_is_no_neighbour_whatever_codes_it(hole):
    # One step is left on each side: 0.1, then 0.2.
    slope = depth_slope(torch.tensor([[1.0, 1.1, hole, 2.0, 2.2]], dtype=torch.float64))[0]
    assert torch.isnan(slope[2])
    assert torch.allclose(slope[[0, 1, 3, 4]], torch.tensor([0.1, 0.1, 0.2, 0.2]).double())
