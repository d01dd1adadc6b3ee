"""Cosines of embeddings: closed forms, brute force, and the cases that have no answer."""

import math

import numpy as np
import pytest

from attnwarp_eval.metrics import (
    Similarity,
    clip_similarity,
    direction_consistency,
    directional_similarity,
    image_similarity,
    match_similarity,
)
from attnwarp_eval.metrics.embedding import TINY_DISPLACEMENT, TINY_NORM

E = np.eye(4)


def by_hand(a, b):
    """In exact sums, without the array code's way of scaling."""
    dot = math.fsum(float(x) * float(y) for x, y in zip(a, b, strict=True))
    return dot / math.sqrt(
        math.fsum(float(x) ** 2 for x in a) * math.fsum(float(y) ** 2 for y in b)
    )


def test_random_embeddings_by_brute_force():
    random = np.random.default_rng(0)
    a, b, t = random.normal(size=(3, 20, 96)) * random.uniform(0.01, 100, size=(3, 20, 1))
    expected = [by_hand(x, y) for x, y in zip(a, t, strict=True)]
    assert clip_similarity(a, t).values.dtype == np.float64
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
        (
            lambda: clip_similarity(E, np.ones(3)),
            r"text: got shape \(1, 3\), expected \(4,\), \(1, 4\) or \(4, 4\)",
        ),
        (
            lambda: clip_similarity(E.astype(complex), E[0]),
            "images: got complex128, expected real numbers",
        ),
        (
            lambda: directional_similarity(E[:3], E, E[0], E[1]),
            r"images_before: got shape \(3, 4\), expected \(4, 4\)",
        ),
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


def test_changes_of_neighbouring_views_by_brute_force_and_one_undefined():
    random = np.random.default_rng(5)
    before, after = random.normal(size=(2, 6, 24))
    after[2] = 3 * before[2]  # unchanged but for its length: no direction
    unit = lambda v: v / math.sqrt(math.fsum(x * x for x in v))  # noqa: E731
    change = [unit(b) - unit(a) for a, b in zip(before, after, strict=True)]
    expected = [by_hand(change[i], change[i + 1]) for i in range(5)]
    expected[1] = expected[2] = math.nan
    result = direction_consistency(before, after)
    np.testing.assert_allclose(result.values, expected, atol=1e-13)
    assert result.undefined == 2


def test_one_view_or_none_has_no_neighbour():
    for count in (0, 1):
        result = direction_consistency(E[:count], E[1 : 1 + count])
        assert len(result.values) == 0 and math.isnan(result.mean)


def test_matched_patches_by_brute_force():
    random = np.random.default_rng(6)
    source, target = random.normal(size=(2, 40, 8))
    source_after, target_after = random.normal(size=(2, 40, 8))
    table = [[by_hand(a, b) for b in target] for a in source]
    pairs = [
        (i, j)
        for i in range(40)
        for j in range(40)
        if table[i][j] == max(table[i]) == max(row[j] for row in table)
    ]
    assert 5 < len(pairs) < 40  # some patches have no partner
    np.testing.assert_allclose(
        match_similarity(source, target, source_after, target_after).values,
        [by_hand(source_after[i], target_after[j]) for i, j in pairs],
        atol=1e-14,
    )


def test_patches_without_a_feature_match_nothing_and_those_that_lose_it_are_undefined():
    nothing = match_similarity(np.zeros((3, 4)), E, E[:3], E)
    assert len(nothing.values) == 0 and math.isnan(nothing.mean)
    assert len(match_similarity(E[:0], E, E[:0], E).values) == 0
    lost = match_similarity(E[:2], E[:2], np.array([E[0], 0 * E[0]]), E[:2])
    assert lost.values[0] == 1 and lost.undefined == 1


def test_features_of_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"target_before: got 3 features a patch, expected 4"):
        match_similarity(E, np.eye(3), E, np.eye(3))
    with pytest.raises(ValueError, match=r"source_after: got shape \(2, 4\), expected \(4, 4\)"):
        match_similarity(E, E, E[:2], E)
    with pytest.raises(ValueError, match=r"images_before: got shape"):
        direction_consistency(E[:2], E[:3])


def test_one_edit_of_a_scene_is_more_consistent_than_an_edit_of_one_view():
    from attnwarp_eval.encoders import load_encoder

    random = np.random.default_rng(8)
    coarse = random.random((8, 10, 3))
    wide = np.kron(coarse, np.ones((16, 16, 1)))  # two views of one wall, 16 px apart
    views = [wide[:, :128], wide[:, 16:144]]
    edited = [view[..., ::-1] ** 2 for view in views]  # its colours exchanged, and darker
    encoder = load_encoder("dino-small", "dino")

    def both(second):
        tokens = encoder.tokens([*views, edited[0], second]).reshape(4, 64, -1)
        embeddings = encoder.images([*views, edited[0], second])
        return (
            match_similarity(*tokens).mean,
            direction_consistency(embeddings[:2], embeddings[2:]).mean,
        )

    (match, direction), (match_one, direction_one) = both(edited[1]), both(1 - views[1])
    assert match > match_one and direction > direction_one
