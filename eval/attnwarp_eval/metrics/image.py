"""Similarity of two pictures: MSE, PSNR, SSIM, MS-SSIM, and the Edit PSNR of a set of views.

Pictures are (H, W, 3) float32 or float64 in [0, 1], masks (H, W) bool. The functions do not convert
values: the caller decides whether they are sRGB or linear, and the figures of :func:`image_error`
say which. All sums are float64. With nothing to measure (an empty mask, a picture smaller than the
window) a figure is NaN, never 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.colors import to_linear
from attnwarp_eval.metrics._pictures import pair
from attnwarp_eval.metrics.arrays import Array, Mask, mean, share

Distance = Callable[[Array, Array], float]
"""Perceptual distance of two (H, W, 3) sRGB pictures in [0, 1]: a mean, 0 if equal."""

WINDOW = 11
"""Side of SSIM's window in px, as :data:`attnwarp.losses.SSIM_WINDOW`, without torch."""

MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the scales, finest first: Wang, Simoncelli & Bovik 2003, section 3.2."""


def mse(image: Any, target: Any, mask: Any = None) -> float:
    """Mean over the mask's pixels and channels of the squared difference; NaN for an empty mask.

    Args:
        image, target: (H, W, 3) in [0, 1], of one size. Values outside the mask do not
            count, NaN included.
        mask: (H, W) bool, the pixels that count; all if left out.

    Raises:
        ValueError: another dtype or shape, or a masked value that is not finite or outside [0,
            1].

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> black, grey = np.zeros((2, 2, 3)), np.full((2, 2, 3), 0.5)
        >>> metrics.mse(black, grey), metrics.mse(black, grey, np.zeros((2, 2), bool))
        (0.25, nan)
    """
    return _mse(*pair(image, target, mask))


def psnr(image: Any, target: Any, mask: Any = None) -> float:
    """-10 log10 of :func:`mse`, in dB: +inf if the pictures are equal, NaN for an empty mask.

    The error is divided by the pixels of the mask. Dividing by all pixels, with the others set to
    0, would add -10 log10(coverage): 6.02 dB at 25 %. The PSNR of several views is that of their
    mean MSE; see :func:`edit_psnr`. A mean of decibels is another figure, which hides bad views.

    Args:
        image, target: (H, W, 3) float32 or float64, sRGB in [0, 1].
        mask: (H, W) bool, True where a pixel counts; all pixels if left out.

    Raises:
        ValueError: another shape, type or range, or a value inside the mask that is not finite.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> black, grey = np.zeros((2, 2, 3)), np.full((2, 2, 3), 0.1)
        >>> round(metrics.psnr(black, grey), 9), metrics.psnr(grey, grey)
        (20.0, inf)
    """
    return psnr_of_mse(mse(image, target, mask))


def ssim(image: Any, target: Any, mask: Any = None) -> float:
    """Mean structural similarity (Wang, Bovik, Sheikh & Simoncelli 2004) over windows and channels;
    at most 1.

    The windows are 11 x 11, Gaussian with sigma 1.5, and lie wholly inside the picture and, given a
    mask, wholly inside the mask, so that no pixel outside counts. The values are those of
    :func:`attnwarp.losses.ssim`.

    Args:
        image, target: (H, W, 3) float32 or float64, sRGB in [0, 1].
        mask: (H, W) bool, True where a pixel counts; all pixels if left out.

    Returns:
        NaN without such a window: a picture below 11 x 11 px, or a mask without an 11 x
        11 square.

    Raises:
        ValueError: another shape, type or range, or a value inside the mask that is not finite.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> picture = np.random.default_rng(0).uniform(size=(16, 16, 3))
        >>> round(metrics.ssim(picture, picture), 9), metrics.ssim(picture, 1 - picture) < 0
        (1.0, True)
    """
    values = ssim_map(image, target, mask)
    return mean(values[np.isfinite(values)])


def ssim_map(image: Any, target: Any, mask: Any = None) -> Array:
    """(H - 10, W - 10) similarity of each window, a mean over channels; NaN if it is not wholly
    inside the mask. Arguments and errors are those of :func:`ssim`.

    The window at [i, j] is centred on the pixel [i + 5, j + 5]. Empty for a picture below 11 x 11
    px.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> picture = np.random.default_rng(0).uniform(size=(16, 12, 3))
        >>> metrics.ssim_map(picture, picture).shape
        (6, 2)
    """
    first, second, inside = pair(image, target, mask)
    if min(inside.shape) < WINDOW:
        return np.empty(tuple(max(0, side - WINDOW + 1) for side in inside.shape))
    luminance, structure = _terms(first, second)
    return np.where(whole_windows(inside), (luminance * structure).mean(axis=-1), np.nan)


def whole_windows(mask: Mask) -> Mask:
    """(H - 10, W - 10) bool: 11 x 11 windows wholly inside a mask of at least that size."""
    # A window is whole if it has no pixel outside: sums of an integral image are exact.
    outside = np.pad(np.cumsum(np.cumsum(~mask, axis=0), axis=1), ((1, 0), (1, 0)))
    columns: npt.NDArray[np.int64] = outside[WINDOW:] - outside[:-WINDOW]
    whole: Mask = columns[:, WINDOW:] == columns[:, :-WINDOW]
    return whole


def ms_ssim(image: Any, target: Any, mask: Any = None) -> float:
    """Multi-scale structural similarity (Wang, Simoncelli & Bovik 2003), in [0, 1].

    Contrast and structure count at five scales, luminance at the coarsest. Each is averaged over
    windows and channels, then multiplied with the paper's exponents. A scale has means of 2 x 2
    pixels of the previous one; an odd last row or column is dropped. A mean below 0 (pictures that
    are each other's negatives) has no real power and counts as 0.

    With a mask, a pixel of a coarser scale is inside if its four pixels are, and windows count
    as in :func:`ssim`, whose arguments and errors it has.

    Returns:
        NaN if a scale has no window: a side below 176 px, or a mask without a square of
        about that size.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> picture = np.full((176, 176, 3), 0.5)
        >>> round(metrics.ms_ssim(picture, picture), 9), metrics.ms_ssim(picture[1:], picture[1:])
        (1.0, nan)
    """
    first, second, inside = pair(image, target, mask)
    product = 1.0
    for scale, weight in enumerate(MS_SSIM_WEIGHTS):
        if scale:
            first, second = (_halved(x).mean(axis=(1, 3)) for x in (first, second))
            inside = _halved(inside).all(axis=(1, 3))
        if min(inside.shape) < WINDOW or not (windows := whole_windows(inside)).any():
            return math.nan
        luminance, structure = _terms(first, second)
        coarsest = scale == len(MS_SSIM_WEIGHTS) - 1
        term = luminance * structure if coarsest else structure
        product *= max(mean(term[windows]), 0.0) ** weight
    return product


def perceptual(image_srgb: Any, target_srgb: Any, distance: Distance, mask: Any = None) -> float:
    """Perceptual distance (such as LPIPS) of two pictures, or of their masked parts; NaN
    for an empty mask.

    Outside the mask the picture is replaced by the target. The distance is then divided by the
    mask's share of the picture. So a mean over pixels becomes a mean over the mask's pixels, except
    near its border: networks see a neighbourhood of each pixel. Pictures that are equal inside the
    mask have distance 0.

    Args:
        image_srgb, target_srgb: (H, W, 3) sRGB in [0, 1], of one size. Values outside the mask may
            be anything; there the network sees the target, black where the target is NaN or
            outside [0, 1].
        distance: function of both pictures in float64. For an encoder: ``lambda a, b:
            float(encoder.distance([a], [b])[0])``.
        mask: (H, W) bool, the pixels that count; all if left out.

    Raises:
        ValueError: another dtype or shape, or a masked value that is not finite or outside [0,
            1].

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> black, white = np.zeros((4, 4, 3)), np.ones((4, 4, 3))
        >>> mask = np.arange(16).reshape(4, 4) < 4  # the first row
        >>> metrics.perceptual(black, white, lambda a, b: float(np.abs(a - b).mean()), mask)
        1.0
    """
    image, target, inside = pair(image_srgb, target_srgb, mask, ("image_srgb", "target_srgb"))
    covered = share(int(inside.sum()), inside.size)
    if not covered > 0:
        return math.nan
    around = np.asarray(target_srgb, dtype=np.float64)
    target = np.where(inside[..., None] | ~((around >= 0) & (around <= 1)), target, around)
    return float(distance(np.where(inside[..., None], image, target), target)) / covered


def image_error(image_srgb: Any, target_srgb: Any, mask: Any = None) -> dict[str, float]:
    """The ``image.*`` figures of an sRGB picture against its reference.

    All are of the sRGB values, as is usual, except those named ``_linear``, which are of linear
    light and so weigh bright parts more.

    Args:
        image_srgb, target_srgb: (H, W, 3), sRGB-encoded, in [0, 1].
        mask: (H, W) bool, the pixels that count; all if left out.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> black, grey = np.zeros((16, 16, 3)), np.full((16, 16, 3), 0.1)
        >>> error = metrics.image_error(black, grey)
        >>> round(error["image.psnr"], 9)
        20.0
    """
    first, second, inside = pair(image_srgb, target_srgb, mask, ("image_srgb", "target_srgb"))
    error, linear = _mse(first, second, inside), _mse(to_linear(first), to_linear(second), inside)
    return {
        "image.mse": error,
        "image.psnr": psnr_of_mse(error),
        "image.mse_linear": linear,
        "image.psnr_linear": psnr_of_mse(linear),
        "image.ssim": ssim(first, second, inside),
        "image.ms_ssim": ms_ssim(first, second, inside),
        "image.pixels": int(inside.sum()),
    }


@dataclass(frozen=True)
class EditPsnr:
    """Fidelity of an edited scene's views to the edited pictures it was fitted to.

    Attributes:
        views: names of the measured views, in order. Methods that edit different views
            are not comparable by this figure: fewer edited views are easier to fit.
        mse: MSE of each view; NaN where undefined.
    """

    views: tuple[str, ...]
    mse: tuple[float, ...]

    @property
    def psnr(self) -> tuple[float, ...]:
        """PSNR of each view in dB; +inf for equal pictures, NaN where undefined."""
        return tuple(map(psnr_of_mse, self.mse))

    @property
    def pooled(self) -> float:
        """PSNR of the mean MSE of the views that have one: +inf if all are 0, NaN without any."""
        return psnr_of_mse(mean(np.array([error for error in self.mse if not math.isnan(error)])))

    @property
    def mean_finite(self) -> float:
        """Mean of the finite PSNRs, so without identical and undefined views; NaN without any."""
        return mean(np.array([value for value in self.psnr if math.isfinite(value)]))

    @property
    def identical(self) -> int:
        """Number of views with equal pictures, PSNR +inf."""
        return sum(value == math.inf for value in self.psnr)

    @property
    def undefined(self) -> int:
        """Number of views without a pixel to compare."""
        return sum(math.isnan(value) for value in self.psnr)

    def figures(self) -> dict[str, float]:
        """The ``edit.*`` figures; each view's as ``edit.psnr.NAME`` and ``edit.mse.NAME``."""
        return {
            "edit.psnr_pooled": self.pooled,
            "edit.psnr_mean": self.mean_finite,
            "edit.views": len(self.views),
            "edit.views_identical": self.identical,
            "edit.views_undefined": self.undefined,
            **{
                f"edit.psnr.{view}": value
                for view, value in zip(self.views, self.psnr, strict=True)
            },
            **{f"edit.mse.{view}": value for view, value in zip(self.views, self.mse, strict=True)},
        }


def edit_psnr(
    edited: Mapping[str, Any], rendered: Mapping[str, Any], masks: Mapping[str, Any] | None = None
) -> EditPsnr:
    """Edit PSNR: edited pictures against renders of the edited scene, view by view.

    Args:
        edited: (H, W, 3) in [0, 1] by the view's name, all edited views, from any
            stage.
        rendered: the same views of the scene fitted to them.
        masks: (H, W) bool by the view's name, counted pixels, for all views or none.

    Raises:
        ValueError: the three have different views; a picture that :func:`mse` refuses, with
            the view's name.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> edited = {"yaw010": np.zeros((4, 4, 3))}
        >>> result = metrics.edit_psnr(edited, {"yaw010": np.full((4, 4, 3), 0.1)})
        >>> round(result.pooled, 9), result.views
        (20.0, ('yaw010',))
    """
    for name, other in (("rendered", rendered), ("masks", masks)):
        if other is not None and set(other) != set(edited):
            without, beyond = sorted(set(edited) - set(other)), sorted(set(other) - set(edited))
            problems = [f"no view {without[0]!r}"] if without else []
            problems += (
                [f"a view {beyond[0]!r} that is not among the edited ones"] if beyond else []
            )
            raise ValueError(
                f"{name}: got {' and '.join(problems)}, expected the {len(edited)} views of edited"
            )
    errors = []
    for view, image in edited.items():
        mask = None if masks is None else masks[view]
        errors.append(
            _mse(*pair(image, rendered[view], mask, (f"edited[{view!r}]", f"rendered[{view!r}]")))
        )
    return EditPsnr(tuple(edited), tuple(errors))


def _mse(image: Array, target: Array, inside: Mask) -> float:
    return mean((image[inside] - target[inside]) ** 2)


def psnr_of_mse(error: float) -> float:
    """:func:`attnwarp.losses.psnr_of_mse`: +inf for 0, NaN for NaN. Views average the error."""
    from attnwarp import losses

    return losses.psnr_of_mse(error)


def _terms(image: Array, target: Array) -> tuple[Array, Array]:
    """(H - 10, W - 10, 3) luminance, and contrast and structure, of each window."""
    import torch

    from attnwarp import losses

    luminance, structure = losses.ssim_terms(torch.from_numpy(image), torch.from_numpy(target))
    return luminance.numpy(), structure.numpy()


def _halved(value: Any) -> Any:
    """(H, W, ...) as (H // 2, 2, W // 2, 2, ...): its 2 x 2 blocks."""
    height, width = (side // 2 for side in value.shape[:2])
    return value[: 2 * height, : 2 * width].reshape(height, 2, width, 2, *value.shape[2:])


def edit_drift(original: npt.NDArray[Any], edited: npt.NDArray[Any]) -> float:
    """Displacement in px of the corner that an edit moves most; NaN if it can't be told.

    Args:
        original, edited: (H, W, 3) in [0, 1], see :func:`attnwarp.drift.drift`.

    Example:
        >>> from attnwarp_eval.metrics.image import edit_drift
        >>> flat = np.zeros((64, 64, 3))
        >>> edit_drift(flat, flat)
        nan
    """
    from attnwarp.drift import drift

    found = drift(original, edited)
    return math.nan if found is None else found.largest
