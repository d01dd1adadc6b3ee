"""Pictures of views: sizes, segments, and masks."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.camera import Camera

Image = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Segment = npt.NDArray[Any]
"""(H, W) bool, or float32 in [0, 1] for a mask with soft edges: values above 1/2 are inside."""
Size = tuple[int, int]


def edit_size(height: int, width: int, longest: int | None, multiple: int) -> Size:
    """Compute the (h, w) of a picture's edit: a longest side, both sides multiples of a number."""
    scale = 1.0 if longest is None else longest / max(height, width)
    h, w = (max(multiple, round(n * scale / multiple) * multiple) for n in (height, width))
    return h, w


MULTIPLES = (8, 16, 32, 64)
"""Multiples to which editors round the sides of a picture."""


def check_view_aspect(size: Size, camera: Camera, name: str) -> None:
    """Refuse a picture or mask whose aspect ratio differs from its view's.

    Args:
        size: (h, w) of the picture: the view's aspect ratio, up to an editor's rounding of the
            sides to multiples.
    """
    full = (camera.height, camera.width)
    if all(edit_size(*full, max(size), multiple) != size for multiple in MULTIPLES):
        check.same_aspect(size, full, name, f"crop or pad it to the view {camera.name!r}")


def resized(image: Image, size: Size) -> Image:
    """Resize an (H, W, 3) picture in [0, 1]: shrinking averages, enlarging is cubic."""
    import cv2

    if image.shape[:2] == size:
        return image
    shrinks = size[0] * size[1] < image.shape[0] * image.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    result = cv2.resize(np.ascontiguousarray(image), size[::-1], interpolation=how)
    return np.clip(result, 0, 1).astype(np.float32)


def enlarged_change(original: Image, edited: Image) -> Image:
    """Add the change of an edit of another size to the full-size picture.

    The change is enlarged linearly, or averaged if the edit is larger than the picture.
    """
    import cv2

    h, w = original.shape[:2]
    if edited.shape[:2] == (h, w):
        return edited
    change = edited - resized(original, (edited.shape[0], edited.shape[1]))
    # Linear weights read only 2 x 2 px of a change, even if more fall on one pixel.
    shrinks = edited.shape[0] >= h and edited.shape[1] >= w
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    fitted = cv2.resize(change, (w, h), interpolation=how)
    return np.clip(original + fitted, 0, 1).astype(np.float32)


def composite(edited: Image, original: Image, segment: Segment, how: str, blur: float) -> Image:
    """Compose the edit inside a segment with the original or black outside.

    Args:
        edited, original: (h, w, 3) pictures in [0, 1].
        segment: (H, W) bool or in [0, 1], at any size.
        how: "none", "black" or "original".
        blur: sigma of the segment's blur, in px of the edit.
    """
    if how == "none":
        return edited
    import cv2

    h, w = edited.shape[:2]
    share: npt.NDArray[Any] = segment.astype(np.float32)
    if share.shape != (h, w):
        share = cv2.resize(share, (w, h), interpolation=cv2.INTER_AREA)
    if blur > 0:
        share = cv2.GaussianBlur(share, (0, 0), blur)
    behind = original if how == "original" else np.zeros_like(original)
    share = share[..., None]
    return np.clip(share * edited + (1 - share) * behind, 0, 1).astype(np.float32)


def full_size(
    original: Image, edited: Image, segment: Segment | None, how: str, blur: float
) -> Image:
    """Apply :func:`enlarged_change` to a composited edit, restricted to its segment.

    An enlarged change reaches beyond the pixels of its edit and brings back the original's detail
    in pixels that :func:`composite` left black.

    Args:
        segment: (H, W) bool or in [0, 1]; None if all is edited.
    """
    picture = enlarged_change(original, edited)
    if segment is None or how == "none" or edited.shape == original.shape:
        return picture
    reached = segment > 0
    if blur > 0:
        import cv2

        sigma = blur * original.shape[1] / edited.shape[1]
        reached = cv2.GaussianBlur(segment.astype(np.float32), (0, 0), sigma) > 0
    behind = original if how == "original" else np.zeros_like(original)
    return np.where(reached[..., None], picture, behind)


def to_bytes(image: npt.NDArray[Any]) -> Bytes:
    """Convert a picture in [0, 1] to (H, W, 3) uint8."""
    return np.asarray(np.rint(255 * np.clip(image, 0, 1)), dtype=np.uint8)


def mask_picture(mask: Tensor) -> Bytes:
    """Draw a mask, (H, W, 3) uint8: True is white."""
    pixels = 255 * mask.to(torch.uint8).cpu().numpy()
    return np.repeat(pixels[..., None], 3, axis=2)
