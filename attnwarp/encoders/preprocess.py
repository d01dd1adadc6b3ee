"""Preprocessing of pictures for pretrained networks.

Resizing uses Pillow's filter, as the reference pipelines do, but on floating values. Those
pipelines round to 8 bits before and after it, which turns differences below 1/255 into noise.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError
from attnwarp.io.text import read_text

FILTERS = {0: "nearest", 1: "Lanczos", 2: "bilinear", 3: "bicubic", 4: "box", 5: "Hamming"}
"""Pillow's filter numbers, as stored in the file."""

_SAMPLED = "bicubic, not antialiased"


@dataclass(frozen=True)
class Preprocessing:
    """Preprocessing steps: resize, crop, scale, normalise, in this order; None skips a step.

    Attributes:
        resize: side in px of the resized shorter edge (the other edge is rounded down), or
            (height, width).
        resample: Pillow's number of the filter.
        crop: (height, width) in px, cut from the centre; a smaller picture is padded with black.
        scale: factor applied to [0, 1]; 1 for networks that expect [0, 1].
        mean, std: mean and deviation of each channel, after the scaling.
        antialias: False resizes like torch's default: a cubic over the nearest 16 pixels for any
            shrinking factor.
    """

    resize: int | tuple[int, int] | None
    resample: int = 3
    crop: tuple[int, int] | None = None
    scale: float = 1.0
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    antialias: bool = True

    @property
    def shape(self) -> tuple[int, int] | None:
        """Output (height, width); None if it depends on the picture."""
        return self.crop or (self.resize if isinstance(self.resize, tuple) else None)

    @property
    def seen(self) -> float:
        """Share of a picture's shorter side left by the crop, in (0, 1]."""
        if self.crop is None or not isinstance(self.resize, int):
            return 1.0
        return min(1.0, min(self.crop) / self.resize)

    def __call__(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Convert (H, W, 3) in [0, 1] to (3, h, w), normalised."""
        if self.resize is not None:
            size = _target(image, self.resize)
            image = resize(image, size, self.resample) if self.antialias else sampled(image, size)
        if self.crop is not None:
            image = center_crop(image, self.crop)
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        scaled = (image * np.float32(self.scale) - mean) / std
        return np.ascontiguousarray(scaled.transpose(2, 0, 1), dtype=np.float32)

    def __str__(self) -> str:
        steps = []
        if self.resize is not None:
            to = self.resize
            what = f"the shorter edge to {to}" if isinstance(to, int) else f"to {to[1]} x {to[0]}"
            how = f"{FILTERS[self.resample]}, antialiased" if self.antialias else _SAMPLED
            steps.append(f"resized {what} px ({how}, floating)")
        if self.crop is not None:
            steps.append(f"the central {self.crop[1]} x {self.crop[0]} px cut out")
        if self.scale != 1:
            steps.append(f"times {self.scale:g}")
        mean, std = (", ".join(f"{v:.4g}" for v in values) for values in (self.mean, self.std))
        return "; ".join([*steps, f"minus ({mean}), over ({std})"])


def resize(
    image: npt.NDArray[np.float32], size: tuple[int, int], resample: int = 3
) -> npt.NDArray[np.float32]:
    """Resize (H, W, 3) in [0, 1] to (h, w, 3) with a Pillow filter, antialiased when shrinking.

    Args:
        resample: Pillow's number of the filter; 3 is bicubic.

    Returns:
        Picture in [0, 1]: overshoots of a cubic at edges are clipped, as with 8 bits.
    """
    from PIL import Image

    if image.shape[:2] == size:
        return image
    channels = []
    for c in range(3):
        channel = np.ascontiguousarray(image[..., c])
        # Width, then height, each clipped, as Pillow does in 8 bits. If the aspect ratio changes,
        # Pillow may resize height first, which only affects clipped values.
        for shape in ((size[1], image.shape[0]), (size[1], size[0])):
            channel = np.asarray(Image.fromarray(channel).resize(shape, resample)).clip(0, 1)
        channels.append(channel)
    return np.stack(channels, axis=2)


def sampled(image: npt.NDArray[np.float32], size: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Resize (H, W, 3) in [0, 1] to (h, w, 3), bicubic, not antialiased, clipped to [0, 1].

    Example:
        >>> half = sampled(np.eye(4, dtype=np.float32)[..., None].repeat(3, axis=2), (2, 2))
        >>> half[..., 0].astype(float).round(3).tolist()  # (-3, 19, 19, -3) / 32 of four
        [[0.611, 0.0], [0.0, 0.611]]
    """
    import torch

    planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]
    small = torch.nn.functional.interpolate(planes, size, mode="bicubic", align_corners=False)
    return np.ascontiguousarray(small[0].numpy().transpose(1, 2, 0).clip(0, 1))


def center_crop(image: npt.NDArray[np.float32], size: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Crop the central (h, w) px of (H, W, 3); a smaller picture is padded with black."""
    out = np.zeros((*size, image.shape[2]), image.dtype)
    window = []
    for side, target in zip(image.shape[:2], size, strict=True):
        start = (side - target) // 2
        low, high = max(start, 0), min(start + target, side)
        window.append((slice(low - start, high - start), slice(low, high)))
    out[window[0][0], window[1][0]] = image[window[0][1], window[1][1]]
    return out


def _target(image: npt.NDArray[np.float32], size: int | tuple[int, int]) -> tuple[int, int]:
    if isinstance(size, tuple):
        return size
    height, width = image.shape[:2]
    longer = int(size * max(height, width) / min(height, width))
    return (size, longer) if height <= width else (longer, size)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file with an object; InputError names the file."""
    try:
        value = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error}); fetch the file again") from None
    if not isinstance(value, dict):
        raise InputError(f"{path}: holds a {type(value).__name__}, expected an object")
    return value
