"""COLMAP sparse models, binary and text: cameras, images and points.

COLMAP's conventions are ours: OpenCV axes, world-to-camera poses, the corner of the image at (0, 0)
and the first pixel's centre at (0.5, 0.5) (colmap/sensor/models.h), so the principal point is taken
as it is.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.io.dataset import Dataset, Missing, with_images
from attnwarp.io.file import FileFormatError, existing_file

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
}
"""COLMAP's camera models: id -> name and number of parameters (colmap/sensor/models.h)."""

MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")
"""Where a sparse model is looked for in a folder, first hit first."""


def find_model(path: str | os.PathLike[str]) -> Path | None:
    """The folder at or under ``path`` that holds a sparse model, or None."""
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
) -> Dataset:
    """Read a COLMAP sparse model; where both binary and text files are there, the binary ones, as
    COLMAP does.

    Images come sorted by name. Quaternions are normalised, as COLMAP does on reading.

    Args:
        path: the folder of the model, or one that holds it as ``sparse/0``, ``sparse`` or
            ``colmap/sparse/0``.
        images: folder of the images; a relative one is tried in ``path`` first and then as it is.
            Left out, the folder ``images`` in ``path`` or in a folder above the model.
        missing_images: "error", or "none" to get None for the path of an image that is not there.
        resize_cameras: when an image has another size than its camera (``images_4`` for instance),
            resize the camera instead of refusing.
        points: False to leave the points out; their file is then not read, and may be missing or
            damaged.

    Raises:
        FileNotFoundError: no model there.
        FileFormatError: a camera with lens distortion, a damaged or truncated file, missing images.
    """
    path = Path(path)
    model = find_model(path)
    if model is None:
        raise FileNotFoundError(
            f"{path}: no COLMAP model (cameras.bin or cameras.txt) here or in"
            f" {', '.join(MODEL_FOLDERS[1:])}"
        )
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    binary = suffix == ".bin"
    lenses = (_binary_cameras if binary else _text_cameras)(
        existing_file(model / f"cameras{suffix}")
    )
    source = existing_file(model / f"images{suffix}")
    poses = sorted((_binary_images if binary else _text_images)(source), key=lambda pose: pose.name)
    if not poses:
        raise FileFormatError(source, "holds no registered image; the reconstruction failed")
    cameras = []
    for pose in poses:
        if pose.camera not in lenses:
            raise FileFormatError(
                source,
                f"image {pose.name!r} uses camera {pose.camera}, which is not in cameras{suffix}",
            )
        cameras.append(_camera(source, pose, lenses[pose.camera], model / f"cameras{suffix}"))
    folder = _image_folder(path, model, images)
    cameras, paths = with_images(
        source,
        cameras,
        [folder / pose.name for pose in poses],
        missing_images=missing_images,
        resize_cameras=resize_cameras,
    )
    cloud = model / f"points3D{suffix}"
    if not points or not cloud.is_file():
        return Dataset(cameras, paths)
    if binary:
        return Dataset(cameras, paths, *_binary_points(existing_file(cloud)))
    # Empty is what COLMAP's own guide asks for where poses are known and points are not: no points,
    # not a damaged file.
    return Dataset(cameras, paths, *_text_points(cloud))


# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Lens:
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


def _image_folder(path: Path, model: Path, images: str | os.PathLike[str] | None) -> Path:
    if images is not None:
        return path / images if (path / images).is_dir() else Path(images)
    roots = [path, model.parent, model.parent.parent, model.parent.parent.parent]
    return next((root / "images" for root in roots if (root / "images").is_dir()), path / "images")


def _camera(source: Path, pose: _Pose, lens: _Lens, cameras_file: Path) -> Camera:
    match lens.model, lens.params:
        case "SIMPLE_PINHOLE", (f, cx, cy):
            fx = fy = f
        case "PINHOLE", (fx, fy, cx, cy):
            pass
        case _:
            raise FileFormatError(
                cameras_file,
                f"camera {pose.camera}, of image {pose.name!r}, has model {lens.model}, expected"
                " PINHOLE or SIMPLE_PINHOLE; run COLMAP's image_undistorter and read the folder"
                " that it writes",
                field="model",
            )
    quat = np.array(pose.quat)
    where = f"image {pose.name!r}"
    norm = np.linalg.norm(quat)
    if not (np.isfinite(norm) and norm > 0) or not np.isfinite(pose.translation).all():
        raise FileFormatError(
            source,
            f"got quaternion {pose.quat} and translation {pose.translation}, expected a finite"
            " pose",
            field=where,
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
        return Camera(K, world_to_camera, lens.width, lens.height, pose.name)
    except ValueError as error:
        raise FileFormatError(cameras_file, f"camera {pose.camera}: {error}") from error


class _Reader:
    """Little-endian values off a file's bytes, with an error that says what was being read when
    they ran out.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at, self.what = (
            path,
            path.read_bytes(),
            0,
            "the number of entries",
        )

    def need(self, count: int) -> None:
        if self.at + count > len(self.data):
            raise FileFormatError(
                self.path,
                f"ends at byte {len(self.data)} while reading {self.what}; get the file again,"
                " whole",
            )

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        self.need(size)
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += size
        return values

    def skip(self, count: int) -> None:
        self.need(count)
        self.at += count

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            self.need(len(self.data))
        text = self.data[self.at : end].decode("utf-8", "surrogateescape")
        self.at = end + 1
        return text

    def entries(self, noun: str) -> Iterator[int]:
        """Count off the entries announced at the start of the file."""
        (count,) = self.take("Q")
        for i in range(count):
            self.what = f"{noun} {i} of {count}"
            yield i
        if self.at != len(self.data):
            raise FileFormatError(
                self.path,
                f"{len(self.data) - self.at} bytes are left after {count} entries; not a COLMAP"
                " file, or damaged",
            )


def _binary_cameras(path: Path) -> dict[int, _Lens]:
    reader = _Reader(path)
    lenses = {}
    for i in reader.entries("camera"):
        camera, model, width, height = reader.take("IiQQ")
        if model not in MODELS:
            raise FileFormatError(
                path,
                f"got id {model} for entry {i}, expected 0 (SIMPLE_PINHOLE) or 1 (PINHOLE); "
                "run COLMAP's image_undistorter and read the folder that it writes",
                field="model",
                row=i,
            )
        name, count = MODELS[model]
        lenses[camera] = _Lens(name, width, height, reader.take(f"{count}d"))
    return lenses


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
    """Line numbers and lines without comments. Empty lines are kept: in images.txt they mean 'no
    keypoints'.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="surrogateescape")
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


def _damaged(path: Path, number: int, line: str, expected: str) -> FileFormatError:
    return FileFormatError(
        path, f"line {number}: got {line[:80]!r}, expected {expected}", row=number
    )


def _text_cameras(path: Path) -> dict[int, _Lens]:
    lenses = {}
    for number, line in _text_lines(path):
        if not line:
            continue
        fields = line.split()
        try:
            camera, model, width, height, *params = fields
            lenses[int(camera)] = _Lens(
                model, int(width), int(height), tuple(float(v) for v in params)
            )
        except ValueError as error:
            raise _damaged(path, number, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]") from error
        count = next((count for name, count in MODELS.values() if name == model), len(params))
        if len(params) != count:
            raise _damaged(path, number, line, f"{count} parameters for {model}")
    return lenses


def _text_images(path: Path) -> list[_Pose]:
    poses = []
    lines = _text_lines(path)
    for number, line in lines:
        if not line:
            continue
        try:
            _, *pose, camera, name = line.split(maxsplit=9)
            poses.append(
                _Pose(tuple(map(float, pose[:4])), tuple(map(float, pose[4:])), int(camera), name)
            )
            if len(pose) != 7:
                raise ValueError(len(pose))
        except ValueError as error:
            raise _damaged(
                path, number, line, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            ) from error
        # The line after it holds the keypoints and may be empty, or missing at the end.
        next(lines, None)
    return poses


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
