"""Encoding of pictures as PNG and JPEG."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt


def encode_picture(
    image: npt.ArrayLike,
    suffix: str = ".png",
    *,
    quality: int = 85,
    chroma: Literal["444", "420"] = "444",
) -> bytes:
    """Encode a picture as the bytes of a file.

    Args:
        image: (H, W, 3) sRGB, floating and clipped to [0, 1], or uint8.
        chroma: chroma of a JPEG: colours at full ("444") or half ("420") resolution.

    Raises:
        ValueError: the shape or suffix is unsupported.

    >>> encode_picture(np.zeros((2, 3, 3)))[:4]
    b'\\x89PNG'
    """
    import cv2

    from attnwarp.io.images import encode_png

    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"image: got shape {pixels.shape}, expected (H, W, 3)")
    if suffix not in (".png", ".jpg"):
        raise ValueError(f"suffix: got {suffix!r}, expected '.png' or '.jpg'")
    if pixels.dtype != np.uint8:
        pixels = np.clip(np.rint(pixels * 255), 0, 255).astype(np.uint8)
    if suffix == ".png":
        return encode_png(pixels)
    sampling = getattr(cv2, f"IMWRITE_JPEG_SAMPLING_FACTOR_{chroma}")
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    encoded, data = cv2.imencode(suffix, pixels[..., ::-1], options)
    if not encoded:
        raise ValueError(f"image: OpenCV makes no {suffix} of shape {pixels.shape}")
    return bytes(data.tobytes())
