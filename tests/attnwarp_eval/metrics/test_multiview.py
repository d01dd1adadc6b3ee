"""Oracles: skimage's colour difference at positions of one's own, brute force over answers, closed forms."""

import math

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from skimage.color import deltaE_ciede2000, rgb2lab

from attnwarp_eval import metrics
from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.truth import Geometry, two_view


@pytest.fixture(scope="module")
def pair():
    scene = load_scene("spheres").with_size(48, 48)
    return two_view(Geometry(scene), scene.source, scene.camera("yaw030"))


def noise(seed, size=48):
    return np.random.default_rng(seed).random((size, size, 3))


def brute(source, target, pair):
    """Mean CIEDE2000 with SciPy's bilinear sampling, pixels as the definition says."""
    x, y = np.moveaxis(pair.xy, -1, 0)
    h, w = source.shape[:2]
    inside = (x >= 0.5) & (x <= w - 0.5) & (y >= 0.5) & (y <= h - 0.5)
    counted = pair.visible & ~pair.edge & inside
    rows, columns = y[counted] - 0.5, x[counted] - 0.5
    light = np.stack(
        [map_coordinates(to_linear(source)[..., c], [rows, columns], order=1) for c in range(3)], -1
    )
    delta = deltaE_ciede2000(rgb2lab(target[counted]), rgb2lab(to_srgb(light)))
    return delta.mean(), counted.sum()


def test_disagreement_above_the_floor_is_the_difference_of_two_brute_force_means(pair):
    edited, truth = (noise(0), noise(1)), (noise(2), noise(2) * 0.9)
    figures = metrics.above_floor(edited, truth, pair)
    value, pixels = brute(*edited, pair)
    floor, _ = brute(*truth, pair)
    assert pixels > 200
    assert figures["multiview.pixels"] == pixels
    assert figures["multiview.delta_e"] == pytest.approx(value, rel=1e-9)
    assert figures["multiview.delta_e_floor"] == pytest.approx(floor, rel=1e-9)
    assert figures["multiview.delta_e_above"] == pytest.approx(value - floor, rel=1e-9)


def test_the_true_edited_views_are_their_own_floor(pair):
    truth = noise(0), noise(1)
    assert metrics.above_floor(truth, truth, pair)["multiview.delta_e_above"] == 0


def test_without_a_common_pixel_it_is_undefined(pair):
    nothing = np.zeros((48, 48), dtype=bool)
    figures = metrics.above_floor((noise(0), noise(1)), (noise(0), noise(1)), pair, mask=nothing)
    assert math.isnan(figures["multiview.delta_e_above"])
    assert figures["multiview.pixels"] == 0


def worlds(views=5, answers=3, size=6):
    random = np.random.default_rng(4)
    names = [f"v{k}" for k in range(views)]
    truth = {
        f"a{k}": {view: random.random((size, size, 3)) for view in names} for k in range(answers)
    }
    images = {view: random.random((size, size, 3)) for view in names}
    masks = {view: random.random((size, size)) < 0.4 for view in names}
    return names, truth, images, masks


def test_the_nearest_answer_of_a_view_is_that_of_least_error_in_its_mask():
    names, truth, images, masks = worlds()
    masks["v3"][:] = False
    nearest = metrics.answers_by_view(images, truth, masks)
    for view in names:
        if view == "v3":
            assert nearest[view] is None
            continue
        errors = [
            sum(
                float((images[view][r, c] - truth[name][view][r, c]) @ (images[view][r, c] - truth[name][view][r, c]))
                for r, c in np.argwhere(masks[view])
            )
            for name in truth
        ]  # fmt: skip
        assert nearest[view] == list(truth)[int(np.argmin(errors))]
    assert len(set(nearest.values())) > 2  # several answers and None


def test_fidelity_is_to_the_answer_that_is_nearest_over_all_views():
    names, truth, images, _ = worlds(size=16)
    everywhere = {name: dict.fromkeys(names, np.ones((16, 16), bool)) for name in truth}
    images = {view: 0.9 * truth["a1"][view] + 0.05 for view in names}
    images["v0"] = truth["a2"]["v0"]  # one view that gives another answer
    name, figures = metrics.edit_fidelity(images, truth, everywhere)
    assert name == "a1"
    for view in names:
        error = np.square(images[view] - truth["a1"][view]).mean()
        assert figures[view]["fidelity.mse"] == pytest.approx(error, rel=1e-9)
        assert figures[view]["fidelity.psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-9)
