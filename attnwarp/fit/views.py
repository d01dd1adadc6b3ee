"""Pictures that splats are fitted on, with their cameras."""

from __future__ import annotations

import filecmp
import hashlib
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.errors import InputWarning, suggest
from attnwarp.io import Dataset, FileFormatError, read_image
from attnwarp.io.images import read_mask, weighted_by_alpha
from attnwarp.reporting import Reporter

HELD_OUT_EVERY = 8
"""Interval of held-out images for a dataset without splits (LLFF's share)."""

HELD_BYTES = 2**31
"""Limit on the bytes of pictures kept on a GPU: 650 of 1297 x 840 px in 8 bits."""

READ_BYTES = 2**29
"""Limit on the bytes of pictures kept in main memory, the rest being read again when drawn: 194 of
1280 x 720 px, where an iteration takes 20 times as long as reading."""

SIZES = {"cpu": 512, "cuda": 1600}
"""Longest side in px of larger pictures in a fit by default: the editors' size, and 3DGS's."""

SAME_POSE = 1e-6
"""Largest difference between two views that count as one, covering the rounding of printed poses:
of rotations, of positions in extents of the cameras, of focal lengths and principal points in
sides."""


class Sized(Protocol):
    """Array, or a value around one."""

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        ...


S = TypeVar("S", bound=Sized)


class Drawn(Sequence[S]):
    """Values created when drawn. The first that fit are kept, since all at once may fill the
    memory."""

    def __init__(self, makers: Sequence[Callable[[], S]], held_bytes: int) -> None:
        self._makers = makers
        self._held: dict[int, S] = {}
        self._left = held_bytes

    def __len__(self) -> int:
        return len(self._makers)

    def __getitem__(self, index: Any) -> Any:
        """Return the value of a number, created again unless kept."""
        if index in self._held:
            return self._held[index]
        value = self._makers[index]()
        if value.nbytes <= self._left:
            self._left -= value.nbytes
            self._held[index] = value
        return value


@dataclass(frozen=True, eq=False)
class Views:
    """Posed pictures, which a fit or an edit tunes splats on.

    Args:
        cameras: cameras, one for each picture, at least one.
        images: (H, W, 3), or (H, W, 4) with straight (not premultiplied) alpha; sRGB; uint8,
            uint16, or floating in [0, 1]. Their type is kept: 8 bits take a quarter of the
            memory.
        masks: (H, W) bool, one for each picture or None; False where the picture is to be ignored.
        exposures: (3, 4) changes of colour [A b], one for each picture or None: of a surface that
            renders as c, the picture shows c + A c + b. See :attr:`attnwarp.fit.Fit.exposures`.

    Attributes:
        transparent: True if any picture has non-opaque pixels.

    Raises:
        ValueError: the lists differ in length, a picture's size differs from its camera's, or a
            dtype or value is invalid; the message names the picture.

    Example:
        >>> import numpy as np
        >>> from attnwarp.fit import Views
        >>> from attnwarp.trial import view
        >>> len(Views([view(side=4)], [np.zeros((4, 4, 3), np.uint8)]))
        1
    """

    cameras: Sequence[Camera]
    images: Sequence[npt.NDArray[Any]]
    masks: Sequence[npt.NDArray[np.bool_] | None] = ()
    exposures: Sequence[npt.NDArray[np.floating[Any]] | None] = ()
    transparent: bool = field(init=False)

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("cameras: got none, expected at least one")
        if len(self.images) != len(self.cameras):
            raise ValueError(
                f"images: got {len(self.images)}, expected {len(self.cameras)}, as cameras"
            )
        for name in ("masks", "exposures"):
            values = list(getattr(self, name)) or [None] * len(self.cameras)
            if len(values) != len(self.cameras):
                raise ValueError(
                    f"{name}: got {len(values)}, expected {len(self.cameras)}, as cameras"
                )
            object.__setattr__(self, name, values)
        for camera, mask, change in zip(self.cameras, self.masks, self.exposures, strict=True):
            if change is not None:
                check.shape(change, (3, 4), f"exposure of {camera.name}")
                check.finite(change, f"exposure of {camera.name}")
            if mask is not None:
                check.shape(mask, (camera.height, camera.width), f"mask of {camera.name}")
                if not mask.any():
                    raise ValueError(
                        f"masks: that of {camera.name} ignores the whole picture; leave it out"
                    )
        if not isinstance(self.images, Drawn):
            object.__setattr__(self, "images", [np.asarray(image) for image in self.images])
        transparent = False
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
            if image.dtype not in (np.uint8, np.uint16) and image.dtype.kind != "f":
                raise ValueError(f"{name}: got {image.dtype}, expected uint8, uint16 or floating")
            if image.dtype.kind == "f":
                check.finite(image, name)
                if image.min() < 0 or image.max() > 1:
                    raise ValueError(
                        f"{name}: got values in [{image.min()}, {image.max()}], expected [0, 1]"
                    )
            transparent |= image.shape[2] == 4 and bool((image[..., 3] < _top(image)).any())
        object.__setattr__(self, "transparent", transparent)

    @classmethod
    def unchecked(
        cls,
        cameras: Sequence[Camera],
        images: Sequence[npt.NDArray[Any]],
        masks: Sequence[npt.NDArray[np.bool_] | None],
        exposures: Sequence[npt.NDArray[np.floating[Any]] | None],
    ) -> Views:
        """Collect opaque pictures that are sound by their making, without looking at any."""
        views = object.__new__(cls)
        views.__dict__.update(
            cameras=cameras, images=images, masks=masks, exposures=exposures, transparent=False
        )
        return views

    def __len__(self) -> int:
        return len(self.cameras)

    def picture(self, index: int) -> npt.NDArray[np.float32]:
        """Return a (H, W, 3) float32 picture in [0, 1], over black, without a copy of a float32
        one that torch can share."""
        image = self.images[index]
        if image.shape[2] == 4:
            return np.asarray(self.target(index, torch.zeros(3, dtype=torch.float32)))
        return to_float(image)

    def target(self, index: int, background: check.Array) -> torch.Tensor:
        """Return a (H, W, 3) float32 picture in [0, 1], composited over ``background`` (3,), on the
        background's device."""
        image, background = self.images[index], check.tensor(background, "background")
        if background.device.type == "cpu":
            pixels = torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32))
        else:
            pixels = self._on(background.device, index).float()
        picture = pixels / _top(image)
        if picture.shape[2] == 3:
            return picture
        alpha = picture[..., 3:]
        return picture[..., :3] * alpha + (1 - alpha) * background.to(picture.dtype)

    def kept(self, index: int, device: torch.device) -> torch.Tensor | None:
        """Return a picture's mask on a device, (H, W) bool, False where the picture is ignored."""
        mask = self.masks[index]
        return None if mask is None else torch.from_numpy(np.asarray(mask, bool)).to(device)

    def masked(self, index: int, picture: torch.Tensor) -> torch.Tensor:
        """Black out what a picture's mask ignores of a (H, W, 3) render or picture. Losses of both
        then ignore it, also SSIM, which reads a pixel's neighbours."""
        kept = self.kept(index, picture.device)
        return picture if kept is None else picture * kept[..., None]

    def exposed(self, index: int, color: torch.Tensor) -> torch.Tensor:
        """Change a render (H, W, 3) as a picture was exposed."""
        change = self.exposures[index]
        if change is None:
            return color
        return expose(color, torch.from_numpy(np.asarray(change)).to(color))

    def gain(self, index: int, like: torch.Tensor) -> torch.Tensor:
        """Return the slope (3, 3) of an exposed picture's colours to a render's."""
        change = self.exposures[index]
        gain = torch.eye(3, dtype=like.dtype, device=like.device)
        return (
            gain if change is None else gain + torch.from_numpy(np.asarray(change)).to(gain)[:, :3]
        )

    def error(self, index: int, image: torch.Tensor, background: torch.Tensor) -> float:
        """Mean squared error of a render (H, W, 3) against a picture, where that is not ignored;
        NaN if all of it is.
        """
        squared = (image - self.target(index, background)).square()
        kept = self.kept(index, squared.device)
        return float((squared if kept is None else squared[kept]).mean())

    def _on(self, device: torch.device, index: int) -> torch.Tensor:
        """Copy a picture's pixels to a GPU, which caches as many pictures as fit."""
        if (device, index) in self._held:
            return self._held[device, index]
        pixels = torch.from_numpy(np.ascontiguousarray(self.images[index])).to(device)
        if sum(held.nbytes for held in self._held.values()) + pixels.nbytes <= HELD_BYTES:
            self._held[device, index] = pixels
        return pixels

    @cached_property
    def _held(self) -> dict[tuple[torch.device, int], torch.Tensor]:
        return {}

    @cached_property
    def digest(self) -> str:
        """Hash cameras and pictures (SHA-256), to check that a resumed fit has the same
        ones."""
        total = hashlib.sha256()
        for camera, image, mask in zip(self.cameras, self.images, self.masks, strict=True):
            spec = {**camera.to_dict(), "name": "", "dtype": str(image.dtype), "shape": image.shape}
            total.update(json.dumps(spec, sort_keys=True).encode())
            total.update(np.ascontiguousarray(image).tobytes())
            total.update(b"" if mask is None else np.packbits(mask).tobytes())
        for change in self.exposures:
            total.update(b"" if change is None else np.asarray(change, np.float64).tobytes())
        return total.hexdigest()


def expose(color: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    """Change a render's colours (H, W, 3) by an exposure (3, 4)."""
    return color + color @ change[:, :3].T + change[:, 3]


def to_float(image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Convert a picture to float32 in [0, 1]; a float32 one that torch can share is not copied."""
    if image.dtype.kind == "f":
        return np.require(image, np.float32, ["C", "W"])
    return image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)


def _top(image: npt.NDArray[Any]) -> float:
    return float(np.iinfo(image.dtype).max) if image.dtype.kind == "u" else 1.0


def shrunk_to(
    max_size: int | None, cameras: Sequence[Camera], device: str, report: Reporter
) -> int | None:
    """Choose the longest side of a fit's pictures in px, as asked or by default, and say so.

    Args:
        device: device of the fit, such as "cpu" or "cuda:1".

    Example:
        >>> from attnwarp.fit.views import shrunk_to
        >>> from attnwarp.reporting import SILENT
        >>> from attnwarp.trial import view
        >>> shrunk_to(None, [view(side=4000)], "cpu", SILENT)
        512
    """
    largest = max(max(camera.width, camera.height) for camera in cameras)
    most = SIZES[device.partition(":")[0]]
    if max_size is not None or largest <= most:
        return max_size
    report.log(f"pictures of {largest} px are shrunk to {most} (--max-size {largest}: not)")
    return most


def load_views(
    dataset: Dataset,
    *,
    max_size: int | None = None,
    exposures: Mapping[str, npt.NDArray[np.floating[Any]]] = MappingProxyType({}),
) -> Views:
    """Read the pictures of a dataset; cameras without a picture are left out. Pictures beyond
    :data:`READ_BYTES` are read again whenever they are drawn.

    Args:
        dataset: dataset, see :func:`attnwarp.io.read_dataset`.
        max_size: longest side in px; larger pictures and their cameras are averaged down to
            it.
        exposures: (3, 4) change of colour of views by their cameras' names, see
            :func:`attnwarp.fit.read_exposures`.

    Raises:
        FileFormatError: a picture is unreadable, or differs in size from its camera.
        ValueError: no camera has a picture.

    Example:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from attnwarp.fit import load_views
        >>> from attnwarp.io import Dataset
        >>> from attnwarp.io.images import encode_png
        >>> path = Path("a.png")
        >>> _ = path.write_bytes(encode_png(np.full((64, 64, 3), 255, np.uint8)))
        >>> from attnwarp.trial import view
        >>> load_views(Dataset([view(side=64)], [path]), max_size=32).cameras[0].width
        32
    """
    cameras, readers, masks = [], [], []
    for camera, path, lens, mask in zip(
        dataset.cameras, dataset.image_paths, dataset.lenses, dataset.mask_paths, strict=True
    ):
        if path is None:
            continue
        if lens is not None:
            raise FileFormatError(
                path, "was taken through a lens that distorts; undistort the data set first"
            )
        shown, longest = camera, max(camera.width, camera.height)
        if max_size is not None and longest > max_size:
            factor = max_size / longest
            width, height = (max(1, round(factor * v)) for v in (camera.width, camera.height))
            shown = camera.resize(width, height)
        cameras.append(shown)
        readers.append(partial(_read, path, camera, shown))
        masks.append(None if mask is None else read_mask(mask, shown.height, shown.width))
    if not cameras:
        raise ValueError(
            "dataset: none of its cameras has an image that is there; put the images where the data"
            " set names them"
        )
    changes = [exposures.get(camera.name) for camera in cameras]
    return Views(cameras, Drawn(readers, READ_BYTES), masks, changes)


def _read(path: Path, camera: Camera, shown: Camera) -> npt.NDArray[Any]:
    """Read a picture of a camera's size, averaged down to that of ``shown``."""
    import cv2

    image = read_image(path)
    if image.shape[:2] != (camera.height, camera.width):
        raise FileFormatError(
            path,
            f"is {image.shape[1]} x {image.shape[0]}, its camera has {camera.width} x"
            f" {camera.height}",
        )
    if shown is camera:
        return image

    def averaged(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        size = (shown.width, shown.height)
        return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA))

    return averaged(image) if image.shape[2] == 3 else weighted_by_alpha(image, averaged)


def hold_out(
    dataset: Dataset, every: int | Sequence[str] = HELD_OUT_EVERY
) -> tuple[Dataset, Dataset | None]:
    """Split a dataset into the part to fit on and the part to measure on.

    The dataset's splits have priority over a number: "train", and "test" or else "val".

    Args:
        dataset: posed images, see :func:`attnwarp.io.read_dataset`.
        every: interval of held-out images for a dataset without splits, from the middle of each
            run of so many in the order of their names, after the dataset's first, which edits take
            as their source; 0 holds out none. Or names of images, with or without folder and
            suffix.

    Returns:
        The part to fit on, and the held-out part or None. A fitted view is never held out: neither
        under another name or by a link, nor as a copy, nor at the same pose.

    Raises:
        ValueError: the dataset's splits or ``every`` leave nothing to fit on, ``every`` is
            negative, or a name is that of no image or of several.

    Warns:
        InputWarning: held-out views that are also fitted on were left out.

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
        (8, ['04'])
    """
    if not isinstance(every, int):
        return _split(dataset, {_named_view(dataset, name) for name in every})
    if every < 0 or every == 1:
        raise ValueError(f"every: got {every}, expected 0 or at least 2")
    named = {split for split in dataset.splits if split is not None}
    if named:
        if "train" not in named:
            raise ValueError(
                f"dataset: its splits are {', '.join(sorted(named))}; none is 'train' to fit on"
            )
        rest = next((name for name in ("test", "val") if name in named), None)
        train = dataset.split("train")
        return train, _apart(train, dataset.split(rest)) if rest else None
    order = sorted(range(len(dataset)), key=lambda i: dataset.cameras[i].name)
    after = order.index(0) + 1 if order else 0
    others = [*order[after:], *order[:after]][:-1]
    middle = max(0, min(every, len(others)) - 1) // 2
    return _split(dataset, set(others[middle::every] if every else ()))


def _split(dataset: Dataset, out: set[int]) -> tuple[Dataset, Dataset | None]:
    if not out:
        return dataset, None
    train = dataset.select([i for i in range(len(dataset)) if i not in out])
    if not len(train):
        raise ValueError("every: names every view, which leaves nothing to fit on")
    return train, _apart(train, dataset.select(sorted(out)))


def _named_view(dataset: Dataset, name: str) -> int:
    found = [
        i
        for i, camera in enumerate(dataset.cameras)
        if name in (camera.name, Path(camera.name).name, Path(camera.name).stem)
    ]
    if len(found) != 1:
        names = [camera.name for camera in dataset.cameras]
        raise ValueError(
            f"every: got the name {name!r}, which {len(found) or 'none'} of the {len(names)} views"
            f" has{suggest(name, names)}"
        )
    return found[0]


def _apart(train: Dataset, test: Dataset) -> Dataset | None:
    """Remove fitted views from the held-out part, by equal files or poses; None if no view is
    left."""
    again = _twins(train.cameras, test.cameras)
    for i, path in enumerate(test.image_paths):
        for j, other in enumerate(train.image_paths):
            if _equal(path, other):
                again[i] = j
                break
    if not again:
        return test
    rest = [i for i in range(len(test)) if i not in again]
    first, twin = next(iter(again.items()))
    warnings.warn(
        f"dataset: {len(again)} of {len(test)} held-out views are fitted on too (first:"
        f" {test.cameras[first].name!r}, which is {train.cameras[twin].name!r}); they are not held"
        f" out{'' if rest else ', which leaves none to measure on'}",
        InputWarning,
        stacklevel=3,
    )
    return test.select(rest) if rest else None


def _equal(one: Path | None, other: Path | None) -> bool:
    """Return True if two files have the same bytes, as a copy and a link have."""
    if one is None or other is None:
        return False
    try:
        return filecmp.cmp(one, other, shallow=False)
    except OSError:
        return False


def _twins(fitted: Sequence[Camera], held_out: Sequence[Camera]) -> dict[int, int]:
    """Find held-out views at the pose of a fitted one, and that one, by their numbers."""
    both = [*fitted, *held_out]
    centers = np.array([camera.position for camera in both])
    extent = float(np.linalg.norm(np.ptp(centers, axis=0))) or 1.0
    poses = np.array(
        [
            [
                *camera.rotation.flat,
                *(camera.position - centers[0]) / extent,
                *(camera.K[:2] / [[camera.width], [camera.height]]).flat,
            ]
            for camera in both
        ]
    )
    apart = np.abs(poses[len(fitted) :, None] - poses[: len(fitted)]).max(axis=2)
    return {i: int(row.argmin()) for i, row in enumerate(apart) if row.min() <= SAME_POSE}
