"""Hard cases of the metrics: nothing to measure, no differences, lengths without direction."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import mpmath
import numpy as np

from attnwarp.camera import SAME_PLACE, Camera, fundamental
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


def _baseline(distance: float, way: Way) -> float:
    """Error of the epipolar distances of matches that miss their partners by 3 px, of two cameras a
    distance apart, undefined below the declared one.
    """
    rng = np.random.default_rng(0)
    cameras = [
        Camera.look_at(
            (place, -3.0, 0.5), (0.2, 0.1, 0.0), width=256, height=256, fov_y=50, up=(0, 0, 1)
        )
        for place in (0.0, distance)
    ]
    points = rng.uniform(-0.5, 0.5, (12, 3))
    pixels = [camera.project(points)[0] for camera in cameras]
    pixels[1] = pixels[1] + 3 * rng.normal(size=(12, 2))
    F = fundamental(*cameras)
    if F is None:
        return float(distance > SAME_PLACE * 2 * np.linalg.norm(cameras[0].position) + 1e-15)
    source, target = (xy.astype(way.numpy) for xy in pixels)
    found = metrics.epipolar_distance(source, target, F)
    expected = _symmetric_distances(cameras, [source, target])
    return max(map(against, expected, map(float, found)))


def _symmetric_distances(cameras: list[Camera], pixels: list[np.ndarray]) -> list[float]:
    """Epipolar distances from the cameras' matrices with 60 digits: each line runs through the
    images of the other's centre and of a point on the match's ray.
    """
    with mpmath.workdps(60):
        K, R, t = (
            [mpmath.matrix(rows.tolist()) for rows in each]
            for each in (
                [camera.K for camera in cameras],
                [camera.rotation for camera in cameras],
                [camera.translation for camera in cameras],
            )
        )
        turned = [mpmath.inverse(one) for one in R]
        centers = [-turned[i] * t[i] for i in (0, 1)]
        sums = [mpmath.mpf(0)] * len(pixels[0])
        for i, j in ((0, 1), (1, 0)):
            epipole = K[j] * (R[j] * centers[i] + t[j])
            for n, (x, y) in enumerate(pixels[i].tolist()):
                ray = turned[i] * mpmath.inverse(K[i]) * mpmath.matrix([x, y, 1])
                shown = K[j] * R[j] * ray
                a, b, c = (
                    epipole[1] * shown[2] - epipole[2] * shown[1],
                    epipole[2] * shown[0] - epipole[0] * shown[2],
                    epipole[0] * shown[1] - epipole[1] * shown[0],
                )
                u, v = pixels[j][n].tolist()
                sums[n] += abs(a * u + b * v + c) / mpmath.sqrt(a * a + b * b)
        return [float(one / 2) for one in sums]


def _matches(count: float, way: Way) -> float:
    """Error of the median and the share of a pair with few matches, next to one with many."""
    distances = [Fraction(k * k, 7) for k in range(int(count))]
    values = np.array([float(one) for one in distances], way.numpy)
    result = metrics.tsed([values, np.full(20, 0.5, way.numpy)])
    ordered = sorted(map(float, values))
    half = len(ordered) // 2
    middle = (ordered[(len(ordered) - 1) // 2] + ordered[half]) / 2 if len(ordered) >= 10 else None
    below = 1 + (middle is not None and middle < 2)
    return max(
        against(math.nan if middle is None else middle, float(result.medians[0])),
        against(below / 2, result.share(2)),
        against(float(middle is None), result.figures()["consistency.tsed_few_matches"]),
    )


def _contrast(contrast: float, way: Way) -> float:
    """Error in px of SIFT matches between a wall and the wall moved by 16 px; a pair is undefined
    and counted if there are too few matches, and a black picture has none.
    """
    wall = np.kron(np.random.default_rng(0).random((24, 24, 3)), np.ones((8, 8, 1)))
    wall = (contrast * wall).astype(way.numpy)
    source, target = metrics.sift_matches(wall[:, :176], wall[:, 16:])
    if not contrast:
        return float(len(source))
    lines = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]])  # matches lie in rows of pixels
    result = metrics.tsed([metrics.epipolar_distance(source, target, lines)])
    if len(source) < 10:
        return against(math.nan, float(result.medians[0]))
    shift = np.median(source - target, axis=0)
    return max(abs(float(shift[0]) - 16), abs(float(shift[1])), float(result.medians[0]))


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
    hard(
        "epipolar_baseline",
        _baseline,
        FLOATS,
        bounds=Bound("px", 1e-3, "a thousandth of TSED's smallest limit"),
    ),
    hard("few_matches", _matches, FLOATS, bounds=Bound("px", 1e-12, "a mean of two stored values")),
    hard(
        "dark_pictures",
        _contrast,
        FLOATS,
        bounds=Bound("px", 0.1, "SIFT finds a blob to a tenth of a pixel"),
    ),
]
