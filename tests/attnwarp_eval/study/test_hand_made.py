"""Oracles: means in CIELAB, pixels counted, and the cut-out moved by hand."""

import numpy as np
import pytest
from skimage.color import rgb2lab

from attnwarp_eval.study.hand_made import COVER, KINDS, hand_made

H, W = 24, 32


@pytest.fixture
def views():
    """A textured view, the same with a red object, and the object's mask."""
    rng = np.random.default_rng(0)
    original = rng.uniform(0.35, 0.5, (H, W, 3)).astype(np.float32)
    mask = np.zeros((H, W), bool)
    mask[6:18, 8:24] = True
    truth = original.copy()
    truth[mask] *= np.float32([1.2, 0.6, 0.6])
    return original, truth, mask


def test_only_the_object_changes_and_by_the_same_bits_each_time(views):
    original, truth, mask = views
    for kind in KINDS:
        picture = hand_made(kind, original, truth, mask, 3)
        assert picture.dtype == np.float32 and picture.min() >= 0 and picture.max() <= 1
        changed = (picture != original).any(-1)
        assert changed.any() and not (changed & ~mask)[: 6 + 11, : 8 + 15].any()
        assert (hand_made(kind, original, truth, mask, 3) == picture).all()


def test_recolouring_gives_the_true_mean_colour_and_keeps_the_texture(views):
    original, truth, mask = views
    picture = hand_made("recoloured", original, truth, mask)
    before, after, wanted = (rgb2lab(image)[mask] for image in (original, picture, truth))
    np.testing.assert_allclose(after.mean(0), wanted.mean(0), atol=0.05)
    np.testing.assert_allclose(after - after.mean(0), before - before.mean(0), atol=0.2)
    assert (picture[~mask] == original[~mask]).all()


def test_paint_has_the_true_mean_colour_and_covers_most_of_the_object(views):
    original, truth, mask = views
    picture = hand_made("painted", original, truth, mask)
    painted = (picture != original).any(-1)
    assert 0.5 < painted[mask].mean() <= 1 and not painted[~mask].any()
    expected = (1 - COVER) * original + COVER * truth[mask].mean(0)
    np.testing.assert_allclose(picture[painted], expected[painted], atol=1e-6)


def test_a_cut_out_lies_one_pixel_off_its_place(views):
    original, truth, mask = views
    picture = hand_made("pasted", original, truth, mask)
    expected = original.copy()
    # One pixel inside the edge, moved right and down by one.
    expected[8:18, 10:24] = truth[7:17, 9:23]
    assert (picture == expected).all()


def test_an_object_out_of_sight_is_refused(views):
    original, truth, _ = views
    with pytest.raises(ValueError, match="shows nothing of the edited object"):
        hand_made("painted", original, truth, np.zeros((H, W), bool))
