"""transforms.json: cameras of nerfstudio, instant-ngp and NeRF's Blender datasets.

``transform_matrix`` is camera-to-world in OpenGL axes (x right, y up, z backward). Pixel centres
lie at +0.5 as here, so ``cx = w / 2`` is the middle of the image. Cameras and points stay in the
world of the file: nerfstudio's ``applied_transform`` and instant-ngp's ``scale``, ``offset`` and
``aabb_scale`` (the scene's fit into its unit cube) are not read.
"""

from __future__ import annotations

import functools
import json
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.errors import suggest
from attnwarp.io.dataset import (
    OF_IMAGES,
    Dataset,
    Distorted,
    Missing,
    nearest_rotation,
    with_images,
)
from attnwarp.io.file import FileFormatError, existing_file, is_file, named_file, write_atomically
from attnwarp.io.images import IMAGE_SUFFIXES, image_size
from attnwarp.io.lens import Lens
from attnwarp.io.ply import read_points, write_points

Array = npt.NDArray[np.float64]

SPLITS = ("train", "val", "test")
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Keys of distortion coefficients, in the order of OpenCV's vector."""

DISTORTION_LIST = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Names of the six numbers of nerfstudio's ``distortion_params``."""

PINHOLE_MODELS = (
    "OPENCV",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "PERSPECTIVE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "FULL_OPENCV",
)
"""Values of ``camera_model`` that mean a pinhole if all distortion coefficients are zero."""

FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

CHANGES_THE_PICTURE = {
    "rolling_shutter": "a rolling shutter",
    "transform_matrix_start": "a camera that moves during the exposure",
    "transform_matrix_end": "a camera that moves during the exposure",
    "skew": "axes that are not at right angles",
    "ftheta_p0": "an f-theta lens",
    "latlong": "a panorama",
    "equirectangular": "a panorama",
    "orthographic": "an orthographic camera",
    "white_transparent": "white pixels that are transparent",
    "black_transparent": "black pixels that are transparent",
    "mask_color": "a colour that is transparent",
    "fix_premult": "alpha of another kind",
    "sharpen": "sharpened pictures",
}
"""Unsupported keys that change a picture's content, and their effect; refused if set."""

OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])


def read_transforms(
    path: str | os.PathLike[str],
    *,
    missing_images: Missing = "error",
    resize_cameras: bool = False,
    points: bool = True,
    distorted: Distorted = "error",
    ignore_keys: Sequence[str] = (),
    scale: int = 1,
) -> Dataset:
    """Read a transforms.json.

    Intrinsics are in the frame or else at the top: ``fl_x``, ``fl_y`` (or ``camera_angle_x``,
    ``camera_angle_y`` in radians), ``cx``, ``cy`` (default: the middle of the image), ``w``, ``h``
    (default: the image's size). ``file_path`` is relative to the file, with or without its
    extension, and backslashes count as slashes. Rotations off by up to 1e-4 (float32, or printed
    numbers) are replaced by the nearest rotation; larger errors are refused. Frames keep their
    order.

    Args:
        path: file, or folder with transforms.json or with transforms_train.json, _val.json,
            _test.json, which are read together and distinguished by ``Dataset.splits``.
        missing_images, resize_cameras, points, distorted, ignore_keys: see :func:`read_dataset`.
        scale: downscaling factor; 4 reads ``images_4/a.png`` for the file's ``images/a.png``, in
            nerfstudio's layout, and resizes the cameras.

    Raises:
        FileNotFoundError: the file does not exist.
        FileFormatError: invalid JSON, a missing or wrongly typed key, lens distortion, an
            unsupported key that changes the picture, a pose that is not rigid, missing images, or
            a split that names no frame; the message names the frame and the key.

    Example:
        >>> import json
        >>> from pathlib import Path
        >>> from attnwarp.io import read_transforms
        >>> pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]  # camera to world
        >>> frame = {"file_path": "a.png", "transform_matrix": pose}
        >>> file = {"w": 64, "h": 48, "fl_x": 60, "frames": [frame]}
        >>> _ = Path("transforms.json").write_text(json.dumps(file))
        >>> [camera] = read_transforms("transforms.json", missing_images="none").cameras
        >>> camera.position.tolist(), camera.K[1].tolist()
        ([0.0, 0.0, 2.0], [0.0, 60.0, 24.0])
    """
    check.one_of(distorted, ("error", "keep"), "distorted")
    path = Path(path)
    read = functools.partial(
        _read_file,
        missing_images=missing_images,
        resize_cameras=resize_cameras,
        with_points=points,
        distorted=distorted,
        ignore_keys=ignore_keys,
        scale=scale,
    )
    if not path.is_dir():
        return read(path, _split_of(path))
    if (path / "transforms.json").exists():
        return read(path / "transforms.json", None)
    files = [path / f"transforms_{split}.json" for split in SPLITS]
    parts = [read(file, _split_of(file)) for file in files if file.exists()]
    if not parts:
        raise FileNotFoundError(
            f"{path}: neither transforms.json nor transforms_train.json is there"
        )
    with_points = next((part for part in parts if part.points is not None), parts[0])
    each: dict[str, Any] = {
        name: [value for part in parts for value in getattr(part, name)] for name in OF_IMAGES
    }
    return replace(with_points, **each)


def write_transforms(
    path: str | os.PathLike[str], dataset: Dataset, *, points_name: str = "sparse_pc.ply"
) -> None:
    """Write ``dataset`` as a transforms.json, and its points as a PLY in the same folder;
    atomically, without copying images.

    A round trip keeps rotations, intrinsics, points and splits, and camera centres to one rounding
    of float64. nerfstudio needs all three splits if any exists. If only one of "test" and "val"
    accompanies "train", its images are written under both names.

    Args:
        path: file, or folder in which transforms.json is written.
        dataset: dataset to write; ``file_path`` becomes the image's path relative to the file, or
            the camera's name without an image.
        points_name: name of the point cloud in the file's folder.

    Raises:
        ValueError: a camera has skew, which the format cannot represent, or a lens, or neither
            image nor name.

    Example:
        >>> from attnwarp import Camera
        >>> from attnwarp.io import Dataset, read_transforms, write_transforms
        >>> camera = Camera.look_at((3, 0, 0), (0, 0, 0), width=8, height=6, fov_y=40, name="a")
        >>> write_transforms("transforms.json", Dataset([camera], [None]))
        >>> read_transforms("transforms.json", missing_images="none").cameras[0].width
        8
    """
    path = Path(path)
    path = path / "transforms.json" if path.is_dir() else path
    intrinsics, frames, names = [], [], []
    for i, (camera, image) in enumerate(zip(dataset.cameras, dataset.image_paths, strict=True)):
        if camera.K[0, 1] != 0:
            raise ValueError(
                f"dataset: camera {i} has skew {camera.K[0, 1]}, which transforms.json cannot hold"
            )
        if dataset.lenses[i] is not None:
            raise ValueError(
                f"dataset: camera {i} ({camera.name}) has a lens; undistort the images first"
            )
        name = camera.name if image is None else _relative(Path(image), path.parent)
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
        # 0.0 + x turns -0.0, which the change of axes produces, into 0.0.
        frames.append({"file_path": name, "transform_matrix": (pose + 0.0).tolist()})
        mask = dataset.mask_paths[i]
        if mask is not None:
            frames[-1]["mask_path"] = _relative(mask, path.parent)
        names.append(name)
    data: dict[str, Any] = {"camera_model": "OPENCV"}
    if intrinsics and all(each == intrinsics[0] for each in intrinsics):
        shared = intrinsics[0]
        # The reader of the original 3DGS supports only this angle.
        data |= {"camera_angle_x": 2 * math.atan(shared["w"] / (2 * shared["fl_x"])), **shared}
    else:
        frames = [frame | each for frame, each in zip(frames, intrinsics, strict=True)]
    members = {
        split: [name for name, its in zip(names, dataset.splits, strict=True) if its == split]
        for split in SPLITS
    }
    held_out = members["test"] or members["val"]
    if members["train"] and held_out:
        members["test"], members["val"] = members["test"] or held_out, members["val"] or held_out
    data |= {f"{split}_filenames": members[split] for split in SPLITS if members[split]}
    if dataset.points is not None:
        write_points(path.with_name(points_name), dataset.points, dataset.colors)
        data["ply_file_path"] = points_name
    data["frames"] = frames
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda stream: stream.write(text.encode()), follow_link=True)


# --------------------------------------------------------------------------------------------------


def _relative(image: Path, folder: Path) -> str:
    """Compute the relative path from a folder to an image, valid through links too."""
    way = Path(os.path.relpath(image, folder))
    # Behind a link, ".." means the parent of the link's target.
    if (folder / way).resolve() != image.resolve():
        way = Path(os.path.relpath(image.parent.resolve() / image.name, folder.resolve()))
    return way.as_posix()


def _scaled(path: Path, name: str, scale: int) -> str:
    """Build the name of a smaller copy of an image."""
    parts = list(Path(name).parts)
    place = next((i for i, part in enumerate(parts) if part.casefold() == "images"), None)
    if place is None:
        raise FileFormatError(
            path, f"got {name!r}, which is not in a folder images; read it without a scale",
            field="file_path",
        )  # fmt: skip
    parts[place] = f"images_{scale}"
    return str(Path(*parts))


def _split_of(path: Path) -> str | None:
    return next((split for split in SPLITS if path.name == f"transforms_{split}.json"), None)


def _read_file(
    path: Path,
    split: str | None,
    *,
    missing_images: Missing,
    resize_cameras: bool,
    with_points: bool,
    distorted: Distorted,
    ignore_keys: Sequence[str],
    scale: int,
) -> Dataset:
    path = existing_file(path)
    data = _read_json(path)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise FileFormatError(path, "missing or empty, expected a list of frames", field="frames")
    cameras: list[Camera] = []
    lenses: list[Lens | None] = []
    names: list[str] = []
    paths: list[Path] = []
    masks: list[Path | None] = []
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise FileFormatError(
                path, f"got {type(frame).__name__}, expected an object", field=f"frames[{i}]", row=i
            )
        name = frame.get("file_path")
        if not isinstance(name, str) or not name:
            raise FileFormatError(
                path,
                f"got {brief(name)}, expected a path",
                field=f"frames[{i}].file_path",
                row=i,
            )
        image = named_file(path.parent, name, IMAGE_SUFFIXES)
        if not is_file(path.parent / name):
            name = name.replace("\\", "/")  # of Windows
        values = _Values(path, i, name, frame, data)
        _check_keys(values, ignore_keys)
        lens = _lens(values)
        if lens is not None and distorted == "error":
            raise values.refuse(
                "camera_model" if lens.kind == "fisheye" else "k1, k2, p1, p2, ...",
                f"got a lens ({lens.kind}, {lens.coefficients}), expected a pinhole; undistort the"
                " images first (attnwarp undistort DATA OUT, or COLMAP's image_undistorter)",
            )
        cameras.append(_camera(values, image))
        lenses.append(lens)
        names.append(name)
        masks.append(None if "mask_path" in ignore_keys else _mask(values))
        # This camera has the full picture's size; with_images resizes it.
        if scale > 1:
            image = named_file(path.parent, _scaled(path, name, scale), IMAGE_SUFFIXES)
        paths.append(image)
    splits = _splits(path, data, names, paths, split)
    cameras, available = with_images(
        path,
        cameras,
        paths,
        missing_images=missing_images,
        resize_cameras=resize_cameras or scale > 1,
    )
    points = colors = None
    ply = data.get("ply_file_path") if with_points else None
    if ply is not None:
        if not isinstance(ply, str):
            raise FileFormatError(path, f"got {brief(ply)}, expected a path", field="ply_file_path")
        cloud = named_file(path.parent, ply)
        if not is_file(cloud):
            raise FileFormatError(
                path, f"{cloud} is missing; put it there or remove the key", field="ply_file_path"
            )
        points, colors = read_points(cloud)
    return Dataset(cameras, available, points, colors, splits, lenses, masks)


def _mask(values: _Values) -> Path | None:
    name = values.get("mask_path")
    if not name:
        return None
    mask = None
    if isinstance(name, str):
        mask = named_file(values.path.parent, name, IMAGE_SUFFIXES)
    if mask is None or not is_file(mask):
        raise values.refuse(
            "mask_path",
            f"got {brief(name)}, which is not there; put it there, or fit on whole pictures:"
            " ignore_keys=['mask_path'] (--ignore-key mask_path)",
        )
    return mask


def brief(value: Any) -> str:
    """Shorten a value of any length for an error message."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        first = str(error).splitlines()[0]
        raise FileFormatError(
            path, f"not JSON: {first}; name a transforms.json, its folder or a COLMAP folder"
        ) from None


def _check_keys(values: _Values, ignore_keys: Sequence[str]) -> None:
    for key, effect in CHANGES_THE_PICTURE.items():
        value = values.get(key)
        if key in ignore_keys or not value:
            continue
        if isinstance(value, list) and not any(value):
            continue
        raise values.refuse(
            key,
            f"got {brief(value)}: {effect}, which is not supported; prepare the images without it,"
            f" or pass ignore_keys=[{key!r}] (--ignore-key {key})",
        )


def _splits(
    path: Path,
    data: dict[str, Any],
    names: list[str],
    images: list[Path],
    split: str | None,
) -> list[str | None]:
    """Determine the split of each frame: from the file's lists, else ``split``.

    Names are compared as paths, with or without the image's suffix. A frame in both test and val
    belongs to test.
    """
    frames: dict[str, list[int]] = {}
    for i, (name, image) in enumerate(zip(names, images, strict=True)):
        for key in {os.path.normpath(path.parent / name), os.path.normpath(image)}:
            frames.setdefault(key, []).append(i)
    result: list[str | None] = [split] * len(names)
    for each in SPLITS:
        key = f"{each}_filenames"
        listed = data.get(key) or []
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise FileFormatError(path, "expected a list of paths", field=key)
        for name in listed:
            ways = (
                os.path.normpath(way)
                for way in (path.parent / name, named_file(path.parent, name, IMAGE_SUFFIXES))
            )
            members = next((frames[way] for way in ways if way in frames), [])
            if not members:
                raise FileFormatError(
                    path,
                    f"{brief(name)} is the name of no frame{suggest(name, names)}; where frames"
                    f" were removed, remove their names too, or all of {key}",
                    field=key,
                )
            for i in members:
                if each != "train" and result[i] == "train":
                    raise FileFormatError(
                        path, f"{brief(names[i])} is in train_filenames too; remove one", field=key
                    )
                result[i] = each
    return result


def number(value: Any) -> float:
    """Convert a JSON value to float; NaN for anything that is no finite number.

    Example:
        >>> number(3), number("fast"), number(None)
        (3.0, nan, nan)
    """
    try:
        result = float(value)
    except (TypeError, ValueError, OverflowError):  # an integer beyond 1.8e308
        return math.nan
    return result if math.isfinite(result) else math.nan


class _Values:
    """Values of one frame: the frame's, or else those at the top of the file."""

    def __init__(
        self, path: Path, index: int, name: str, frame: dict[str, Any], top: dict[str, Any]
    ) -> None:
        self.path, self.index, self.name, self.levels = path, index, name, (frame, top)

    def refuse(self, key: str, message: str) -> FileFormatError:
        return FileFormatError(
            self.path, message, field=f"frames[{self.index}] ({self.name}): {key}", row=self.index
        )

    def level_of(self, *keys: str) -> dict[str, Any]:
        """Find the innermost level with one of ``keys``."""
        return next((level for level in self.levels if any(key in level for key in keys)), {})

    def get(self, key: str) -> Any:
        return self.level_of(key).get(key)

    def number(self, key: str, level: dict[str, Any] | None = None) -> float | None:
        value = self.get(key) if level is None else level.get(key)
        if value is None:
            return None
        result = number(value)
        if math.isnan(result):
            raise self.refuse(key, f"got {brief(value)}, expected a finite number")
        return result


def _lens(values: _Values) -> Lens | None:
    """Read the lens of a frame, None for a pinhole.

    Coefficients are in ``distortion_params`` or in separate keys, in the frame or at the top.
    """
    model = values.get("camera_model")
    if model is not None and model not in (*PINHOLE_MODELS, *FISHEYE_MODELS):
        raise values.refuse(
            "camera_model",
            f"got {brief(model)}, expected one of {', '.join((*PINHOLE_MODELS, *FISHEYE_MODELS))};"
            " undistort the images first",
        )
    fisheye = model in FISHEYE_MODELS or bool(values.get("is_fisheye"))
    given = (_coefficients(values, level) for level in values.levels)
    by_name = next((c for c in given if c is not None), dict.fromkeys(DISTORTION, 0.0))
    if by_name["k4"] and not fisheye and model != "FULL_OPENCV":
        # Some programs use the coefficient in a polynomial, others in a denominator.
        raise values.refuse(
            "k4", f"got {by_name['k4']:g}, expected 0 unless camera_model is FULL_OPENCV"
        )
    if fisheye:
        names = ("k1", "k2", "k3", "k4")
        spare = [key for key in DISTORTION if key not in names and by_name[key]]
        if spare:
            raise values.refuse(spare[0], "got a coefficient that a fisheye lens does not have")
        return Lens("fisheye", tuple(by_name[key] for key in names))
    lens = Lens("brown", tuple(by_name[key] for key in DISTORTION))
    return None if lens.is_pinhole else lens


def _coefficients(values: _Values, level: dict[str, Any]) -> dict[str, float] | None:
    """Read the coefficients of one level by name; None without any."""
    own = {key: values.number(key, level) for key in DISTORTION}
    listed = level.get("distortion_params")
    if listed is None:
        if all(value is None for value in own.values()):
            return None
        return {key: value or 0.0 for key, value in own.items()}
    coefficients = [number(v) for v in listed] if isinstance(listed, list) else []
    if len(coefficients) != len(DISTORTION_LIST) or any(map(math.isnan, coefficients)):
        raise values.refuse(
            "distortion_params",
            f"got {brief(listed)}, expected six numbers: {' '.join(DISTORTION_LIST)}",
        )
    result = dict.fromkeys(DISTORTION, 0.0)
    result.update(zip(DISTORTION_LIST, coefficients, strict=True))
    for key, value in own.items():
        if value is not None and value != result[key]:
            raise values.refuse(key, "differs from distortion_params; remove one of them")
    return result


def _camera(values: _Values, image: Path) -> Camera:
    size = [values.number("w"), values.number("h")]
    if None in size:
        if not is_file(image):
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
    try:
        return Camera(K, pose, width, height, values.name.removeprefix("./"))
    except ValueError as error:
        raise values.refuse("transform_matrix", str(error)) from None


def _matrix(path: Path, key: str, row: int, value: Any) -> Array:
    """Parse a finite (4, 4) or (3, 4) matrix; a last row must be [0, 0, 0, 1]."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise FileFormatError(
            path, f"got {brief(value)}, expected 4 x 4 or 3 x 4 finite numbers", field=key, row=row
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
