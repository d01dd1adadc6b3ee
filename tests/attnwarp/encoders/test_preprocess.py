"""Pictures reach a network as its published pipeline brings them there."""

import numpy as np
import pytest
from PIL import Image

from attnwarp.encoders.preprocess import center_crop, resize


@pytest.fixture
def random():
    return np.random.default_rng(0)


@pytest.mark.parametrize(
    "resample", [Image.Resampling.BICUBIC, Image.Resampling.BILINEAR, Image.Resampling.LANCZOS]
)
@pytest.mark.parametrize("to", [(20, 31), (61, 90), (40, 17)])
def test_resizing_is_pillow_s_apart_from_its_rounding(random, resample, to):
    picture = random.integers(0, 256, (40, 50, 3), dtype=np.uint8)
    expected = np.asarray(Image.fromarray(picture).resize(to[::-1], resample), dtype=np.float64)
    got = 255 * resize((picture / 255).astype(np.float32), to, int(resample))
    # 8 bits are rounded twice, after the rows and after the columns, the first of which the second
    # one's weights (whose magnitudes sum to at most 1.5) may stretch: 0.5 * 1.5 + 0.5.
    assert np.abs(got - expected).max() < 1.25
    assert np.abs(got - expected).mean() < 0.35


def test_making_a_picture_smaller_averages_instead_of_skipping_pixels():
    stripes = np.zeros((64, 64, 3), np.float32)
    stripes[:, ::2] = 1
    assert (
        np.abs(resize(stripes, (8, 8)) - 0.5).max() < 0.02
    )  # without a wider filter it would be 0 or 1


def test_a_cubic_s_overshoot_is_cut_off():
    step = np.zeros((8, 8, 3), np.float32)
    step[:, 4:] = 1
    large = resize(step, (64, 64))
    assert large.min() == 0 and large.max() == 1


def test_a_picture_of_the_right_size_is_not_touched(random):
    picture = random.random((32, 32, 3), dtype=np.float32)
    assert np.array_equal(resize(picture, (32, 32)), picture)


@pytest.mark.parametrize("shape", [(9, 14), (4, 14), (14, 5), (3, 4), (8, 8), (7, 9)])
def test_the_centre_is_cut_as_transformers_cuts_it(random, shape):
    from transformers import image_transforms

    picture = random.random((*shape, 3), dtype=np.float32)
    expected = image_transforms.center_crop(picture, (8, 8), input_data_format="channels_last")
    assert np.array_equal(center_crop(picture, (8, 8)), expected)
