"""Lens distortion: OpenCV's two formulas, and resampling of pictures to a pinhole camera.

Formulas: docs.opencv.org, calib3d ("Brown", rational, with tangential terms) and calib3d_fisheye
(Kannala and Brandt 2006). COLMAP's models RADIAL, OPENCV, FULL_OPENCV and their fisheye kin are
special cases. Coordinates here have pixel centres at +0.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.io.images import weighted_by_alpha

Array = npt.NDArray[np.float64]

LARGEST_GROWTH = 2.0
"""Largest growth of an undistorted picture's width and height (COLMAP's limit)."""

STEEPEST = 1.4
"""Largest angle of rays from the optical axis (radians, 80 degrees): a pinhole needs ever more
pixels for steeper rays."""

ROUND_TRIP = 0.01
"""Largest round-trip error of a border pixel, undistorted and distorted again, in px."""

RAYS, STEPS = 200, 200
"""Rays to each border of the picture, and points on each, in the search for folds."""


INVERTED = 1e-9
"""Largest round-trip error of a point, undistorted and distorted again, in focal lengths."""

RADII = 4097
"""Number of radii in the table that initialises the inversion of radial distortion."""


@dataclass(frozen=True)
class Lens:
    """Distortion of a lens, as a function of normalised image coordinates.

    Args:
        kind: "brown" for radial and tangential terms, "fisheye" for a polynomial in the angle.
        coefficients: k1 k2 p1 p2 k3 k4 k5 k6 for "brown", k1 k2 k3 k4 for "fisheye"; missing ones
            are 0.

    Raises:
        ValueError: unknown kind, too many coefficients, or a non-finite coefficient.

    Example:
        >>> from attnwarp.io import Lens
        >>> Lens("brown", (0.1,)).undistort([1.1, 0.0]).round(9).tolist()  # 1.1 = 1 + 0.1 * 1^3
        [1.0, 0.0]
    """

    kind: Literal["brown", "fisheye"]
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        check.one_of(self.kind, ("brown", "fisheye"), "kind")
        count = 8 if self.kind == "brown" else 4
        if len(self.coefficients) > count:
            raise ValueError(
                f"coefficients: got {len(self.coefficients)}, expected at most {count} for"
                f" {self.kind!r}"
            )
        values = tuple(float(v) for v in self.coefficients)
        check.finite(np.array(values), "coefficients")
        object.__setattr__(self, "coefficients", values + (0.0,) * (count - len(values)))

    @property
    def is_pinhole(self) -> bool:
        """True if the lens has no effect. A fisheye lens without coefficients is not a pinhole."""
        return self.kind == "brown" and not any(self.coefficients)

    def distort(self, xy: npt.ArrayLike) -> Array:
        """Distort normalised coordinates (X/Z, Y/Z).

        Args:
            xy: (..., 2) undistorted coordinates.

        Returns:
            (..., 2) distorted coordinates.

        Example:
            >>> from attnwarp.io import Lens
            >>> Lens("brown", (0.1,)).distort([1.0, 0.0]).tolist()  # 1 + 0.1 * 1^2
            [1.1, 0.0]
        """
        xy = np.asarray(xy, dtype=np.float64)
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        if self.kind == "fisheye":
            r = np.sqrt(r2)
            with np.errstate(invalid="ignore", divide="ignore"):
                factor = np.where(r > 0, self._angle(np.arctan(r)) / r, 1.0)
            return xy * factor[..., None]
        _, _, p1, p2, *_ = self.coefficients
        radial = self._radial(r2)
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
            ],
            axis=-1,
        )

    def undistort(self, xy: npt.ArrayLike) -> Array:
        """Invert :meth:`distort` by iteration; NaN if the iteration finds no inverse.

        If several inverses exist, the one before the first fold is found; :meth:`folds` marks
        others.

        Args:
            xy: (..., 2) distorted normalised coordinates.

        Returns:
            (..., 2) undistorted coordinates, clamped to 80 degrees from the axis.
        """
        target = np.asarray(xy, dtype=np.float64)
        if self.kind == "fisheye":
            # Newton's method in the angle alone.
            r = np.linalg.norm(target, axis=-1)
            theta = self._before_fold(r)
            for _ in range(50):
                slope = (self._angle(theta + 1e-6) - self._angle(theta - 1e-6)) / 2e-6
                slope = np.where(np.abs(slope) > 1e-6, slope, 1.0)
                theta = np.clip(theta - (self._angle(theta) - r) / slope, 0, STEEPEST)
            with np.errstate(invalid="ignore", divide="ignore"):
                factor = np.where(r > 0, np.tan(theta) / r, 1.0)
            left = np.abs(self._angle(theta) - r)
            # Clamp to the steepest ray only if the angle still rises there.
            ends = self._angle(np.array([STEEPEST - 1e-6, STEEPEST]))
            cut = (r > ends[1]) & bool(ends[1] > ends[0]) & (theta >= STEEPEST)
            found = (left <= INVERTED * (1 + r)) | cut
            return np.where(found[..., None], target * factor[..., None], np.nan)
        length = np.linalg.norm(target, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = np.where(length > 0, self._before_fold(length) / length, 1.0)
        point = target * factor[..., None]
        for _ in range(50):
            here, dx, dy, det = self._linear(point)
            error = here - target
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                point = point - np.stack(
                    [
                        (dy[..., 1] * error[..., 0] - dy[..., 0] * error[..., 1]) / det,
                        (dx[..., 0] * error[..., 1] - dx[..., 1] * error[..., 0]) / det,
                    ],
                    axis=-1,
                )
        with np.errstate(invalid="ignore", over="ignore"):
            left = np.abs(self.distort(point) - target).max(axis=-1)
        found = left <= INVERTED * (1 + np.abs(target).max(axis=-1))
        return np.where(found[..., None], point, np.nan)

    def _linear(self, point: Array) -> tuple[Array, Array, Array, Array]:
        """Compute :meth:`distort`, its slopes in x and y by differences, and their determinant."""
        step = 1e-6
        here = self.distort(point)
        dx = (self.distort(point + np.array([step, 0.0])) - here) / step
        dy = (self.distort(point + np.array([0.0, step])) - here) / step
        return here, dx, dy, dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0]

    def folds(self, xy: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Mark the points beyond a fold, which :meth:`distort` mirrors onto already visible points.

        Args:
            xy: (..., 2) undistorted normalised coordinates.

        Returns:
            (...) bool.

        Example:
            >>> from attnwarp.io import Lens
            >>> Lens("brown", (-0.1,)).folds([[1.0, 0.0], [2.0, 0.0]]).tolist()  # 1 - 0.3 r^2
            [False, True]
        """
        folded: npt.NDArray[np.bool_] = ~(self._linear(np.asarray(xy, dtype=np.float64))[3] > 0)
        return folded

    def _radial(self, r2: Array) -> Array:
        """Compute the stretch of a point at a squared distance from the axis."""
        k1, k2, _, _, k3, k4, k5, k6 = self.coefficients
        return (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))

    def _before_fold(self, length: Array) -> Array:
        """Invert the radial terms by a table up to their first fold, the start of Newton's method:
        a start at the target may converge beyond a fold. Gives angles for a fisheye lens.
        """
        r = np.linspace(0, STEEPEST if self.kind == "fisheye" else np.tan(STEEPEST), RADII)
        with np.errstate(invalid="ignore", divide="ignore"):
            shown = self._angle(r) if self.kind == "fisheye" else r * self._radial(r * r)
            rising = np.diff(shown) > 0
        end = RADII if rising.all() else 1 + int(np.argmin(rising))
        return np.interp(length, shown[:end], r[:end])

    def _angle(self, theta: Array) -> Array:
        k1, k2, k3, k4 = self.coefficients
        t2 = theta * theta
        return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


def undistorted_camera(camera: Camera, lens: Lens) -> Camera:
    """Compute the largest pinhole camera of equal focal length and axis without blank pixels.

    Args:
        camera: camera of the distorted picture, without the lens.
        lens: lens of the distorted picture.

    Returns:
        A camera at the same pose; its image is a window of whole pixels, at most twice as wide and
        high as the distorted one.

    Raises:
        ValueError: the coefficients fold the picture over, so that no inverse exists, or no window
            without a blank pixel exists.

    Example:
        >>> from attnwarp.io import Lens, undistorted_camera
        >>> from attnwarp.trial import view
        >>> camera = view(side=64)
        >>> pinhole = undistorted_camera(camera, Lens("brown", (-0.5,)))  # a barrel shows more
        >>> pinhole.width > 64, bool(pinhole.K[0, 0] == camera.K[0, 0])
        (True, True)
    """
    W, H = camera.width, camera.height
    across, down = np.arange(W) + 0.5, np.arange(H) + 0.5
    sides = [
        np.stack([np.full(H, 0.5), down], -1), np.stack([np.full(H, W - 0.5), down], -1),
        np.stack([across, np.full(W, 0.5)], -1), np.stack([across, np.full(W, H - 0.5)], -1),
    ]  # fmt: skip
    points = [lens.undistort(camera.directions(side)[..., :2]) for side in sides]
    for side, point in zip(sides, points, strict=True):
        steep = np.linalg.norm(point, axis=-1) >= np.tan(STEEPEST) * (1 - 1e-9)
        error = np.abs(_pixels(camera, lens.distort(point)) - side).max(axis=-1)
        if not (steep | (error <= ROUND_TRIP)).all():
            raise _folded(camera, lens)
    # The inverse of a border pixel may lie beyond two folds, even on the axis' other side, where
    # the picture is no longer mirrored: the whole way there is searched.
    ends = np.concatenate([point[:: max(1, len(point) // RAYS)] for point in points])
    if lens.folds(ends * np.linspace(0, 1, STEPS)[:, None, None]).any():
        raise _folded(camera, lens)
    left, right, top, bottom = (_pixels(camera, point) for point in points)
    cx, cy = camera.K[0, 2], camera.K[1, 2]
    x0, x1 = _window(left[:, 0].max(), right[:, 0].min(), cx, W)
    y0, y1 = _window(top[:, 1].max(), bottom[:, 1].min(), cy, H)
    if x1 <= x0 or y1 <= y0:
        raise ValueError(
            f"lens: the coefficients {lens.coefficients} bend the borders of the picture of camera"
            f" {camera.name!r} so far that no window without a blank pixel is left; calibrate the"
            " lens again"
        )
    K = camera.K.copy()
    K[:2, 2] -= [x0, y0]
    return Camera(K, camera.world_to_camera, x1 - x0, y1 - y0, camera.name)


def _folded(camera: Camera, lens: Lens) -> ValueError:
    return ValueError(
        f"lens: the coefficients {lens.coefficients} fold the picture of camera {camera.name!r}"
        " over, so it cannot be undistorted; calibrate the lens again"
    )


def undistorted_image(
    image: npt.NDArray[Any], camera: Camera, lens: Lens, target: Camera
) -> npt.NDArray[Any]:
    """Resample a picture (bilinearly) to the pinhole camera ``target`` at the same pose.

    Args:
        image: (H, W, C) uint8 or uint16, taken by ``camera`` through ``lens``; a fourth channel is
            straight alpha.
        camera, lens: camera and lens of the picture.
        target: camera to resample to.

    Returns:
        (target.height, target.width, C) of the same dtype; 0 outside the picture.

    Raises:
        ValueError: ``image`` and ``camera`` differ in size.

    Example:
        >>> import numpy as np
        >>> from attnwarp.io import Lens, undistorted_camera, undistorted_image
        >>> from attnwarp.trial import view
        >>> camera, lens = view(), Lens("brown", (-0.2,))
        >>> grey = np.full((32, 32, 3), 128, np.uint8)
        >>> image = undistorted_image(grey, camera, lens, undistorted_camera(camera, lens))
        >>> np.unique(image).tolist()  # grey everywhere, no blank border
        [128]
    """
    from scipy.ndimage import map_coordinates

    check.shape(image, (camera.height, camera.width, "C"), "image")
    xy = _pixels(camera, lens.distort(target.directions()[..., :2]))
    outside = ~(
        (xy[..., 0] >= 0) & (xy[..., 0] <= camera.width)
        & (xy[..., 1] >= 0) & (xy[..., 1] <= camera.height)
    )  # fmt: skip
    rows = np.where(outside, 0.0, xy[..., 1] - 0.5)
    columns = np.where(outside, 0.0, xy[..., 0] - 0.5)

    def resampled(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        result = np.empty((target.height, target.width, values.shape[2]), values.dtype)
        for channel in range(values.shape[2]):
            value = map_coordinates(
                values[..., channel].astype(np.float64), [rows, columns], order=1, mode="nearest"
            )
            whole = np.rint(value) if result.dtype.kind == "u" else value
            result[..., channel] = np.where(outside, 0, whole)
        return result

    if image.shape[2] == 4:
        return weighted_by_alpha(image, resampled)
    return resampled(image)


def _pixels(camera: Camera, xy: Array) -> Array:
    """Convert (..., 2) normalised coordinates to px."""
    K = camera.K
    return np.stack(
        [
            K[0, 0] * xy[..., 0] + K[0, 1] * xy[..., 1] + K[0, 2],
            K[1, 1] * xy[..., 1] + K[1, 2],
        ],
        axis=-1,
    )


def _window(low: float, high: float, center: float, size: int) -> tuple[int, int]:
    """Count pixels with centres in [low, high], at most LARGEST_GROWTH times ``size``."""
    first, last = int(np.ceil(low - 0.5)), int(np.floor(high - 0.5)) + 1
    spare = last - first - int(LARGEST_GROWTH * size)
    if spare > 0:
        # Cropped first from the side that is farther from the principal point.
        cut = int(np.clip(round((spare + (center - first) - (last - center)) / 2), 0, spare))
        first, last = first + cut, last - (spare - cut)
    return first, last
