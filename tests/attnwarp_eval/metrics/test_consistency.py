"""Cross-view consistency on scenes whose colours are known at every point, and flow where its
answer is known.
"""

import math

import numpy as np
import pytest
import torch
from direct_light import direct

from attnwarp.camera import Camera
from attnwarp.warp.sampling import sample_at
from attnwarp_eval import metrics
from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.shapes import Rectangle
from attnwarp_eval.truth import Geometry, appearance, two_view
from attnwarp_eval.truth.features import SolidField


@pytest.fixture(scope="module")
def spheres():
    return Geometry(load_scene("spheres"))


def pair_of(geometry, yaw, size):
    scene = load_scene("spheres").with_size(size, size)
    return two_view(geometry, scene.source, scene.camera(f"yaw{yaw:03d}"))


def painted(geometry, camera, cycles=2.0):
    """(H, W, 3) linear colours of a smooth function of the surface point, at the pixels' centres
    exactly.
    """
    points = geometry.trace(camera).point
    field = SolidField((0, 0, 0.6), 4.0, channels=3, cycles=cycles, seed=5)
    return np.clip(
        0.4 + 0.08 * np.nan_to_num(np.moveaxis(field.on_grid(points, background=0.0), 0, -1)), 0, 1
    )


def linear(result, target):
    """(N, 3) differences in linear light at the counted pixels of an sRGB target."""
    seen = target[result.counted]
    return to_linear(seen) - to_linear(seen - result.srgb[result.counted])


@pytest.mark.parametrize("yaw", [10, 60])
def test_a_painted_scene_disagrees_by_no_more_than_bilinear_sampling_errs(spheres, yaw):
    errors = {}
    for size in (64, 128):
        pair = pair_of(spheres, yaw, size)
        source, target = (painted(spheres, camera) for camera in (pair.source, pair.target))
        result = metrics.cross_view(to_srgb(source), to_srgb(target), pair)
        assert result.counted.sum() > 400 * (size / 64) ** 2
        errors[size] = np.abs(linear(result, to_srgb(target)))
        # The error of linear interpolation is at most (|f_xx| + |f_yy|) / 8, in units of the
        # largest second difference near the taps; half as much again for what differences over a
        # pixel miss of a derivative.
        row, column = np.floor(pair.xy[result.counted][:, ::-1]).astype(int).T
        bound = sum(
            np.max([np.abs(np.roll(second, shift, (0, 1))) for shift in np.ndindex(3, 3)], axis=0)
            for second in (
                np.roll(np.gradient(np.gradient(source, axis=a), axis=a), (-1, -1), (0, 1))
                for a in (0, 1)
            )
        )[row, column]
        share_within = (errors[size] <= 1.5 / 8 * bound + 1e-6).mean()
        assert (
            share_within > 0.98
        )  # the rest: gradients taken across an edge are no bound, either way
    # Half the pixel, a quarter of the error: the order of linear interpolation. A little less,
    # since a band of 2 px leaves more of the spheres' steep limbs at 128 (measured 3.2 and 3.5).
    assert 3 < np.median(errors[64]) / np.median(errors[128]) < 4.2
    assert errors[128].mean() < 1e-3


def test_a_rendered_scene_is_consistent_and_a_planted_slip_of_its_target_is_not(spheres):
    # Direct light, whose pictures have the least noise.
    scene = direct("spheres").with_size(128, 128)
    pair = pair_of(spheres, 20, 128)
    source, target = (
        to_srgb(appearance(scene, c, spp=32)).astype(np.float64) for c in (pair.source, pair.target)
    )
    floor = metrics.cross_view(source, target, pair).figures()
    # What is left is sampling, noise, and pixels of unlike area: measured 1.3, where an unlike
    # colour is 10 and more.
    assert floor["consistency.delta_e"] < 2
    assert floor["consistency.pixels"] > 5000
    for slip, least in ((1, 1.5), (2, 2.5)):
        slipped = metrics.cross_view(source, np.roll(target, slip, axis=1), pair).figures()
        assert slipped["consistency.delta_e"] > least * floor["consistency.delta_e"]


@pytest.mark.parametrize("yaw", [0, 20, 75])
def test_a_planted_shift_of_colour_comes_back_exactly(spheres, yaw):
    pair = pair_of(spheres, yaw or 10, 64)
    if not yaw:
        pair = two_view(spheres, pair.source, pair.source)
    random = np.random.default_rng(yaw)
    source = random.uniform(0.1, 0.6, (64, 64, 3))
    shift = np.array([0.05, -0.1, 0.2])
    # The warp's own sampler makes the target: another implementation, with rounding to a tap (1e-7
    # px) of its own.
    xy = torch.from_numpy(pair.xy)
    sampled = sample_at(torch.from_numpy(source.transpose(2, 0, 1)), xy).numpy().transpose(1, 2, 0)
    target = np.clip(sampled + shift, 0, 1)
    result = metrics.cross_view(to_srgb(source), to_srgb(target), pair)
    found = linear(result, to_srgb(target))
    np.testing.assert_allclose(found, np.broadcast_to(shift, found.shape), atol=1e-6)


def test_delta_e_of_greys_has_its_closed_form(spheres):
    # CIEDE2000 without chroma: |dL| / S_L, S_L = 1 + 0.015 (L - 50)^2 / sqrt(20 + (L - 50)^2) at
    # the mean L.
    camera = pair_of(spheres, 10, 32).source
    pair = two_view(spheres, camera, camera)
    Y = np.array([0.2, 0.5])
    L1, L2 = 116 * np.cbrt(Y) - 16
    middle = (L1 + L2) / 2 - 50
    expected = abs(L2 - L1) / (1 + 0.015 * middle**2 / np.sqrt(20 + middle**2))
    one, other = (to_srgb(np.full((32, 32, 3), y)) for y in Y)
    figures = metrics.cross_view(one, other, pair).figures()
    # sRGB's matrix gives white to four digits, so grey has a chroma of about 0.01.
    assert figures["consistency.delta_e"] == pytest.approx(expected, abs=0.02)
    assert figures["consistency.mae_srgb"] == pytest.approx(
        float(to_srgb(Y[1]) - to_srgb(Y[0])), abs=1e-12
    )


def test_what_is_counted_is_what_is_said(spheres):
    pair = pair_of(spheres, 30, 64)
    flat = np.full((64, 64, 3), 0.5)
    result = metrics.cross_view(flat, flat, pair)
    assert not result.counted[~pair.visible].any() and not result.counted[pair.edge].any()
    x, y = np.moveaxis(pair.xy, -1, 0)
    taps = (x >= 0.5) & (x <= 63.5) & (y >= 0.5) & (y <= 63.5)
    assert np.array_equal(result.counted, pair.visible & ~pair.edge & taps)
    for values in (result.srgb[..., 0], result.delta_e):
        assert np.array_equal(np.isfinite(values), result.counted)
    half = np.zeros((64, 64), bool)
    half[:, 32:] = True
    asked = metrics.cross_view(flat, flat, pair, mask=~half)
    assert np.array_equal(asked.counted, result.counted & ~half)
    # Pixels not asked about are no candidates.
    assert asked.candidates == (pair.visible & ~half).sum()


def test_nothing_co_visible_is_undefined_and_counted():
    # Hard case 8: two cameras back to back.
    wall = Rectangle(np.array([3.0, 0, 0]), np.array([0, 9.0, 0]), np.array([0, 0, 9.0]))
    other = Rectangle(
        np.array([-3.0, 0, 0]), np.array([0, 9.0, 0]), np.array([0, 0, 9.0]), object_id=1
    )
    views = [Camera.look_at((0, 0, 0), (x, 0, 0), width=16, height=16, fov_y=40) for x in (1, -1)]
    pair = two_view(Geometry([wall, other]), *views)
    flat = np.full((16, 16, 3), 0.5)
    result = metrics.cross_view(flat, flat, pair)
    figures = result.figures()
    assert figures.pop("consistency.pixels") == 0 and result.candidates == 0
    assert all(math.isnan(value) for value in figures.values())


def sideways(shift, size=128):
    """A textured wall seen by two cameras that look straight at it, ``shift`` px apart: exact pair
    and pictures.
    """
    wall = Rectangle(np.array([2.0, 0, 0]), np.array([0, 9.0, 0]), np.array([0, 0, 9.0]))
    geometry = Geometry([wall])
    first = Camera.look_at((0, 0, 0), (2, 0, 0), width=size, height=size, fov_y=60, name="first")
    step = shift * 2.0 / first.K[0, 0]
    second = Camera.look_at(
        (0, step, 0), (2, step, 0), width=size, height=size, fov_y=60, name="second"
    )
    pair = two_view(geometry, first, second)
    field = SolidField((2, 0, 0), 2.0, channels=3, cycles=9.0, terms=12, seed=1)

    def seen(camera):
        values = field.on_grid(geometry.trace(camera).point, background=0.0)
        return to_srgb(np.clip(0.4 + 0.12 * np.moveaxis(values, 0, -1), 0, 1))

    return pair, seen(first), seen(second)


@pytest.mark.parametrize("shift", [3.0, -5.5])
def test_flow_finds_a_small_sideways_step_and_is_judged_so(shift):
    pair, source, target = sideways(shift)
    moved = pair.xy - pair.target.pixel_centers()
    assert np.abs(moved[pair.visible]).max(axis=0) == pytest.approx((abs(shift), 0), abs=1e-9)
    flow = metrics.optical_flow(source, target)
    offset = np.linalg.norm(flow.xy - pair.xy, axis=-1)[pair.visible]
    # OpenCV's flow of a smooth translation is good to a tenth of a pixel or so.
    assert np.median(offset) < 0.15 and (offset < 1).mean() > 0.9
    assert flow.accepted[pair.visible].mean() > 0.9
    exact = metrics.cross_view(source, target, pair).figures()["consistency.delta_e"]
    along = metrics.disagreement_at(source, target, flow.xy, flow.accepted)
    assert abs(along.figures()["consistency.delta_e"] - exact) < 1
    # Another colour in one view is seen by both.
    tinted = to_srgb(to_linear(target) * [1.0, 0.6, 0.6])
    exact, along = (
        result.figures()["consistency.delta_e"]
        for result in (
            metrics.cross_view(source, tinted, pair),
            metrics.disagreement_at(source, tinted, flow.xy, flow.accepted),
        )
    )
    assert exact == pytest.approx(along, rel=0.1) and exact > 10


def test_the_check_refuses_flow_that_does_not_come_back():
    _, source, target = sideways(3.0)
    random = np.random.default_rng(0)
    noise = random.uniform(0, 1, target.shape)
    assert metrics.optical_flow(source, target).accepted.mean() > 0.85
    assert metrics.optical_flow(source, noise).accepted.mean() < 0.3


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 40, 3), (11, 40, 3)])
def test_pictures_too_small_for_flow_have_none(shape):
    # Hard case 14.
    flat = np.full(shape, 0.5)
    flow = metrics.optical_flow(flat, flat)
    assert np.isnan(flow.xy).all() and not flow.accepted.any()
    figures = metrics.disagreement_at(flat, flat, flow.xy, flow.accepted).figures("flow_")
    assert figures.pop("consistency.flow_pixels") == 0
    assert all(math.isnan(value) for value in figures.values())
