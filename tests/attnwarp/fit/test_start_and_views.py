"""Start of a fit: first splats, pictures from files, and which of them are held out."""

import json
import weakref

import numpy as np
import pytest
import torch
from edit_folders import Watched
from PIL import Image

from attnwarp import Camera
from attnwarp.errors import InputWarning
from attnwarp.fit import (
    FitSettings,
    Views,
    extent_of,
    first_splats,
    from_points,
    hold_out,
    load_views,
    random_points,
)
from attnwarp.io import Dataset, read_dataset

from .conftest import ring


def grid(n=4, step=0.5):
    ticks = np.arange(n) * step
    return np.stack(np.meshgrid(ticks + 10, ticks - 20, ticks + 5), -1).reshape(-1, 3)


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_first_splats_are_as_large_as_the_gaps_around_them(kind):
    g = from_points(grid(), kind=kind)
    # In a grid the three nearest neighbours are one step away, at corners too.
    torch.testing.assert_close(g.scales, torch.full_like(g.scales, 0.5))
    np.testing.assert_allclose(g.world_means(), grid(), atol=1e-6)
    assert g.opacities.unique().tolist() == [pytest.approx(0.1)]


def test_first_splats_have_their_points_colours():
    colors = np.array([[0, 128, 255], [10, 20, 30]], np.uint8)
    g = from_points([[0, 0, 0], [1, 0, 0]], colors, kind="3d", sh_degree=2)
    assert g.sh.shape == (2, 9, 3)
    torch.testing.assert_close(
        g.sh[:, 0] * 0.28209479177387814 + 0.5, torch.tensor(colors / 255, dtype=torch.float32)
    )
    assert float(g.sh[:, 1:].abs().max()) == 0


def test_first_discs_are_turned_every_way_and_first_ellipsoids_none():
    points = np.random.default_rng(0).normal(size=(3000, 3))
    normals = from_points(points, kind="2d").normals()
    # The mean of n random unit vectors has length of about 1 / sqrt(n) = 0.018; their covariance is
    # I / 3.
    assert float(normals.mean(0).norm()) < 0.08
    torch.testing.assert_close(normals.T @ normals / 3000, torch.eye(3) / 3, rtol=0, atol=0.03)
    torch.testing.assert_close(
        from_points(points, kind="3d").rotations(), torch.eye(3).expand(3000, 3, 3)
    )


def test_points_at_one_place_become_one_splat():
    g = from_points([[0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0]], kind="3d")
    assert len(g) == 2
    torch.testing.assert_close(g.scales, torch.ones(2, 3))


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_one_point_alone_is_a_hundredth_of_the_scene_in_any_unit(unit):
    view = dict(width=8, height=8, fov_y=40)
    place = np.array([1e6, 2e6, 3e6])
    camera = Camera.look_at(place + unit * np.array([0, 4, 0]), place, **view)
    alone = from_points([place], kind="2d", cameras=[camera])
    torch.testing.assert_close(alone.scales, torch.full((1, 2), 0.04 * unit), rtol=1e-6, atol=0)
    # Cameras 4 units from their middle: 1.1 times that is the extent.
    ends = [Camera.look_at(place + unit * np.array([x, 1, 0]), place, **view) for x in (-4, 4)]
    among = from_points([place], kind="3d", cameras=ends)
    torch.testing.assert_close(among.scales, torch.full((1, 3), 0.044 * unit), rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("points", "colors", "message"),
    [
        (np.zeros((0, 3)), None, "points: got none"),
        (np.zeros((2, 2)), None, r"points: got shape \(2, 2\)"),
        (np.array([[0, 0, np.nan]]), None, r"points: nan at index \(0, 2\)"),
        (np.zeros((1, 3)), np.zeros((1, 3)), "colors: got float64, expected uint8"),
    ],
)
def test_points_that_cannot_be_used_are_refused(points, colors, message):
    with pytest.raises(ValueError, match=message):
        from_points(points, colors, kind="2d")


def test_random_points_surround_what_the_cameras_look_at():
    offset = np.array([100.0, -50.0, 7.0])
    points, colors = random_points(ring(offset=offset), 5000, seed=2)
    distance = np.linalg.norm(ring()[0].position)
    assert colors.dtype == np.uint8 and len(points) == 5000
    # The mean of n draws from a cube of half an edge h errs by h / sqrt(3 n) = 0.02 an axis.
    np.testing.assert_allclose(points.mean(0), offset, atol=0.15)
    assert np.abs(points - offset).max() == pytest.approx(distance, rel=0.1)


def test_random_points_lie_in_front_of_parallel_cameras():
    cameras = [
        Camera.look_at([x, 0, 0], [x, 5, 0], width=8, height=8, fov_y=40) for x in (-1.0, 0.0, 1.0)
    ]
    points, _ = random_points(cameras, 1000)
    assert points[:, 1].mean() > 0.5


def test_extent_is_that_of_3dgs_and_a_single_cameras_is_its_distance_from_what_it_sees():
    cameras = ring(4)
    centers = np.stack([c.position for c in cameras])
    assert extent_of(cameras) == pytest.approx(
        1.1 * np.linalg.norm(centers - centers.mean(0), axis=1).max()
    )
    assert extent_of(cameras[:1]) == 1
    away = np.array([[0.0, 0, 2], [0, 7, 0], [5, 0, 0]])
    for unit in (1e-3, 1.0, 1e4):
        one = Camera.look_at((3, 1, 2), (0, 0, 0), width=8, height=8, fov_y=40)
        assert extent_of([one, one], one.position + unit * away) == pytest.approx(5 * unit)
        # Where cameras stand apart, they decide alone.
        assert extent_of(cameras, unit * away) == extent_of(cameras)
    assert extent_of([one], np.empty((0, 3))) == extent_of([one], one.position[None]) == 1


def camera(width=6, height=4, name="a.png"):
    return Camera.look_at([3, 0, 0], [0, 0, 0], width=width, height=height, fov_y=40, name=name)


def test_transparent_pixels_show_the_background():
    image = np.zeros((4, 6, 4), np.uint8)
    image[..., 0] = 255
    image[0, 0, 3], image[0, 1, 3] = 255, 51
    views = Views([camera()], [image])
    assert views.transparent
    seen = views.target(0, torch.tensor([0.0, 0.5, 1.0]))
    torch.testing.assert_close(seen[0, 0], torch.tensor([1.0, 0, 0]))
    torch.testing.assert_close(seen[0, 1], torch.tensor([0.2, 0.4, 0.8]))
    torch.testing.assert_close(seen[1, 1], torch.tensor([0.0, 0.5, 1.0]))


def test_an_opaque_alpha_channel_is_not_transparent():
    assert not Views([camera()], [np.full((4, 6, 4), 255, np.uint8)]).transparent


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_white_is_one_in_every_depth(dtype):
    top = np.iinfo(dtype).max if np.dtype(dtype).kind == "u" else 1
    seen = Views([camera()], [np.full((4, 6, 3), top, dtype)]).target(0, torch.zeros(3))
    assert seen.dtype == torch.float32 and float(seen.min()) == 1


@pytest.mark.door
@pytest.mark.parametrize(
    ("image", "message"),
    [
        (
            np.zeros((4, 5, 3), np.uint8),
            r"images\[0\] \(a.png\): got 5 x 4 px, its camera has 6 x 4",
        ),
        (np.zeros((4, 6), np.uint8), r"got shape \(4, 6\)"),
        (np.zeros((4, 6, 3), np.int32), "got int32"),
        (np.full((4, 6, 3), 1.5, np.float32), r"got values in \[1.5, 1.5\]"),
        (np.full((4, 6, 3), np.nan, np.float32), "not finite"),
    ],
)
def test_pictures_that_cannot_be_used_are_refused_by_name(image, message):
    with pytest.raises(ValueError, match=message):
        Views([camera()], [image])


def test_pictures_beyond_the_memory_for_them_are_read_again(tmp_path, monkeypatch):
    """Oracle: the arrays that were written."""
    noise = np.random.default_rng(0).integers(0, 256, (3, 8, 8, 3), np.uint8)
    paths = [tmp_path / name for name in ("0.png", "1.png", "2.png")]
    for path, pixels in zip(paths, noise, strict=True):
        Image.fromarray(pixels).save(path)
    monkeypatch.setattr("attnwarp.fit.views.READ_BYTES", noise[0].nbytes)
    views = load_views(Dataset(ring(3, size=8), paths))
    for _ in range(2):
        for k in range(3):
            np.testing.assert_array_equal(views.images[k], noise[k])
    alive = [weakref.ref(views.images[k]) for k in range(3)]
    assert [reference() is not None for reference in alive] == [True, False, False]


def test_pictures_are_shrunk_by_area_and_their_cameras_with_them(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    big = camera(60, 40)
    views = load_views(Dataset([big], [tmp_path / "a.png"]), max_size=30)
    small = pixels.astype(float).reshape(20, 2, 30, 2, 3).mean((1, 3))
    np.testing.assert_allclose(views.images[0], small, atol=0.51)
    np.testing.assert_allclose(views.cameras[0].K, big.resize(30, 20).K)


def test_colour_of_transparent_pixels_does_not_bleed_when_shrunk(tmp_path):
    pixels = np.zeros((8, 8, 4), np.uint8)
    pixels[:, ::2] = [200, 100, 50, 255]
    pixels[:, 1::2] = [0, 255, 0, 0]  # green that nobody can see
    Image.fromarray(pixels).save(tmp_path / "a.png")
    views = load_views(Dataset([camera(8, 8)], [tmp_path / "a.png"]), max_size=4)
    np.testing.assert_allclose(
        views.images[0].astype(float), np.tile([200, 100, 50, 127.5], (4, 4, 1)), atol=1
    )


def named(count, splits=None):
    cameras = [camera(name=f"{k:02d}.png").moved([k, 0, 0]) for k in range(count)]
    return Dataset(cameras[::-1], [None] * count, splits=splits or [])


def test_one_of_eight_is_held_out_in_the_order_of_names_and_never_the_first_view():
    for first in range(17):
        data = named(17).select([first, *(k for k in range(17) if k != first)])
        train, test = hold_out(data)
        # In the middle of the eight after the first in the order of names, and of the next eight.
        number = int(data.cameras[0].name[:2])
        expected = {f"{(number + step) % 17:02d}.png" for step in (4, 12)}
        assert {c.name for c in test.cameras} == expected
        assert len(train) == 15 and train.cameras[0] is data.cameras[0]
    assert [c.name for c in hold_out(named(9), ["03", "05.png"])[1].cameras] == ["05.png", "03.png"]
    with pytest.raises(ValueError, match="the name '9', which none of the 9 views has"):
        hold_out(named(9), ["9"])
    everything, nothing = hold_out(named(17), 0)
    assert len(everything) == 17 and nothing is None


def test_a_data_sets_own_splits_are_kept_to():
    train, test = hold_out(named(4, ["train", "val", "test", "train"]))
    assert (len(train), len(test)) == (2, 1)
    train, test = hold_out(named(3, ["train", "val", "train"]))
    assert len(test) == 1
    with pytest.raises(ValueError, match="none is 'train'"):
        hold_out(named(2, ["val", "test"]))


def posed(x):
    """A camera-to-world matrix of transforms.json."""
    return [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def write_split(folder, split, frames):
    lens = {"w": 8, "h": 6, "fl_x": 9.0}
    data = {**lens, "frames": [{"file_path": n, "transform_matrix": posed(x)} for n, x in frames]}
    (folder / f"transforms_{split}.json").write_text(json.dumps(data))


def copied(source, target):
    target.write_bytes(source.read_bytes())


def saved_anew(source, target):
    with Image.open(source) as picture:
        picture.save(target.with_suffix(".tif"))


AGAIN = {
    "the same frame": (None, "a.png", 0.0),
    "spelled otherwise": (None, "./images/../a.png", 0.0),
    "spelled by Windows": (None, ".\\a.png", 0.0),
    "the same picture at another pose": (None, "a.png", 0.3),
    "a link": (lambda a, b: b.symlink_to(a), "b.png", 0.3),
    "a hard link": (lambda a, b: b.hardlink_to(a), "b.png", 0.3),
    "a copy": (copied, "b.png", 0.3),
    "a copy at the rounded pose": (copied, "b.png", 1e-9),
    "another picture of the same pose": (saved_anew, "b", 0.0),
}


@pytest.mark.parametrize("split", ["test", "val"])
@pytest.mark.parametrize("how", AGAIN)
def test_a_picture_that_is_fitted_on_is_not_held_out(tmp_path, how, split):
    """Oracle: the frames, of which one is that of the fitted picture a.png and one is not."""
    make, again, x = AGAIN[how]
    (tmp_path / "images").mkdir()
    random = np.random.default_rng(0)
    for name in ("a.png", "c.png", "d.png"):
        pixels = random.integers(0, 256, (6, 8, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / name)
    if make is not None:
        make(tmp_path / "a.png", tmp_path / again)
    write_split(tmp_path, "train", [("a.png", 0.0), ("c.png", 1.0)])
    write_split(tmp_path, split, [("d.png", 2.0), (again, x)])
    with pytest.warns(InputWarning, match=r"1 of 2 held-out views are fitted on .* which is 'a.pn"):
        train, test = hold_out(read_dataset(tmp_path))
    assert [c.name for c in train.cameras] == ["a.png", "c.png"]
    assert [c.name for c in test.cameras] == ["d.png"]
    write_split(tmp_path, split, [(again, x)])
    with pytest.warns(InputWarning, match="which leaves none to measure on"):
        train, test = hold_out(read_dataset(tmp_path))
    assert len(train) == 2 and test is None


def test_views_that_are_alike_and_others_stay_held_out(tmp_path, recwarn):
    """One place with another lens, and a small step aside; all files have one size."""
    for name in ("a.png", "b.png", "c.png", "d.png"):
        pixels = np.random.default_rng(ord(name[0])).integers(0, 256, (6, 8, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / name.replace("png", "bmp"))
    first = camera(8, 6, name="a.png")
    longer = Camera(first.K * [[2], [2], [1]], first.world_to_camera, 8, 6, "b.png")
    aside = first.moved([0, 1e-3, 0])
    cameras = [first, first.moved([5, 0, 0]), longer, aside]
    paths = [tmp_path / f"{name}.bmp" for name in "abcd"]
    splits = ["train", "train", "test", "test"]
    _, test = hold_out(Dataset(cameras, paths, splits=splits))
    assert len(test) == 2 and not recwarn.list


def test_a_single_picture_is_fitted_on_and_not_held_out():
    train, test = hold_out(named(1))
    assert len(train) == 1 and test is None


def test_the_digest_knows_pixels_and_cameras_but_not_names():
    image = np.zeros((4, 6, 3), np.uint8)
    same = Views([camera(name="b.png")], [image.copy()])
    other = image.copy()
    other[0, 0, 0] = 1
    assert Views([camera()], [image]).digest == same.digest
    assert Views([camera()], [other]).digest != same.digest
    assert Views([camera().moved([0, 0, 1e-9])], [image]).digest != same.digest


def test_a_point_far_astray_costs_the_others_no_digits():
    points = np.random.default_rng(0).normal(size=(50, 3))
    g = from_points([*points, [1e9, 0, 0]], kind="3d")
    # float32 keeps 1e-7 of the few units that the others lie from their median.
    np.testing.assert_allclose(g.world_means()[:50], points, atol=1e-6)


@pytest.mark.door
def test_cameras_at_one_place_that_look_in_opposite_directions_are_refused():
    view = dict(width=8, height=8, fov_y=40)
    both = [Camera.look_at((1, 2, 3), (1 + x, 2, 3), **view) for x in (1, -1)]
    with pytest.raises(ValueError, match="all stand at one place and look different ways"):
        random_points(both, 50)
    points, _ = random_points(both[:1] * 2, 50)  # one way alone, where a guess is possible
    assert np.ptp(points, axis=0).min() > 0


@pytest.mark.parametrize(("radius", "place"), [(3e-3, 5e6), (3e-10, 0.0)])
def test_a_small_ring_of_cameras_far_away_is_no_single_place(radius, place):
    """Millimetres at a map's coordinates, and a world in tiny units."""
    center = np.array([place, -place, 0.5 * place])
    around = [np.array([np.cos(a), np.sin(a), 0]) for a in np.arange(8) * np.pi / 4]
    view = dict(width=8, height=8, fov_y=40)
    cameras = [Camera.look_at(center + radius * way, center, **view) for way in around]
    # A step between neighbouring float64 numbers is 1e-9 at 5e6, and positions err by a few.
    tolerance = 10 * np.spacing(place) + 1e-6 * radius
    assert extent_of(cameras) == pytest.approx(1.1 * radius, abs=tolerance)
    points, _ = random_points(cameras, 2000)
    # Of 2,000 draws from a cube, the outermost of an axis is within 1% of its face.
    reach = np.abs(points - center).max(0)
    np.testing.assert_allclose(reach, radius, rtol=0.01, atol=tolerance)


@pytest.mark.parametrize("place", [(0, 0, 0), (3e-10, 1e-10, 0), (5e6, -4e6, 123.4)])
def test_cameras_at_one_place_are_told_by_rounding_alone(place):
    random = np.random.default_rng(1)
    ways = random.normal(size=(300, 3)) * max(1.0, *np.abs(place))
    view = dict(width=8, height=8, fov_y=40)
    cameras = [Camera.look_at(place, place + way, **view) for way in ways]
    assert extent_of(cameras) == 1
    with pytest.raises(ValueError, match="cameras that all stand at one place"):
        random_points(cameras, 10)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_points_far_astray_begin_no_splats_and_are_told(unit):
    # Cameras 3 units from the middle; 100 points about it, so that 100 * 3.3 is the reach.
    points = unit * np.random.default_rng(0).normal(0, 0.1, (100, 3))
    points[3], points[7], points[9] = [300 * unit, 0, 0], [0, 400 * unit, 0], [0, 0, -1e200]
    colors = np.arange(300).reshape(100, 3).astype(np.uint8)
    cameras = [
        Camera.look_at(unit * np.array([x, 0.01, 0]), (0, 0, 0), width=8, height=8, fov_y=40)
        for x in (-3.0, 3.0)
    ]
    data = Dataset(cameras, ["a.png", "b.png"], points=points, colors=colors)
    said = []
    splats = first_splats(data, cameras, FitSettings(sh_degree=0), Watched(log=said.append))
    (line,) = said
    assert line.startswith("2 of 100 points are left out, over 100 times as far")
    expected = from_points(
        np.delete(points, (7, 9), 0), np.delete(colors, (7, 9), 0), kind="2d", sh_degree=0
    )
    assert splats.digest() == expected.digest()


def test_of_more_first_splats_than_a_fit_may_have_some_are_drawn_and_widened():
    """Oracle: a grid in a plane, whose first splats are all of one size."""
    flat = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0]), -1).reshape(-1, 3)
    data, said = Dataset(ring(3), ["a.png"] * 3, points=flat), []
    settings = FitSettings(sh_degree=0, max_splats=400)
    some = first_splats(data, data.cameras, settings, Watched(log=said.append))
    every = first_splats(data, data.cameras, FitSettings(sh_degree=0))
    assert said == ["beginning with 400 of 1600 first splats, as max_splats is 400"]
    assert len(some) == 400
    places = set(map(tuple, some.world_means()))
    assert len(places) == 400 and places <= set(map(tuple, every.world_means()))
    # A quarter of the discs, each of four times the area.
    torch.testing.assert_close(some.scales.median(), 2 * every.scales.median())
