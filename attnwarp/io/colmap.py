"""COLMAP sparse models, binary and text: cameras, images and points.

COLMAP's conventions equal ours: OpenCV axes, world-to-camera poses, the corner of the image at
(0, 0) and the first pixel's centre at (0.5, 0.5) (colmap/sensor/models.h), so the principal point
is unchanged.
"""

from __future__ import annotations

import itertools
import os
import struct
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.errors import InputWarning
from attnwarp.io.dataset import Dataset, Distorted, Missing, with_images
from attnwarp.io.file import FileFormatError, existing_file, is_file, named_file
from attnwarp.io.images import IMAGE_SUFFIXES
from attnwarp.io.lens import Lens
from attnwarp.io.text import read_text

Array = npt.NDArray[np.float64]

MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""COLMAP's camera models: id -> name and number of parameters (colmap/sensor/models.h)."""

BROWN: dict[str, tuple[int, ...]] = {
    "SIMPLE_RADIAL": (0,),
    "RADIAL": (0, 1),
    "OPENCV": (0, 1, 2, 3),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
FISHEYE: dict[str, tuple[int, ...]] = {
    "SIMPLE_RADIAL_FISHEYE": (0,),
    "RADIAL_FISHEYE": (0, 1),
    "OPENCV_FISHEYE": (0, 1, 2, 3),
}
"""Models supported by :class:`Lens`: indices of the coefficients in their last parameters."""

ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
"""Models with one focal length for both axes."""

MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")
"""Subfolders searched for a sparse model, in order."""


def find_model(path: str | os.PathLike[str]) -> Path | None:
    """Find the folder at or under ``path`` with a sparse model; None without one."""
    for name in MODEL_FOLDERS:
        folder = Path(path) / name
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    return None


def read_colmap(
    path: str | os.PathLike[str],
    *,
    images: str | os.PathLike[str] | None = None,
    missing_images: Missing = "error",
    resize_cameras: bool = False,
    points: bool = True,
    distorted: Distorted = "error",
    scale: int = 1,
) -> Dataset:
    """Read a COLMAP sparse model; binary files take precedence over text files, as in
    COLMAP.

    Images are sorted by name. Quaternions are normalised, as COLMAP does on reading.

    Args:
        path: folder of the model, or a folder with the model in ``sparse/0``, ``sparse`` or
            ``colmap/sparse/0``.
        images: folder of the images; a relative path is tried in ``path`` first, then in the
            working folder. By default the folder ``images`` in ``path`` or above the model.
        missing_images, resize_cameras, points, distorted, scale: see :func:`read_dataset`.

    A folder ``masks`` beside the images has masks of the same names, or with ".png" appended.

    Warns:
        InputWarning: another model next to ``sparse/0`` has more images.

    Raises:
        FileNotFoundError: the folder has no model.
        FileFormatError: a camera has lens distortion, a file is damaged or truncated, or images are
            missing.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp.io import read_colmap
        >>> model = Path("sparse/0")
        >>> model.mkdir(parents=True)
        >>> _ = (model / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24")
        >>> _ = (model / "images.txt").write_text("1 1 0 0 0 0 0 2 1 a.png\\n\\n")
        >>> [camera] = read_colmap(".", missing_images="none", points=False).cameras
        >>> camera.name, camera.position.tolist()
        ('a.png', [0.0, 0.0, -2.0])
    """
    check.one_of(distorted, ("error", "keep"), "distorted")
    path = Path(path)
    model = find_model(path)
    if model is None:
        raise FileNotFoundError(
            f"{path}: no COLMAP model (cameras.bin or cameras.txt) here or in"
            f" {', '.join(MODEL_FOLDERS[1:])}"
        )
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    binary = suffix == ".bin"
    intrinsics = (_binary_cameras if binary else _text_cameras)(
        existing_file(model / f"cameras{suffix}")
    )
    source = existing_file(model / f"images{suffix}")
    poses = sorted((_binary_images if binary else _text_images)(source), key=lambda pose: pose.name)
    if not poses:
        raise FileFormatError(source, "holds no registered image; the reconstruction failed")
    for one, two in itertools.pairwise(poses):
        if one.name == two.name:
            raise FileFormatError(source, f"image {one.name!r} stands twice; remove one")
    cameras: list[Camera] = []
    lenses: list[Lens | None] = []
    for pose in poses:
        if pose.camera not in intrinsics:
            raise FileFormatError(
                source,
                f"image {pose.name!r} uses camera {pose.camera}, which is not in cameras{suffix}",
            )
        camera, lens = _camera(
            source, pose, intrinsics[pose.camera], model / f"cameras{suffix}", distorted
        )
        cameras.append(camera)
        lenses.append(lens)
    folder = _image_folder(path, model, images, "images" if scale == 1 else f"images_{scale}")
    if model != path:
        _warn_of_larger(model, len(poses), folder)
    cameras, paths = with_images(
        source,
        cameras,
        [named_file(folder, pose.name) for pose in poses],
        missing_images=missing_images,
        resize_cameras=resize_cameras or scale > 1,
        elsewhere="images=FOLDER (--images FOLDER)",
    )
    masks = [_mask(folder.with_name("masks"), pose.name) for pose in poses]
    cloud = model / f"points3D{suffix}"
    if not points or not cloud.is_file():
        return Dataset(cameras, paths, lenses=lenses, mask_paths=masks)
    # COLMAP's guide asks for an empty text file if poses are known and points are not: no
    # points, not a damaged file.
    xyz, colors = _binary_points(existing_file(cloud)) if binary else _text_points(cloud)
    return Dataset(cameras, paths, xyz, colors, lenses=lenses, mask_paths=masks)


def _mask(folder: Path, name: str) -> Path | None:
    """Find the mask of a picture: NAME.png (COLMAP's), or the picture's name, with any suffix."""
    stem = (folder / name).with_suffix("")
    each = [folder / f"{name}.png", folder / name, *(Path(f"{stem}{s}") for s in IMAGE_SUFFIXES)]
    return next((path for path in each if is_file(path)), None)


# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Intrinsics:
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class _Pose:
    quat: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


def _warn_of_larger(model: Path, count: int, images: Path) -> None:
    """Warn if another model next to this one has more images. If photographs do not connect, COLMAP
    writes several models, numbered in the order in which it began them: the first may not be
    the best.
    """
    others = {
        other: _image_count(other)
        for other in model.parent.iterdir()
        if other.name.isdecimal() and other != model
    }
    largest = max(others, key=lambda other: (others[other], other.name), default=model)
    if others.get(largest, 0) > count:
        warnings.warn(
            f"{model}: is read, with {count} images; {largest} has {others[largest]}, and may be"
            f" the better model: name it, with {images} as the folder of its images (--images)",
            InputWarning,
            stacklevel=3,
        )


def _image_count(model: Path) -> int:
    """Count the registered images of a model; 0 if unreadable."""
    try:
        if (model / "images.bin").is_file():
            with (model / "images.bin").open("rb") as stream:
                return int(struct.unpack("<Q", stream.read(8))[0])
        return len(_text_images(model / "images.txt"))
    except (OSError, struct.error, FileFormatError):
        return 0


def _image_folder(
    path: Path, model: Path, images: str | os.PathLike[str] | None, name: str
) -> Path:
    """Find the folder ``images``; by default the folder of that name nearest to the model."""
    if images is not None:
        return path / images if (path / images).is_dir() else Path(images)
    # An absolute path, since the parent of "." is ".".
    roots = [path, *Path(os.path.normpath(model.absolute())).parents[:3]]
    return next((root / name for root in roots if (root / name).is_dir()), path / name)


def _camera(
    source: Path, pose: _Pose, intrinsics: _Intrinsics, cameras_file: Path, distorted: Distorted
) -> tuple[Camera, Lens | None]:
    model, params = intrinsics.model, intrinsics.params
    whose = f"camera {pose.camera}, of image {pose.name!r}, has model {model}"
    lens: Lens | None = None
    if model in BROWN or model in FISHEYE:
        coefficients = [0.0] * (8 if model in BROWN else 4)
        places = BROWN.get(model) or FISHEYE[model]
        for place, value in zip(places, params[-len(places) :], strict=True):
            coefficients[place] = value
        try:
            lens = Lens("brown" if model in BROWN else "fisheye", tuple(coefficients))
        except ValueError as error:
            raise FileFormatError(cameras_file, f"camera {pose.camera}: {error}") from error
        lens = None if lens.is_pinhole else lens
        if lens is not None and distorted == "error":
            raise FileFormatError(
                cameras_file,
                f"{whose}, expected PINHOLE or SIMPLE_PINHOLE; undistort the images first (attnwarp"
                " undistort, or COLMAP's image_undistorter) and read the folder that this writes",
                field="model",
            )
    elif model not in ("SIMPLE_PINHOLE", "PINHOLE"):
        raise FileFormatError(
            cameras_file,
            f"{whose}, expected PINHOLE, SIMPLE_PINHOLE or, to undistort,"
            f" {', '.join([*BROWN, *FISHEYE])}; run COLMAP's image_undistorter and read the folder"
            " that it writes",
            field="model",
        )
    fx, fy, cx, cy = (params[0], *params[:3]) if model in ONE_FOCAL else params[:4]
    quat = np.array(pose.quat)
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(quat)
    if not (np.isfinite(norm) and norm > 0) or not np.isfinite(pose.translation).all():
        raise FileFormatError(
            source,
            f"got quaternion {pose.quat} and translation {pose.translation}, expected a finite"
            " pose",
            field=f"image {pose.name!r}",
        )
    w, x, y, z = quat / norm
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    world_to_camera[:3, 3] = pose.translation
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    try:
        name = pose.name.replace("\\", "/")  # of Windows
        return Camera(K, world_to_camera, intrinsics.width, intrinsics.height, name), lens
    except ValueError as error:
        raise FileFormatError(cameras_file, f"camera {pose.camera}: {error}") from error


class _Reader:
    """Reader of little-endian values from a file's bytes, whose error at the end of the data names
    the expected value.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.position, self.what = (
            path,
            path.read_bytes(),
            0,
            "the number of entries",
        )

    def need(self, count: int) -> None:
        if self.position + count > len(self.data):
            raise FileFormatError(
                self.path,
                f"ends at byte {len(self.data)} while reading {self.what}; get the file again,"
                " whole",
            )

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        self.need(size)
        values = struct.unpack_from("<" + layout, self.data, self.position)
        self.position += size
        return values

    def skip(self, count: int) -> None:
        self.need(count)
        self.position += count

    def text(self) -> str:
        end = self.data.find(b"\0", self.position)
        if end < 0:
            self.need(len(self.data))
        text = self.data[self.position : end].decode("utf-8", "surrogateescape")
        self.position = end + 1
        return text

    def entries(self, noun: str) -> Iterator[int]:
        """Count the entries announced at the start of the file."""
        (count,) = self.take("Q")
        for i in range(count):
            self.what = f"{noun} {i} of {count}"
            yield i
        if self.position != len(self.data):
            raise FileFormatError(
                self.path,
                f"{len(self.data) - self.position} bytes are left after {count} entries; the file"
                " is damaged, or of another format",
            )


def _binary_cameras(path: Path) -> dict[int, _Intrinsics]:
    reader = _Reader(path)
    intrinsics: dict[int, _Intrinsics] = {}
    for i in reader.entries("camera"):
        camera, model, width, height = reader.take("IiQQ")
        if model not in MODELS:
            raise FileFormatError(
                path,
                f"got id {model} for entry {i}, expected 0 to {max(MODELS)}; the file is"
                " damaged, or of a newer COLMAP",
                field="model",
                row=i,
            )
        name, count = MODELS[model]
        _once(path, intrinsics, camera)
        intrinsics[camera] = _Intrinsics(name, width, height, reader.take(f"{count}d"))
    return intrinsics


def _once(path: Path, intrinsics: dict[int, _Intrinsics], camera: int) -> None:
    if camera in intrinsics:
        raise FileFormatError(path, f"camera {camera} stands twice; remove one")


def _binary_images(path: Path) -> list[_Pose]:
    reader = _Reader(path)
    poses = []
    for _ in reader.entries("image"):
        _, *pose, camera = reader.take("I7dI")
        name = reader.text()
        (keypoints,) = reader.take("Q")
        reader.skip(24 * keypoints)
        poses.append(_Pose(tuple(pose[:4]), tuple(pose[4:]), camera, name))
    return poses


def _binary_points(path: Path) -> tuple[Array, npt.NDArray[np.uint8]]:
    reader = _Reader(path)
    points, colors = [], []
    for _ in reader.entries("point"):
        _, x, y, z, red, green, blue, _, track = reader.take("Q3d3BdQ")
        reader.skip(8 * track)
        points.append((x, y, z))
        colors.append((red, green, blue))
    return _points(path, points, colors)


def _text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Iterate over line numbers and lines without comments. Empty lines are kept: in images.txt
    they mean 'no keypoints'.
    """
    try:
        text = read_text(path, errors="surrogateescape")
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


def _damaged(path: Path, number: int, line: str, expected: str) -> FileFormatError:
    return FileFormatError(
        path, f"line {number}: got {line[:80]!r}, expected {expected}", row=number
    )


def _text_cameras(path: Path) -> dict[int, _Intrinsics]:
    intrinsics: dict[int, _Intrinsics] = {}
    for number, line in _text_lines(path):
        if not line:
            continue
        fields = line.split()
        try:
            name, model, width, height, *params = fields
            camera = int(name)
            lens = _Intrinsics(model, int(width), int(height), tuple(float(v) for v in params))
        except ValueError as error:
            raise _damaged(path, number, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]") from error
        count = next((count for name, count in MODELS.values() if name == model), len(params))
        if len(params) != count:
            raise _damaged(path, number, line, f"{count} parameters for {model}")
        _once(path, intrinsics, camera)
        intrinsics[camera] = lens
    return intrinsics


def _text_images(path: Path) -> list[_Pose]:
    poses = []
    lines = _text_lines(path)
    for number, line in lines:
        if not line:
            continue
        try:
            poses.append(_text_pose(line))
        except ValueError as error:
            raise _damaged(
                path, number, line, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            ) from error
        # The next line has the keypoints and may be empty, or missing at the end.
        number, line = next(lines, (number, ""))
        if len(line.split()) == 10:  # an image again; a keypoint has three numbers
            raise _damaged(
                path,
                number,
                line,
                "the keypoints X Y POINT3D_ID of the image before, or an empty line for none",
            )
    return poses


def _text_pose(line: str) -> _Pose:
    """Parse the fields of an image's line; ValueError for an unexpected format."""
    _, qw, qx, qy, qz, tx, ty, tz, camera, name = line.split(maxsplit=9)
    rotation, translation = (qw, qx, qy, qz), (tx, ty, tz)
    return _Pose(tuple(map(float, rotation)), tuple(map(float, translation)), int(camera), name)


def _text_points(path: Path) -> tuple[Array, npt.NDArray[np.uint8]]:
    points, colors = [], []
    for number, line in _text_lines(path):
        if not line:
            continue
        try:
            _, x, y, z, red, green, blue, *_ = line.split()
            points.append((float(x), float(y), float(z)))
            colors.append((int(red), int(green), int(blue)))
            if not all(0 <= value <= 255 for value in colors[-1]):
                raise ValueError(colors[-1])
        except ValueError as error:
            raise _damaged(path, number, line, "POINT3D_ID X Y Z R G B ERROR TRACK[]") from error
    return _points(path, points, colors)


def _points(
    path: Path, points: Sequence[tuple[float, ...]], colors: Sequence[tuple[int, ...]]
) -> tuple[Array, npt.NDArray[np.uint8]]:
    xyz = np.array(points, dtype=np.float64).reshape(-1, 3)
    bad = ~np.isfinite(xyz).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise FileFormatError(
            path, f"point {row} (counted from 0) is {points[row]}, not finite", field="xyz", row=row
        )
    return xyz, np.array(colors, dtype=np.uint8).reshape(-1, 3)
