"""Flaws of known size: brute force pixel by pixel, and a slope whose slide follows by hand."""

import dataclasses

import numpy as np
import pytest
from skimage.color import lab2lch, rgb2lab

from attnwarp.drift import drift
from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.truth import Geometry, two_view
from attnwarp_eval.two_view import HIDDEN
from attnwarp_lab.probes.audit.flaws import CONDITIONS, COUNTED, FLAWS, Edited
from benchmarks.drift import Formula

SIZE = 48


@pytest.fixture(scope="module")
def edited():
    scene = load_scene("spheres").with_size(SIZE, SIZE)
    pair = two_view(Geometry(scene), scene.source, scene.camera("yaw030"))
    pictures = np.random.default_rng(0).uniform(0.2, 0.8, (5, SIZE, SIZE, 3))
    source, before, after, another, misdirected = pictures
    ids, counts = np.unique(pair.hits.object_id[pair.hits.valid], return_counts=True)
    mask = pair.hits.object_id == ids[np.argsort(counts)[-2]]  # a thing, not the ground
    return Edited(pair, source, before, after, another, mask, misdirected=misdirected)


def flawed(edited, name):
    flaw, size = CONDITIONS[name]
    return flaw.make(edited, size)


def changed(edited, name):
    return np.abs(flawed(edited, name) - edited.after).max(axis=-1) > 1e-9


@pytest.mark.parametrize("name", [name for name in CONDITIONS if name != "elsewhere=1"])
def test_a_flaw_is_a_picture_and_most_stay_in_their_place(edited, name):
    picture = flawed(edited, name)
    assert picture.shape == edited.after.shape
    assert picture.min() >= 0
    assert picture.max() <= 1
    assert changed(edited, name).any()
    if name.partition("=")[0] in ("hue", "hue_all", "slid") or name == "answer=0.3":
        assert not changed(edited, name)[~edited.mask].any()


def test_another_answer_covers_its_share_of_the_object_around_one_point(edited):
    place = changed(edited, "answer=0.3")
    assert place.sum() == round(0.3 * edited.mask.sum())
    points = edited.pair.hits.point
    center = min(points[place], key=lambda p: np.linalg.norm(points[place] - p, axis=1).max())
    reach = np.linalg.norm(points[place] - center, axis=1).max()
    outside = edited.mask & ~place
    assert np.linalg.norm(points[outside] - center, axis=1).min() > 0.3 * reach
    np.testing.assert_array_equal(flawed(edited, "answer=1"), edited.another)
    np.testing.assert_array_equal(flawed(edited, "unedited=1"), edited.before)
    assert flawed(edited, "elsewhere=1") is None


def test_a_hue_is_turned_by_its_degrees_and_keeps_lightness_and_chroma(edited):
    soft = dataclasses.replace(edited, after=0.5 + 0.1 * (edited.after - 0.5))  # stays in gamut
    old, new = (
        lab2lch(rgb2lab(image))[soft.mask] for image in (soft.after, flawed(soft, "hue=45"))
    )
    np.testing.assert_allclose(new[:, :2], old[:, :2], atol=0.05)
    turn = np.degrees(new[:, 2] - old[:, 2]) % 360
    np.testing.assert_allclose(turn[old[:, 1] > 1], 45, atol=2)


def test_what_hides_is_doubled_where_it_hides(edited):
    pair, result = edited.pair, flawed(edited, "doubled=1")
    count = 0
    for row, column in np.argwhere(pair.label == HIDDEN):
        x, y = pair.xy[row, column]
        if not (0.5 <= x <= SIZE - 0.5 and 0.5 <= y <= SIZE - 0.5):
            continue
        i, j = int(y - 0.5), int(x - 0.5)
        v, u = y - 0.5 - i, x - 0.5 - j
        taps = to_linear(edited.source)[i : i + 2, j : j + 2]
        weights = np.outer([1 - v, v], [1 - u, u])[: taps.shape[0], : taps.shape[1]]
        expected = to_srgb((weights[..., None] * taps).sum(axis=(0, 1)))
        np.testing.assert_allclose(result[row, column], expected, atol=1e-9)
        count += 1
    assert count > 10
    assert not changed(edited, "doubled=1")[pair.label != HIDDEN].any()


@pytest.mark.parametrize("size", [1.0, 2.0])
def test_texture_slides_by_its_pixels_along_the_surface(edited, size):
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    slope = np.array([0.004, 0.007])  # of linear light, per px
    light = 0.2 + np.repeat((x * slope[0] + y * slope[1])[..., None], 3, axis=-1)
    soft = dataclasses.replace(
        edited, after=to_srgb(light), mask=np.ones_like(edited.mask), _kept={}
    )
    moved = to_linear(flawed(soft, f"slid={size:g}")) - light
    inside = (slice(4, -4),) * 2
    # A step along the surface, by the camera's own projection of two points a little apart.
    along = soft.along()[inside]
    lengths = np.linalg.norm(along, axis=-1)
    seen = edited.pair.hits.valid[inside]
    np.testing.assert_allclose(lengths[seen], 1, atol=1e-6)
    assert not lengths[~seen].any()
    np.testing.assert_allclose(moved[inside][..., 0], size * along @ slope, atol=1e-6)


def test_paint_bleeds_by_its_pixels(edited):
    inside = np.argwhere(edited.mask)
    for size in (4, 8):
        for row, column in np.argwhere(changed(edited, f"bled={size}")):
            assert not edited.mask[row, column]
            assert np.hypot(*(inside - [row, column]).T).min() <= size
    assert changed(edited, "bled=8").sum() > changed(edited, "bled=4").sum()


def test_ghosts_and_weak_edits_are_sums_of_light(edited):
    for name, share, picture in (("ghost", 0.25, edited.another), ("weak_all", 0.5, edited.before)):
        expected = (1 - share) * to_linear(edited.after) + share * to_linear(picture)
        found = to_linear(flawed(edited, f"{name}={share:g}"))
        np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(flawed(edited, "weak_all=1"), edited.before, atol=1e-9)
    np.testing.assert_array_equal(flawed(edited, "misdirected_all=1"), edited.misdirected)


def test_noise_has_its_size_and_is_another_in_each_view(edited):
    noise, other = (
        flawed(dataclasses.replace(edited, place=place), "noise_all=0.03") - edited.after
        for place in (0, 1)
    )
    assert noise.std() == pytest.approx(0.03, rel=0.05)
    assert abs(np.corrcoef(noise.ravel(), other.ravel())[0, 1]) < 0.05  # 6912 draws: 0.012
    np.testing.assert_array_equal(flawed(edited, "noise=0.03") - edited.after, noise)


def test_blur_keeps_the_light_and_a_moved_picture_lies_two_pixels_to_the_right(edited):
    point = np.zeros((SIZE, SIZE, 3))
    point[24, 24] = 1
    of = dataclasses.replace(edited, after=point)
    light = to_linear(flawed(of, "blur=2"))[..., 0]
    assert light.sum() == pytest.approx(1, rel=1e-6)
    variance = (light.sum(0) * (np.arange(SIZE) - 24.0) ** 2).sum()
    assert np.sqrt(variance) == pytest.approx(2, rel=0.01)  # sampled, cut at four sigma
    np.testing.assert_array_equal(np.argwhere(flawed(of, "moved=2")[..., 0] > 0.5), [[24, 26]])


@pytest.mark.parametrize(
    ("name", "motion"),
    [("moved=8", (8, 0, 0, 0)), ("zoomed=2", (0, 0, 2, 0)), ("turned=0.5", (0, 0, 0, 0.5))],
)
def test_a_picture_is_moved_by_its_size_as_the_drift_of_an_edit_finds(edited, name, motion):
    of = dataclasses.replace(edited, after=Formula(2).picture(128))
    found = drift(of.after, flawed(of, name))
    values = np.array([found.right, found.down, found.scale, found.turn])
    np.testing.assert_allclose(values, motion, atol=0.1)


def test_texture_is_removed_by_its_share_within_each_object(edited):
    half, flat = (to_linear(flawed(edited, f"flat={size}")) for size in ("0.5", "1"))
    light = to_linear(edited.after)
    np.testing.assert_allclose(half, (light + flat) / 2, atol=1e-9)
    ids = edited.pair.hits.object_id
    for one in np.unique(ids):
        here = ids == one
        mean = np.broadcast_to(light[here].mean(axis=0), (here.sum(), 3))
        np.testing.assert_allclose(flat[here], mean, atol=1e-9)


def test_sizes_rise_and_the_shown_one_is_among_them():
    for flaw in FLAWS:
        assert list(flaw.sizes) == sorted(flaw.sizes)
        assert flaw.reference in flaw.sizes
    assert len(COUNTED) == 5 and not any(flaw.alike for flaw in COUNTED)
