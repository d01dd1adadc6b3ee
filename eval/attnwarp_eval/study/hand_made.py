"""Source views edited by hand, as a person would with a picture editor, and drawn from the truth.

The true result of such an edit is that of the scene's edit, so that all other views can be judged.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

Kind = Literal["recoloured", "painted", "pasted"]
KINDS: tuple[str, ...] = get_args(Kind)

COVER = 0.7
"""Opacity of the paint."""

SHIFT = 1
"""Pixels that a pasted cut-out is off its place, to the right and down."""


def hand_made(kind: str, original: Image, truth: Image, mask: Mask, seed: int = 0) -> Image:
    """The source view, edited by hand.

    ``recoloured``: the object's pixels are moved in CIELAB until their mean is the true one, which
    keeps texture and shading. ``painted``: round strokes of the true mean colour across the object,
    that cover most of it. ``pasted``: the truly edited object, cut out one pixel inside its edge
    and pasted one pixel off its place.

    Args:
        kind: one of :data:`KINDS`.
        original: (H, W, 3) sRGB in [0, 1], the view before the edit.
        truth: (H, W, 3), the view after it.
        mask: (H, W), the edited object.
        seed: of the strokes.

    Raises:
        ValueError: the source shows nothing of the object.

    Example:
        >>> import numpy as np
        >>> grey, red = np.full((8, 8, 3), 0.5, np.float32), np.zeros((8, 8, 3), np.float32)
        >>> red[..., 0] = 1
        >>> picture = hand_made("pasted", grey, red, np.eye(8, dtype=bool)[::-1] | True)
        >>> picture[4, 4].tolist(), picture[0, 0].tolist()
        ([1.0, 0.0, 0.0], [0.5, 0.5, 0.5])
    """
    if not mask.any():
        raise ValueError("mask: the source view shows nothing of the edited object")
    make = {"recoloured": _recoloured, "painted": _painted, "pasted": _pasted}[kind]
    return np.clip(make(original, truth, mask, seed), 0, 1).astype(np.float32)


def _recoloured(original: Image, truth: Image, mask: Mask, seed: int) -> Image:
    from skimage.color import lab2rgb, rgb2lab

    before, after = rgb2lab(original), rgb2lab(truth)
    moved = before.copy()
    moved[mask] += after[mask].mean(0) - before[mask].mean(0)
    return np.where(mask[..., None], lab2rgb(moved), original)


def _painted(original: Image, truth: Image, mask: Mask, seed: int) -> Image:
    import cv2

    rng = np.random.default_rng(seed)
    points = np.argwhere(mask)[:, ::-1]
    width = max(2, round(float(np.sqrt(mask.sum())) / 4))
    strokes = np.zeros(mask.shape, np.uint8)
    for _ in range(12):
        (x, y), (u, v) = points[rng.integers(len(points), size=2)].tolist()
        cv2.line(strokes, (x, y), (u, v), 1, width)
    # A steady hand stays within the lines.
    paint = COVER * ((strokes > 0) & mask).astype(np.float32)[..., None]
    return (1 - paint) * original + paint * truth[mask].mean(0)


def _pasted(original: Image, truth: Image, mask: Mask, seed: int) -> Image:
    import cv2

    inside = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    cut = np.roll(inside, SHIFT, (0, 1))
    cut[:SHIFT], cut[:, :SHIFT] = False, False
    return np.where(cut[..., None], np.roll(truth, SHIFT, (0, 1)), original)
