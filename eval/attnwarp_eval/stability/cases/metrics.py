"""Hard cases of the metrics: nothing to measure, no differences, lengths without direction."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import mpmath
import numpy as np

from attnwarp_eval import metrics
from attnwarp_eval.metrics.embedding import TINY_DISPLACEMENT, TINY_NORM
from attnwarp_eval.stability.case import Bound, Way, hard, ways
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


def against(expected: float, result: float) -> float:
    """Absolute difference; infinite if only one of the two is undefined or infinite."""
    if math.isnan(expected) or math.isnan(result):
        return 0.0 if math.isnan(expected) and math.isnan(result) else math.inf
    if math.isinf(expected) or math.isinf(result):
        return 0.0 if expected == result else math.inf
    return abs(expected - result)


def _magnitude(magnitude: float, way: Way) -> float:
    """Error of the cosine of long embeddings."""
    a, b = ((v * magnitude).astype(way.numpy) for v in _vectors())
    return against(_cosine(a, b), float(metrics.image_similarity(a, b[None]).values[0]))


def _short(length: float, way: Way) -> float:
    """Error of the cosine of a short embedding, undefined below the declared length."""
    a, b = _vectors()
    short = (a / np.linalg.norm(a) * length).astype(way.numpy)
    result = float(metrics.image_similarity(short, b[None].astype(way.numpy)).values[0])
    defined = np.linalg.norm(short.astype(np.float64)) >= TINY_NORM
    return against(_cosine(short, b.astype(way.numpy)) if defined else math.nan, result)


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
    return against(
        _cosine(change, text[1] - text[0]) if defined else math.nan, float(result.values[0])
    )


def _psnr(difference: float, way: Way) -> float:
    """Error of the PSNR of pictures that differ by a constant."""
    image = np.full((8, 8, 3), 0.25, way.numpy)
    target = (image + np.array(difference, way.numpy)).astype(way.numpy)
    return against(_decibels(image[0, 0, 0], target[0, 0, 0]), metrics.psnr(image, target))


def _decibels(a: float, b: float) -> float:
    """Exact up to the logarithm: the stored values are fractions."""
    difference = Fraction(float(a)) - Fraction(float(b))
    if difference == 0:
        return math.inf
    return -20 * float(mpmath.log10(abs(mpmath.mpf(difference.numerator) / difference.denominator)))


def _masked(outside: Callable[[np.ndarray], None]) -> Callable[[float, Way], float]:
    """Error of the PSNR under a mask, for any values outside the mask."""

    def measure(pixels: float, way: Way) -> float:
        mask = np.zeros((64, 64), bool)
        mask.ravel()[np.random.default_rng(0).permutation(4096)[: int(pixels)]] = True
        image = np.full((64, 64, 3), 0.25, way.numpy)
        target = np.full((64, 64, 3), 0.375, way.numpy)
        spoiled = target[~mask]
        outside(spoiled)
        target[~mask] = spoiled
        expected = _decibels(0.25, 0.375) if pixels else math.nan
        return against(expected, metrics.psnr(image, target, mask))

    return measure


def _equal(values: np.ndarray) -> None:
    values[:] = 0.25


def _nothing(values: np.ndarray) -> None:
    values[:] = np.nan


def _ends(distance: float, way: Way) -> float:
    """Error of the difference of logits of two shares of 1,000, at a distance from 0 and from 1."""
    count, low, high = 1000, distance, 1 - distance
    with mpmath.workdps(40):
        logits = [
            mpmath.log((k + 0.5) / (count - k + 0.5))
            for k in (mpmath.mpf(share) * count for share in (low, high))
        ]
        exact = float(logits[1] - logits[0])
    return against(exact, compared(low, high, "odds", counts=(count, count)))


CASES = [
    hard(
        "long_embedding",
        _magnitude,
        ways("metrics", precisions=("float64", "float32", "float16")),
        bounds=COSINE,
    ),
    hard("short_embedding", _short, FLOATS, bounds=COSINE),
    hard("small_change", _displacement, FLOATS, bounds=COSINE),
    hard("equal_pictures", _psnr, FLOATS, bounds=DECIBELS),
    hard("empty_mask", _masked(_equal), FLOATS, bounds=DECIBELS),
    hard("nan_outside_a_mask", _masked(_nothing), FLOATS, bounds=DECIBELS),
    hard("masked_psnr", _masked(_equal), FLOATS, bounds=DECIBELS),
    hard(
        "shares_at_the_ends",
        _ends,
        (Way("statistics"),),
        bounds=Bound("of a logit", 1e-9, "reports show three digits"),
    ),
]
