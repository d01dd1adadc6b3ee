"""PSNR, SSIM and MS-SSIM against scikit-image, torchmetrics, brute force and closed forms; hard
cases 14, 31, 34 to 36, 40.
"""

import math

import numpy as np
import pytest
import skimage.metrics
import torch
from further import further
from imported_modules import modules_after
from torchmetrics.functional.image import (
    multiscale_structural_similarity_index_measure,
    peak_signal_noise_ratio,
    structural_similarity_index_measure,
)

from attnwarp_eval import metrics
from attnwarp_eval.colors import to_linear
from attnwarp_eval.metrics.registry import METRICS, metric


def pictures(height=40, width=52, seed=0, noise=0.15):
    """A smooth picture and the same with noise, as edited views are: not two pictures of noise."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 17.0
    image = np.stack(
        [0.5 + 0.4 * np.sin(x * (k + 1) + y + random.uniform(0, 6)) for k in range(3)], axis=-1
    )
    return image, np.clip(image + noise * random.standard_normal(image.shape), 0, 1)


def tensor(image):
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]


SIZES = [(11, 11), (12, 31), (40, 52), (64, 64), (177, 200)]


@pytest.mark.parametrize("size", SIZES)
def test_mse_and_psnr_are_those_of_scikit_image_and_torchmetrics(size):
    image, target = pictures(*size)
    assert metrics.mse(image, target) == pytest.approx(
        skimage.metrics.mean_squared_error(image, target), rel=1e-12
    )
    expected = skimage.metrics.peak_signal_noise_ratio(target, image, data_range=1.0)
    assert metrics.psnr(image, target) == pytest.approx(expected, abs=1e-10)
    other = peak_signal_noise_ratio(tensor(image), tensor(target), data_range=1.0)
    # Its factor 10 / ln 10 is float32: 5e-8 of 17 dB.
    assert metrics.psnr(image, target) == pytest.approx(float(other), abs=2e-6)


@pytest.mark.parametrize("size", SIZES)
def test_ssim_is_that_of_scikit_image_and_torchmetrics(size):
    image, target = pictures(*size)
    expected, full = skimage.metrics.structural_similarity(
        image,
        target,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        channel_axis=-1,
        data_range=1.0,
        full=True,
    )
    assert metrics.ssim(image, target) == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(
        metrics.ssim_map(image, target), full[5:-5, 5:-5].mean(-1), rtol=0, atol=1e-12
    )
    _, other = structural_similarity_index_measure(
        tensor(image), tensor(target), data_range=1.0, return_full_image=True
    )
    # torchmetrics' own mean counts windows over a reflected border too; its map without them is
    # ours.
    windows = other[0].numpy()[:, 5:-5, 5:-5]
    # Its kernel is normalised in another order; 1e-10 is rounding.
    assert metrics.ssim(image, target) == pytest.approx(windows.mean(), abs=1e-10)


def oracle_ms_ssim(image, target):
    """From torchmetrics' SSIM and contrast-structure at each scale, without its reflected border at
    the coarsest.
    """
    a, b = tensor(image), tensor(target)
    product = 1.0
    for scale, weight in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        if scale:
            a, b = (torch.nn.functional.avg_pool2d(x, 2) for x in (a, b))
        _, structure = structural_similarity_index_measure(
            a, b, data_range=1.0, return_contrast_sensitivity=True
        )
        _, full = structural_similarity_index_measure(a, b, data_range=1.0, return_full_image=True)
        term = float(full[..., 5:-5, 5:-5].mean()) if scale == 4 else float(structure)
        product *= max(term, 0.0) ** weight
    return product, float(full.mean()), float(full[..., 5:-5, 5:-5].mean())


@pytest.mark.parametrize(
    ("size", "noise"), further(((177, 191), 0.4), ((176, 176), 0.05), ((224, 180), 0.15))
)
def test_ms_ssim_is_that_of_torchmetrics(size, noise):
    image, target = pictures(*size, noise=noise)
    expected, bordered, valid = oracle_ms_ssim(image, target)
    got = metrics.ms_ssim(image, target)
    assert got == pytest.approx(expected, abs=1e-10)
    whole = float(
        multiscale_structural_similarity_index_measure(
            tensor(image), tensor(target), data_range=1.0
        )
    )
    # All that separates us from its public figure is the border of the coarsest scale, which the
    # paper's code leaves out. Its exponents are float32.
    assert got * (bordered / valid) ** 0.1333 == pytest.approx(whole, abs=1e-8)


def test_ms_ssim_of_negatives_is_zero_and_not_a_complex_number():
    image, _ = pictures(176, 176)
    assert metrics.ms_ssim(image, 1 - image) == 0


@pytest.mark.parametrize("size", [(1, 1), (1, 30), (10, 30), (40, 52), (180, 180)])
def test_identical_pictures(size):
    # Hard case 34: +inf, kept apart; and SSIM 1, where there is one (hard case 14).
    image, _ = pictures(*size)
    result = metrics.image_error(image, image.copy())
    assert result["image.mse"] == result["image.mse_linear"] == 0
    assert result["image.psnr"] == result["image.psnr_linear"] == math.inf
    assert metrics.ssim_map(image, image).size == max(size[0] - 10, 0) * max(size[1] - 10, 0)
    for name, least in (("image.ssim", 11), ("image.ms_ssim", 176)):
        if min(size) < least:
            assert math.isnan(result[name])
        else:
            assert result[name] == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (40, 52), (180, 180)])
def test_an_empty_mask_leaves_everything_undefined(size):
    # Hard case 35.
    image, target = pictures(*size)
    result = metrics.image_error(image, target, np.zeros(size, bool))
    assert result.pop("image.pixels") == 0
    assert all(math.isnan(value) for value in result.values())


def brute_ssim(image, target, mask):
    """Windows one by one, textbook formula, two passes for the variances."""
    taps = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    weights = np.outer(taps, taps) / taps.sum() ** 2
    result = np.full((image.shape[0] - 10, image.shape[1] - 10), np.nan)
    for i in range(result.shape[0]):
        for j in range(result.shape[1]):
            at = slice(i, i + 11), slice(j, j + 11)
            if not mask[at].all():
                continue
            channels = []
            for c in range(3):
                x, y = image[at][..., c], target[at][..., c]
                mx, my = (weights * x).sum(), (weights * y).sum()
                vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
                cov = (weights * (x - mx) * (y - my)).sum()
                channels.append(
                    (2 * mx * my + 1e-4)
                    * (2 * cov + 9e-4)
                    / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
                )
            result[i, j] = np.mean(channels)
    return result


@pytest.mark.parametrize("seed", range(3))
def test_masked_ssim_is_the_mean_over_windows_wholly_inside(seed):
    image, target = pictures(26, 31, seed)
    mask = np.ones((26, 31), bool)
    mask[tuple(np.random.default_rng(seed).integers(0, (26, 31), (6, 2)).T)] = False
    expected = brute_ssim(image, target, mask)
    assert 0 < np.isfinite(expected).sum() < expected.size
    np.testing.assert_allclose(metrics.ssim_map(image, target, mask), expected, rtol=0, atol=1e-12)
    assert metrics.ssim(image, target, mask) == pytest.approx(np.nanmean(expected), abs=1e-12)


def test_ssim_of_a_mask_thinner_than_the_window_is_undefined():
    image, target = pictures(40, 40)
    mask = np.zeros((40, 40), bool)
    mask[:10] = True
    assert math.isnan(metrics.ssim(image, target, mask))
    assert math.isfinite(metrics.psnr(image, target, mask))


def test_ms_ssim_in_a_rectangle_is_that_of_the_rectangle_alone():
    # Aligned to 16 px, so that the blocks of all five scales are the crop's own.
    image, target = pictures(224, 208)
    mask = np.zeros((224, 208), bool)
    mask[16:208, 32:208] = True
    expected = metrics.ms_ssim(image[16:208, 32:208], target[16:208, 32:208])
    assert metrics.ms_ssim(image, target, mask) == pytest.approx(expected, abs=1e-12)
    # The coarsest scale has two windows, and a hole of one pixel in the middle reaches both.
    mask[100, 100] = False
    assert math.isnan(metrics.ms_ssim(image, target, mask))


@pytest.mark.parametrize("filling", [np.nan, np.inf, -3.0, 1e300])
def test_what_lies_outside_the_mask_changes_nothing(filling):
    # Hard case 36.
    image, target = pictures(180, 180)
    mask = np.zeros((180, 180), bool)
    mask[:178, :178] = True
    expected = metrics.image_error(image, target, mask)
    spoiled = [np.where(mask[..., None], x, filling) for x in (image, target)]
    assert metrics.image_error(*spoiled, mask) == expected
    assert all(math.isfinite(value) for value in expected.values())


def test_values_that_are_no_picture_are_refused_with_their_place():
    image, target = pictures()
    spoiled = target.copy()
    spoiled[3, 4, 1] = np.nan
    with pytest.raises(
        ValueError, match="target: nan at row 3, column 4, channel 1; 1 values are NaN or outside"
    ):
        metrics.mse(image, spoiled)
    with pytest.raises(
        ValueError,
        match=r"image: got uint8, expected float32 or float64 in \[0, 1\]; divide by 255",
    ):
        metrics.psnr(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match=r"target: got 40 x 51 pixels \(H x W\), expected 40 x 52"):
        metrics.mse(image, target[:, 1:])
    with pytest.raises(ValueError, match=r"image: got shape \(40, 52\), expected \(H, W, 3\)"):
        metrics.mse(image[..., 0], target[..., 0])
    with pytest.raises(ValueError, match="mask: got float64, expected bool"):
        metrics.mse(image, target, np.ones((40, 52)))
    with pytest.raises(ValueError, match="image_srgb: -0.1 at row 0"):
        metrics.image_error(image - image - 0.1, target)


def test_linear_figures_are_those_of_the_linear_pictures():
    image, target = pictures()
    result = metrics.image_error(image, target)
    assert result["image.mse_linear"] == metrics.mse(to_linear(image), to_linear(target))
    assert result["image.psnr_linear"] == metrics.psnr(to_linear(image), to_linear(target))
    assert result["image.mse_linear"] != result["image.mse"]


def test_single_precision_is_measured_in_double():
    # Hard case 31's kin: an error of 1e-6 is squared to 1e-12, below float32's resolution of a
    # mean.
    image = np.full((200, 200, 3), 0.5, np.float32)
    target = image + np.float32(2**-20)
    assert metrics.mse(image, target) == pytest.approx(2.0**-40, rel=1e-12)
    assert metrics.psnr(torch.from_numpy(image), torch.from_numpy(target)) == pytest.approx(
        120.4, abs=0.05
    )


def test_edit_psnr_averages_the_error_and_not_the_decibels():
    flat = np.full((4, 5, 3), 0.5)
    edited = {"b": flat + 0.1, "a": flat + 0.01, "same": flat, "unseen": flat}
    rendered = dict.fromkeys(edited, flat)
    masks = {view: np.full((4, 5), view != "unseen") for view in edited}
    got = metrics.edit_psnr(edited, rendered, masks)
    assert got.views == ("b", "a", "same", "unseen")  # in the order they came
    assert got.psnr[:3] == pytest.approx((20, 40, math.inf)) and math.isnan(got.psnr[3])
    assert got.pooled == pytest.approx(-10 * math.log10((1e-2 + 1e-4 + 0) / 3), abs=1e-9)
    assert got.mean_finite == pytest.approx(30, abs=1e-9)
    assert (got.identical, got.undefined) == (1, 1)
    figures = got.figures()
    assert figures["edit.psnr.b"] == pytest.approx(20) and figures["edit.mse.b"] == pytest.approx(
        0.01
    )
    assert (
        figures["edit.views"],
        figures["edit.views_identical"],
        figures["edit.views_undefined"],
    ) == (4, 1, 1)


@pytest.mark.parametrize(
    ("psnr", "pooled"),
    [((math.inf, math.inf), math.inf), ((math.nan, math.nan), math.nan), ((), math.nan)],
)
def test_edit_psnr_where_no_view_has_a_finite_one(psnr, pooled):
    mse = tuple(0.0 if value == math.inf else value for value in psnr)
    got = metrics.EditPsnr(tuple(map(str, range(len(psnr)))), mse)
    assert got.pooled == pytest.approx(pooled, nan_ok=True)
    assert math.isnan(got.mean_finite)
    assert got.identical + got.undefined == len(psnr)


@pytest.mark.door
def test_edit_psnr_refuses_views_that_do_not_match():
    flat = np.full((2, 2, 3), 0.5)
    with pytest.raises(
        ValueError, match="rendered: got no view 'b', expected the 2 views of edited"
    ):
        metrics.edit_psnr({"a": flat, "b": flat}, {"a": flat})
    with pytest.raises(ValueError, match="masks: got a view 'c' that is not among the edited ones"):
        metrics.edit_psnr(
            {"a": flat}, {"a": flat}, {"a": np.ones((2, 2), bool), "c": np.ones((2, 2), bool)}
        )
    with pytest.raises(ValueError, match=r"rendered\['a'\]: 1.5 at row 0"):
        metrics.edit_psnr({"a": flat}, {"a": flat * 3})


def test_every_figure_is_registered():
    image, target = pictures(12, 12)
    names = {
        *metrics.image_error(image, target),
        *metrics.edit_psnr({"yaw.010": image}, {"yaw.010": target}).figures(),
    }
    for name in names:
        assert metric(name).unit
    assert METRICS["image.psnr"].direction == "higher" and METRICS["image.mse"].direction == "lower"


def test_importing_metrics_imports_nothing_heavy():
    heavy = {"torch", "cv2", "scipy", "skimage", "mitsuba", "open3d", "pyvista", "numba"}
    modules = modules_after("import attnwarp_eval.metrics")
    assert "attnwarp_eval.metrics" in modules and not modules & heavy


def local(image, target):
    """A distance that is a mean over places and sees nothing around them."""
    return float(np.abs(image - target).mean())


def blurring(image, target):
    """One that sees 7 x 7 px around each place, as a network does."""
    from scipy.ndimage import uniform_filter

    return float(
        np.abs(uniform_filter(image, (7, 7, 1)) - uniform_filter(target, (7, 7, 1))).mean()
    )


@pytest.mark.parametrize("distance", [local, blurring])
def test_a_mask_of_everything_is_no_mask_for_a_perceptual_distance(distance):
    image, target = pictures()
    whole = distance(image, target)
    assert metrics.perceptual(image, target, distance) == whole > 0
    assert metrics.perceptual(image, target, distance, np.ones(image.shape[:2], bool)) == whole


@pytest.mark.parametrize("garbage", [0.0, 1.0, 7.5, np.nan, -np.inf])
@pytest.mark.parametrize("distance", [local, blurring])
def test_what_is_equal_inside_the_mask_is_at_distance_0_whatever_is_outside(distance, garbage):
    _, target = pictures()
    mask = np.zeros(target.shape[:2], bool)
    mask[8:30, 11:41] = True
    spoilt = np.where(mask[..., None], target, garbage)
    assert metrics.perceptual(spoilt, target, distance, mask) == 0
    assert metrics.perceptual(target, spoilt, distance, mask) == 0
    image, _ = pictures()
    known = metrics.perceptual(image, target, distance, mask)
    assert known > 0
    assert (
        metrics.perceptual(np.where(mask[..., None], image, garbage), target, distance, mask)
        == known
    )


def test_a_masked_distance_is_the_mean_over_the_mask_apart_from_the_border():
    image, target = pictures()
    mask = np.zeros(target.shape[:2], bool)
    mask[8:30, 11:41] = True
    expected = np.abs(image - target)[8:30, 11:41].mean()
    assert metrics.perceptual(image, target, local, mask) == pytest.approx(expected, rel=1e-12)
    # All of a mask in one colour: what spills over is what the border misses, to the last digit.
    shifted = np.clip(target, 0.1, 0.8)
    result = metrics.perceptual(shifted + 0.1, shifted, blurring, mask)
    assert result == pytest.approx(0.1, rel=1e-9)


def test_an_empty_mask_has_no_distance_and_asks_for_none():
    image, target = pictures()
    assert math.isnan(
        metrics.perceptual(image, target, lambda a, b: 1 / 0, np.zeros(image.shape[:2], bool))
    )
