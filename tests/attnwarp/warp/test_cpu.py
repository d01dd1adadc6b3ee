"""The kernels of a pair of views against the definition in torch, on what breaks geometry.

The definition is held to closed forms by its own tests. Here positions must agree to 1e-6 px and
masks must be equal, but where a rule lies within rounding of its threshold.
"""

import dataclasses
import itertools
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from closed_forms import orbit, plane_depth, rolled, shell, skewed, sphere

from attnwarp import Camera
from attnwarp.render.threads import set_thread_count
from attnwarp.warp.settings import PRESETS, preset
from attnwarp.warp.view import Surface, warp_surfaces, warp_view

PIXELS = 1e-6
"""Positions agree to this; sums in another order leave about 1e-12."""
ROUNDING = 1e-9
"""Relative: within this of its threshold a rule may go either way."""


def agree(*arguments, sizes=((16, 16), (7, 5)), **more):
    """The view by kernels, after it was compared with the definition's."""
    kernels = warp_surfaces(*arguments, **more)
    definition = warp_surfaces(*arguments, **more, backend="reference")
    assert list(kernels.rules) == list(definition.rules)
    for name, rule in definition.rules.items():
        assert torch.equal(kernels.rules[name], rule), name
    assert torch.equal(kernels.mask, definition.mask)
    pairs = [(kernels.correspondence, definition.correspondence)]
    target = kernels.correspondence.target
    for size in (*sizes, (target.height, target.width)):
        source_size = size[::-1] if size[0] != size[1] else None
        got, expected = (view.at(size, source_size=source_size) for view in (kernels, definition))
        assert torch.equal(got.mask, expected.mask), size
        pairs.append((got.correspondence, expected.correspondence))
    for got, expected in pairs:
        assert torch.equal(got.defined, expected.defined)
        scale = expected.xy.abs().clamp_min(1)
        difference = ((got.xy - expected.xy).abs() / scale)[expected.defined]
        assert difference.numel() == 0 or difference.max() < PIXELS
        assert torch.allclose(
            got.target_depth, expected.target_depth, rtol=1e-12, atol=1e-300, equal_nan=True
        )
        # A coordinate near 0 is a difference of larger ones, which round by their own size.
        moved = np.linalg.norm(got.source.relative_to(got.target)[:3, 3])
        largest = expected.points.norm(dim=-1, keepdim=True) + float(moved)
        error = (got.points - expected.points).abs() / largest.clamp_min(1e-300)
        assert torch.equal(got.points.isnan(), expected.points.isnan())
        assert torch.nan_to_num(error).max() < 1e-14
    return kernels


def scene(camera, dtype=np.float64):
    """A sphere before a wall: depth, normals, alpha with a soft rim, and a picture."""
    depth, normal = sphere(camera)
    wall = plane_depth(camera, (1, 0, 0), -1.5)
    ball = np.isfinite(depth) & ~(depth > np.nan_to_num(wall, nan=np.inf))
    z = np.where(ball, depth, wall)
    points = camera.unproject(camera.pixel_centers(), z)
    alpha = np.clip(1.2 - np.abs(np.nan_to_num(points[..., 2], nan=9.0)) / 2, 0, 1)
    image = 0.5 + 0.4 * np.sin(4 * np.nan_to_num(points))
    normals = np.where(ball[..., None], normal, [1.0, 0, 0])
    return Surface(*(part.astype(dtype) for part in (z, normals, alpha, image)))


EVERYTHING = preset("corrected", photometric=0.3, segment=True, depth_relative=1e-3)
VARIANTS = {
    **PRESETS,
    "everything": EVERYTHING,
    "source_incidence": preset("corrected", normal_test="source_incidence"),
    "camera_frame": preset("released", normal_test="camera_frame"),
    "nearest": preset("corrected", depth_interpolation="nearest", mask_resize="nearest"),
    "target_bounds": preset("corrected", bounds="target", in_front=False),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", VARIANTS)
def test_every_choice_agrees_with_the_definition(name, dtype):
    segment = torch.zeros(48, 48, dtype=torch.bool)
    segment[10:40, 8:44] = True
    shares = []
    for yaw, change in itertools.product((0, 25, 75, 150), (lambda c: c, skewed)):
        source, target = orbit(0, height=1, size=48), orbit(yaw, height=0.5, size=48)
        cameras = change(source), change(target)
        surfaces = [scene(camera, dtype) for camera in reversed(cameras)]
        settings = VARIANTS[name]
        edited = segment if settings.segment else None
        view = agree(*cameras, *surfaces, settings, target_segment=edited)
        shares.append(float(view.mask.float().mean()))
    assert min(shares) < 0.1
    assert max(shares) > 0.1


def test_views_and_their_parts_of_different_sizes_agree():
    source, target = orbit(0, size=40, width=60, height=1), orbit(20, size=48, height=1)
    seen, other = scene(target), scene(source)
    small = scene(source.resize(30, 20))
    for parts in ({"alpha": small.alpha}, {"image": small.image}, {"depth": small.depth}):
        view = agree(
            source, target, seen, dataclasses.replace(other, **parts), EVERYTHING, sizes=()
        )
        assert view.mask.any()


@pytest.mark.parametrize("part", ["depth", "alpha", "image"])
@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_a_part_of_the_source_with_other_proportions_is_refused_by_name(part, backend):
    source, target = orbit(0, size=32, width=16, height=1), orbit(20, size=32, width=16, height=1)
    seen, other = scene(target), scene(source)
    turned = dataclasses.replace(other, **{part: np.swapaxes(getattr(other, part), 0, 1)})
    with pytest.raises(ValueError, match=f"source_{part}: got 16 x 32 .* aspect ratio of 32 x 16"):
        warp_surfaces(source, target, seen, turned, EVERYTHING, backend=backend)


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_maps_that_are_flipped_or_of_the_other_byte_order_are_read_as_they_show(backend):
    source, target = orbit(0, size=16, height=1), orbit(20, size=16, height=1)
    plain = [scene(camera, np.float32) for camera in (target, source)]
    settings = preset("corrected", normal_test="facing", photometric=0.2)
    expected = warp_surfaces(source, target, *plain, settings, backend=backend).mask
    assert expected.any() and not expected.all()
    for change in (
        lambda a: a[::-1, ::-1].copy()[::-1, ::-1],
        lambda a: a.astype(a.dtype.newbyteorder()),
        np.asfortranarray,
    ):
        views = [
            Surface(*map(change, (view.depth, view.normal, view.alpha, view.image)))
            for view in plain
        ]
        mask = warp_surfaces(source, target, *views, settings, backend=backend).mask
        assert torch.equal(mask, expected)


@pytest.mark.parametrize("in_front", [True, False])
def test_undefined_depth_is_masked_and_never_filled(in_front):
    # Hard cases 5 and 36: in the target, in the source, and in what is sampled.
    camera = orbit(0, size=6)
    depth = np.full((6, 6), 4.0)
    depth[0] = [0, np.nan, np.inf, -1, -np.inf, -0.0]
    surface = Surface(depth, np.full((6, 6, 3), camera.forward), np.where(depth > 0, 1, np.nan))
    settings = preset("corrected", in_front=in_front)
    view = agree(camera, orbit(3, size=6), surface, surface, settings, sizes=((3, 3), (2, 3)))
    assert not view.correspondence.defined[0].any()
    assert torch.isnan(view.correspondence.points[0]).all()
    assert view.mask[2:].any()


@pytest.mark.parametrize("hole", [np.nan, np.inf, 0.0, -1.0])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_hole_in_what_stands_before_it_makes_a_point_visible(hole, dtype):
    # A wall at 1.5 hides all of the target's at 2. Beside a hole at the border it has one neighbour
    # to each side, or none.
    camera = orbit(0, size=6)
    before = np.full((6, 6), 1.5, dtype)
    before[:, 1] = before[4, :] = hole
    behind = Surface(np.full((6, 6), 2.0, dtype))
    settings = preset("corrected", normal_test="none", opaque=None)
    view = agree(camera, camera, behind, Surface(before), settings, sizes=((3, 3), (2, 3)))
    assert view.correspondence.defined.all()
    assert not view.rules["depth_agrees"].any()


def test_depth_on_a_grid_is_the_slanted_planes_own_and_none_across_an_edge():
    # Hard cases 26 to 28.
    camera = orbit(0, size=64, height=2)
    slant = plane_depth(camera, (0, 0.2, 1), -1.0)
    step = np.where(np.arange(64) < 31, slant, 2 * slant)
    bare = preset("paper", gaussian_filter="none", depth_spread=0.05)
    for depth in (slant, step):
        view = agree(orbit(9, size=64, height=2), camera, Surface(depth), None, bare)
        for size in ((32, 32), (16, 16)):
            z = view.at(size).correspondence.target_depth.numpy()
            exact = plane_depth(camera.resize(*size), (0, 0.2, 1), -1.0)
            ratio = (z / exact)[np.isfinite(z)]
            assert (np.abs(ratio[:, None] / [1, 2] - 1).min(axis=1) < 1e-6).all()
            assert ratio.size > 0.2 * z.size
    assert np.isnan(view.at((32, 32)).correspondence.target_depth[:, 15]).all()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_masks_differ_only_within_rounding_of_a_threshold(scale):
    # Thresholds that pixels lie on: the depth test's own tolerance, taken from a pixel.
    def scaled(camera):
        pose = camera.world_to_camera.copy()
        pose[:3, 3] *= scale
        return Camera(camera.K, pose, camera.width, camera.height)

    source, target = orbit(0, height=1), rolled(orbit(40, height=1), 30)
    surfaces = [
        dataclasses.replace(scene(camera), depth=scale * scene(camera).depth)
        for camera in (target, source)
    ]
    cameras = scaled(source), scaled(target)
    bare = preset("corrected", depth_slope=0.0, normal_test="none", opaque=None)
    from attnwarp.warp.sampling import sample_depth

    wide = warp_surfaces(*cameras, *surfaces, bare, backend="reference").correspondence
    seen = sample_depth(surfaces[1].depth, wide, spread=bare.depth_spread)
    off = ((wide.z - seen).abs() / wide.z)[torch.isfinite(seen)]
    limit = float(off[off > 0].median())
    on_limit = dataclasses.replace(bare, depth_relative=limit)
    ours, theirs = (
        warp_surfaces(*cameras, *surfaces, on_limit, backend=backend)
        for backend in ("auto", "reference")
    )
    differs = ours.rules["depth_agrees"] != theirs.rules["depth_agrees"]
    bracket = ((wide.z - seen).abs() / wide.z / limit - 1).abs() < ROUNDING
    assert bracket.any()
    assert not (differs & ~bracket).any()
    assert differs.sum() <= bracket.sum()


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_splats_agree_in_every_preset(kind):
    splats, source, target = shell(4000, kind), orbit(0, size=64), orbit(30, size=64, height=0.5)
    for name, settings in PRESETS.items():
        ours, theirs = (
            warp_view(splats, source, target, settings, warp_backend=backend)
            for backend in ("auto", "reference")
        )
        assert torch.equal(ours.mask, theirs.mask), name
        defined = theirs.correspondence.defined
        assert torch.equal(ours.correspondence.defined, defined)
        difference = (ours.correspondence.xy - theirs.correspondence.xy)[defined]
        assert difference.numel() == 0 or difference.abs().max() < PIXELS
        assert torch.equal(ours.at((16, 16)).mask, theirs.at((16, 16)).mask)
    assert ours.mask.any()


def test_bits_do_not_depend_on_threads():
    source, target = orbit(0, height=1, size=70), orbit(30, height=0.5, size=70)
    surfaces = [scene(camera) for camera in (target, source)]

    def results():
        view = warp_surfaces(source, target, *surfaces, EVERYTHING)
        layer = view.at((33, 33), source_size=(33, 33))
        parts = [view.mask, *view.rules.values(), layer.mask]
        for c in (view.correspondence, layer.correspondence):
            parts += [part.view(torch.int64) for part in (c.xy, c.points, c.target_depth)]
        return [part.clone() for part in parts]

    try:
        set_thread_count(1)
        alone = results()
        set_thread_count(5)
        assert all(torch.equal(a, b) for a, b in zip(alone, results(), strict=True))
    finally:
        set_thread_count(None)


def test_results_outlive_the_next_call():
    # Memory is used again once nothing holds it, and not before.
    source, target = orbit(0, size=64), orbit(20, size=64)
    surfaces = [scene(camera) for camera in (target, source)]
    first = warp_surfaces(source, target, *surfaces, EVERYTHING)
    copies = first.correspondence.xy.clone(), first.mask.clone()
    for yaw in (40, 60, 80):
        warp_surfaces(source, orbit(yaw, size=64), *surfaces, EVERYTHING)
    assert torch.equal(torch.nan_to_num(first.correspondence.xy), torch.nan_to_num(copies[0]))
    assert torch.equal(first.mask, copies[1])


@pytest.mark.door
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": np.ones((4, 4))}, r"target_depth: got shape \(4, 4\), expected \(8, 8\)"),
        ({"depth": np.ones((8, 8), int)}, r"target_depth: got torch\.int64, expected a floating"),
        ({"normal": np.ones((8, 8))}, r"target_normal: got shape \(8, 8\), expected \(8, 8, 3\)"),
        ({"alpha": np.ones((4, 4))}, r"target_alpha: got shape \(4, 4\), expected \(8, 8\)"),
        ({"image": np.ones((8, 8, 1))}, r"target_image: got shape \(8, 8, 1\)"),
    ],
)
def test_the_door_says_what_came_and_what_was_expected(changes, message):
    camera = orbit(0, size=8)
    good = scene(camera)
    with pytest.raises(ValueError, match=message):
        warp_surfaces(camera, camera, dataclasses.replace(good, **changes), good, EVERYTHING)
    with pytest.raises(ValueError, match=r"backend: got 'numba', expected one of 'auto'"):
        warp_surfaces(camera, camera, good, good, backend="numba")


@pytest.mark.slow
def test_half_precision_is_rounded_as_by_numpy_where_the_processor_converts_none():
    program = """
import numba
import numpy as np

from attnwarp.warp._kernels import sampling


@numba.njit
def widen(bits, values):
    for k in range(bits.size):
        values[k] = sampling._wide(bits[k])


@numba.njit
def narrow(values, bits):
    for k in range(values.size):
        bits[k] = sampling._narrow(bits, values[k])


bits = np.arange(1 << 16, dtype=np.uint16)
values = np.empty(bits.size, np.float32)
widen(bits, values)
exact = bits.view(np.float16).astype(np.float32)
assert ((values.view(np.uint32) == exact.view(np.uint32)) | np.isnan(exact)).all()
assert (np.isnan(values) == np.isnan(exact)).all()

finite = np.sort(exact[np.isfinite(exact)])
between = (finite[1:] + finite[:-1]) / 2  # exact: ties
up, down = (np.nextafter(between, np.float32(end)) for end in (np.inf, -np.inf))
ends = np.float32([65519.996, 65520, 65536, 1e30, np.inf, -np.inf, np.nan, 1e-45, 2.0**-25, -0.0])
values = np.concatenate([finite, between, up, down, ends])
result = np.empty(values.size, np.uint16)
narrow(values, result)
with np.errstate(over="ignore"):
    expected = values.astype(np.float16)
undefined = np.isnan(expected)
assert (np.isnan(result.view(np.float16)) == undefined).all()
assert (result == expected.view(np.uint16))[~undefined].all()
"""
    result = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "NUMBA_CPU_NAME": "generic"},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr[-500:]
