"""Oracles: closed forms, NumPy's singular value decomposition."""

import numpy as np
import pytest
import torch

from attnwarp import Camera
from attnwarp.methods.pictures import (
    check_view_aspect,
    composite,
    edit_size,
    enlarged_change,
    full_size,
    mask_picture,
)


def test_the_change_of_a_small_edit_is_enlarged_and_the_detail_stays():
    original = np.random.default_rng(0).random((32, 32, 3)).astype(np.float32) * 0.5
    small = original.reshape(16, 2, 16, 2, 3).mean((1, 3))  # what averaging leaves
    result = enlarged_change(original, small + np.float32(0.25))
    assert np.allclose(result, original + 0.25, rtol=0, atol=1e-6)
    assert np.allclose(enlarged_change(original, small), original, rtol=0, atol=1e-6)


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_the_change_of_a_larger_edit_is_the_mean_of_its_pixels(factor):
    """Oracle: means of blocks."""
    original = np.full((16, 16, 3), 0.5, np.float32)
    edited = np.random.default_rng(0).random((16 * factor, 16 * factor, 3)).astype(np.float32)
    means = edited.reshape(16, factor, 16, factor, 3).mean((1, 3))
    assert np.allclose(enlarged_change(original, edited), means, rtol=0, atol=1e-6)


def test_an_edit_of_full_size_is_taken_as_it_is():
    original, edited = np.random.default_rng(0).random((2, 8, 8, 3)).astype(np.float32)
    assert np.array_equal(enlarged_change(original, edited), edited)


@pytest.mark.parametrize(("how", "outside"), [("none", 0.75), ("black", 0.0), ("original", 0.25)])
def test_outside_a_segment_stands_what_was_asked_for(how, outside):
    edited, original = (np.full((8, 8, 3), value, np.float32) for value in (0.75, 0.25))
    segment = np.zeros((16, 16), bool)  # of the full picture, twice as large
    segment[:, :8] = True
    result = composite(edited, original, segment, how, 0.0)
    assert (result[:, :4] == 0.75).all()
    assert (result[:, 4:] == np.float32(outside)).all()


@pytest.mark.parametrize("how", ["black", "original"])
def test_the_enlarged_change_of_an_edit_stays_in_its_segment(how):
    """Oracle: the picture before the edit, and black."""
    original = np.random.default_rng(0).random((32, 32, 3)).astype(np.float32)
    segment = np.zeros((32, 32), bool)
    segment[:, :14] = True  # ends within a pixel of the edit
    small = original.reshape(8, 4, 8, 4, 3).mean((1, 3))
    edited = composite(np.clip(small + 0.2, 0, 1), small, segment, how, 0.0)
    result = full_size(original, edited, segment, how, 0.0)
    assert np.array_equal(
        result[~segment], 0 * original[~segment] if how == "black" else original[~segment]
    )
    inner = np.s_[:, :8]  # a pixel of the edit away from the segment's end
    assert np.array_equal(result[inner], enlarged_change(original, edited)[inner])
    assert np.abs(enlarged_change(original, edited) - result)[~segment].max() > 0.05  # as it was


def test_a_blurred_segment_reaches_four_sigma_of_the_edits_pixels_beyond_its_end():
    original = np.full((64, 64, 3), 0.25, np.float32)
    segment = np.zeros((64, 64), bool)
    segment[:, :24] = True
    edited = np.full((32, 32, 3), 0.75, np.float32)  # everywhere
    row = full_size(original, edited, segment, "original", 1.5)[32, :, 0]
    assert (row[:36] == 0.75).all()  # 4 sigma of 1.5 px at half the size are 12 px
    assert (row[36:] == 0.25).all()


def test_a_blurred_segment_is_a_gaussian_step():
    from scipy.stats import norm

    edited, original = np.ones((65, 65, 3), np.float32), np.zeros((65, 65, 3), np.float32)
    segment = np.zeros((65, 65), bool)
    segment[:, :32] = True
    row = composite(edited, original, segment, "original", 1.5)[32, :, 0]
    # A pixel at distance d from the edge sees the normal tail; sampled at pixels, cut at 4 sigma.
    expected = norm.cdf((32 - (np.arange(65) + 0.5)) / 1.5)
    assert np.abs(row - expected)[8:-8].max() < 0.01


def test_sides_are_the_multiples_nearest_to_the_size_asked_for():
    assert edit_size(768, 1024, 512, 64) == (384, 512)
    assert edit_size(100, 70, None, 16) == (96, 64)
    assert edit_size(3, 300, 64, 16) == (16, 64)  # never empty


def test_a_mask_is_white_where_it_is_true():
    mask = torch.tensor([[True, False]])
    assert mask_picture(mask).tolist() == [[[255] * 3, [0] * 3]]


def test_a_picture_of_the_source_is_the_views_shape_at_any_size_or_what_an_editor_makes_of_it():
    """Oracle: sizes worked out by hand for a view of 1080 x 1920."""
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), width=1920, height=1080, fov_y=40, up=(0, 1, 0))
    # Halves, a third of a third, a seventh either way, the double; multiples of 32 and 64.
    for size in (
        (540, 960),
        (120, 213),
        (154, 274),
        (155, 275),
        (2160, 3840),
        (32, 64),
        (256, 448),
    ):
        check_view_aspect(size, camera, "picture")
    for size in ((1920, 1080), (1080, 1080), (540, 1000), (512, 512)):
        with pytest.raises(ValueError, match="picture: got .* expected the aspect ratio of 1080 x"):
            check_view_aspect(size, camera, "picture")
