"""transforms.json: cameras as nerfstudio, instant-ngp and the Blender data sets of NeRF write them.

``transform_matrix`` is camera-to-world in OpenGL axes (x right, y up, z backward). Pixel centres
lie at +0.5 as here, so ``cx = w / 2`` is the middle of the image. Cameras and points stay in the
world of the file: ``applied_transform`` is handed on as information, and instant-ngp's ``scale``,
``offset`` and ``aabb_scale`` (how it fits the scene into its unit cube) are not applied.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.io.dataset import Dataset, Missing, nearest_rotation, with_images
from attnwarp.io.file import FileFormatError, existing_file, write_atomically
from attnwarp.io.images import image_size
from attnwarp.io.ply import read_points, write_points

Array = npt.NDArray[np.float64]

SPLITS = ("train", "val", "test")
IMAGE_SUFFIXES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".PNG",
    ".JPG",
    ".JPEG",
    ".webp",
    ".tif",
    ".tiff",
    ".exr",
)
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
PINHOLE_MODELS = (
    "OPENCV",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "PERSPECTIVE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "FULL_OPENCV",
)
"""Values of ``camera_model`` that are a pinhole as long as every distortion coefficient is zero."""

OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])


def read_transforms(
    path: str | os.PathLike[str],
    *,
    missing_images: Missing = "error",
    resize_cameras: bool = False,
    points: bool = True,
) -> Dataset:
    """Read a transforms.json.

    Intrinsics stand in the frame or else at the top: ``fl_x``, ``fl_y`` (or ``camera_angle_x``,
    ``camera_angle_y`` in radians), ``cx``, ``cy`` (the middle of the image if left out), ``w``,
    ``h`` (the image's own size if left out). ``file_path`` is relative to the file, with or without
    its extension. Rotations off by up to 1e-4 (float32, or printed numbers) are replaced by the
    nearest rotation; beyond, they are refused. Frames keep their order.

    Args:
        path: the file, or a folder with transforms.json or with transforms_train.json, _val.json,
            _test.json, which are read together and told apart by ``Dataset.splits``.
        missing_images: "error", or "none" to get None for the path of an image that is not there.
        resize_cameras: when an image has another size than its camera, resize the camera instead of
            refusing.
        points: False to leave the points out; their file is then not read, and may be missing or
            damaged.

    Raises:
        FileNotFoundError: no such file.
        FileFormatError: not JSON, a key that is missing or of the wrong type, lens distortion, a
            pose that is not rigid, missing images; the message names the frame and the key.
    """
    path = Path(path)
    if not path.is_dir():
        return _read_file(path, _split_of(path), missing_images, resize_cameras, points)
    if (path / "transforms.json").exists():
        return _read_file(path / "transforms.json", None, missing_images, resize_cameras, points)
    files = [path / f"transforms_{split}.json" for split in SPLITS]
    parts = [
        _read_file(file, _split_of(file), missing_images, resize_cameras, points)
        for file in files
        if file.exists()
    ]
    if not parts:
        raise FileNotFoundError(
            f"{path}: neither transforms.json nor transforms_train.json is there"
        )
    with_points = next((part for part in parts if part.points is not None), parts[0])
    return Dataset(
        [camera for part in parts for camera in part.cameras],
        [image for part in parts for image in part.image_paths],
        with_points.points,
        with_points.colors,
        [split for part in parts for split in part.splits],
        parts[0].applied_transform,
    )


def write_transforms(
    path: str | os.PathLike[str], dataset: Dataset, *, points_name: str = "sparse_pc.ply"
) -> None:
    """Write ``dataset`` as a transforms.json, and its points as a PLY beside it; atomically, images
    are not copied.

    Read back, rotations, camera centres to one rounding of float64, intrinsics, points and splits
    are the same.

    Args:
        path: the file, or a folder in which transforms.json is written.
        dataset: ``file_path`` becomes the image's path relative to the file, or the camera's name
            without an image.
        points_name: name of the point cloud beside the file.

    Raises:
        ValueError: a camera with skew, which the format cannot hold, or with neither image nor
            name.
    """
    path = Path(path)
    path = path / "transforms.json" if path.is_dir() else path
    intrinsics, frames, names = [], [], []
    for i, (camera, image) in enumerate(zip(dataset.cameras, dataset.image_paths, strict=True)):
        if camera.K[0, 1] != 0:
            raise ValueError(
                f"dataset: camera {i} has skew {camera.K[0, 1]}, which transforms.json cannot hold"
            )
        name = (
            camera.name if image is None else Path(os.path.relpath(image, path.parent)).as_posix()
        )
        if not name:
            raise ValueError(f"dataset: camera {i} has neither an image nor a name for file_path")
        K = camera.K
        fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        intrinsics.append(
            {"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        )
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation.T * OPENGL_TO_OPENCV
        pose[:3, 3] = camera.position
        # 0.0 + x turns -0.0, which the change of axes makes, into 0.0.
        frames.append({"file_path": name, "transform_matrix": (pose + 0.0).tolist()})
        names.append(name)
    data: dict[str, Any] = {"camera_model": "OPENCV"}
    if intrinsics and all(each == intrinsics[0] for each in intrinsics):
        shared = intrinsics[0]
        # The reader of the original 3DGS knows only this angle.
        data |= {"camera_angle_x": 2 * math.atan(shared["w"] / (2 * shared["fl_x"])), **shared}
    else:
        frames = [frame | each for frame, each in zip(frames, intrinsics, strict=True)]
    if dataset.applied_transform is not None:
        data["applied_transform"] = dataset.applied_transform.tolist()
    for split in sorted({split for split in dataset.splits if split is not None}):
        data[f"{split}_filenames"] = [
            name for name, its in zip(names, dataset.splits, strict=True) if its == split
        ]
    if dataset.points is not None:
        write_points(path.with_name(points_name), dataset.points, dataset.colors)
        data["ply_file_path"] = points_name
    data["frames"] = frames
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda stream: stream.write(text.encode()))


# --------------------------------------------------------------------------------------------------


def _split_of(path: Path) -> str | None:
    return next((split for split in SPLITS if path.name == f"transforms_{split}.json"), None)


def _read_file(
    path: Path, split: str | None, missing_images: Missing, resize_cameras: bool, with_points: bool
) -> Dataset:
    path = existing_file(path)
    try:
        data = json.loads(path.read_bytes())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(path, f"not JSON: {error}") from error
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise FileFormatError(path, "missing or empty, expected a list of frames", field="frames")
    cameras, paths, splits = [], [], []
    named = {name: each for each in SPLITS for name in _names_of_split(path, data, each)}
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise FileFormatError(
                path, f"got {type(frame).__name__}, expected an object", field=f"frames[{i}]", row=i
            )
        name = frame.get("file_path")
        if not isinstance(name, str) or not name:
            raise FileFormatError(
                path, f"got {name!r}, expected a path", field=f"frames[{i}].file_path", row=i
            )
        image = _find_image(path.parent / name)
        cameras.append(_camera(_Values(path, i, name, frame, data), image))
        paths.append(image)
        splits.append(named.get(name, split))
    cameras, found = with_images(
        path, cameras, paths, missing_images=missing_images, resize_cameras=resize_cameras
    )
    points = colors = None
    ply = data.get("ply_file_path") if with_points else None
    if ply is not None:
        if not isinstance(ply, str):
            raise FileFormatError(path, f"got {ply!r}, expected a path", field="ply_file_path")
        if not (path.parent / ply).is_file():
            raise FileFormatError(
                path,
                f"{path.parent / ply} is missing; put it there or remove the key",
                field="ply_file_path",
            )
        points, colors = read_points(path.parent / ply)
    applied = None
    if "applied_transform" in data:
        applied = _matrix(path, "applied_transform", None, data["applied_transform"])[:3]
    return Dataset(cameras, found, points, colors, splits, applied)


def _names_of_split(path: Path, data: dict[str, Any], split: str) -> list[str]:
    key = f"{split}_filenames"
    names = data.get(key, [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise FileFormatError(path, "expected a list of paths", field=key)
    return names


def _find_image(path: Path) -> Path:
    """``path``, or if there is no such file, ``path`` with the first image suffix that makes it
    one.
    """
    if path.is_file():
        return path
    return next(
        (each for suffix in IMAGE_SUFFIXES if (each := Path(f"{path}{suffix}")).is_file()), path
    )


class _Values:
    """The values that hold for one frame: its own, or else those at the top of the file."""

    def __init__(
        self, path: Path, index: int, name: str, frame: dict[str, Any], top: dict[str, Any]
    ) -> None:
        self.path, self.index, self.name, self.levels = path, index, name, (frame, top)

    def refuse(self, key: str, message: str) -> FileFormatError:
        return FileFormatError(
            self.path, message, field=f"frames[{self.index}] ({self.name}): {key}", row=self.index
        )

    def level_of(self, *keys: str) -> dict[str, Any]:
        """The innermost level that has one of ``keys``."""
        return next((level for level in self.levels if any(key in level for key in keys)), {})

    def get(self, key: str) -> Any:
        return self.level_of(key).get(key)

    def number(self, key: str, level: dict[str, Any] | None = None) -> float | None:
        value = self.get(key) if level is None else level.get(key)
        if value is None:
            return None
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            raise self.refuse(key, f"got {value!r}, expected a finite number")
        return float(value)


def _camera(values: _Values, image: Path) -> Camera:
    model = values.get("camera_model")
    if model is not None and model not in PINHOLE_MODELS:
        raise values.refuse(
            "camera_model", f"got {model!r}, expected a pinhole; undistort the images first"
        )
    if values.get("is_fisheye"):
        raise values.refuse(
            "is_fisheye", "a fisheye lens is not a pinhole; undistort the images first"
        )
    for key in DISTORTION:
        value = values.number(key)
        if value:
            raise values.refuse(
                key,
                f"got lens distortion {value:g}, expected 0; undistort the images first (COLMAP's"
                " image_undistorter or OpenCV's undistort) and write the file for the undistorted"
                " ones",
            )
    size = [values.number("w"), values.number("h")]
    if None in size:
        if not image.is_file():
            raise values.refuse(
                "w, h", f"missing, and the image {image} is not there to take the size from"
            )
        size = [
            given if given is not None else own
            for given, own in zip(size, image_size(image), strict=True)
        ]
    width, height = (int(v or 0) for v in size)
    if [width, height] != size or width < 1 or height < 1:
        raise values.refuse(
            "w, h", f"got {size[0]:g} x {size[1]:g}, expected whole numbers of pixels"
        )
    level = values.level_of("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
    focal = []
    for axis, extent in (("x", width), ("y", height)):
        f, angle = values.number(f"fl_{axis}", level), values.number(f"camera_angle_{axis}", level)
        if f is None and angle is not None:
            if not 0 < angle < math.pi:
                raise values.refuse(
                    f"camera_angle_{axis}", f"got {angle:g}, expected radians in (0, pi)"
                )
            f = extent / 2 / math.tan(angle / 2)
        focal.append(f)
    # One focal length means square pixels.
    fx, fy = focal[0] or focal[1], focal[1] or focal[0]
    if fx is None or fy is None or fx <= 0 or fy <= 0:
        raise values.refuse(
            "fl_x",
            f"got {fx}, {fy}; expected positive fl_x, or camera_angle_x, in the frame or at"
            " the top",
        )
    cx, cy = values.number("cx"), values.number("cy")
    K = np.array(
        [
            [fx, 0, width / 2 if cx is None else cx],
            [0, fy, height / 2 if cy is None else cy],
            [0, 0, 1],
        ]
    )
    key = f"frames[{values.index}] ({values.name}): transform_matrix"
    matrix = _matrix(values.path, key, values.index, values.levels[0].get("transform_matrix"))
    R = nearest_rotation(values.path, key, matrix[:3, :3]) * OPENGL_TO_OPENCV
    pose = np.eye(4)
    pose[:3, :3] = R.T
    pose[:3, 3] = -R.T @ matrix[:3, 3]
    return Camera(K, pose, width, height, values.name.removeprefix("./"))


def _matrix(path: Path, key: str, row: int | None, value: Any) -> Array:
    """(4, 4) or (3, 4) of finite numbers, with the last row [0, 0, 0, 1] if it is there."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise FileFormatError(
            path, f"got {str(value)[:60]}, expected a 4 x 4 matrix of numbers", field=key, row=row
        )
    if not np.isfinite(matrix).all():
        raise FileFormatError(
            path, "holds a value that is not finite; leave the frame out", field=key, row=row
        )
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
        raise FileFormatError(
            path,
            f"got last row {matrix[3].tolist()}, expected [0, 0, 0, 1]; the matrix may be"
            " transposed",
            field=key,
            row=row,
        )
    return matrix
