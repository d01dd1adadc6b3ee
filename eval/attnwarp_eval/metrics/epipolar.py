"""Epipolar consistency of two views' features, from pictures and cameras, without truth.

TSED, the thresholded symmetric epipolar distance (J. J. Yu et al., "Long-Term Photometric
Consistent Novel View Synthesis with Diffusion Models", ICCV 2023): the share of view pairs that
have enough matches and a small median distance.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp_eval.metrics._pictures import picture
from attnwarp_eval.metrics.arrays import Array, floats, quantile, share

if TYPE_CHECKING:
    from attnwarp.camera import Camera

LEAST_MATCHES = 10
"""Least matches of a pair, as in the paper."""

LIMITS = (1, 2, 4)
"""Limits of the median distance in px."""

RATIO = 0.8
"""Upper bound of a match's descriptor distance, as a share of the second best (Lowe 2004)."""


@dataclass(frozen=True, eq=False)
class Tsed:
    """Epipolar distances of view pairs.

    Attributes:
        medians: (P,) median distance of each pair in px; NaN without a baseline or with too few
            matches.
        matches: (P,) int, matches of each pair; 0 without a baseline.
        baseline: (P,) bool, whether the pair has two centres of projection.
    """

    medians: Array
    matches: npt.NDArray[np.int64]
    baseline: npt.NDArray[np.bool_]

    def share(self, limit: float) -> float:
        """Share of the pairs with a baseline whose median is below ``limit`` px. A pair with too
        few matches counts against; if all have too few, the share is NaN.
        """
        measured = np.isfinite(self.medians).any()
        below = int((self.medians < limit).sum())
        return share(below, int(self.baseline.sum()) if measured else 0)

    def figures(self) -> dict[str, float]:
        """The ``consistency.tsed*`` figures: shares, the median of the pairs' medians, and counts
        of pairs, of those with too few matches and of those without a baseline.
        """
        few = self.baseline & np.isnan(self.medians)
        return {
            **{f"consistency.tsed_{limit}px": self.share(limit) for limit in LIMITS},
            "consistency.tsed_distance": quantile(self.medians[np.isfinite(self.medians)], 0.5),
            "consistency.tsed_pairs": len(self.medians),
            "consistency.tsed_few_matches": int(few.sum()),
            "consistency.tsed_no_baseline": int((~self.baseline).sum()),
        }


def epipolar_distance(source_xy: Any, target_xy: Any, F: Any) -> Array:
    """(N,) symmetric epipolar distance of matches, in px: the mean of the two distances of a match
    from the epipolar line of its partner.

    A point at the epipole has no line in the other picture, and its distance is 0: no line
    contradicts it. Lower is better.

    Args:
        source_xy, target_xy: (N, 2) matched positions in px, row by row.
        F: (3, 3) with y^T F x = 0 for positions x of the source and y of the target, as
            :func:`attnwarp.camera.fundamental` gives it.

    Raises:
        ValueError: other shapes, or values that are NaN or infinite.

    Example:
        >>> from attnwarp_eval import metrics
        >>> rows = [[0, 0, 0], [0, 0, -1], [0, 1, 0]]  # lines are rows of pixels
        >>> metrics.epipolar_distance([[3, 4], [3, 4]], [[9, 4], [9, 6]], rows).tolist()
        [0.0, 2.0]
    """
    source = floats(source_xy, ("N", 2), "source_xy")
    target = floats(target_xy, (len(source), 2), "target_xy")
    matrix = floats(F, (3, 3), "F")
    for value, name in ((source, "source_xy"), (target, "target_xy"), (matrix, "F")):
        check.finite(value, name)
    ones = np.ones((len(source), 1))
    x, y = np.hstack([source, ones]), np.hstack([target, ones])
    lines, back = x @ matrix.T, y @ matrix
    residual = np.abs((y * lines).sum(axis=1))
    lengths = (np.hypot(each[:, 0], each[:, 1]) for each in (lines, back))
    distances = (
        np.divide(residual, length, out=np.zeros_like(residual), where=length > 0)
        for length in lengths
    )
    return np.asarray(sum(distances) / 2)


def tsed(distances: Sequence[Any]) -> Tsed:
    """Judge view pairs by the epipolar distances of their matches.

    Args:
        distances: for each pair the (N,) px of :func:`epipolar_distance`; None where the two views
            share a centre of projection, and so have no epipolar line.

    Raises:
        ValueError: distances of another shape, or NaN or infinite.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> figures = metrics.tsed([np.full(20, 1.5), np.full(3, 0.1), None]).figures()
        >>> figures["consistency.tsed_1px"], figures["consistency.tsed_2px"]
        (0.0, 0.5)
        >>> figures["consistency.tsed_few_matches"], figures["consistency.tsed_no_baseline"]
        (1, 1)
    """
    medians, matches = [], []
    for number, each in enumerate(distances):
        name = f"distances[{number}]"
        values = np.zeros(0) if each is None else floats(each, ("N",), name)
        check.finite(values, name)
        matches.append(len(values))
        medians.append(float(np.median(values)) if len(values) >= LEAST_MATCHES else np.nan)
    return Tsed(
        np.array(medians, dtype=np.float64),
        np.array(matches, dtype=np.int64),
        np.array([each is not None for each in distances], dtype=bool),
    )


def sift_matches(source_srgb: Any, target_srgb: Any) -> tuple[Array, Array]:
    """Match SIFT features of two pictures with OpenCV: mutual nearest neighbours, by a margin.

    Args:
        source_srgb, target_srgb: (h, w, 3) and (H, W, 3) sRGB in [0, 1].

    Returns:
        (N, 2) and (N, 2) positions in px, centres at +0.5. N = 0 for pictures without
        features, such as black ones.

    Raises:
        ValueError: a picture that is not sRGB in [0, 1].

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> coarse = np.random.default_rng(0).random((16, 16, 3))
        >>> wall = np.kron(coarse, np.ones((8, 8, 1)))
        >>> source, target = metrics.sift_matches(wall[:, :112], wall[:, 16:])
        >>> np.median(source - target, axis=0).round(1).tolist()
        [16.0, 0.0]
    """
    return match_features(
        sift_features(source_srgb, "source_srgb"), sift_features(target_srgb, "target_srgb")
    )


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of a picture from :func:`sift_features`.

    Attributes:
        xy: (N, 2) px, pixel centres at +0.5.
        descriptors: (N, 128) float32; None without keypoints.
    """

    xy: Array
    descriptors: npt.NDArray[np.float32] | None


def sift_features(image_srgb: Any, name: str = "image_srgb") -> Keypoints:
    """Find SIFT features of a picture, by OpenCV.

    Args:
        image_srgb: (H, W, 3) sRGB in [0, 1].
        name: name of the picture, for messages.

    Raises:
        ValueError: a picture that is not sRGB in [0, 1].

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> metrics.sift_features(np.zeros((64, 64, 3))).xy.shape
        (0, 2)
    """
    import cv2

    cv: Any = cv2  # its stubs lack precise upscaling, which corrects a shift of 0.25 px
    eight_bit = np.round(255 * picture(image_srgb, name)).astype(np.uint8)
    points, descriptors = cv.SIFT_create(enable_precise_upscale=True).detectAndCompute(
        cv.cvtColor(eight_bit, cv.COLOR_RGB2GRAY), None
    )
    return Keypoints(np.array([point.pt for point in points]).reshape(-1, 2) + 0.5, descriptors)


def match_features(source: Keypoints, target: Keypoints) -> tuple[Array, Array]:
    """Match features from :func:`sift_features` of two pictures, as :func:`sift_matches` does.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> coarse = np.random.default_rng(0).random((16, 16, 3))
        >>> features = metrics.sift_features(np.kron(coarse, np.ones((8, 8, 1))))
        >>> source, target = metrics.match_features(features, features)
        >>> np.abs(source - target).max().item()
        0.0
    """
    import cv2

    if len(source.xy) < 2 or len(target.xy) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher: Any = cv2.BFMatcher(cv2.NORM_L2)
    there = matcher.knnMatch(source.descriptors, target.descriptors, k=2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(target.descriptors, source.descriptors)}
    rows = [
        (best.queryIdx, best.trainIdx)
        for best, second in there
        if best.distance < RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    index = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return source.xy[index[:, 0]], target.xy[index[:, 1]]


def tsed_of_views(images: Sequence[Any], cameras: Sequence[Camera]) -> Tsed:
    """Judge neighbouring views by SIFT matches of their pictures, at known cameras.

    Args:
        images: N pictures, (H, W, 3) sRGB in [0, 1], in path order.
        cameras: N cameras of the pictures' sizes.

    Returns:
        One entry for each of the N - 1 pairs of neighbours. A pair of 512 px takes about 0.1 s.

    Raises:
        ValueError: numbers or sizes that differ, or a picture that is not sRGB in [0, 1].

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp_eval import metrics
        >>> black = np.zeros((64, 64, 3))
        >>> size = dict(width=64, height=64, fov_y=60)
        >>> cameras = [Camera.look_at((x, -4, 0), (0, 0, 0), **size) for x in (0, 1)]
        >>> result = metrics.tsed_of_views([black, black], cameras)
        >>> result.matches.tolist(), result.share(1)  # nothing to match
        ([0], nan)
    """
    from attnwarp.camera import fundamental

    if len(images) != len(cameras):
        raise ValueError(f"images: got {len(images)}, expected {len(cameras)}, one for each camera")
    features = [
        sift_features(picture(image, f"images[{i}]", shape=(camera.height, camera.width)))
        for i, (image, camera) in enumerate(zip(images, cameras, strict=True))
    ]
    distances: list[Array | None] = []
    for (source, view), (target, key) in itertools.pairwise(zip(features, cameras, strict=True)):
        F = fundamental(view, key)
        matches = None if F is None else match_features(source, target)
        distances.append(None if matches is None else epipolar_distance(*matches, F))
    return tsed(distances)
