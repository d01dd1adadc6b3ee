"""Dataset of posed images, read from transforms.json and COLMAP folders."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.camera import EXACT_ROTATION, Camera, nearest_orthonormal
from attnwarp.errors import InputWarning
from attnwarp.io.file import FileFormatError, is_file
from attnwarp.io.images import IMAGE_SUFFIXES, image_size, orientation
from attnwarp.io.lens import Lens

Array = npt.NDArray[np.float64]

ROTATION_TOLERANCE = 1e-4
"""Largest |R R^T - I| treated as float32 or printing noise and repaired; Camera allows
1e-5.
"""

OF_IMAGES = ("cameras", "image_paths", "splits", "lenses", "mask_paths")
"""Fields of :class:`Dataset` with one value for each image."""

Missing = Literal["error", "none"]
Distorted = Literal["error", "keep"]


@dataclass(eq=False)
class Dataset:
    """Posed images of one scene, with an optional first point cloud.

    Args:
        cameras: cameras, one for each image, OpenCV axes, pixel centres at +0.5; ``name`` is the
            image's name in the file.
        image_paths: paths, one for each camera; None for a missing image.
        points: (P, 3) float64 world coordinates, or None.
        colors: (P, 3) uint8 sRGB of the points, or None.
        splits: splits, one for each camera: "train", "val", "test", or None if the file names none.
        lenses: lenses, one for each camera; None for a pinhole. Every camera is used as a pinhole:
            pictures of another lens must be undistorted first, see :func:`undistort`.
        mask_paths: pictures, one for each camera, whose dark pixels (below half of white) say
            which pixels of the image to ignore; None without one.

    Raises:
        ValueError: lists of different lengths, a wrong shape or dtype.

    Example:
        >>> from attnwarp import Camera
        >>> from attnwarp.io import Dataset
        >>> cameras = [
        ...     Camera.look_at((3, i, 0), (0, 0, 0), width=4, height=3, fov_y=40) for i in range(3)
        ... ]
        >>> data = Dataset(cameras, [None] * 3, splits=["train", "train", "test"])
        >>> len(data.split("train"))
        2
    """

    cameras: list[Camera]
    image_paths: list[Path | None]
    points: Array | None = None
    colors: npt.NDArray[np.uint8] | None = None
    splits: list[str | None] = field(default_factory=list)
    lenses: list[Lens | None] = field(default_factory=list)
    mask_paths: list[Path | None] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.splits = self.splits or [None] * len(self.cameras)
        self.lenses = self.lenses or [None] * len(self.cameras)
        self.mask_paths = self.mask_paths or [None] * len(self.cameras)
        for name in OF_IMAGES:
            if len(getattr(self, name)) != len(self.cameras):
                raise ValueError(
                    f"{name}: got {len(getattr(self, name))}, expected {len(self.cameras)}, as"
                    " cameras"
                )
        if self.points is not None:
            self.points = np.asarray(self.points, dtype=np.float64)
            check.shape(self.points, ("P", 3), "points")
            check.finite(self.points, "points")
        if self.colors is not None:
            if self.points is None:
                raise ValueError("colors: given without points")
            self.colors = np.asarray(self.colors)
            check.shape(self.colors, (len(self.points), 3), "colors")
            if self.colors.dtype != np.uint8:
                raise ValueError(f"colors: got {self.colors.dtype}, expected uint8")

    def __len__(self) -> int:
        return len(self.cameras)

    def select(self, indices: Sequence[int]) -> Dataset:
        """Select the images at ``indices``, in that order, with the same points."""
        chosen = {name: [getattr(self, name)[i] for i in indices] for name in OF_IMAGES}
        return replace(self, **chosen)  # type: ignore[arg-type]

    def with_pictures(self) -> Dataset:
        """Select the cameras whose image is not missing.

        Example:
            >>> from attnwarp.trial import view
            >>> data = Dataset([view(), view()], [None, Path("b.png")], splits=["train", "test"])
            >>> data.with_pictures().splits
            ['test']
        """
        return self.select([i for i, path in enumerate(self.image_paths) if path is not None])

    def split(self, name: str) -> Dataset:
        """Select the images of one split.

        Raises:
            ValueError: the split has no image; the message lists the existing splits.
        """
        indices = [i for i, split in enumerate(self.splits) if split == name]
        if not indices:
            available = sorted({split for split in self.splits if split is not None})
            raise ValueError(
                f"name: got {name!r}, expected one of"
                f" {', '.join(map(repr, available)) or '(no splits)'}"
            )
        return self.select(indices)


def nearest_rotation(path: Path, name: str, R: Array) -> Array:
    """Return ``R`` if it is a rotation to 1e-12, or the nearest rotation (by SVD) if to 1e-4; raise
    an error with the deviation otherwise."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.abs(R @ R.T - np.eye(3)).max())
    if not error <= ROTATION_TOLERANCE:
        size = np.linalg.norm(R, axis=0)
        hint = (
            "its axes are not at right angles, or it was rounded too coarsely; export the poses"
            " again"
        )
        if np.ptp(size) <= ROTATION_TOLERANCE * size.max():
            hint = f"its columns have length {size.mean():.6g}: remove the scale from the pose"
        raise FileFormatError(
            path,
            f"rotation is not orthonormal, max |R R^T - I| = {error:.3g}, and only up to"
            f" {ROTATION_TOLERANCE:g} is repaired; {hint}",
            field=name,
        )
    if np.linalg.det(R) < 0:
        raise FileFormatError(
            path, "rotation has determinant -1 (it mirrors); flip one axis of the pose", field=name
        )
    if error <= EXACT_ROTATION:
        return R
    return nearest_orthonormal(R)


def with_images(
    source: Path,
    cameras: list[Camera],
    paths: list[Path],
    *,
    missing_images: Missing,
    resize_cameras: bool,
    elsewhere: str = "",
) -> tuple[list[Camera], list[Path | None]]:
    """Check that each camera's image exists and has the camera's size.

    Args:
        elsewhere: hint on naming another folder of images, if possible.

    Returns:
        Cameras (resized to their images if ``resize_cameras``), and paths, None for missing
        images.

    Warns:
        InputWarning: images have an EXIF tag that requests rotation.
    """
    check.one_of(missing_images, ("error", "none"), "missing_images")
    absent = [path for path in paths if not is_file(path)]
    if absent and missing_images == "error":
        first = ", ".join(str(path) for path in absent[:3])
        more = f" and {len(absent) - 3} more" if len(absent) > 3 else ""
        stem = absent[0].with_suffix("")
        others = (Path(f"{stem}{suffix}") for suffix in IMAGE_SUFFIXES)
        there = next((f"; {other.name} is there" for other in others if is_file(other)), "")
        folder = f", or name their folder: {elsewhere}" if elsewhere else ""
        raise FileFormatError(
            source,
            f"{len(absent)} of {len(paths)} images are missing: {first}{more}{there}; put them"
            f" there{folder}, or do without: missing_images='none' (--missing-images none)",
        )
    missing = set(absent)
    available: list[Path | None] = [None if path in missing else path for path in paths]
    cameras = list(cameras)
    for i, path in enumerate(available):
        if path is None:
            continue
        camera, (width, height) = cameras[i], image_size(path)
        if (width, height) == (camera.width, camera.height):
            continue
        if (width > height) != (camera.width > camera.height) and orientation(path) >= 5:
            raise FileFormatError(
                source,
                f"{path} is stored as {width} x {height} with an EXIF tag that asks for a turn,"
                f" which is not followed; its camera is {camera.width} x {camera.height}: write the"
                " pictures out turned, without the tag",
            )
        if not resize_cameras:
            raise FileFormatError(
                source,
                f"{path} is {width} x {height}, but its camera is {camera.width} x {camera.height};"
                " use the images the cameras were made for, or pass resize_cameras=True"
                " (--resize-cameras) if they are the same pictures at another size",
            )
        remedy = "turn or crop it as the camera saw it, or use the picture the camera was made for"
        try:
            check.same_aspect((height, width), (camera.height, camera.width), str(path), remedy)
        except ValueError as error:
            raise FileFormatError(source, str(error)) from None
        cameras[i] = camera.resize(width, height)
    _warn_of_turns(source, [path for path in available if path is not None])
    return cameras, available


def _warn_of_turns(source: Path, paths: Sequence[Path]) -> None:
    """Warn of pictures that viewers rotate although their poses refer to stored pixels."""
    turned = [path for path in paths if orientation(path) != 1]
    if turned:
        warnings.warn(
            f"{source}: {len(turned)} of {len(paths)} images have an EXIF tag that asks for a turn"
            f" (first: {turned[0]}); it is not followed, since a pose belongs to the pixels as they"
            " are stored",
            InputWarning,
            stacklevel=4,
        )
