"""Agreement of two edited views on a surface's colour: exactly, and as published work
approximates it.

Exactly: :func:`cross_view` compares the colours of the same surface point in two pictures, at
correspondences known from the scene. Published work has no such correspondences and takes
optical flow between the unedited pictures instead (Lai et al. 2018, Learning Blind Video Temporal
Consistency); :func:`optical_flow` finds it, and
:func:`attnwarp_eval.metrics.disagreement_at` compares along it. Only the positions differ between
the two.

Pictures are sRGB in [0, 1]. Sampling is in linear light, since a pixel is a mean of light, and at
exact positions in float64. Two other samplers are unsuitable: ``cv2.remap`` rounds positions to
1/32 px, and :mod:`attnwarp.warp` is under test.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.metrics._pictures import picture, region
from attnwarp_eval.metrics.arrays import Array, Mask, mean

if TYPE_CHECKING:
    from attnwarp_eval.two_view import TwoView

FLOW_LEAST = 12
"""Smallest side in pixels that OpenCV's DIS takes; below it there is no flow."""

FLOW_SLOPE, FLOW_SLACK = 0.01, 0.5
"""Forward-backward check: |f + b|^2 <= 0.01 (|f|^2 + |b|^2) + 0.5 px^2 (Sundaram 2010, 3)."""


@dataclass(frozen=True, eq=False)
class Disagreement:
    """Disagreement of two pictures at each pixel of the target, and the counted pixels.

    Attributes:
        counted: (H, W) bool, pixels that were compared.
        srgb: (H, W, 3) target minus source at the same point, sRGB; NaN elsewhere.
        delta_e: (H, W) CIEDE2000 between the two colours (D65, 2 degree observer); NaN elsewhere.
        candidates: number of pixels considered; at exact correspondences, pixels that have
            a position.
    """

    counted: Mask
    srgb: Array
    delta_e: Array
    candidates: int

    def figures(self, prefix: str = "") -> dict[str, float]:
        """The ``consistency.*`` figures with ``prefix`` before each name; NaN without pixels."""
        values = {
            "mae_srgb": mean(np.abs(self.srgb[self.counted])),
            "delta_e": mean(self.delta_e[self.counted]),
            "pixels": int(self.counted.sum()),
        }
        return {f"consistency.{prefix}{name}": value for name, value in values.items()}


def cross_view(
    source_srgb: Any, target_srgb: Any, pair: TwoView, *, mask: Any = None
) -> Disagreement:
    """Compare the colours of the same surface points in two pictures, at exact correspondences.

    A target pixel counts if

    - the source certainly shows it (``pair.visible``),
    - it lies in neither view within 2 px of a depth or object edge (``pair.edge``), and
    - its position has all four bilinear taps.

    There the two TRUE pictures differ too, due to bilinear sampling, the area that a pixel covers
    in either view, the noise of the renderer, and highlights. The same figure of the true pictures
    is this floor; report it with the figure.

    Args:
        source_srgb, target_srgb: (H, W, 3) sRGB in [0, 1], of the sizes of ``pair``'s cameras.
        pair: :func:`attnwarp_eval.truth.two_view` of them.
        mask: (H, W) bool of the target, pixels to compare, such as the edited object's; by default
            all.

    Raises:
        ValueError: a picture that is not sRGB in [0, 1] or has another size than its camera.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> from attnwarp_eval.scene.file import load_scene
        >>> from attnwarp_eval.truth import Geometry, two_view
        >>> scene = load_scene("spheres").with_size(32, 32)
        >>> pair = two_view(Geometry(scene), scene.source, scene.targets[0])
        >>> grey = np.full((32, 32, 3), 0.5)
        >>> difference = metrics.cross_view(grey, grey + 0.1, pair)
        >>> round(float(np.nanmax(difference.srgb)), 6), difference.counted.any().item()
        (0.1, True)
    """
    source = picture(source_srgb, "source_srgb", shape=(pair.source.height, pair.source.width))
    target = picture(target_srgb, "target_srgb", shape=pair.label.shape)
    selected = region(mask, target.shape) & pair.visible
    counted = selected & ~pair.edge
    return disagreement(source, target, pair.xy, counted, int(selected.sum()))


@dataclass(frozen=True, eq=False)
class Flow:
    """Optical flow from a target picture to a source picture.

    Attributes:
        xy: (H, W, 2) source positions in pixels, centres at +0.5; NaN where there is no flow.
        accepted: (H, W) bool: inside the source picture and past the forward-backward check.
    """

    xy: Array
    accepted: Mask


def optical_flow(source_srgb: Any, target_srgb: Any) -> Flow:
    """Find each target pixel in the source picture by OpenCV's Dense Inverse Search (Kroeger et al.
    2016) with the medium preset, in 8-bit grey.

    Args:
        source_srgb, target_srgb: (H, W, 3) sRGB in [0, 1], of one size; the UNEDITED pictures, as
            in published work.

    Returns:
        Flow with NaN and False everywhere for pictures below 12 x 12 px.

    Raises:
        ValueError: pictures of different sizes or not sRGB in [0, 1].

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> x, y = np.meshgrid(np.arange(64), np.arange(64))
        >>> grey = 0.5 + 0.2 * (np.sin(x / 3) + np.sin(y / 4))
        >>> pattern = np.stack([grey] * 3, axis=-1)
        >>> flow = metrics.optical_flow(pattern, pattern)
        >>> np.abs(flow.xy[32, 32] - 32.5).max().item() < 0.1  # nothing moved
        True
    """
    target = picture(target_srgb, "target_srgb")
    source = picture(source_srgb, "source_srgb", shape=target.shape)
    height, width = shape = target.shape[:2]
    if min(shape) < FLOW_LEAST:
        return Flow(np.full((*shape, 2), np.nan), np.zeros(shape, dtype=bool))
    forward = _flow(_grey(target), _grey(source))
    backward = _flow(_grey(source), _grey(target))
    centers = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    xy = centers + forward
    inside = has_taps(xy, shape)
    back = np.full((*shape, 2), np.nan)
    back[inside] = sampled(backward, xy[inside])
    gap, length = (
        ((forward + back) ** 2).sum(axis=-1),
        (forward**2).sum(axis=-1) + (back**2).sum(axis=-1),
    )
    with np.errstate(invalid="ignore"):
        accepted = inside & (gap <= FLOW_SLOPE * length + FLOW_SLACK)
    return Flow(xy, accepted)


def has_taps(xy: Array, shape: tuple[int, ...]) -> Mask:
    """Positions with four bilinear taps in (H, W): within outermost pixel centres, not NaN."""
    height, width = shape[:2]
    with np.errstate(invalid="ignore"):
        inside: Mask = (
            (xy >= 0.5).all(axis=-1) & (xy[..., 0] <= width - 0.5) & (xy[..., 1] <= height - 0.5)
        )
    return inside


def sampled(image: Array, xy: Array) -> Array:
    """(N, C) bilinear samples of an (H, W, C) picture at (N, 2) positions that have taps."""
    from scipy.ndimage import map_coordinates

    indices = (xy[:, ::-1] - 0.5).T
    return np.stack(
        [
            map_coordinates(image[..., c], indices, order=1, mode="nearest")
            for c in range(image.shape[-1])
        ],
        -1,
    )


def disagreement(
    source: Array, target: Array, xy: Array, pixels: Mask, candidates: int
) -> Disagreement:
    """Disagreement of sRGB pictures, at the pixels of ``pixels`` whose position has taps."""
    from skimage.color import deltaE_ciede2000, rgb2lab

    counted = pixels & has_taps(xy, source.shape)
    shape = counted.shape
    srgb, delta_e = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    if counted.any():
        source_colors = to_srgb(sampled(to_linear(source), xy[counted]))
        target_colors = target[counted]
        srgb[counted] = target_colors - source_colors
        delta_e[counted] = deltaE_ciede2000(rgb2lab(target_colors), rgb2lab(source_colors))
    return Disagreement(counted, srgb, delta_e, candidates)


def _grey(image: Array) -> npt.NDArray[np.uint8]:
    import cv2

    return cv2.cvtColor(np.round(255 * image).astype(np.uint8), cv2.COLOR_RGB2GRAY).astype(np.uint8)


def _flow(target: npt.NDArray[np.uint8], source: npt.NDArray[np.uint8]) -> Array:
    """(H, W, 2) displacement of each pixel of the target in the source, in px."""
    import cv2

    cv: Any = cv2  # its stubs lack DIS, and None as the initial flow
    search = cv.DISOpticalFlow_create(cv.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return search.calc(target, source, None).astype(np.float64)
