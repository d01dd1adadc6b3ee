"""Oracles: the Jacobian of a plane's homography by differences, loops over pixels, formulas written out."""

import numpy as np
import pytest
import torch

from attnwarp import Camera
from attnwarp.editing.injection import blended
from attnwarp.methods.attention_warping import blend
from attnwarp.methods.geometry import choose_chain
from attnwarp.methods.sight import Sight, depth_margin, near_edges, pixel_ratio
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


def test_one_source_without_confidence_is_the_plain_warp_bit_for_bit():
    view = warp(SIDE)
    random = torch.Generator().manual_seed(0)
    source = torch.randn((1, 64, 5), generator=random)
    plain, layer = view.at((8, 8)), Sight([view]).warp(0).at((8, 8), source_size=(8, 8))
    assert torch.equal(layer.warp_tokens(source), plain.warp_tokens(source))
    assert torch.equal(layer.weight, plain.weight)


def test_confidence_is_foreshortening_times_the_margin_of_depth():
    limit = 0.05
    off = 0.03  # of the depth: the source's own surface stands nearer by that share
    behind = on_plane(SIDE)
    nearer = Surface(behind.depth * (1 - off), behind.normal)
    settings = preset("corrected", depth_relative=limit, depth_slope=0.0)
    view = warp_surfaces(SIDE, TARGET, on_plane(TARGET), nearer, settings)
    # (z - d) / (limit z) with d = (1 - off) z
    inside = view.mask.numpy()
    assert inside.any()
    margin = depth_margin(view).numpy()
    assert np.allclose(margin[inside], 1 - (off / limit) ** 2, atol=1e-6)
    sight = Sight([view], soft=True)
    expected = np.where(inside, np.minimum(1, pixel_ratio(view).numpy()) * margin, 0)
    assert np.allclose(sight.confidence[0].numpy(), expected, atol=1e-12)
    assert depth_margin(warp(SIDE, depth_agreement=False)).min() == 1


def test_the_margin_of_depth_widens_with_the_slope_of_the_source_by_a_loop():
    """Oracle: the tolerance written out, with the smaller of the two steps along each axis."""
    behind = on_plane(SIDE)
    nearer = Surface(behind.depth * 0.97, behind.normal)
    settings = preset("corrected", depth_relative=0.02, depth_slope=0.5)
    view = warp_surfaces(SIDE, TARGET, on_plane(TARGET), nearer, settings)
    margin, depth = depth_margin(view).numpy(), nearer.depth
    z, seen = view.correspondence.z.numpy(), 0
    for row, column in np.argwhere(view.mask.numpy()):
        x, y = (int(v) for v in view.correspondence.xy[row, column].floor())
        if not (0 < x < SIZE - 1 and 0 < y < SIZE - 1):
            continue
        steps = [
            min(abs(depth[y, x] - depth[y + dy, x + dx]), abs(depth[y, x] - depth[y - dy, x - dx]))
            for dy, dx in ((0, 1), (1, 0))
        ]
        tolerance = 0.02 * z[row, column] + 0.5 * sum(steps)
        # The source's depth is 0.97 of the distance, up to its interpolation.
        expected = 1 - (0.03 * z[row, column] / tolerance) ** 2
        assert margin[row, column] == pytest.approx(max(0, expected), abs=1e-6)
        seen += 0 < expected < 0.9
    assert seen > 20


@pytest.mark.parametrize("soft", [False, True])
def test_a_pixels_weight_is_that_of_the_source_it_takes_by_a_loop(soft):
    """Oracle: loops over a target that is wider than it is high."""
    target = Camera.look_at((0, 0.3, 3), (0, 0, 0), width=30, height=18, fov_y=40, up=(0, 1, 0))
    views = [
        warp_surfaces(source, target, on_plane(target), on_plane(source), preset("corrected"))
        for source in (camera((1.8, 0, 1.2)), camera((-1.5, 0.2, 2)))
    ]
    sight = Sight(views, soft)
    ratios, margins = ([f(view).numpy() for view in views] for f in (pixel_ratio, depth_margin))
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
            if seen:
                confidence = qualities[best] * margins[best][row, column]
                expected[row, column] = confidence if soft else 1.0
    np.testing.assert_allclose(sight.weight.numpy(), expected, rtol=0, atol=1e-12)
    assert min(taken) > 20  # both are taken, and neither


def test_a_depth_edge_is_a_share_of_the_nearest_depth():
    """Closed form: of three inverse depths 1, 1, 1 + x the bend is x and the nearest is 1 + x, so
    an edge of 5 % begins at x = 1 / 19 = 0.0526.
    """
    for x, edge in ((0.0520, False), (0.0533, True)):
        inverse = torch.tensor([[1.0, 1.0, 1.0, 1 + x, 1 + x, 1 + x]], dtype=torch.float64)
        assert near_edges(1 / inverse, 1).any() == edge


@pytest.mark.parametrize("margin", [0, 1, 2, 3])
def test_a_depth_edge_is_near_within_the_margin_of_a_box_before_a_wall(margin):
    """Oracle: Chebyshev distance to the pixels on either side of the box's outline, by a loop."""
    depth = torch.full((20, 24), 4.0)
    depth[6:13, 9:17] = 3.0
    depth[:3] = torch.nan  # the sky behind the wall's upper edge
    both_sides = [
        (y, x)
        for y in range(20)
        for x in range(24)
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0))
        if 0 <= y + dy < 20
        and 0 <= x + dx < 24
        and not bool(depth[y, x].nan_to_num(9.0) == depth[y + dy, x + dx].nan_to_num(9.0))
    ]
    expected = torch.zeros(20, 24, dtype=torch.bool)
    for y in range(20):
        for x in range(24):
            expected[y, x] = any(max(abs(y - v), abs(x - u)) <= margin - 1 for v, u in both_sides)
    assert torch.equal(near_edges(depth, margin), expected)
    assert expected.any() == (margin > 0)


def test_a_plane_at_a_grazing_angle_has_no_depth_edge_though_its_depth_leaps():
    grazing = Camera.look_at((0, -2.0, 0.1), (0, 0, 0), width=32, height=32, fov_y=40)
    depth = torch.from_numpy(on_plane(grazing).depth)
    below = depth[16:]  # the horizon lies above
    assert (below[0] / below[1] > 1.2).all()
    assert not near_edges(below, 3).any()


@pytest.mark.parametrize("exponent", [-900, -60, 60, 900])
def test_depth_edges_do_not_depend_on_the_unit_of_length(exponent):
    """Powers of two scale without rounding, so nothing may differ."""
    random = np.random.default_rng(0)
    depth = torch.from_numpy(random.choice([1.0, 1.03, 1.2, 5.0], (16, 16)))
    expected = near_edges(depth, 1)
    assert expected.any() and not expected.all()
    assert torch.equal(near_edges(depth * 2.0**exponent, 1), expected)


def test_a_picture_is_taken_from_the_source_that_shows_no_edge_there():
    """A post stands before the plane in one source's depth alone; features are taken as before."""
    behind = on_plane(SIDE)
    post = behind.depth.copy()
    post[:, 10:14] *= 0.5
    with_post = warp_surfaces(
        SIDE, TARGET, on_plane(TARGET), Surface(post, behind.normal), preset("corrected")
    )
    views = [with_post, warp(FAR)]
    plain, sight = Sight(views), Sight(views, margins=[2, 0])
    size = (SIZE, SIZE)
    assert torch.equal(sight.choice(size), plain.choice(size))
    assert torch.equal(plain.choice(size, picture=True), plain.choice(size))
    # Oracle: the column of the source in which a pixel lands. The post's edges lie at 10 and 14, and
    # 2 px on either side of both are all from 8 to 16.
    column = with_post.correspondence.xy[..., 0].floor()
    near = (column >= 8) & (column < 16)
    taken = plain.choice(size) == 0
    assert (near & taken).any() and (~near & taken).any()
    changed = torch.where(sight.mask_at(1, size), 1, -1)
    assert torch.equal(
        sight.choice(size, picture=True), torch.where(near & taken, changed, plain.choice(size))
    )
    layer = sight.warp(0, picture=True).at(size, source_size=size)
    assert torch.equal(layer.mask, taken & ~near)


def test_features_are_blended_by_confidence_in_float64():
    view = warp(SIDE)
    sight = Sight([view], soft=True)
    random = torch.Generator().manual_seed(0)
    source, new = (torch.randn((1, 64, 3), generator=random) for _ in range(2))
    grid = sight.warp(0).at((8, 8), source_size=(8, 8))
    result = blend(grid, source, new, 0.6)[0]
    moved = view.at((8, 8)).warp_tokens(source.double())[0]
    confidence = sight.confidence[0].reshape(8, 3, 8, 3).mean(dim=(1, 3)).reshape(-1)
    share = 0.6 * confidence * view.at((8, 8)).mask.reshape(-1)
    expected = share[:, None] * moved + (1 - share[:, None]) * new[0].double()
    assert torch.allclose(result.double(), expected, rtol=0, atol=1e-6)
    assert ((share > 0.05) & (share < 0.55)).sum() > 5


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_blend_by_confidence_in_half_precision_is_rounded_once(dtype):
    """Oracle: the formula in float64. A second rounding would be another half step."""
    layer = Sight([warp(SIDE)], soft=True).warp(0).at((8, 8), source_size=(8, 8))
    random = torch.Generator().manual_seed(0)
    source, new = (torch.randn((1, 64, 50), generator=random).to(dtype) for _ in range(2))
    share = 0.9 * layer.weight.reshape(-1, 1)
    expected = share * layer.warp_tokens(source.double()) + (1 - share) * new.double()
    result = blended(blend, layer, source, new, 0.9)
    allowed = torch.finfo(dtype).eps / 2 * expected.abs() + 1e-6
    assert ((result.double() - expected).abs() <= allowed).all()
    assert result.dtype == dtype and (share > 0.05).any()


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
