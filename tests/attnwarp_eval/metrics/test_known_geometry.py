"""Agreement at known correspondences: one pixel at a time, torch's sampler, and pictures that agree
by construction.
"""

import math

import numpy as np
import pytest
import torch
from skimage.color import deltaE_ciede2000, rgb2lab

from attnwarp_eval import metrics
from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.metrics.known_geometry import CHANGED

SIZE = 24


def identity(size=SIZE):
    y, x = np.mgrid[:size, :size] + 0.5
    return np.stack([x, y], -1), np.ones((size, size), bool)


def pictures(seed, count):
    return list(np.random.default_rng(seed).random((count, SIZE, SIZE, 3)))


def color_at(image, x, y):
    """Bilinear in linear light, one tap at a time."""
    column, row = math.floor(x - 0.5), math.floor(y - 0.5)
    u, v = x - 0.5 - column, y - 0.5 - row
    linear = to_linear(image)
    total = np.zeros(3)
    for dy, wy in ((0, 1 - v), (1, v)):
        for dx, wx in ((0, 1 - u), (1, u)):
            if wx * wy:
                total += wx * wy * linear[row + dy, column + dx]
    return to_srgb(total)


def apart(a, b):
    return float(deltaE_ciede2000(rgb2lab(a), rgb2lab(b)))


def test_an_edit_is_judged_pixel_by_pixel_against_what_differed_before():
    old_source, old_target, new_source, new_target = pictures(0, 4)
    new_target[: SIZE // 2] = old_target[: SIZE // 2]  # not changed there
    new_source[: SIZE // 2] = old_source[: SIZE // 2]
    xy, accepted = identity()
    xy += np.array([0.3, -0.4])
    accepted[:, 5] = False
    added = []
    for row in range(SIZE):
        for column in range(SIZE):
            x, y = xy[row, column]
            if not accepted[row, column] or not (0.5 <= x <= SIZE - 0.5 and y >= 0.5):
                continue
            was, now = (color_at(image, x, y) for image in (old_source, new_source))
            before, after = old_target[row, column], new_target[row, column]
            if max(apart(was, now), apart(before, after)) >= CHANGED:
                added.append(apart(now, after) - apart(was, before))
    figures = metrics.edit_agreement(
        (old_source, old_target), (new_source, new_target), xy, accepted
    )
    assert figures["consistency.edit_pixels"] == len(added) < SIZE**2 * 0.6
    assert figures["consistency.edit_delta_e"] == pytest.approx(np.mean(added), abs=1e-9)
    assert figures["consistency.edit_delta_e_p90"] == pytest.approx(np.quantile(added, 0.9))


def test_an_edit_that_changes_nothing_has_no_figure_and_one_that_both_show_has_0():
    source, target, paint = pictures(1, 3)
    xy, accepted = identity()
    none = metrics.edit_agreement((source, target), (source, target), xy, accepted)
    assert none["consistency.edit_pixels"] == 0
    assert math.isnan(none["consistency.edit_delta_e"])
    same = metrics.edit_agreement((source, source), (paint, paint), xy, accepted)
    assert same["consistency.edit_delta_e"] == pytest.approx(0, abs=1e-9)
    highlight = np.clip(source + 0.2, 0, 1)  # only the target shows it, before the edit and after
    kept = metrics.edit_agreement((source, highlight), (paint, paint), xy, accepted)
    assert kept["consistency.edit_delta_e"] < 0


@pytest.mark.parametrize("seen", [1.0, 0.875])
def test_features_are_those_of_torchs_sampler(seen):
    random = np.random.default_rng(3)
    height, width, grid = 40, 64, 5
    source, target = random.normal(size=(2, grid, grid, 7))
    y, x = np.mgrid[:height, :width] + 0.5
    xy = np.stack([x + random.normal(0, 2, x.shape), y + random.normal(0, 2, y.shape)], -1)
    accepted = random.random((height, width)) < 0.8
    side = height * seen
    left, top = (width - side) / 2, (height - side) / 2
    expected = []
    for i in range(grid):
        for j in range(grid):
            column, row = (int(edge + (k + 0.5) * side / grid) for edge, k in ((left, j), (top, i)))
            u, v = (xy[row, column] - [left, top]) / side  # share of the square
            if not accepted[row, column] or not (0 <= u <= 1 and 0 <= v <= 1):
                continue
            at = torch.nn.functional.grid_sample(
                torch.from_numpy(source).permute(2, 0, 1)[None],
                torch.tensor([[[[2 * u - 1, 2 * v - 1]]]]),
                padding_mode="border",
                align_corners=False,
            ).flatten()
            expected.append(
                float(torch.cosine_similarity(at, torch.from_numpy(target[i, j]), dim=0))
            )
    result = metrics.feature_consistency(source, target, xy, accepted, (height, width), seen=seen)
    assert 5 < len(expected) < grid**2
    np.testing.assert_allclose(result.values, expected, atol=1e-12)


def test_a_view_and_itself_have_distance_0_and_nothing_trusted_has_none():
    (source,) = pictures(4, 1)
    xy, accepted = identity()
    distance = lambda a, b: float(np.abs(a - b).mean())  # noqa: E731
    assert metrics.perceptual_consistency(source, source, xy, accepted, distance) < 1e-12
    darker = 0.5 * source
    half = accepted & (xy[..., 0] < SIZE / 2)
    assert metrics.perceptual_consistency(source, darker, xy, half, distance) == pytest.approx(
        np.abs(source - darker)[half].mean()
    )
    nothing = np.zeros_like(accepted)
    assert math.isnan(metrics.perceptual_consistency(source, source, xy, nothing, distance))
    tokens = np.ones((4, 4, 3))
    assert not len(metrics.feature_consistency(tokens, tokens, xy, nothing, (SIZE, SIZE)).values)


def test_black_pictures_agree():
    black = np.zeros((SIZE, SIZE, 3))
    xy, accepted = identity()
    assert metrics.disagreement_at(black, black, xy, accepted).figures("rendered_")[
        "consistency.rendered_delta_e"
    ] == pytest.approx(0)


def test_positions_of_another_size_are_refused():
    source, target = pictures(5, 2)
    xy, accepted = identity(SIZE - 1)
    with pytest.raises(ValueError, match="xy"):
        metrics.disagreement_at(source, target, xy, accepted)
