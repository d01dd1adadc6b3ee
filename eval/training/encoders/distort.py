"""Distortions of known strength, on one scale from 0 (unseen) to 5 (ruined).

The scale is defined here, not measured on people. Within a kind, it follows the parameter, so its
order is beyond doubt. Between kinds, it is coarse: a shift by one pixel is weaker than a blur of
two. So pairs of different kinds differ by at least a full step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[Any]
Apply = Callable[[Image, float, np.random.Generator], Image]

MARGIN = 8
"""Pixels around a crop that shifts may draw in."""


def _between(strength: float, values: tuple[float, ...]) -> float:
    """The parameter at a strength, linear between those given for 0, 1, 2, ..."""
    return float(np.interp(strength, np.arange(len(values)), values))


def _shift(image: Image, strength: float, rng: np.random.Generator) -> Image:
    far, angle = _between(strength, (0, 2.0, 5.0)), rng.uniform(0, 2 * np.pi)
    move = np.array([[1, 0, far * np.cos(angle)], [0, 1, far * np.sin(angle)]])
    # Cubic taps keep the detail that linear ones would blur away at half a pixel.
    return cv2.warpAffine(
        image, move, image.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101
    )


def _turn(image: Image, strength: float, rng: np.random.Generator) -> Image:
    angle = _between(strength, (0, 2.0, 5.0)) * (1 if rng.uniform() < 0.5 else -1)
    h, w = image.shape[:2]
    move = cv2.getRotationMatrix2D((w / 2 - 0.5, h / 2 - 0.5), angle, 1)
    return cv2.warpAffine(
        image, move, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101
    )


def _blur(image: Image, strength: float, rng: np.random.Generator) -> Image:
    sigma = _between(strength, (0, 0.6, 1.0, 1.7, 2.9, 5.0))
    return cv2.GaussianBlur(image, (0, 0), sigma) if sigma > 0.05 else image


def _motion(image: Image, strength: float, rng: np.random.Generator) -> Image:
    long, angle = _between(strength, (0, 2.5, 4.5, 7.5, 12, 20)), rng.uniform(0, np.pi)
    steps = np.linspace(-0.5, 0.5, 2 * int(np.ceil(long)) + 1) * long
    total = np.zeros_like(image)
    for s in steps:
        move = np.array([[1, 0, s * np.cos(angle)], [0, 1, s * np.sin(angle)]])
        total += cv2.warpAffine(
            image,
            move,
            image.shape[1::-1],
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT_101,
        )
    return total / len(steps)


def _noise(image: Image, strength: float, rng: np.random.Generator) -> Image:
    return image + rng.normal(
        0, _between(strength, (0, 0.02, 0.045, 0.09, 0.16, 0.28)), image.shape
    ).astype(np.float32)


def _jpeg(image: Image, strength: float, rng: np.random.Generator) -> Image:
    quality = round(_between(strength, (95, 60, 30, 15, 7, 3)))
    ok, code = cv2.imencode(
        ".jpg",
        np.clip(image * 255, 0, 255).astype(np.uint8)[..., ::-1],
        [cv2.IMWRITE_JPEG_QUALITY, quality],
    )
    back = cv2.imdecode(code, cv2.IMREAD_COLOR)
    assert ok and back is not None
    return back[..., ::-1].astype(np.float32) / 255


def _brightness(image: Image, strength: float, rng: np.random.Generator) -> Image:
    gain = _between(strength, (0, 0.06, 0.13, 0.22, 0.34, 0.5))
    return image * (1 - gain) if rng.uniform() < 0.5 else 1 - (1 - image) * (1 - gain)


def _contrast(image: Image, strength: float, rng: np.random.Generator) -> Image:
    keep = 1 - _between(strength, (0, 0.15, 0.3, 0.47, 0.65, 0.85))
    return image.mean() + keep * (image - image.mean())


def _saturation(image: Image, strength: float, rng: np.random.Generator) -> Image:
    keep = 1 - _between(strength, (0, 0.35, 0.7, 1.0))
    grey = image @ np.array([0.299, 0.587, 0.114], np.float32)
    return grey[..., None] + keep * (image - grey[..., None])


def _cast(image: Image, strength: float, rng: np.random.Generator) -> Image:
    way = rng.normal(size=3)
    way -= way.mean()
    amount = _between(strength, (0, 0.03, 0.07, 0.12, 0.19, 0.28))
    return image + (amount * way / np.linalg.norm(way) * np.sqrt(3)).astype(np.float32)


KINDS: dict[str, tuple[Apply, float]] = {
    "shift": (_shift, 1.9), "turn": (_turn, 1.9), "blur": (_blur, 5.0), "motion": (_motion, 5.0), "noise": (_noise, 5.0),
    "jpeg": (_jpeg, 5.0), "brightness": (_brightness, 5.0), "contrast": (_contrast, 5.0), "saturation": (_saturation, 2.9),
    "cast": (_cast, 5.0),
}  # fmt: skip
"""Every kind: how it is done, and the greatest strength it reaches (a shift alone never ruins a
picture).
"""

TRAIN_KINDS = tuple(KINDS)


def distorted(image: Image, kind: str, strength: float, seed: int) -> Image:
    """The picture with a distortion of a kind and strength.

    Args:
        image: (H, W, 3) in [0, 1], with :data:`MARGIN` pixels around what is returned.
        kind: a key of :data:`KINDS`.
        strength: 0 to the kind's greatest.
        seed: seed of directions, signs and noise; the same one for both of a pair of one kind, so
            that strength alone differs.
    """
    apply, _ = KINDS[kind]
    out = apply(image, strength, np.random.default_rng(seed))
    m = MARGIN
    return np.clip(out[m:-m, m:-m], 0, 1).astype(np.float32)


def draw_pair(
    rng: np.random.Generator, kinds: tuple[str, ...], *, across: float = 0.5
) -> tuple[tuple[str, float, int], tuple[str, float, int]]:
    """A weaker and a stronger distortion, each (kind, strength, seed).

    Args:
        across: share of pairs of two different kinds, at least a full step apart; of one kind, at
            least 0.35 of a step.
    """
    while True:
        one, other = (str(k) for k in rng.choice(kinds, 2))
        if rng.uniform() > across:
            other = one
        elif other == one:
            continue
        a, b = rng.uniform(0.15, KINDS[one][1]), rng.uniform(0.15, KINDS[other][1])
        if b - a < (0.35 if one == other else 1.0):
            continue
        seed = int(rng.integers(2**31))
        return (one, a, seed), (other, b, seed)
