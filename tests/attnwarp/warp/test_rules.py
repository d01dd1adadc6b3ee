"""Rules of visibility against closed forms of spheres and planes, and the published claims about them."""

import numpy as np
import pytest
import torch
from closed_forms import area, faces, orbit, plane_depth, rolled, shell, sphere

from attnwarp import Camera
from attnwarp.warp.correspondence import correspond, in_bounds
from attnwarp.warp.rules import (
    angle_between,
    camera_frame,
    depth_agrees,
    facing,
    gaussian_filter,
    opaque,
    photometric,
    source_incidence,
)


def test_facing_is_what_a_convex_body_shows_to_both():
    for yaw in (0, 30, 75, 120, 150):
        source, target = orbit(0, height=1, size=128), orbit(yaw, height=-0.5, size=128)
        depth, normal = sphere(target)
        c = correspond(source, target, depth)
        expected = faces(source, normal, normal) & np.isfinite(depth)
        for sign in (1.0, -2.5):  # of either sign and any length
            assert np.array_equal(facing(c, sign * normal).numpy(), expected)


@pytest.mark.parametrize("yaw", [0, 20, 60])
def test_depth_agreement_with_exact_depth_is_exact_visibility_of_a_sphere_before_a_wall(yaw):
    # The wall is hidden where the segment to the source camera meets the sphere: a closed form.
    # Interior pixels only: taps across the outline do not answer, and a pixel whose neighbours
    # differ is on it.
    source, target = orbit(0, size=256, height=1), orbit(yaw, size=256, height=1)
    wall = ((1, 0, 0), -1.5)

    def scene(camera):
        ball, flat = sphere(camera)[0], plane_depth(camera, *wall)
        return np.fmin(ball, flat), ball <= np.nan_to_num(flat, nan=np.inf)

    depth, _ = scene(target)
    source_depth, _ = scene(source)
    c = correspond(source, target, depth)
    got = (depth_agrees(c, source_depth) & in_bounds(c)).numpy()

    points = target.unproject(target.pixel_centers(), depth)
    ray = points - source.position
    length = np.linalg.norm(ray, axis=-1)
    unit = ray / length[..., None]
    along = -(unit @ source.position)
    half = 1.0 - ((source.position + along[..., None] * unit) ** 2).sum(-1)
    with np.errstate(invalid="ignore"):
        entry = along - np.sqrt(np.where(half > 0, half, np.nan))
        visible = ~(entry < length * (1 - 1e-9)) & in_bounds(c).numpy() & np.isfinite(depth)
    hidden = np.isfinite(depth) & in_bounds(c).numpy() & ~visible
    answers = depth_agrees(c, source_depth, relative=1e9).numpy()  # where the taps answer at all
    assert not (got & hidden & answers).any()
    # Within 2 % of the sphere's rim both surfaces come together, and the slope term must keep them
    # apart there too.
    kept = (got & visible).sum() / max(1, (visible & answers).sum())
    assert kept > 0.995
    assert yaw == 0 or hidden.sum() > 500


@pytest.mark.parametrize("gap", [0.3, 0.03, 0.005])
def test_a_card_just_above_its_ground_hides_what_lies_under_it(gap):
    # A fixed threshold of 15 mm misses a card 5 mm above its ground whole; relative + slope misses
    # none (interior).
    source = Camera.look_at((0, 0, 3), (0, 0, 0), width=256, height=256, fov_y=40, up=(0, 1, 0))
    target = Camera.look_at((2.0, 0, 2.2), (0, 0, 0), width=256, height=256, fov_y=40)

    def card(camera):
        ground, top = plane_depth(camera, (0, 0, 1), 0.0), plane_depth(camera, (0, 0, 1), gap)
        p = camera.unproject(camera.pixel_centers(), top)
        on = (np.abs(p[..., 0]) < 0.4) & (np.abs(p[..., 1]) < 0.4)
        return np.where(on, top, ground), on

    # The target is told the ground's depth everywhere: what lies under the card is what must be
    # rejected.
    ground = plane_depth(target, (0, 0, 1), 0.0)
    c = correspond(source, target, ground)
    agrees = depth_agrees(c, card(source)[0]).numpy()
    # Under the card as the source sees it, by its own ray through the ground point.
    points = target.unproject(target.pixel_centers(), ground)
    above = points + (source.position - points) * (gap / source.position[2])
    inner, outer = 0.4 - 0.03, 0.4 + 0.03
    under = (np.abs(above[..., :2]) < inner).all(-1) & in_bounds(c).numpy()
    beside = (np.abs(above[..., :2]) > outer).any(-1) & in_bounds(c).numpy()
    assert under.sum() > 1000
    assert not (agrees & under).any()
    assert agrees[beside].all()


def test_source_incidence_is_the_angle_at_the_surface():
    source, target = orbit(0, height=0.5, size=128), orbit(40, height=0.2, size=128)
    depth, normal = sphere(target)
    c = correspond(source, target, depth)
    ray = source.position - normal
    cosine = (ray * normal).sum(-1) / np.linalg.norm(ray, axis=-1)
    for angle in (20.0, 60.0, 90.0):
        expected = cosine > np.cos(np.radians(angle))
        difference = source_incidence(c, normal, angle).numpy() != expected
        assert not (difference & (np.abs(cosine - np.cos(np.radians(angle))) > 1e-9)).any()


def test_an_undefined_normal_does_not_pass():
    camera = orbit(0, size=4)
    c = correspond(camera, camera, np.full((4, 4), 3.0))
    normal = np.broadcast_to(-camera.forward, (4, 4, 3)).copy()
    normal[0, 0] = np.nan
    normal[0, 1] = 0
    for rule in (facing, source_incidence, camera_frame):
        assert rule(c, normal).sum() == 14
        assert not rule(c, normal)[0, :2].any()


def test_opacity_is_asked_of_both_images():
    camera = orbit(0, size=4)
    c = correspond(camera, camera, np.full((4, 4), 3.0))
    alpha = np.ones((4, 4))
    alpha[0] = 0.4
    assert opaque(c, 0.5, target_alpha=alpha).tolist() == [[False] * 4] + [[True] * 4] * 3
    assert torch.equal(opaque(c, 0.5, source_alpha=alpha), opaque(c, 0.5, target_alpha=alpha))
    assert opaque(c, 0.5).all()


def test_photometric_is_the_mean_over_channels():
    camera = orbit(0, size=2)
    c = correspond(camera, camera, np.array([[3.0, 3.0], [3.0, np.nan]]))
    source = np.zeros((2, 2, 3))
    target = np.zeros((2, 2, 3))
    target[0, 0] = [0.6, 0, 0]  # mean 0.2
    target[0, 1] = [0.61, 0, 0]
    assert photometric(c, source, target, 0.2 + 1e-12).tolist() == [[True, False], [True, False]]


def test_the_angle_with_a_vector_of_no_length_is_undefined():
    a = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    assert torch.isnan(angle_between(a, torch.zeros(3, dtype=torch.float64)))


def kept_by_the_camera_frame_test(source, target):
    """Shares of the target's sphere, by area: of what both see, and of what only the target
    sees."""
    depth, normal = sphere(target)
    kept = camera_frame(correspond(source, target, depth), normal).numpy()
    both = faces(source, normal, normal) & np.isfinite(depth)
    only = np.isfinite(depth) & ~both
    weight = np.nan_to_num(area(target, normal))
    return (weight * (kept & both)).sum() / weight[both].sum(), (
        weight * (kept & only)
    ).sum() / max(weight[only].sum(), 1e-300)


@pytest.mark.parametrize(
    ("yaw", "of_both", "of_hidden"),
    [(30, 1.0, 0.0), (60, 1.0, 0.0), (75, 0.27, 0.0), (90, 0.10, 0.0), (135, 0.0, 0.40)],
)
def test_the_camera_frame_test_throws_away_co_visible_surface_as_yaw_grows(yaw, of_both, of_hidden):
    both, hidden = kept_by_the_camera_frame_test(
        orbit(0, distance=3, size=256), orbit(yaw, distance=3, size=256)
    )
    # 0.012: the figures are quoted to a percent, and the area near the outline is integrated on a
    # pixel grid.
    assert abs(both - of_both) < 0.012
    assert abs(hidden - of_hidden) < 0.012


def test_the_camera_frame_test_drops_56_percent_under_a_pure_roll():
    source = orbit(0, distance=3, size=256)
    kept, _ = kept_by_the_camera_frame_test(source, rolled(source, 90))
    assert abs(1 - kept - 0.56) < 0.012
    depth, normal = sphere(rolled(source, 90))
    c = correspond(source, rolled(source, 90), depth)
    assert torch.equal(facing(c, normal), torch.from_numpy(np.isfinite(depth)))


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_the_filters_on_gaussians_are_those_on_points(kind):
    shells = shell(4000, kind)
    n = shells.world_means()
    source, target = orbit(0, distance=3, size=128), orbit(75, distance=3, height=0.4, size=128)
    seen = [faces(camera, n, n) for camera in (source, target)]
    same = seen[0] == seen[1]
    # Normals of float32 quaternions: points within 1e-4 of the rim may fall to either side.
    clear = np.ones(len(n), dtype=bool)
    for camera in (source, target):
        clear &= np.abs(((camera.position - n) * n).sum(-1)) > 1e-3
    assert np.array_equal(
        gaussian_filter(shells, source, target, "facing").numpy()[clear], same[clear]
    )

    turned = [
        np.where(s[:, None], n, -n) @ camera.rotation.T
        for s, camera in zip(seen, (source, target), strict=True)
    ]
    cosine = (turned[0] * turned[1]).sum(-1)
    clear &= np.abs(cosine - 0.5) > 1e-3
    within = cosine > 0.5
    assert np.array_equal(
        gaussian_filter(shells, source, target, "camera_frame").numpy()[clear], within[clear]
    )
    assert np.array_equal(
        gaussian_filter(shells, source, target, "printed").numpy()[clear], ~within[clear]
    )
    ray = source.position - n
    incidence = np.abs((ray * n).sum(-1)) / np.linalg.norm(ray, axis=-1)
    clear &= np.abs(incidence - 0.5) > 1e-3
    got = gaussian_filter(shells, source, target, "source_incidence").numpy()
    assert np.array_equal(got[clear], (same & (incidence > 0.5))[clear])
    assert gaussian_filter(shells, source, target, "none").all()
    assert not gaussian_filter(shells, source, source, "printed").any()
