"""The pictures that splats are fitted on, with their cameras."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.io import Dataset, FileFormatError, read_image
from attnwarp.io.images import weighted_by_alpha

HELD_OUT_EVERY = 8
"""One image of so many is held out where a data set names no split (LLFF's habit)."""


@dataclass(frozen=True, eq=False)
class Views:
    """Posed pictures.

    Args:
        cameras: one for each picture, at least one.
        images: (H, W, 3), or (H, W, 4) with straight (not premultiplied) alpha; sRGB; uint8,
            uint16, or floating in [0, 1]. They are kept as they are: 8 bits take a quarter of the
            memory.

    Raises:
        ValueError: lists of different lengths, a picture of another size than its camera's, a wrong
            dtype, values out of range; the message names the picture.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.fit import Views
        >>> camera = Camera.look_at((3, 0, 0), (0, 0, 0), width=4, height=3, fov_y=40)
        >>> len(Views([camera], [np.zeros((3, 4, 3), np.uint8)]))
        1
    """

    cameras: Sequence[Camera]
    images: Sequence[npt.NDArray[Any]]

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("cameras: got none, expected at least one")
        if len(self.images) != len(self.cameras):
            raise ValueError(
                f"images: got {len(self.images)}, expected {len(self.cameras)}, as cameras"
            )
        for i, (camera, image) in enumerate(zip(self.cameras, self.images, strict=True)):
            name = f"images[{i}] ({camera.name})"
            if image.ndim != 3 or image.shape[2] not in (3, 4):
                raise ValueError(
                    f"{name}: got shape {image.shape}, expected (H, W, 3) or (H, W, 4)"
                )
            if image.shape[:2] != (camera.height, camera.width):
                raise ValueError(
                    f"{name}: got {image.shape[1]} x {image.shape[0]} px, its camera has "
                    f"{camera.width} x {camera.height}; resize one of them"
                )
            if image.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
                raise ValueError(
                    f"{name}: got {image.dtype}, expected uint8, uint16, float32 or float64"
                )
            if image.dtype.kind == "f":
                check.finite(image, name)
                if image.min() < 0 or image.max() > 1:
                    raise ValueError(
                        f"{name}: got values in [{image.min()}, {image.max()}], expected [0, 1]"
                    )

    def __len__(self) -> int:
        return len(self.cameras)

    @cached_property
    def transparent(self) -> bool:
        """Whether any picture has pixels that are not opaque."""
        return any(
            image.shape[2] == 4 and bool((image[..., 3] < _top(image)).any())
            for image in self.images
        )

    def target(self, index: int, background: torch.Tensor) -> torch.Tensor:
        """(H, W, 3) float32 picture in [0, 1], over ``background`` (3,) where it is transparent."""
        image = self.images[index]
        picture = torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32)) / _top(image)
        if picture.shape[2] == 3:
            return picture
        alpha = picture[..., 3:]
        return picture[..., :3] * alpha + (1 - alpha) * background.to(picture.dtype)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of cameras and pictures: whether a fit that is taken up again has the same
        ones."""
        total = hashlib.sha256()
        for camera, image in zip(self.cameras, self.images, strict=True):
            spec = {**camera.to_dict(), "name": "", "dtype": str(image.dtype), "shape": image.shape}
            total.update(json.dumps(spec, sort_keys=True).encode())
            total.update(np.ascontiguousarray(image).tobytes())
        return total.hexdigest()


def _top(image: npt.NDArray[Any]) -> float:
    return float(np.iinfo(image.dtype).max) if image.dtype.kind == "u" else 1.0


def load_views(
    dataset: Dataset,
    *,
    max_size: int | None = None,
    damaged: Literal["warn", "error"] = "warn",
) -> Views:
    """Read the pictures of a data set; cameras without one are left out.

    Args:
        dataset: see :func:`attnwarp.io.read_dataset`.
        max_size: longest side in px; larger pictures are averaged down to it, and their cameras
            with them.
        damaged: "error" for pictures to measure on; see :func:`attnwarp.io.read_image`.

    Raises:
        FileFormatError: a picture that cannot be read, or of another size than its camera.
        ValueError: no camera has a picture.

    Example:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.fit import load_views
        >>> from attnwarp.io import Dataset
        >>> from attnwarp.io.images import encode_png
        >>> path = Path("a.png")
        >>> _ = path.write_bytes(encode_png(np.full((48, 64, 3), 255, np.uint8)))
        >>> camera = Camera.look_at((3, 0, 0), (0, 0, 0), width=64, height=48, fov_y=40)
        >>> views = load_views(Dataset([camera], [path]), max_size=32)
        >>> views.cameras[0].width, views.cameras[0].height
        (32, 24)
    """
    cameras, images = [], []
    for camera, path, lens in zip(
        dataset.cameras, dataset.image_paths, dataset.lenses, strict=True
    ):
        if path is None:
            continue
        if lens is not None:
            raise FileFormatError(
                path, "was taken through a lens that distorts; undistort the data set first"
            )
        image = read_image(path, damaged=damaged)
        if image.shape[:2] != (camera.height, camera.width):
            raise FileFormatError(
                path,
                f"is {image.shape[1]} x {image.shape[0]}, its camera has {camera.width} x"
                f" {camera.height}",
            )
        if max_size is not None and max(image.shape[:2]) > max_size:
            image = _shrink(image, max_size)
            camera = camera.resize(image.shape[1], image.shape[0])
        cameras.append(camera)
        images.append(image)
    if not cameras:
        raise ValueError(
            "dataset: none of its cameras has an image that is there; put the images where the data"
            " set names them"
        )
    return Views(cameras, images)


def _shrink(image: npt.NDArray[Any], longest: int) -> npt.NDArray[Any]:
    import cv2

    factor = longest / max(image.shape[:2])
    width, height = (max(1, round(factor * side)) for side in (image.shape[1], image.shape[0]))

    def averaged(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA))

    return averaged(image) if image.shape[2] == 3 else weighted_by_alpha(image, averaged)


def hold_out(dataset: Dataset, every: int = HELD_OUT_EVERY) -> tuple[Dataset, Dataset | None]:
    """The part of a data set to fit on and the part to measure on.

    Splits of the data set come first: "train", and "test" or else "val".

    Args:
        dataset: posed images, see :func:`attnwarp.io.read_dataset`.
        every: without splits, one of so many images is held out, in the order of their names,
            beginning with the first; 0 holds out none.

    Returns:
        The part to fit on, and the held-out part or None.

    Raises:
        ValueError: the data set's splits leave nothing to fit on, or ``every`` is 1 or negative.

    Example:
        >>> from attnwarp import Camera
        >>> from attnwarp.fit import hold_out
        >>> from attnwarp.io import Dataset
        >>> cameras = [
        ...     Camera.look_at((3, i, 0), (0, 0, 0), width=4, height=3, fov_y=40, name=f"{i:02}")
        ...     for i in range(9)
        ... ]
        >>> train, test = hold_out(Dataset(cameras, [None] * 9))
        >>> len(train), [camera.name for camera in test.cameras]
        (7, ['00', '08'])
    """
    if every < 0 or every == 1:
        raise ValueError(f"every: got {every}, expected 0 or at least 2")
    named = {split for split in dataset.splits if split is not None}
    if named:
        if "train" not in named:
            raise ValueError(
                f"dataset: its splits are {', '.join(sorted(named))}; none is 'train' to fit on"
            )
        rest = next((name for name in ("test", "val") if name in named), None)
        return dataset.split("train"), dataset.split(rest) if rest else None
    order = sorted(range(len(dataset)), key=lambda i: dataset.cameras[i].name)
    out = set(order[::every]) if every else set()
    if not out or len(out) == len(dataset):
        return dataset, None
    train = [i for i in range(len(dataset)) if i not in out]
    return dataset.select(train), dataset.select(sorted(out))
