"""Correspondences and sampling against closed forms, mpmath, OpenCV and brute force."""

import cv2
import mpmath
import numpy as np
import pytest
import torch

from attnwarp import Camera
from attnwarp.warp.correspondence import (
    Correspondence,
    correspond,
    correspond_at,
    in_bounds,
    layer_size,
    resize_depth,
    sample,
    sample_at,
    sample_depth,
)


def orbit(yaw, *, size=64, distance=4.0, fov=45.0, height=0.0, width=None):
    angle = np.radians(yaw)
    position = (distance * np.cos(angle), distance * np.sin(angle), height)
    return Camera.look_at(position, (0, 0, 0), width=width or size, height=size, fov_y=fov)


def rolled(camera, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return Camera(camera.K, turn @ camera.world_to_camera, camera.width, camera.height)


def plane_depth(camera, normal, offset):
    """Depth of the plane normal . X = offset, from rays in world axes."""
    rays = camera.directions() @ camera.rotation
    z = (offset - np.dot(normal, camera.position)) / (rays @ np.asarray(normal, float))
    return np.where(z > 0, z, np.nan)


def sphere(camera, radius=1.0):
    """Depth and outward normals of a sphere at the origin."""
    rays = camera.directions() @ camera.rotation
    length = np.linalg.norm(rays, axis=-1)
    unit = rays / length[..., None]
    along = unit @ camera.position
    # r^2 - |oc - (oc.d) d|^2 keeps its digits at the outline, where b^2 - c does not.
    half = radius**2 - ((camera.position - along[..., None] * unit) ** 2).sum(-1)
    t = np.where(half > 0, -along - np.sqrt(np.maximum(half, 0)), np.nan)
    return t / length, (camera.position + t[..., None] * unit) / radius


def homography(source, target, normal, offset):
    """The source position of target pixels on the plane normal . X = offset: K_s (R + t n^T / d)
    K_t^-1.
    """
    relative = source.world_to_camera @ np.linalg.inv(target.world_to_camera)
    n = target.rotation @ np.asarray(normal, float)
    d = offset - np.dot(normal, target.position)
    return (
        source.K @ (relative[:3, :3] + np.outer(relative[:3, 3], n) / d) @ np.linalg.inv(target.K)
    )


def apply(H, xy):
    p = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1) @ H.T
    return p[..., :2] / p[..., 2:]


def skewed(camera):
    """The camera with fx != fy, skew and a principal point outside the image."""
    K = camera.K.copy()
    K[0] = [1.3 * K[0, 0], 0.1 * K[0, 0], -0.4 * camera.width]
    return Camera(K, camera.world_to_camera, camera.width, camera.height)


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
    known = c.defined.numpy()
    assert known.sum() > 1000
    # 1e-4 px is the bound of the hard case; float64 leaves about 1e-11.
    assert np.abs(c.xy.numpy() - expected)[known].max() < 1e-9


@pytest.mark.parametrize("focal", [1.0, 30.0, 1e3, 1e5])
def test_focal_lengths_from_1_to_1e5_px_keep_their_position(focal):
    # Hard case 11.
    K = np.array([[focal, 0, 32.0], [0, focal, 32.0], [0, 0, 1]])
    pose = np.eye(4)
    pose[0, 3] = 0.3 / focal
    target, source = Camera(K, np.eye(4), 64, 64), Camera(K, pose, 64, 64)
    depth = np.full((64, 64), 2.0)
    # A pure shift along x at constant depth moves every pixel by f * t / z.
    c = correspond(source, target, depth)
    assert torch.allclose(
        c.xy, torch.from_numpy(target.pixel_centers() + np.array([0.15, 0])), rtol=0, atol=1e-9
    )


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


def test_a_view_corresponds_to_itself_and_its_features_keep_their_bits():
    # Hard case 6, and the invariant that the identity warp changes nothing, bit for bit.
    camera = orbit(33, size=48, height=0.7, width=56)
    depth = plane_depth(camera, (0.3, 0.2, 1.0), -1.2)
    depth = np.where(np.isfinite(depth), depth, 5.0)
    c = correspond(camera, camera, depth)
    assert np.abs(c.xy.numpy() - camera.pixel_centers()).max() < 1e-3
    for dtype in (torch.float32, torch.float16, torch.bfloat16, torch.float64):
        features = torch.randn(2, 5, 48, 56, generator=torch.Generator().manual_seed(0)).to(dtype)
        warped, mask = sample(features, c)
        assert torch.equal(warped, features)
        assert mask.all()


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_a_tiny_baseline_keeps_its_digits(offset):
    # Hard case 7: a baseline of 1e-6 at depth 1e-3 moves pixels by about half a pixel; a world at
    # 1e6 has steps of 1.2e-10, so positions there can differ by 1e-4 of it.
    mpmath.mp.dps = 60
    focal, depth, baseline = 500.0, 1e-3, 1e-6
    K = np.array([[focal, 0, 3.5], [0, focal, 2.0], [0, 0, 1]])
    start = Camera.look_at((0, 0, 0), (3, 1, 2), width=7, height=4, fov_y=40)
    target = Camera(K, start.world_to_camera, 7, 4).moved((offset, -offset, offset))
    pose = target.world_to_camera.copy()
    pose[0, 3] += baseline
    source = Camera(K, pose, 7, 4)
    c = correspond(source, target, np.full((4, 7), depth))

    Ps, Pt = (mpmath.matrix(camera.world_to_camera.tolist()) for camera in (source, target))
    relative = Ps * mpmath.inverse(Pt)
    worst = mpmath.mpf(0)
    for i in range(4):
        for j in range(7):
            ray = [
                (mpmath.mpf(j) + 0.5 - K[0, 2]) / focal,
                (mpmath.mpf(i) + 0.5 - K[1, 2]) / focal,
                1,
            ]
            p = relative * mpmath.matrix([*(depth * r for r in ray), 1])
            x, y = focal * p[0] / p[2] + K[0, 2], focal * p[1] / p[2] + K[1, 2]
            worst = max(worst, abs(x - float(c.xy[i, j, 0])), abs(y - float(c.xy[i, j, 1])))
    assert abs(float((c.xy[..., 0] - torch.arange(7) - 0.5).mean()) - 0.5) < 0.05
    assert worst < 1e-3


def test_opposed_views_share_no_visible_surface_of_a_plane_between_them():
    # Hard case 8: each camera looks away from the other, so that all the target sees lies behind
    # the source.
    target = orbit(0)
    away = Camera.look_at((4.1, 0, 0), (8, 0, 0), width=64, height=64, fov_y=45)
    c = correspond(away, target, np.full((64, 64), 4.0))
    assert not c.defined.any()
    assert not in_bounds(c).any()
    warped, mask = sample(torch.ones(3, 64, 64), c)
    assert not mask.any()
    assert (warped == 0).all()


@pytest.mark.parametrize("offset", [1e2, 1e4, 1e6])
def test_an_offset_of_the_world_moves_nothing(offset):
    # Hard case 9, against the run that is not shifted.
    source, target = orbit(0, height=1), orbit(40, height=1.5)
    depth = plane_depth(target, (0, 0, 1), -1.0)
    here = correspond(source, target, depth)
    shift = (offset, -offset, 0.5 * offset)
    there = correspond(source.moved(shift), target.moved(shift), depth)
    assert torch.equal(here.defined, there.defined)
    difference = (here.xy - there.xy)[in_bounds(here)]
    # 1e-3 px is the bound; float64 at 1e6 leaves 1e-8.
    assert difference.abs().max() < 1e-6


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_scale_of_the_scene_changes_no_mask(scale):
    # Hard case 10: no tolerance here has a length in it.
    def scaled(camera):
        pose = camera.world_to_camera.copy()
        pose[:3, 3] *= scale
        return Camera(camera.K, pose, camera.width, camera.height)

    source, target = orbit(0, height=1), orbit(40, height=1.5)
    depth, source_depth = (sphere(camera)[0] for camera in (target, source))
    here, there = (
        correspond(source, target, depth),
        correspond(scaled(source), scaled(target), depth * scale),
    )
    assert torch.equal(in_bounds(here), in_bounds(there))
    seen = sample_depth(source_depth, here)
    assert torch.equal(torch.isnan(seen), torch.isnan(sample_depth(source_depth * scale, there)))
    assert torch.isfinite(seen).sum() > 100


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


def test_a_rotation_that_is_not_orthonormal_is_refused_by_how_much():
    # Hard case 15.
    pose = np.eye(4)
    pose[0, 0] = 1.0001
    with pytest.raises(ValueError, match=r"not orthonormal.*= 0\.0002"):
        Camera(np.diag([100.0, 100, 1]), pose, 8, 8)


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
    known = np.isfinite(got)
    assert known.sum() > 0.3 * known.size
    assert np.abs(got / exact - 1)[known].max() < 1e-6
    in_z = resize_depth(depth, size, interpolation="bilinear", spread=None).numpy()
    assert np.nanmax(np.abs(in_z / exact - 1)) > 1e-6


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
    for c in (full, layer):
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
    known = layer.defined.numpy()
    assert np.abs(layer.xy.numpy() * [512 / w, 512 / h] - exact)[known].max() < 1e-6


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float16, 5e-4), (torch.bfloat16, 4e-3)])
def test_half_precision_features_are_blended_in_float32(dtype, bound):
    # Hard case 29, against the same stored values in float64. At 512 px a half-precision grid would
    # be off by taps.
    source, target = orbit(0, size=512, height=1), orbit(25, size=512, height=1)
    c = correspond(source, target, plane_depth(target, (1, 0, 0), 0.0))
    features = torch.rand(3, 512, 512, generator=torch.Generator().manual_seed(1)).to(dtype)
    warped, _ = sample(features, c)
    exact, _ = sample(features.double(), c)
    assert warped.dtype == dtype
    assert (warped.double() - exact).abs().max() < bound


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_half_precision_grid_is_refused(dtype):
    # Hard case 30.
    with pytest.raises(ValueError, match=r"xy: got torch\.\w*float16, expected float32 or float64"):
        sample_at(torch.ones(1, 4, 4), torch.ones(4, 4, 2, dtype=dtype))
    c = correspond(orbit(0), orbit(10), np.full((64, 64), 4.0))
    with pytest.raises(ValueError, match="expected float64"):
        Correspondence(c.source, c.target, c.xy.to(dtype), c.points, c.target_depth)


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
    for h, w in ((64, 64), (32, 48)):
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


def test_the_sources_own_depth_answers_where_its_taps_do():
    source, target = orbit(0, size=128, height=1), orbit(20, size=128, height=1)
    depth, source_depth = (plane_depth(camera, (0, 0, 1), -1.0) for camera in (target, source))
    c = correspond(source, target, depth)
    seen = sample_depth(source_depth, c)
    inside = in_bounds(c)
    assert torch.isnan(seen[~inside]).all()
    known = torch.isfinite(seen)
    assert known.sum() > 0.3 * inside.sum()
    # Inverse depth is linear on a plane, except where the border clamps a tap: within half a pixel
    # of the image's end.
    inner = known & ((c.xy > 0.5) & (c.xy < 127.5)).all(-1)
    assert (seen / c.z - 1)[inner].abs().max() < 1e-9


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
