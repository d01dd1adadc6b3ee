"""Oracles: the Jacobian of a plane's homography by differences, loops over pixels, formulas written out."""

import numpy as np
import pytest
import torch

from attnwarp import Camera
from attnwarp.methods.geometry import choose_chain
from attnwarp.methods.sight import Sight, pixel_ratio
from attnwarp.warp import Surface, preset, resize_mask, warp_surfaces

SIZE = 24


def camera(position, size=SIZE):
    return Camera.look_at(position, (0, 0, 0), width=size, height=size, fov_y=40, up=(0, 1, 0))


def on_plane(view):
    """Surface that a camera sees of the plane z = 0."""
    rays = view.directions() @ view.rotation
    depth = -view.position[2] / rays[..., 2]
    return Surface(depth, np.broadcast_to([0.0, 0, 1], (*depth.shape, 3)))


def plane_point(view, xy):
    """(3,) point of the plane z = 0 that a pixel position shows."""
    ray = view.directions(np.array([[xy]]))[0, 0] @ view.rotation
    return view.position - ray * (view.position[2] / ray[2])


TARGET, SIDE, FAR = camera((0, 0.3, 3)), camera((2.5, 0, 1.5)), camera((-0.5, 0.2, 7))


def warp(source, **changes):
    settings = preset("corrected", **changes)
    return warp_surfaces(source, TARGET, on_plane(TARGET), on_plane(source), settings)


@pytest.mark.parametrize("source", [SIDE, FAR])
def test_the_ratio_of_pixels_is_the_determinant_of_the_homographys_jacobian(source):
    ratio = pixel_ratio(warp(source)).numpy()
    step = 1e-4
    for row, column in ((3, 5), (12, 12), (20, 17)):
        x, y = column + 0.5, row + 0.5
        moved = [
            source.project(plane_point(TARGET, (x + dx, y + dy))[None])[0][0]
            for dx, dy in ((step, 0), (-step, 0), (0, step), (0, -step))
        ]
        jacobian = np.stack([moved[0] - moved[1], moved[2] - moved[3]]) / (2 * step)
        assert ratio[row, column] == pytest.approx(abs(np.linalg.det(jacobian)), rel=1e-6)


@pytest.mark.parametrize("size", [(SIZE, SIZE), (6, 6)])
def test_zeros_stand_around_the_source_as_padding_has_them(size):
    """Oracle: torch's grid_sample with zero padding."""
    view = warp(SIDE, in_front=False, opaque=None, depth_agreement=False, normal_test="none")
    view = view.with_mask(view.rules["defined"])
    h, w = size
    features = torch.rand(
        1, h * w, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    layer = Sight([view], zeros=True).warp(0).at(size)
    xy = layer.warp.correspondence.xy
    grid = 2 * xy / torch.tensor([w, h]) - 1
    maps = features[0].T.reshape(1, 3, h, w)
    padded = torch.nn.functional.grid_sample(
        maps, grid[None], padding_mode="zeros", align_corners=False
    )
    assert torch.allclose(
        layer.warp_tokens(features), padded[0].flatten(1).T[None], rtol=0, atol=1e-9
    )
    border = Sight([view]).warp(0).at(size).warp_tokens(features)
    assert (border - layer.warp_tokens(features)).abs().max() > 0.1


@pytest.mark.parametrize("size", [(SIZE, SIZE), (8, 8), (6, 6)])
def test_a_pixel_takes_the_source_that_sees_it_best_by_a_loop(size):
    views = [warp(FAR), warp(SIDE), warp(camera((0, 0, 1.2)))]
    sight = Sight(views)
    h, w = size
    block = SIZE // h
    masks = [resize_mask(view.mask, size) & view.at(size).correspondence.defined for view in views]
    ratios = [pixel_ratio(view).tolist() for view in views]
    counts = [0] * 4
    for row in range(h):
        for column in range(w):
            best, number = 0.0, -1
            for k, view in enumerate(views):
                if not masks[k][row, column]:
                    continue
                total = 0.0
                for y in range(row * block, (row + 1) * block):
                    for x in range(column * block, (column + 1) * block):
                        total += min(1.0, ratios[k][y][x]) * bool(view.mask[y, x])
                if total / block**2 > best + 1e-6:
                    best, number = total / block**2, k
            assert int(sight.choice(size)[row, column]) == number
            counts[number] += 1
    assert sum(count > 0 for count in counts) >= 2  # more than one answer occurs
    # Every pixel that some source sees has features of exactly one.
    layers = [sight.warp(k).at(size, source_size=size).mask for k in range(3)]
    assert torch.equal(torch.stack(layers).sum(dim=0), torch.stack(masks).any(dim=0).long())


def test_sources_are_compared_by_their_edits_whatever_the_size_of_their_photographs():
    """Oracle: the same sources, photographed at one size."""
    large = camera(SIDE.position, 3 * SIZE)
    # The mask's rules read depths pixel by pixel, so they are left out.
    alike, unlike = (
        [warp(source, depth_agreement=False) for source in sources]
        for sources in ((SIDE, FAR), (large, FAR))
    )
    # All edits have one size, so that of the large photograph is a ninth of it.
    expected, result = Sight(alike), Sight(unlike, scales=[1 / 9, 1.0])
    assert {0, 1} <= set(expected.choice((8, 8)).flatten().tolist())
    assert torch.equal(result.choice((8, 8)), expected.choice((8, 8)))
    inside = result.views[0].mask & expected.views[0].mask
    ratios = [sight.quality[0][inside] for sight in (result, expected)]
    assert torch.allclose(*ratios, rtol=1e-9, atol=0)


def test_one_source_is_the_plain_warp_bit_for_bit():
    view = warp(SIDE)
    random = torch.Generator().manual_seed(0)
    source = torch.randn((1, 64, 5), generator=random)
    plain, layer = view.at((8, 8)), Sight([view]).warp(0).at((8, 8), source_size=(8, 8))
    assert torch.equal(layer.warp_tokens(source), plain.warp_tokens(source))
    assert torch.equal(layer.weight, plain.weight)


def test_a_pixel_of_a_wide_target_takes_the_best_source_by_a_loop():
    """Oracle: loops over a target that is wider than it is high."""
    target = Camera.look_at((0, 0.3, 3), (0, 0, 0), width=30, height=18, fov_y=40, up=(0, 1, 0))
    views = [
        warp_surfaces(source, target, on_plane(target), on_plane(source), preset("corrected"))
        for source in (camera((1.8, 0, 1.2)), camera((-1.5, 0.2, 2)))
    ]
    sight = Sight(views)
    ratios = [pixel_ratio(view).numpy() for view in views]
    expected = np.zeros((18, 30))
    taken = [0, 0, 0]
    for row in range(18):
        for column in range(30):
            qualities = [
                min(1.0, ratio[row, column]) * bool(view.mask[row, column])
                for ratio, view in zip(ratios, views, strict=True)
            ]
            seen = [k for k, view in enumerate(views) if view.mask[row, column]]
            assert bool(sight.mask[row, column]) == bool(seen)
            best = max(seen, key=lambda k: qualities[k], default=-1)
            taken[best] += 1
            expected[row, column] = best
    np.testing.assert_array_equal(sight.choice((18, 30)).numpy(), expected)
    assert min(taken) > 20  # both are taken, and neither


def test_a_chain_goes_outward_and_each_is_covered_by_those_before():
    """Oracle: points on a ring as sets; a view sees a window of them."""
    views, count = 12, 360

    def window(view):
        return {(view * 30 + k) % count for k in range(-60, 60)}

    def seen(source, target):
        points = sorted(window(target))
        pixels = np.array([[p in window(source) for p in points]])
        return pixels, np.ones_like(pixels)

    chain = choose_chain(views, 0, 5, 0.5, seen)
    union = window(0)
    for number, view in enumerate(chain):
        rest = [v for v in range(views) if v not in (0, *chain[:number])]
        share = {v: len(window(v) & union) / len(window(v)) for v in rest}
        assert share[view] >= 0.5
        assert share[view] == min(value for value in share.values() if value >= 0.5)
        union |= window(view)
    assert len(union) == count  # all around with five sources
    assert choose_chain(views, 0, 1, 0.5, seen) == ()
    assert len(choose_chain(3, 0, 9, 0.5, seen)) == 2
