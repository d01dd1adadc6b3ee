"""Hard cases of the metrics: nothing to measure, nothing that differs, lengths without a
direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import mpmath
import numpy as np

from attnwarp_eval import metrics
from attnwarp_eval.metrics.embedding import TINY_DISPLACEMENT, TINY_NORM
from attnwarp_eval.stability.case import Bound, Case, Way, ways
from attnwarp_eval.statistics.scales import compared

FLOATS = ways("metrics")
COSINE = Bound("cosine", 1e-6, "encoders compute in float32")
DECIBELS = Bound("dB", 1e-6, "reports show two digits behind the point")


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Cosine in mpmath, so that no length overflows."""
    with mpmath.workdps(40):
        u, v = ([mpmath.mpf(float(x)) for x in row] for row in (a, b))
        product = sum(x * y for x, y in zip(u, v, strict=True))
        return float(product / mpmath.sqrt(sum(x * x for x in u) * sum(y * y for y in v)))


def _vectors() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, 64), rng.uniform(-1, 1, 64)


def _against(expected: float, result: float) -> float:
    """Their difference; infinite where only one of them is undefined, or infinite."""
    if math.isnan(expected) or math.isnan(result):
        return 0.0 if math.isnan(expected) and math.isnan(result) else math.inf
    if math.isinf(expected) or math.isinf(result):
        return 0.0 if expected == result else math.inf
    return abs(expected - result)


def _magnitude(magnitude: float, way: Way) -> float:
    """Error of the cosine of long embeddings."""
    a, b = ((v * magnitude).astype(way.numpy) for v in _vectors())
    return _against(_cosine(a, b), float(metrics.image_similarity(a, b[None]).values[0]))


def _short(length: float, way: Way) -> float:
    """Error of the cosine of a short embedding, undefined below the declared length."""
    a, b = _vectors()
    short = (a / np.linalg.norm(a) * length).astype(way.numpy)
    result = float(metrics.image_similarity(short, b[None].astype(way.numpy)).values[0])
    defined = np.linalg.norm(short.astype(np.float64)) >= TINY_NORM
    return _against(_cosine(short, b.astype(way.numpy)) if defined else math.nan, result)


def _displacement(length: float, way: Way) -> float:
    """Error of the directional similarity of a small change, undefined below the declared one."""
    a, b = _vectors()
    before = (a / np.linalg.norm(a)).astype(way.numpy)
    side = b - (b @ a) / (a @ a) * a
    after = (before + length * side / np.linalg.norm(side)).astype(way.numpy)
    with mpmath.workdps(40):
        units = []
        for row in (before, after):
            values = [mpmath.mpf(float(x)) for x in row]
            size = mpmath.sqrt(sum(x * x for x in values))
            units.append([x / size for x in values])
        change = np.array([float(y - x) for x, y in zip(*units, strict=True)])
    text = np.zeros((2, 64))
    text[0, 0] = text[1, 1] = 1.0
    result = metrics.directional_similarity(before[None], after[None], text[0], text[1])
    defined = np.linalg.norm(change) >= TINY_DISPLACEMENT
    return _against(
        _cosine(change, text[1] - text[0]) if defined else math.nan, float(result.values[0])
    )


def _psnr(difference: float, way: Way) -> float:
    """Error of the PSNR of pictures that differ by a constant."""
    image = np.full((8, 8, 3), 0.25, way.numpy)
    target = (image + np.array(difference, way.numpy)).astype(way.numpy)
    return _against(_decibels(image[0, 0, 0], target[0, 0, 0]), metrics.psnr(image, target))


def _decibels(a: float, b: float) -> float:
    """Exact up to the logarithm: the stored values are fractions."""
    difference = Fraction(float(a)) - Fraction(float(b))
    if difference == 0:
        return math.inf
    return -20 * float(mpmath.log10(abs(mpmath.mpf(difference.numerator) / difference.denominator)))


def _masked(outside: Callable[[np.ndarray], None]) -> Callable[[float, Way], float]:
    """Error of the PSNR under a mask, whatever stands outside of it."""

    def measure(pixels: float, way: Way) -> float:
        mask = np.zeros((64, 64), bool)
        mask.ravel()[np.random.default_rng(0).permutation(4096)[: int(pixels)]] = True
        image = np.full((64, 64, 3), 0.25, way.numpy)
        target = np.full((64, 64, 3), 0.375, way.numpy)
        spoiled = target[~mask]
        outside(spoiled)
        target[~mask] = spoiled
        expected = _decibels(0.25, 0.375) if pixels else math.nan
        return _against(expected, metrics.psnr(image, target, mask))

    return measure


def _equal(values: np.ndarray) -> None:
    values[:] = 0.25


def _nothing(values: np.ndarray) -> None:
    values[:] = np.nan


def _visible_tokens(visible: float, way: Way) -> float:
    """Error of the shares of right, wrong and missing labels among a few visible tokens of 64."""
    tokens, seen = np.zeros((8, 8), np.int16), np.zeros((8, 8), bool)
    seen.ravel()[np.random.default_rng(0).permutation(64)[: int(visible)]] = True
    carried = (np.arange(64) % 3 - 2).astype(np.int16).reshape(8, 8)  # none, outside, right
    result = metrics.label_transport(carried, tokens, tokens, seen, ~seen)
    taken = [int(label) for label, shown in zip(carried.flat, seen.flat, strict=True) if shown]
    hidden = [int(label) for label, shown in zip(carried.flat, seen.flat, strict=True) if not shown]
    counted = {
        "right": (taken.count(0), taken),
        "wrong": (taken.count(-1), taken),
        "none": (taken.count(-2), taken),
        "painted_hidden": (hidden.count(0), hidden),
    }
    return max(
        _against(float(Fraction(n, len(of))) if of else math.nan, result[f"labels.{name}"])
        for name, (n, of) in counted.items()
    )


def _ends(distance: float, way: Way) -> float:
    """Error of the difference of logits of two shares of 1,000, at a distance from 0 and from 1."""
    count, low, high = 1000, distance, 1 - distance
    with mpmath.workdps(40):
        logits = [
            mpmath.log((k + 0.5) / (count - k + 0.5))
            for k in (mpmath.mpf(share) * count for share in (low, high))
        ]
        exact = float(logits[1] - logits[0])
    return _against(exact, compared(low, high, "odds", counts=(count, count)))


CASES = [
    Case(
        31,
        "long_embedding",
        "Norms of embeddings that overflow",
        input="two embeddings of 64 values",
        oracle="the cosine in mpmath",
        hardness="magnitude",
        levels=(1, 1e2, 1e4, 6e4, 1e20, 1e38, 1e150, 1e300),
        required=6e4,
        quick=(1, 6e4),
        bounds={"forward": COSINE},
        ways=ways("metrics", precisions=("float64", "float32", "float16")),
        measure=_magnitude,
        limit="infinite in that type: refused",
    ),
    Case(
        32,
        "short_embedding",
        "An embedding of length almost 0",
        input="two embeddings of 64 values, one of them short",
        oracle=f"the cosine in mpmath; undefined below {TINY_NORM:g}",
        hardness="length",
        levels=(1, 1e-3, 2e-6, 5e-7, 1e-12, 1e-40, 1e-300, 0),
        required=0,
        quick=(1, 2e-6, 0),
        bounds={"forward": COSINE},
        ways=FLOATS,
        measure=_short,
    ),
    Case(
        33,
        "small_change",
        "Directional similarity of a change of almost nothing",
        input="an embedding and one beside it",
        oracle=f"the cosine in mpmath; undefined below {TINY_DISPLACEMENT:g}",
        hardness="length of the change",
        levels=(1, 1e-2, 1e-3, 1e-4, 2e-5, 5e-6, 1e-8, 0),
        required=0,
        quick=(1, 1e-3, 0),
        bounds={"forward": COSINE},
        ways=FLOATS,
        measure=_displacement,
    ),
    Case(
        34,
        "equal_pictures",
        "PSNR of pictures that are almost equal",
        input="a grey picture and one beside it",
        oracle="the closed form of the stored values, in fractions; infinite for equal ones",
        hardness="difference",
        levels=(0.1, 1e-3, 1e-6, 1e-7, 1e-9, 1e-12, 1e-16, 0),
        required=0,
        quick=(0.1, 1e-6, 0),
        bounds={"forward": DECIBELS},
        ways=FLOATS,
        measure=_psnr,
    ),
    Case(
        35,
        "empty_mask",
        "A mask of a few pixels, and of none",
        input="pictures that differ by 1/8, the same outside the mask",
        oracle="the closed form; undefined without a pixel",
        hardness="pixels in the mask",
        levels=(4096, 1024, 100, 10, 1, 0),
        required=0,
        quick=(1024, 1, 0),
        bounds={"forward": DECIBELS},
        ways=FLOATS,
        measure=_masked(_equal),
    ),
    Case(
        36,
        "nan_outside_a_mask",
        "NaN outside of a mask",
        input="pictures that differ by 1/8, NaN outside the mask",
        oracle="the closed form; undefined without a pixel",
        hardness="pixels in the mask",
        levels=(4096, 1024, 100, 10, 1, 0),
        required=0,
        quick=(1024, 0),
        bounds={"forward": DECIBELS},
        ways=FLOATS,
        measure=_masked(_nothing),
    ),
    Case(
        40,
        "masked_psnr",
        "PSNR under a mask of little coverage",
        input="pictures that differ by 1/8, equal outside the mask",
        oracle="the closed form: what lies outside gains nothing",
        hardness="pixels of 4096 in the mask",
        levels=(4096, 1024, 410, 41, 4, 1),
        required=1,
        quick=(1024, 1),
        bounds={"forward": DECIBELS},
        ways=FLOATS,
        measure=_masked(_equal),
    ),
    Case(
        62,
        "visible_tokens",
        "Labels of a few visible tokens, and of none",
        input="8 x 8 tokens of one part, some of which the source shows",
        oracle="counts by a loop, as fractions; undefined without a token",
        hardness="visible tokens",
        levels=(64, 32, 8, 2, 1, 0),
        required=0,
        quick=(32, 1, 0),
        bounds={"forward": Bound("of 1", 1e-12, "a fraction of whole numbers")},
        ways=(Way("metrics"),),
        measure=_visible_tokens,
    ),
    Case(
        63,
        "shares_at_the_ends",
        "Shares of almost 0 and 1, and of exactly these, on the scale of odds",
        input="two shares of 1,000 things, one from each end",
        oracle="empirical logits in mpmath",
        hardness="distance from 0 and from 1",
        levels=(0.5, 0.1, 1e-3, 1e-6, 1e-9, 1e-15, 0),
        required=0,
        quick=(0.5, 1e-3, 0),
        bounds={"forward": Bound("of a logit", 1e-9, "reports show three digits")},
        ways=(Way("statistics"),),
        measure=_ends,
    ),
]
