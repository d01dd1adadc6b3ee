"""Pairs of views against closed forms of spheres and planes."""

import dataclasses

import numpy as np
import pytest
import torch
from closed_forms import faces, orbit, plane_depth, shell, sphere

from attnwarp import Camera, Gaussians
from attnwarp.settings import Weight
from attnwarp.trial import disc as one_disc
from attnwarp.warp.depth import resize_depth
from attnwarp.warp.rules import RULES, Rule, gaussian_filter, in_front
from attnwarp.warp.settings import PRESETS, WarpSettings, preset
from attnwarp.warp.view import Surface, near_plane, render_surface, warp_surfaces, warp_view


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_world_in_millimetres_has_the_depth_of_its_plane(backend):
    # All of it lies before the renderer's default near plane of 0.01. The cameras stand side by
    # side before a facing disc at depth 0.003, a millimetre wide: 25 px.
    K = np.array([[75.0, 0, 16], [0, 75.0, 16], [0, 0, 1]])
    beside = np.eye(4)
    beside[0, 3] = 2 * 0.003 / 75  # 2 px at that depth
    target, source = Camera(K, np.eye(4), 32, 32), Camera(K, beside, 32, 32)
    disc = Gaussians(
        "2d",
        torch.tensor([[0, 0, 0.003]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 2), 5e-4),
        torch.full((1,), 0.99),
        torch.zeros(1, 1, 3),
    )
    surface = render_surface(disc, target, backend=backend)
    middle = (slice(12, 20), slice(12, 20))
    assert surface.depth[middle].numpy() == pytest.approx(0.003, rel=1e-6)
    view = warp_view(disc, source, target, backend=backend)
    expected = target.pixel_centers()[middle] + [2.0, 0]
    assert np.abs(view.correspondence.xy[middle].numpy() - expected).max() < 1e-4
    assert view.mask[middle].all()


@pytest.mark.parametrize("place", [0.0, 1e5])
@pytest.mark.parametrize("origin", [0.0, 1e5])
@pytest.mark.parametrize("scale", [0.1, 0.9, 0.995, 1.0, 1.02, 3.0])
def test_the_near_plane_is_a_hundredth_of_the_median_distance(scale, origin, place):
    random = torch.Generator().manual_seed(3)
    way = torch.nn.functional.normalize(torch.randn(101, 3, generator=random), dim=1)
    distance = scale * torch.linspace(0.5, 1.5, 101)[:, None]
    splats = Gaussians(
        "2d",
        way * distance + place,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(101, 1),
        torch.full((101, 2), 0.1),
        torch.ones(101),
        torch.zeros(101, 1, 3),
        origin=np.full(3, origin),
    )
    pose = np.eye(4)
    pose[:3, 3] = -(place + origin)
    camera = Camera(np.array([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]]), pose, 32, 32)
    away = splats.means.numpy().astype(np.float64) + origin - (place + origin)
    expected = np.median(np.sqrt((away**2).sum(axis=1))) / 100
    assert near_plane(splats, camera) == pytest.approx(expected, rel=1e-6)


def test_nothing_nearer_than_the_near_plane_that_is_asked_for_is_seen():
    # A disc at depth 20 and, on the source's axis alone, one at depth 0.1.
    camera = Camera(np.array([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]]), np.eye(4), 32, 32)
    beside = np.eye(4)
    beside[0, 3] = 20 * 4 / 32  # 4 px at depth 20
    target = Camera(camera.K, beside, 32, 32)
    discs = Gaussians(
        "2d",
        torch.tensor([[0, 0, 20.0], [0, 0, 0.1]]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        torch.tensor([[50.0, 50.0], [0.02, 0.02]]),
        torch.ones(2),
        Gaussians.sh_from_rgb(torch.tensor([[1.0, 0, 0], [0, 1.0, 0]])),
    )
    far, default = (render_surface(discs, camera, near=near) for near in (1.0, None))
    assert default.depth[16, 16].item() == pytest.approx(0.1, rel=1e-5)
    assert far.depth.numpy() == pytest.approx(np.full((32, 32), 20.0), rel=1e-5)
    assert far.image[16, 16].tolist() == pytest.approx([1, 0, 0], abs=0.02)
    settings = preset("corrected", photometric=0.2)
    seen = warp_view(discs, camera, target, settings, near=1.0)
    # The floater hides the wall from the source, by depth and by colour.
    assert seen.mask[:, 8:24].all()
    assert not warp_view(discs, camera, target, settings).mask[12:20, 16:24].any()


def test_at_yaw_150_bounds_alone_accept_nothing_but_points_behind_the_source():
    # A background at depth 20.
    source, target = orbit(0, size=128), orbit(150, size=128)
    depth = np.full((128, 128), 20.0)
    for name in ("paper", "released"):
        settings = dataclasses.replace(PRESETS[name], photometric=None)
        view = warp_surfaces(source, target, Surface(depth), None, settings)
        assert view.mask.sum() > 1000
        assert (view.correspondence.z[view.mask] < 0).all()
        strict = dataclasses.replace(settings, in_front=True)
        tested = warp_surfaces(source, target, Surface(depth), None, strict, warn_empty=False)
        assert not tested.mask.any()
        assert not in_front(tested.correspondence)[view.mask].any()


def test_the_paper_as_printed_has_no_depth_for_the_same_view():
    camera = orbit(0, size=64)
    view = warp_view(shell(500), camera, camera, preset("paper", gaussian_filter="printed"))
    assert not view.mask.any()
    assert torch.isnan(view.correspondence.target_depth).all()


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_splats_of_a_sphere_warp_like_the_sphere(kind):
    source, target = orbit(0, size=96), orbit(30, size=96, height=0.5)
    view = warp_view(shell(kind=kind), source, target)
    depth, normal = sphere(target)
    visible = faces(source, normal, normal) & np.isfinite(depth)
    mask = view.mask.numpy()
    cosines = []
    for camera in (source, target):
        ray = camera.position - normal
        cosines.append((ray * normal).sum(-1) / np.linalg.norm(ray, axis=-1))
    # Steeper than that, depth changes by some percent a pixel at this size, and its taps may be
    # rejected.
    inner = visible & (np.fmin(*cosines) > 0.5)
    assert mask[inner].mean() > 0.99
    # Splats reach past the outline: less than a pixel all around it, of a radius of 30 px.
    assert (mask & ~visible).sum() < 2 / 30 * visible.sum()
    exact, _ = source.project(normal)
    error = np.linalg.norm(view.correspondence.xy.numpy() - exact, axis=-1)[mask & inner]
    # A flat splat, cut off at 3 sigma, stands off the sphere by at most (3 * 0.6 * 0.025)^2 / 2 =
    # 1e-3 scene units, which at this yaw is 0.03 px.
    assert np.median(error) < 0.03
    assert set(view.rules) == {
        "defined",
        "in_bounds",
        "in_front",
        "opaque",
        "depth_agrees",
        "facing",
    }
    assert torch.equal(view.mask, torch.stack(list(view.rules.values())).all(0))
    assert view.target.counters["splats"] == 20_000


def test_both_doors_give_the_same_view():
    splats, source, target = shell(5000), orbit(0, size=64), orbit(30, size=64)
    for name, settings in PRESETS.items():
        whole = warp_view(splats, source, target, settings)
        filtered = splats.select(gaussian_filter(splats, source, target, settings.gaussian_filter))
        seen = render_surface(filtered, target, settings)
        seen = dataclasses.replace(seen, image=render_surface(splats, target, settings).image)
        parts = warp_surfaces(
            source, target, seen, render_surface(splats, source, settings), settings
        )
        assert torch.equal(whole.mask, parts.mask), name
        assert list(whole.rules) == list(parts.rules)
    given = np.zeros((64, 64, 3))
    released = warp_view(
        splats, source, target, PRESETS["released"], source_image=given, target_image=given
    )
    assert released.rules["photometric"].sum() == released.correspondence.defined.sum()


def test_the_truths_own_surface_warps_to_within_a_thousandth_of_a_pixel():
    # The calibration: exact depth in, exact positions out, at image size; and at 32 by 1 / z
    # interpolation.
    source, target = orbit(0, size=256, height=0.3), orbit(30, size=256)
    (depth, normal), (source_depth, source_normal) = sphere(target), sphere(source)
    settings = preset("corrected", depth_relative=1e-4)
    view = warp_surfaces(
        source, target, Surface(depth, normal), Surface(source_depth, source_normal), settings
    )
    exact, _ = source.project(normal)
    assert np.abs(view.correspondence.xy.numpy() - exact)[view.mask.numpy()].max() < 1e-9
    layer = view.at((32, 32))
    small = sphere(target.resize(32, 32))[1]
    exact_layer, _ = source.resize(32, 32).project(small)
    error = (
        8
        * np.linalg.norm(layer.correspondence.xy.numpy() - exact_layer, axis=-1)[layer.mask.numpy()]
    )
    assert layer.mask.sum() > 200
    # The four taps lie half an image pixel around the centre: what is left is the sphere's
    # curvature over that.
    assert np.median(error) < 6e-3
    assert view.at((32, 32)) is layer


@dataclasses.dataclass(frozen=True)
class LimitedSettings(WarpSettings):
    farthest: Weight | None = None


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_a_rule_of_ones_own_needs_no_kernel(backend, request):
    # A wall at depth 2 with one row at 4, and a limit between them.
    def near(correspondence, target_depth, target_normal, farthest):
        return target_depth <= farthest

    record = Rule(
        "near",
        near,
        setting="farthest",
        reads=("target_depth", "target_normal"),
        limits={"farthest": "farthest"},
    )
    RULES.append(record)
    request.addfinalizer(RULES.pop)
    depth = np.full((6, 6), 2.0)
    depth[2] = 4.0
    camera = Camera(np.array([[6.0, 0, 3], [0, 6, 3], [0, 0, 1]]), np.eye(4), 6, 6)
    wall = Surface(depth, np.broadcast_to([0.0, 0, -1], (6, 6, 3)))
    off, on = (
        warp_surfaces(camera, camera, wall, wall, LimitedSettings(farthest=f), backend=backend)
        for f in (None, 3.0)
    )
    assert "near" not in off.rules and off.mask.all()
    assert list(on.rules) == [*off.rules, "near"]
    assert on.mask.any(dim=1).tolist() == [True, True, False, True, True, True]
    with pytest.raises(
        ValueError, match=r"target_surface\.normal: got None, but .* farthest needs"
    ):
        settings = LimitedSettings(farthest=3.0, normal_test="none")
        warp_surfaces(camera, camera, Surface(depth), wall, settings, backend=backend)


def test_bounds_are_held_against_the_size_that_is_asked_for():
    source, target = orbit(0, size=64), orbit(0, size=32)
    depth = np.full((32, 32), 4.0)
    bare = preset("paper", gaussian_filter="none", bounds="source")
    assert warp_surfaces(source, target, Surface(depth), None, bare).mask.all()
    # Held against the target's 32 x 32, positions in the 64 x 64 source pass in one quarter of it.
    quarter = warp_surfaces(source, target, Surface(depth), None, preset("paper")).mask
    assert quarter.sum() == 256
    assert quarter[:16, :16].all()


def test_a_rule_says_what_it_needs():
    camera = orbit(0, size=4)
    depth = np.full((4, 4), 3.0)
    with pytest.raises(
        ValueError, match=r"source_surface\.depth: got None, but the rule depth_agreement needs it"
    ):
        warp_surfaces(camera, camera, Surface(depth))
    with pytest.raises(
        ValueError, match=r"target_surface\.normal: got None, but the rule normal_test='facing'"
    ):
        warp_surfaces(camera, camera, Surface(depth), Surface(depth))
    with pytest.raises(
        ValueError, match=r"source_surface\.image: got None, but the rule photometric"
    ):
        warp_surfaces(camera, camera, Surface(depth), Surface(depth), PRESETS["released"])


@pytest.mark.door
def test_a_mistaken_argument_is_named_with_what_was_expected():
    disc, camera = shell(50), orbit(0, size=8)
    for change, message in (
        ({"gaussians": "splats.ply"}, "gaussians: got str, expected attnwarp.Gaussians"),
        ({"source": 0}, "source: got int, expected attnwarp.Camera"),
        ({"target": None}, "target: got NoneType, expected attnwarp.Camera"),
        ({"settings": "corrected"}, "settings: got str, expected WarpSettings, such as PRESETS"),
    ):
        with pytest.raises(TypeError, match=message):
            warp_view(**{"gaussians": disc, "source": camera, "target": camera, **change})
    wall = Surface(np.full((8, 8), 2.0))
    for name in ("target_surface", "source_surface"):
        given = {"source": camera, "target": camera, "target_surface": wall, name: wall.depth}
        with pytest.raises(TypeError, match=f"{name}: got ndarray, expected Surface, such as"):
            warp_surfaces(**given)


@pytest.mark.door
def test_what_no_rule_reads_is_refused_with_the_setting_that_would_read_it():
    disc, camera = shell(50), orbit(0, size=8)
    for change, message in (
        ({"source_image": np.zeros((8, 8, 3))}, "source_image: the settings have photometric=None"),
        ({"target_image": np.zeros((8, 8, 3))}, "target_image: the settings have photometric=None"),
        ({"target_segment": np.ones((8, 8), bool)}, "target_segment: the settings have segment=F"),
    ):
        with pytest.raises(ValueError, match=message):
            warp_view(disc, camera, camera, **change)
    wall = Surface(np.full((8, 8), 2.0))
    with pytest.raises(ValueError, match="target_segment: the settings have segment=False"):
        warp_surfaces(camera, camera, wall, target_segment=np.ones((8, 8), bool))


def test_a_view_without_a_position_says_what_to_check_and_why():
    """Oracle: poses in the other conventions, made by hand from one in OpenCV's."""
    given = {"width": 16, "height": 16, "fov_y": 40, "up": (0, 1, 0)}
    right = Camera.look_at((0.5, 0, -3), (0, 0, 0), **given)
    opengl = np.diag([1.0, -1, -1, 1]) @ right.world_to_camera
    backwards = np.linalg.inv(right.world_to_camera)
    remedy = "; check world_to_camera of both: from world to camera, not camera-to-world; OpenCV"
    wall = Surface(np.full((16, 16), 2.0))
    assert warp_view(one_disc(0.3), right, right).mask.any()
    for pose in (opengl, backwards):
        wrong = Camera(right.K, pose, 16, 16)
        with pytest.warns(UserWarning, match=f"the target sees no surface{remedy}") as issued:
            view = warp_view(one_disc(0.3), wrong, wrong)
        assert [warning.filename for warning in issued] == [__file__]
        assert not view.mask.any()
        warp_view(one_disc(0.3), wrong, wrong, warn_empty=False)  # a warning would be an error here
    ahead, behind = (Camera(right.K, np.diag(d), 16, 16) for d in ([1.0] * 4, [1.0, -1, -1, 1]))
    settings = preset("corrected", depth_agreement=False, normal_test="none")
    for backend in ("auto", "reference"):
        with pytest.warns(UserWarning, match=f"every point lies behind the source{remedy}") as got:
            warp_surfaces(behind, ahead, wall, None, settings, backend=backend)
        assert [warning.filename for warning in got] == [__file__]
        message = "depth is nowhere finite and above zero; check the depth map, and world_to_camera"
        with pytest.warns(UserWarning, match=message):
            nothing = Surface(np.full((16, 16), np.nan))
            warp_surfaces(ahead, ahead, nothing, None, settings, backend=backend)


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_a_view_without_alpha_is_opaque_everywhere(backend):
    camera = orbit(0, size=8)
    settings = preset("corrected", depth_agreement=False, normal_test="none", opaque=0.5)
    depth = np.full((8, 8), 2.0)
    view = warp_surfaces(camera, camera, Surface(depth), None, settings, backend=backend)
    assert view.rules["opaque"].all()
    clear = Surface(depth, alpha=np.zeros((8, 8)))
    view = warp_surfaces(camera, camera, clear, None, settings, backend=backend)
    assert not view.rules["opaque"].any()


def test_what_a_notebook_prints_is_one_short_line():
    camera = Camera(np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]), np.eye(4), 8, 6)
    depth = np.full((6, 8), 2.0)
    depth[:3] = np.nan
    surface = Surface(depth, alpha=np.ones((6, 8)))
    settings = preset("corrected", depth_agreement=False, normal_test="none")
    view = warp_surfaces(camera, camera, surface, None, settings)
    assert repr(surface) == "Surface((6, 8): depth, alpha)"
    assert repr(view.correspondence) == "Correspondence((6, 8) <- (6, 8), 50 % defined)"
    assert repr(view).startswith("WarpedView((6, 8) <- (6, 8), mask 50 %; rules: defined 50 %, ")
    assert len(repr(view)) < 150


def test_pictures_of_the_wrong_axes_or_range_are_refused_and_a_segment_may_be_an_array():
    disc, source, target = shell(50), orbit(0, size=8), orbit(0, size=12, width=16)
    settings = preset("corrected", photometric=0.2, segment=True)
    first, second = np.zeros((8, 8, 3)), np.full((12, 16, 3), 0.5)
    for change, message in (
        ({"source_image": np.zeros((3, 8, 8))}, r"source_image: got 3 x 8 .* \(H, W, C\)"),
        ({"source_image": np.zeros((12, 16, 3))}, "source_image: got 12 x 16 .* of 8 x 8; its"),
        ({"target_image": np.zeros((3, 12, 16))}, r"shape \(3, 12, 16\), expected \(12, 16, 3\)"),
        ({"target_image": np.zeros((12, 16, 4))}, r"shape \(12, 16, 4\), expected \(12, 16, 3\)"),
        (
            {"target_image": 255 * second},
            r"target_image: got values in \[128, 128\], expected sRGB",
        ),
        (
            {"target_image": torch.full((12, 16, 3), 128, dtype=torch.uint8)},
            r"target_image: got values in \[128, 128\], expected sRGB",
        ),
        ({"source_image": first - 1}, r"source_image: got values in \[-1, -1\], expected sRGB"),
        ({"target_segment": np.ones((8, 8))}, r"target_segment: got shape \(8, 8\), expected \(12"),
        # A share of 0.01 is no True, nor is NaN.
        (
            {"target_segment": np.full((12, 16), 0.01)},
            "got torch.float64, expected bool; pass mask",
        ),
        ({"target_segment": torch.full((12, 16), torch.nan)}, "got torch.float32, expected bool"),
        ({"target_segment": np.ones((12, 16), np.uint8)}, "got torch.uint8, expected bool; pass"),
    ):
        given = {"source_image": first, "target_image": second, **change}
        with pytest.raises(ValueError, match=message):
            warp_view(disc, source, target, settings, **given)
    segment = np.zeros((12, 16), bool)
    segment[:, 8:] = True
    segment.setflags(write=False)
    view = warp_view(disc, source, target, settings, target_segment=segment)
    assert np.array_equal(view.rules["segment"], segment)


def test_another_mask_reaches_a_layer_that_was_made_already():
    source, target = orbit(0, size=64), orbit(10, size=64)
    depth = plane_depth(target, (1, 0, 0), 0.0)
    depth[40:, :] = np.nan
    wall = Surface(depth)
    view = warp_surfaces(source, target, wall, None, preset("paper", gaussian_filter="none"))
    assert view.at((16, 16)).mask[5, 5]
    right = torch.zeros(64, 64, dtype=torch.bool)
    right[:, 32:] = True
    other = view.with_mask(right)
    expected = torch.zeros(16, 16, dtype=torch.bool)
    expected[:10, 8:] = True  # a pixel of the layer is 4 x 4 of the mask's
    assert torch.equal(other.at((16, 16)).mask, expected)


def test_a_layers_mask_drops_pixels_whose_own_correspondence_is_undefined():
    source, target = orbit(0, size=64), orbit(10, size=64)
    depth = plane_depth(target, (1, 0, 0), 0.0)
    depth[:, 31:33] = np.nan  # both taps of the 32 grid's column 15 keep one pixel, column 16 too
    view = warp_surfaces(
        source, target, Surface(depth), None, preset("paper", gaussian_filter="none")
    )
    undefined = torch.isnan(resize_depth(depth, (32, 32)))
    assert undefined.any()
    assert not view.at((32, 32)).mask[undefined].any()
    features = torch.ones(2, 32, 32)
    assert view.at((32, 32)).warp(features).shape == (2, 32, 32)


def test_undefined_depth_is_the_views_largest():
    splats, camera = shell(300), orbit(0, size=40)
    plain = render_surface(splats, camera, preset("corrected"))
    filled = render_surface(splats, camera, preset("corrected", undefined_depth="farthest"))
    depth, other = plain.depth.numpy(), filled.depth.numpy()
    undefined = np.isnan(depth)
    assert undefined.any() and not undefined.all()
    assert np.array_equal(other[~undefined], depth[~undefined])
    assert (other[undefined] == np.nanmax(depth)).all()
    away = Camera.look_at((9, 0, 0), (18, 0, 0), width=8, height=8, fov_y=20, up=(0, 0, 1))
    far = preset("corrected", undefined_depth="farthest")
    assert torch.isnan(torch.as_tensor(render_surface(splats, away, far).depth)).all()
