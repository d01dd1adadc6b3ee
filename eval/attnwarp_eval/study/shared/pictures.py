"""Pictures of one cell and view, for display only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.io.picture import encode_picture
from attnwarp.warp import Surface, WarpedView, sample
from attnwarp_eval.two_view import AMBIGUOUS, HIDDEN, NONE, VISIBLE, Hits, TwoView

if TYPE_CHECKING:
    from attnwarp_eval.world import World

Image = npt.NDArray[np.float32]

WIDTH = 256
"""Pictures are reduced to this width: a mask's errors stay visible, and a report small."""

CLASSES: dict[str, tuple[str, str]] = {
    "visible, accepted": ("#2ca25f", "right"),
    "not visible, rejected": ("#4a4a4a", "right"),
    "hidden, accepted": ("#e31a1c", "wrong"),
    "outside the source image, accepted": ("#ff7f00", "wrong"),
    "behind the source camera, accepted": ("#e7298a", "wrong"),
    "visible, rejected": ("#1f78b4", "lost"),
    "ambiguous, not scored": ("#d9d06b", "either"),
}
"""Colours of a mask against truth, with the meaning of each class."""

EPE_RANGE = (1e-2, 10.0)
"""Pixels from the dark to the bright end of an endpoint error map, on a logarithmic scale."""

DEPTH_RANGE = 0.02
"""Relative depth error at the ends of the blue-white-red map: blue is too near, red too far."""


ORDER = ("warped", "mask", "endpoint-error", "render", "depth-error")
"""Order of pictures in a row; other pictures follow."""

SHARED = ("source", "target")
"""Pictures that are the same for every variant, shown once above the variants' rows."""


def of_warp(
    world: World, name: str, spp: int, truth: TwoView, view: WarpedView
) -> dict[str, bytes]:
    """JPEG files of a warp: the two true views, the warped source, mask and endpoint error."""
    source, target = world.image(world.source.name, spp), world.image(name, spp)
    return _jpegs(
        {
            "source": source,
            "target": target,
            "warped": warped(source, view),
            "mask": mask_against_truth(view.mask.numpy(), truth, target),
            "endpoint-error": endpoint_map(view.correspondence.xy.numpy(), truth),
        }
    )


def of_depth(surface: Surface, hits: Hits) -> dict[str, bytes]:
    """JPEG file of a depth map's error against the true hits."""
    depth = np.asarray(surface.depth, dtype=np.float64)
    return _jpegs({"depth-error": depth_map(depth, hits)})


def of_fit(surface: Surface, hits: Hits, image: npt.NDArray[np.uint8]) -> dict[str, bytes]:
    """JPEG files of a fit's held-out view, whose true picture is (H, W, 3) sRGB."""
    return _jpegs(
        {
            "target": (image / 255).astype(np.float32),
            "render": np.asarray(surface.image, dtype=np.float32),
            "depth-error": depth_map(np.asarray(surface.depth, dtype=np.float64), hits),
        }
    )


MARKS = {
    "the thing, marked": "#2ca25f",
    "the thing, not marked": "#1f78b4",
    "something else, marked": "#e31a1c",
}
"""Colours of a lifted mask against the exact one."""


def of_mask(
    world: World, name: str, marked: npt.NDArray[np.bool_], thing: npt.NDArray[np.bool_], spp: int
) -> dict[str, bytes]:
    """JPEG file of a lifted mask in the colours of :data:`MARKS` over the darkened target."""
    target = world.image(name, spp)
    classes = (marked & thing, ~marked & thing, marked & ~thing)
    grey = 0.35 * target.mean(axis=2, keepdims=True).repeat(3, axis=2)
    image = grey
    for color, pixels in zip(MARKS.values(), classes, strict=True):
        image = np.where(pixels[..., None], grey + 0.65 * rgb(color), image)
    return _jpegs({"target": target, "lifted": enlarged(image.astype(np.float32))})


def _jpegs(images: dict[str, Image]) -> dict[str, bytes]:
    return {name: jpeg(image) for name, image in images.items()}


def jpeg(image: Image) -> bytes:
    """An sRGB image in [0, 1], reduced to :data:`WIDTH`, as JPEG without chroma subsampling.

    A report with PNG pictures would be three times as large.
    """
    import cv2

    pixels: npt.NDArray[Any] = np.clip(np.rint(np.asarray(image) * 255), 0, 255).astype(np.uint8)
    if pixels.shape[1] > WIDTH:
        height = round(pixels.shape[0] * WIDTH / pixels.shape[1])
        pixels = cv2.resize(pixels, (WIDTH, height), interpolation=cv2.INTER_AREA)
    return encode_picture(pixels, ".jpg")


def enlarged(image: Image) -> Image:
    """A picture smaller than :data:`WIDTH` with each pixel as a block, for looking at."""
    block = max(1, WIDTH // image.shape[1])
    return np.kron(image, np.ones((block, block, 1), dtype=np.float32))


def rgb(color: str) -> npt.NDArray[np.float32]:
    """(3,) of a '#rrggbb' colour."""
    return np.array([int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)], dtype=np.float32)


def checkered(shape: tuple[int, int]) -> Image:
    """(H, W, 3) light grey squares of 16 px, which mean "nothing"."""
    y, x = np.indices(shape) // 16
    return np.repeat((0.78 + 0.1 * ((x + y) % 2))[..., None], 3, axis=2).astype(np.float32)


def carried(source: Image, view: WarpedView) -> Image:
    """(H, W, 3) the source image warped to the target, ignoring the mask."""
    planes = torch.from_numpy(np.ascontiguousarray(source.transpose(2, 0, 1)))
    return sample(planes, view.correspondence)[0].permute(1, 2, 0).numpy()


def warped(source: Image, view: WarpedView) -> Image:
    """(H, W, 3) the source image warped to the target; a checkerboard where the mask rejects."""
    height, width = view.mask.shape
    return np.where(view.mask.numpy()[..., None], carried(source, view), checkered((height, width)))


def mask_against_truth(mask: npt.NDArray[np.bool_], truth: TwoView, target: Image) -> Image:
    """(H, W, 3) the mask in the colours of :data:`CLASSES` over the darkened target."""
    label, surface = truth.label, truth.hits.valid
    outside = (label == NONE) & surface
    classes: dict[str, Any] = {
        "visible, accepted": (label == VISIBLE) & mask,
        "not visible, rejected": ((label == HIDDEN) | outside) & ~mask,
        "hidden, accepted": (label == HIDDEN) & mask,
        "outside the source image, accepted": outside & ~truth.behind & mask,
        "behind the source camera, accepted": outside & truth.behind & mask,
        "visible, rejected": (label == VISIBLE) & ~mask,
        "ambiguous, not scored": label == AMBIGUOUS,
    }
    grey = target.mean(axis=2, keepdims=True).repeat(3, axis=2)
    image = 0.35 * grey
    for name, pixels in classes.items():
        image = np.where(pixels[..., None], 0.35 * grey + 0.65 * rgb(CLASSES[name][0]), image)
    return np.asarray(image, dtype=np.float32)


def endpoint_map(xy: npt.NDArray[np.float64], truth: TwoView) -> Image:
    """Endpoint error of visible pixels, logarithmic; grey elsewhere, red without a position."""
    import matplotlib

    error = np.linalg.norm(xy - truth.xy, axis=-1)
    low, high = np.log10(EPE_RANGE)
    scaled = (np.log10(np.maximum(np.nan_to_num(error), 1e-12)) - low) / (high - low)
    image = matplotlib.colormaps["viridis"](np.clip(scaled, 0, 1))[..., :3]
    image = np.where(np.isfinite(error)[..., None], image, rgb("#b2182b"))
    return np.where(truth.visible[..., None], image, 0.85).astype(np.float32)


def depth_map(depth: npt.NDArray[np.float64], truth: Hits) -> Image:
    """Signed relative depth error: blue too near, red too far, grey no surface, black no depth."""
    import matplotlib

    with np.errstate(invalid="ignore"):
        error = (depth - truth.depth) / truth.depth
    image = matplotlib.colormaps["RdBu_r"](
        np.clip(0.5 + 0.5 * np.nan_to_num(error) / DEPTH_RANGE, 0, 1)
    )[..., :3]
    image = np.where(np.isfinite(error)[..., None], image, 0.0)
    return np.where(truth.valid[..., None], image, 0.7).astype(np.float32)
