"""Cosines of embeddings: closed forms, brute force, and the cases that have no answer."""

import math

import numpy as np
import pytest

from attnwarp_eval.metrics import (
    Similarity,
    clip_similarity,
    directional_similarity,
    image_similarity,
)
from attnwarp_eval.metrics.embedding import TINY_DISPLACEMENT, TINY_NORM
from attnwarp_eval.metrics.registry import METRICS

E = np.eye(4)


def by_hand(a, b):
    """In exact sums, without the array code's way of scaling."""
    dot = math.fsum(float(x) * float(y) for x, y in zip(a, b, strict=True))
    return dot / math.sqrt(
        math.fsum(float(x) ** 2 for x in a) * math.fsum(float(y) ** 2 for y in b)
    )


def test_angles_of_0_45_90_and_180_degrees():
    images = np.array([E[0], E[0] + E[1], E[1], -3 * E[0]])
    expected = [1, math.sqrt(0.5), 0, -1]
    for values in (
        clip_similarity(images, 7 * E[0]).values,
        image_similarity(7 * E[:1], images).values,
    ):
        np.testing.assert_allclose(values, expected, atol=1e-15)
        assert values.dtype == np.float64


def test_random_embeddings_by_brute_force():
    random = np.random.default_rng(0)
    a, b, t = random.normal(size=(3, 20, 96)) * random.uniform(0.01, 100, size=(3, 20, 1))
    expected = [by_hand(x, y) for x, y in zip(a, t, strict=True)]
    np.testing.assert_allclose(clip_similarity(a, t).values, expected, atol=1e-14)
    np.testing.assert_allclose(
        clip_similarity(a, t[0]).values, [by_hand(x, t[0]) for x in a], atol=1e-14
    )
    np.testing.assert_allclose(
        image_similarity(t[0], b).values, [by_hand(x, t[0]) for x in b], atol=1e-14
    )
    unit = {
        name: v / np.linalg.norm(v, axis=1, keepdims=True)
        for name, v in (("a", a), ("b", b), ("t", t))
    }
    change = t[3] / np.linalg.norm(t[3]) - t[1] / np.linalg.norm(t[1])
    expected = [by_hand(y - x, change) for x, y in zip(unit["a"], unit["b"], strict=True)]
    np.testing.assert_allclose(
        directional_similarity(a, b, t[1], t[3]).values, expected, atol=1e-13
    )


def test_it_agrees_with_torch():
    import torch
    from torch.nn.functional import cosine_similarity, normalize

    i0, i1, t0, t1 = (
        torch.randn(5, 32, generator=torch.Generator().manual_seed(k)).double() for k in range(4)
    )
    expected = cosine_similarity(normalize(i1) - normalize(i0), normalize(t1) - normalize(t0))
    np.testing.assert_allclose(
        directional_similarity(i0, i1, t0, t1).values, expected.numpy(), atol=1e-13
    )


def test_directions_in_closed_form():
    # The picture goes from e0 to e1; the prompt goes the same way, across, and back.
    for t0, t1, expected in ((E[0], E[1], 1), (E[2], E[3], 0), (E[1], E[0], -1), (E[0], E[2], 0.5)):
        assert directional_similarity(E[:1], 5 * E[1:2], t0, 9 * t1).mean == pytest.approx(
            expected, abs=1e-15
        )


def test_lengths_do_not_matter_since_they_are_taken_out_first():
    random = np.random.default_rng(1)
    i0, i1, t0, t1 = random.normal(size=(4, 6, 16))
    scaled = directional_similarity(3 * i0, 0.2 * i1, 50 * t0[0], t1[0])
    np.testing.assert_allclose(
        scaled.values, directional_similarity(i0, i1, t0[0], t1[0]).values, atol=1e-14
    )


@pytest.mark.parametrize("tiny", [0.0, 0.1 * TINY_NORM, -0.9 * TINY_NORM, 1e-320])
def test_an_embedding_without_length_is_undefined_and_counted(tiny):
    images = np.array([E[0], tiny * E[0], E[0] + E[1]])
    for result in (clip_similarity(images, E[0]), image_similarity(E[0], images)):
        assert np.isnan(result.values).tolist() == [False, True, False]
        assert (result.undefined, result.defined) == (1, 2)
        assert result.mean == pytest.approx((1 + math.sqrt(0.5)) / 2)  # not of three
    assert clip_similarity(images, tiny * E[0]).undefined == 3


def test_a_small_embedding_that_has_a_direction_keeps_it():
    assert clip_similarity(2 * TINY_NORM * E[:1], E[0]).mean == 1


def test_a_view_that_did_not_change_is_undefined_and_counted():
    before, after = (
        np.array([E[0], E[0], E[0]]),
        np.array([E[1], 2 * E[0], E[0] + 0.1 * TINY_DISPLACEMENT * E[1]]),
    )
    result = directional_similarity(before, after, E[0], E[1])
    assert (
        result.values[0] == pytest.approx(1)
        and np.isnan(result.values[1:]).all()
        and result.undefined == 2
    )
    just = directional_similarity(E[:1], E[:1] + 2 * TINY_DISPLACEMENT * E[1:2], E[0], E[1])
    assert just.mean == pytest.approx(
        math.sqrt(0.5), abs=1e-4
    )  # along e1, where the prompt goes from e0 to e1


def test_prompts_that_say_the_same_leave_every_view_undefined():
    result = directional_similarity(E[:2], E[2:4], E[0], 3 * E[0])
    assert result.undefined == 2 and result.defined == 0 and math.isnan(result.mean)


def test_float16_embeddings_do_not_overflow():
    images = np.array([[300, 400] * 32, [400, -300] * 32], dtype=np.float16)
    with np.errstate(over="ignore"):
        assert np.isinf(
            (images[0] ** 2).sum()
        )  # as the length would, computed in their own precision
    result = clip_similarity(images, images[0])
    assert result.values[0] == pytest.approx(1, abs=1e-15) and abs(result.values[1]) < 1e-15


def test_the_ends_of_float64_do_no_harm():
    assert clip_similarity(1e300 * E[:2], 1e300 * (E[0] + E[1])).values == pytest.approx(
        [math.sqrt(0.5)] * 2
    )


def test_rounding_never_gives_more_than_1():
    random = np.random.default_rng(2)
    x = random.normal(size=(500, 7))
    assert np.abs(clip_similarity(x, x).values).max() <= 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_encoder_s_nan_is_refused_and_not_taken_for_undefined(bad):
    images = E.copy()
    images[2, 1] = bad
    with pytest.raises(
        ValueError, match="images: 1 of 4 embeddings are NaN or infinite, row 2 first"
    ):
        clip_similarity(images, E[0])
    with pytest.raises(ValueError, match="images_before: 1 of 4"):
        directional_similarity(images, E, E[0], E[1])
    with pytest.raises(ValueError, match="text_after: 1 of 1"):
        directional_similarity(E, E, E[0], images[2])


@pytest.mark.door
@pytest.mark.parametrize(
    "call, complaint",
    [
        (lambda: clip_similarity(E[0], E[0]), r"images: got shape \(4,\), expected \(N, D\)"),
        (
            lambda: clip_similarity(E, np.ones(3)),
            r"text: got shape \(1, 3\), expected \(4,\), \(1, 4\) or \(4, 4\)",
        ),
        (lambda: clip_similarity(E, E[:2]), r"text: got shape \(2, 4\)"),
        (
            lambda: clip_similarity(E.astype(complex), E[0]),
            "images: got complex128, expected real numbers",
        ),
        (
            lambda: directional_similarity(E[:3], E, E[0], E[1]),
            r"images_before: got shape \(3, 4\), expected \(4, 4\)",
        ),
        (lambda: image_similarity(E[:3], E), r"source_edit: got shape \(3, 4\)"),
    ],
)
def test_shapes_that_do_not_fit_are_named(call, complaint):
    with pytest.raises(ValueError, match=complaint):
        call()


def test_no_views_give_no_value():
    result = clip_similarity(np.zeros((0, 4)), E[0])
    assert (
        isinstance(result, Similarity) and result.values.shape == (0,) and math.isnan(result.mean)
    )


def test_the_figures_are_specified():
    for name in ("clip_similarity", "clip_directional", "clip_image", "dino_image"):
        assert (
            METRICS[f"embedding.{name}"].direction == "higher"
            and METRICS[f"embedding.{name}"].unit == "cosine"
        )
    assert METRICS["embedding.undefined"].direction == "lower"
    assert METRICS["perceptual.distance"].direction == "lower"
