"""Fidelity to the truth of an edit: figures by hand, and the edits that scenes name."""

import math

import numpy as np
import pytest
from direct_light import direct

from attnwarp_eval import metrics
from attnwarp_eval.truth import Geometry, appearance, to_srgb
from attnwarp_eval.truth.edits import edit_mask

SIZE = 48


def disc():
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    return x**2 + y**2 < 14**2


def by_hand(inside, outside):
    """A truth, and a picture off by a constant inside the object and another outside of it."""
    mask = disc()
    truth = np.random.default_rng(0).uniform(0.3, 0.6, (SIZE, SIZE, 3))
    return truth + np.where(mask, inside, outside)[..., None], truth, mask


def test_inside_and_outside_are_told_apart():
    image, truth, mask = by_hand(0.1, 0.01)
    result = metrics.fidelity(image, truth, mask)
    assert result["fidelity.psnr.inside"] == pytest.approx(20, abs=1e-9)
    assert result["fidelity.psnr.outside"] == pytest.approx(40, abs=1e-9)
    assert result["fidelity.mse"] == pytest.approx(
        (mask.mean() * 1e-2 + (~mask).mean() * 1e-4), rel=1e-9
    )
    assert result["fidelity.ssim.outside"] > result["fidelity.ssim.inside"]
    assert "fidelity.preserved_psnr" not in result and "fidelity.distance" not in result


def test_the_pixels_on_the_outline_count_in_neither():
    image, truth, mask = by_hand(0.1, 0.01)
    rim = np.zeros_like(mask)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            rim[1:-1, 1:-1] |= mask[1:-1, 1:-1] != np.roll(mask, (dy, dx), (0, 1))[1:-1, 1:-1]
    spoiled = np.where(rim[..., None], 1.0, image)
    expected, result = metrics.fidelity(image, truth, mask), metrics.fidelity(spoiled, truth, mask)
    for name in (
        "fidelity.psnr.inside",
        "fidelity.psnr.outside",
        "fidelity.ssim.inside",
        "fidelity.ssim.outside",
    ):
        assert result[name] == expected[name]
    assert (
        result["fidelity.pixels.inside"] + result["fidelity.pixels.outside"] + rim.sum() == SIZE**2
    )
    assert result["fidelity.psnr"] < expected["fidelity.psnr"]


def test_preservation_is_against_the_original_and_outside():
    original = np.random.default_rng(1).uniform(0.2, 0.7, (SIZE, SIZE, 3))
    mask = disc()
    truth = np.where(mask[..., None], 1 - original, original)
    spilled = np.where(
        mask[..., None], truth, original + 0.1
    )  # the right object in a picture that was painted over
    result = metrics.fidelity(spilled, truth, mask, original_srgb=original)
    assert result["fidelity.psnr.inside"] == math.inf
    assert result["fidelity.preserved_psnr"] == pytest.approx(20, abs=1e-9)
    untouched = metrics.fidelity(original, truth, mask, original_srgb=original)
    assert (
        untouched["fidelity.preserved_psnr"] == math.inf
        and untouched["fidelity.preserved_mse"] == 0
    )
    assert untouched["fidelity.preserved_ssim"] == pytest.approx(1, abs=1e-12)
    assert untouched["fidelity.psnr.inside"] < 15


def mean_difference(image, truth):
    return float(np.abs(image - truth).mean())


def test_a_distance_that_is_a_mean_over_places_becomes_that_of_the_region():
    image, truth, mask = by_hand(0.1, 0.03)
    result = metrics.fidelity(image, truth, mask, original_srgb=truth, distance=mean_difference)
    assert result["fidelity.distance.inside"] == pytest.approx(0.1, abs=1e-12)
    assert result["fidelity.distance.outside"] == pytest.approx(0.03, abs=1e-12)
    assert result["fidelity.preserved_distance"] == pytest.approx(0.03, abs=1e-12)
    assert result["fidelity.distance"] == mean_difference(image, truth)


@pytest.mark.parametrize(("fill", "empty"), [(True, "outside"), (False, "inside")])
def test_an_empty_region_is_undefined_and_counted(fill, empty):
    # Hard case 35; True is what an edit of the light has.
    image, truth, _ = by_hand(0.1, 0.01)
    mask = np.full((SIZE, SIZE), fill)
    result = metrics.fidelity(image, truth, mask, original_srgb=truth, distance=mean_difference)
    full = "inside" if fill else "outside"
    assert result[f"fidelity.pixels.{empty}"] == 0 and result[f"fidelity.pixels.{full}"] == SIZE**2
    for name in ("mse", "psnr", "ssim", "distance"):
        assert math.isnan(result[f"fidelity.{name}.{empty}"])
        assert result[f"fidelity.{name}.{full}"] == result[f"fidelity.{name}"]
    assert math.isnan(result["fidelity.preserved_psnr"]) is fill
    assert math.isnan(result["fidelity.ms_ssim"])  # 48 px


def test_one_pixel():
    # Hard case 14.
    result = metrics.fidelity(np.zeros((1, 1, 3)), np.ones((1, 1, 3)), np.ones((1, 1), bool))
    assert result["fidelity.psnr"] == result["fidelity.psnr.inside"] == 0
    assert math.isnan(result["fidelity.ssim"]) and math.isnan(result["fidelity.psnr.outside"])


def test_the_nearest_answer_is_one_for_all_views():
    def flat(value):
        return np.full((4, 4, 3), value)

    answers = {"dark": {"a": flat(0.2), "b": flat(0.2)}, "light": {"a": flat(0.8), "b": flat(0.8)}}
    assert metrics.nearest_answer({"a": flat(0.3), "b": flat(0.25)}, answers)[0] == "dark"
    # One view each way: neither is met, and the nearer of the two overall is said.
    name, result = metrics.nearest_answer({"a": flat(0.3), "b": flat(0.75)}, answers)
    assert name == "light" and result["light"] == pytest.approx(
        -10 * math.log10((0.25 + 0.0025) / 2)
    )
    assert metrics.nearest_answer({"a": flat(0.8), "b": flat(0.8)}, answers) == (
        "light", {"dark": pytest.approx(-10 * math.log10(0.36)), "light": math.inf},
    )  # fmt: skip
    nothing = {view: np.zeros((4, 4), bool) for view in "ab"}
    assert metrics.nearest_answer({"a": flat(0.2), "b": flat(0.2)}, answers, nothing)[0] is None
    with pytest.raises(
        ValueError,
        match=r"answers\['dark'\]: got views \['a', 'b'\], expected those of images, \['a'\]",
    ):
        metrics.nearest_answer({"a": flat(0.2)}, answers)
    with pytest.raises(ValueError, match="answers: got none"):
        metrics.nearest_answer({"a": flat(0.2)}, {})


@pytest.mark.usefixtures("coarse_textures")
def test_the_truth_of_an_edit_is_faithful_and_preserves_the_rest_and_the_unedited_view_is_not():
    # Direct light: of more bounces the edited bear lights its surroundings otherwise.
    scene = direct("bear").with_size(64, 64)
    hits = Geometry(scene).trace(scene.source)
    original, truth = (
        to_srgb(appearance(world, scene.source, spp=4)) for world in (scene, scene.edited("polar"))
    )
    mask = edit_mask(scene, "polar", hits)
    best = metrics.fidelity(truth, truth, mask, original_srgb=original)
    # The bear's surroundings are lit alike, so off its outline the truth leaves them as they were,
    # bit for bit.
    assert (
        best["fidelity.psnr"]
        == best["fidelity.psnr.inside"]
        == best["fidelity.preserved_psnr"]
        == math.inf
    )
    nothing = metrics.fidelity(original, truth, mask, original_srgb=original)
    assert nothing["fidelity.psnr.inside"] < 15 and nothing["fidelity.preserved_psnr"] == math.inf
