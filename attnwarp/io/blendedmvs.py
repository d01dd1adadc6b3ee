"""Scenes of BlendedMVS as published: MVSNet's cameras next to a folder of images.

``cams/00000000_cam.txt`` has the world-to-camera matrix (OpenCV axes) under ``extrinsic`` and K
under ``intrinsic``; the line of depths below is unused. ``blended_images/00000000.jpg`` is its
image; files ending in ``_masked`` are the same without a background and are skipped. MVSNet counts
pixel centres at +0.5, so the principal point is unchanged.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.io.dataset import Dataset, Missing, nearest_rotation, with_images
from attnwarp.io.file import FileFormatError, visible
from attnwarp.io.images import image_size
from attnwarp.io.text import read_text

CAMERAS, IMAGES = "cams", "blended_images"
SUFFIX = "_cam.txt"


def is_blendedmvs(path: Path) -> bool:
    """Return True if a folder is a scene of BlendedMVS."""
    return (path / CAMERAS).is_dir() and (path / IMAGES).is_dir()


def read_blendedmvs(path: str | os.PathLike[str], *, missing_images: Missing = "error") -> Dataset:
    """Read a scene of BlendedMVS, in either published resolution.

    Args:
        path: folder of the scene, with ``cams`` and ``blended_images``.
        missing_images: "error", or "none" to leave out cameras without an image file, since only
            images give the camera's size.

    Raises:
        FileNotFoundError: the scene does not exist.
        FileFormatError: a camera is damaged, or images are missing.

    Example:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from attnwarp.io import read_blendedmvs
        >>> from attnwarp.io.picture import encode_picture
        >>> scene = Path("scene")
        >>> for name in ("cams", "blended_images"):
        ...     (scene / name).mkdir(parents=True)
        >>> text = "extrinsic\\n1 0 0 0\\n0 1 0 0\\n0 0 1 2\\n0 0 0 1\\n\\n"
        >>> text += "intrinsic\\n9 0 4\\n0 9 3\\n0 0 1\\n\\n1.5 0.1 128 14.3\\n"
        >>> _ = (scene / "cams" / "00000000_cam.txt").write_text(text)
        >>> picture = encode_picture(np.zeros((6, 8, 3), np.uint8), ".jpg")
        >>> _ = (scene / "blended_images" / "00000000.jpg").write_bytes(picture)
        >>> [camera] = read_blendedmvs("scene").cameras
        >>> camera.width, camera.position.tolist()
        (8, [0.0, 0.0, -2.0])
    """
    path = Path(path)
    if not is_blendedmvs(path):
        raise FileNotFoundError(f"{path}: no scene of BlendedMVS ({CAMERAS} and {IMAGES}) is there")
    files = visible((path / CAMERAS).glob(f"*{SUFFIX}"))
    if not files:
        raise FileFormatError(path / CAMERAS, f"holds no camera, expected files *{SUFFIX}")
    images = [path / IMAGES / f"{file.name.removesuffix(SUFFIX)}.jpg" for file in files]
    available = [image.is_file() for image in images]
    if missing_images == "none":
        files = [file for file, there in zip(files, available, strict=True) if there]
        images = [image for image, there in zip(images, available, strict=True) if there]
        if not files:
            raise FileFormatError(
                path, f"holds none of the pictures in {IMAGES}, which alone say the cameras' size"
            )
    elif not all(available):
        first = images[available.index(False)]
        raise FileFormatError(
            path,
            f"{available.count(False)} of {len(images)} images are missing: {first}; put them"
            " there, or do without: missing_images='none' (--missing-images none)",
        )
    cameras = [_camera(file, image) for file, image in zip(files, images, strict=True)]
    cameras, paths = with_images(
        path, cameras, images, missing_images=missing_images, resize_cameras=False
    )
    return Dataset(cameras, paths)


def _camera(file: Path, image: Path) -> Camera:
    words = read_text(file, errors="replace").split()
    matrices = {}
    for name, side in (("extrinsic", 4), ("intrinsic", 3)):
        matrices[name] = _matrix(file, words, name, side)
    pose, K = matrices["extrinsic"], matrices["intrinsic"]
    if not np.array_equal(pose[3], [0, 0, 0, 1]):
        raise FileFormatError(file, f"last row is {pose[3].tolist()}, expected 0 0 0 1",
                              field="extrinsic")  # fmt: skip
    pose[:3, :3] = nearest_rotation(file, "extrinsic", pose[:3, :3])
    if K[0, 1] or K[1, 0] or not np.array_equal(K[2], [0, 0, 1]) or min(K[0, 0], K[1, 1]) <= 0:
        raise FileFormatError(file, f"got {K.tolist()}, expected a pinhole without skew",
                              field="intrinsic")  # fmt: skip
    width, height = image_size(image)
    return Camera(K, pose, width, height, name=image.name)


def _matrix(file: Path, words: list[str], name: str, side: int) -> npt.NDArray[np.float64]:
    """Parse the numbers after a word as a square matrix."""
    count = side * side
    try:
        begin = words.index(name) + 1
        values = np.array([float(word) for word in words[begin : begin + count]])
    except ValueError as error:
        raise FileFormatError(file, f"{error}; export the camera again", field=name) from None
    if len(values) != count or not np.isfinite(values).all():
        raise FileFormatError(
            file, f"got {len(values)} numbers, expected {count} finite ones", field=name
        )
    return values.reshape(side, side)
