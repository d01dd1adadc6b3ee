"""Variants of transforms.json: our reader against one written from nerfstudio's conventions.

The second reader (docs.nerf.studio, "Data conventions", and the data parser of nerfstudio, where
the top of the file counts before the frame) shares no code with ours. It understands
pinholes and OpenCV's two lenses, and it refuses what it does not understand.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from attnwarp.io import Dataset, read_transforms
from scripts.survey.outcome import Outcome, Row, attempt, refusal

PART = "transforms.json"
SIZE = (40, 30)
FRAMES = 4
TOLERANCE = 1e-6
"""Tolerance of centres in scene units, of directions in radians, of pixels as a share of one: six
digits of a printed matrix, or a rotation in float32, move none of them by more.
"""

Data = dict[str, Any]

RAYS = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, -0.25], [-0.2, 0.2], [0.25, 0.15]])
"""(N, 2) directions X/Z, Y/Z (y down) whose pixels are compared."""


@dataclass(frozen=True)
class View:
    """A frame as the second reader understands it."""

    image: str
    center: npt.NDArray[np.float64]
    rays: npt.NDArray[np.float64]
    pixels: npt.NDArray[np.float64]
    split: str | None
    size: tuple[int, int]


def second_reader(file: Path) -> list[View]:
    """The views of a transforms.json.

    Raises:
        ValueError: it holds something that this reader does not understand.
    """
    data = json.loads(file.read_text())
    views = []
    for frame in data["frames"]:
        both = {**frame, **data}  # what stands at the top holds for every frame
        for key in ("mask_path", "rolling_shutter", "skew"):
            if both.get(key):
                raise ValueError(key)
        image = _image(file.parent, frame["file_path"])
        width, height = Image.open(image).size
        w, h = both.get("w", width), both.get("h", height)
        if (w, h) != (width, height):
            raise ValueError("the picture has another size")
        if "fl_x" in both:
            fx = float(both["fl_x"])
        else:
            fx = 0.5 * w / math.tan(0.5 * float(both["camera_angle_x"]))
        fy = float(both["fl_y"]) if "fl_y" in both else fx
        if "fl_y" not in both and "camera_angle_y" in both:
            fy = 0.5 * h / math.tan(0.5 * float(both["camera_angle_y"]))
        cx, cy = float(both.get("cx", w / 2)), float(both.get("cy", h / 2))
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        to_world = np.array(frame["transform_matrix"], dtype=np.float64)
        if to_world.shape not in ((4, 4), (3, 4)):
            raise ValueError("transform_matrix")
        turn = to_world[:3, :3]
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
            raise ValueError("the pose is not rigid")
        if len(to_world) == 4 and not np.allclose(to_world[3], [0, 0, 0, 1]):
            raise ValueError("the last row")
        # OpenGL axes: y up, the camera looks along -z.
        rays = np.column_stack([RAYS[:, 0], -RAYS[:, 1], -np.ones(len(RAYS))]) @ turn.T
        views.append(
            View(str(image.resolve()), to_world[:3, 3], rays, _pixels(both, K), None, (w, h))
        )
    return _with_splits(file, data, views)


def _image(folder: Path, name: str) -> Path:
    for suffix in ("", ".png", ".jpg"):
        if (path := folder / (name + suffix)).is_file():
            return path
    raise ValueError(f"no image {name}")


def _pixels(both: Data, K: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Pixels of RAYS by OpenCV, with nerfstudio's names of the coefficients."""
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    listed = both.get("distortion_params")
    if listed is not None and len(listed) != 6:
        raise ValueError("distortion_params")
    c = dict(zip(names, listed or [0.0] * 6, strict=True))
    c |= {name: float(both[name]) for name in (*names, "k5", "k6") if name in both}
    model = both.get("camera_model", "OPENCV")
    points = np.column_stack([RAYS, np.ones(len(RAYS))])[:, None]
    still = np.zeros(3)
    if "FISHEYE" in model or both.get("is_fisheye"):
        D = np.array([c["k1"], c["k2"], c["k3"], c["k4"]])
        pixels = cv2.fisheye.projectPoints(points, still, still, K, D)[0]
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "FULL_OPENCV"):
        raise ValueError(model)
    if c["k4"] and model != "FULL_OPENCV":
        raise ValueError("k4 of no known formula")
    D = np.array([c.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
    pixels = cv2.projectPoints(points, still, still, K, D)[0]
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def _with_splits(file: Path, data: Data, views: list[View]) -> list[View]:
    splits: dict[str, str] = {}
    for split in ("train", "val", "test"):
        for name in data.get(f"{split}_filenames", []):
            image = str(_image(file.parent, name).resolve())
            if image not in [view.image for view in views]:
                raise ValueError(f"no frame {name}")
            splits[image] = split
    return [View(v.image, v.center, v.rays, v.pixels, splits.get(v.image), v.size) for v in views]


def our_views(data: Dataset) -> list[View]:
    """Our reading in the terms of the second reader."""
    views = []
    for camera, image, lens, split in zip(
        data.cameras, data.image_paths, data.lenses, data.splits, strict=True
    ):
        seen = RAYS if lens is None else lens.distort(RAYS)
        pixels = (np.column_stack([seen, np.ones(len(seen))]) @ camera.K.T)[:, :2]
        rays = np.column_stack([RAYS, np.ones(len(RAYS))]) @ camera.rotation
        path = "" if image is None else str(image.resolve())
        size = (camera.width, camera.height)
        views.append(View(path, camera.position, rays, pixels, split, size))
    return views


def difference(ours: list[View], theirs: list[View]) -> str:
    """Values that differ; empty if none."""
    if [v.image for v in ours] != [v.image for v in theirs]:
        return f"{len(ours)} images against {len(theirs)}, or other ones"
    for k, (one, two) in enumerate(zip(ours, theirs, strict=True)):
        if one.split != two.split:
            return f"frame {k}: split {one.split} against {two.split}"
        if one.size != two.size:
            return f"frame {k}: size {one.size} against {two.size}"
        for name in ("center", "rays", "pixels"):
            gap = np.abs(getattr(one, name) - getattr(two, name)).max()
            if not gap <= TOLERANCE * max(1.0, np.abs(two.center).max()):
                return f"frame {k}: {name} {gap:.3g} apart"
    return ""


def compare(name: str, file: Path) -> Row:
    """The row of one variant; a lens is compared as it comes for undistortion."""
    ours = attempt(lambda: read_transforms(file, distorted="keep"))
    theirs = attempt(lambda: second_reader(file))
    if ours.error is not None:
        both = theirs.error is not None
        return refusal(PART, name, ours.error, file.parent, both=both)
    assert isinstance(ours.result, Dataset)
    told = " ".join(ours.notices).replace(f"{file.parent}/", "")
    if theirs.error is not None:
        outcome = Outcome.NOTICE if told else Outcome.SILENT
        return Row(PART, name, outcome, told or f"the second reader refuses: {theirs.error}")
    views = theirs.result
    assert isinstance(views, list)
    wrong = difference(our_views(ours.result), views)
    if not wrong and any(lens is not None for lens in ours.result.lenses):
        # Who does not ask for lenses must not get them as pinholes.
        plain = attempt(lambda: read_transforms(file))
        if plain.error is None:
            wrong = "a lens is read as a pinhole"
    if wrong:
        return Row(PART, name, Outcome.SILENT if not told else Outcome.NOTICE, wrong)
    return Row(PART, name, Outcome.SAME, told)


# The variants
# --------------------------------------------------------------------------------------------------


def base(rng: np.random.Generator) -> Data:
    """Four frames at random poses, with intrinsics at the top."""
    frames = []
    for k in range(FRAMES):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, rng.uniform(-3, 3, 3)
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": pose.tolist()})
    top = {"w": 40, "h": 30, "fl_x": 35.0, "fl_y": 36.0, "cx": 19.25, "cy": 15.5}
    return {"camera_model": "OPENCV", **top, "frames": frames}


def _top(**values: Any) -> Callable[[Data], Data]:
    return lambda data: {**data, **values}


def _without(*keys: str) -> Callable[[Data], Data]:
    return lambda data: {key: value for key, value in data.items() if key not in keys}


def _each(change: Callable[[Data, int], Data]) -> Callable[[Data], Data]:
    return lambda data: {**data, "frames": [change(f, k) for k, f in enumerate(data["frames"])]}


def _frame(**values: Any) -> Callable[[Data], Data]:
    """Frame 1 with other values."""
    return _each(lambda frame, k: {**frame, **values} if k == 1 else frame)


def _pose(change: Callable[[npt.NDArray[np.float64]], Any]) -> Callable[[Data], Data]:
    return _each(
        lambda frame, k: {
            **frame,
            "transform_matrix": np.asarray(change(np.array(frame["transform_matrix"]))).tolist(),
        }
    )


def _chain(*changes: Callable[[Data], Data]) -> Callable[[Data], Data]:
    def change(data: Data) -> Data:
        for each in changes:
            data = each(data)
        return data

    return change


NAMES = [f"images/{k}.png" for k in range(FRAMES)]
_NO_FOCAL = _without("fl_x", "fl_y", "cx", "cy")

VARIANTS: dict[str, Callable[[Data], Data]] = {
    "plain": _top(),
    "no camera_model": _without("camera_model"),
    "PINHOLE": _top(camera_model="PINHOLE"),
    "unknown camera_model": _top(camera_model="MIRROR"),
    "no size": _without("w", "h"),
    "no principal point": _without("cx", "cy"),
    "no fl_y": _without("fl_y"),
    "no focal length": _without("fl_x", "fl_y"),
    "camera_angle_x alone": _chain(_NO_FOCAL, _top(camera_angle_x=1.0)),
    "both angles": _chain(_NO_FOCAL, _top(camera_angle_x=1.0, camera_angle_y=0.8)),
    "angle beside fl_x": _top(camera_angle_x=2.0),
    "keys in another order": lambda data: dict(reversed(data.items())),
    "frames in another order": lambda data: {**data, "frames": data["frames"][::-1]},
    "intrinsics in the frames": _chain(
        _without("fl_x", "fl_y", "cx", "cy", "w", "h"),
        _each(lambda f, k: {**f, "w": 40, "h": 30, "fl_x": 30.0 + k, "fl_y": 31.0 + k,
                            "cx": 20.0, "cy": 14.0 + k}),
    ),
    "one frame's own intrinsics": _frame(fl_x=50.0, fl_y=51.0, cx=18.0, cy=12.0),
    "one frame's own angle": _frame(camera_angle_x=1.2),
    "one frame's own lens": _frame(k1=0.1, k2=0.0),
    "zero distortion": _top(k1=0.0, k2=0.0, p1=0.0, p2=0.0),
    "k1 k2 p1 p2": _top(k1=0.05, k2=-0.01, p1=0.002, p2=-0.003),
    "k3": _top(k1=0.05, k2=-0.01, k3=0.004, p1=0.0, p2=0.0),
    "k4 of OPENCV": _top(k1=0.05, k4=0.01),
    "FULL_OPENCV": _top(camera_model="FULL_OPENCV", k1=0.05, k2=0.01, p1=0.001, p2=0.002,
                        k3=0.003, k4=0.02, k5=0.01, k6=0.001),
    "distortion_params": _top(distortion_params=[0.05, -0.01, 0.002, 0.0, 0.001, -0.002]),
    "distortion_params in the frames": _each(
        lambda f, k: {**f, "distortion_params": [0.05, 0, 0, 0, 0.001, 0.0]}),
    "distortion_params of five": _top(distortion_params=[0.05, 0, 0, 0, 0]),
    "distortion_params of zeros": _top(distortion_params=[0, 0, 0, 0, 0, 0]),
    "OPENCV_FISHEYE": _top(camera_model="OPENCV_FISHEYE", k1=0.05, k2=-0.01, k3=0.002, k4=0.001),
    "OPENCV_FISHEYE of zeros": _top(camera_model="OPENCV_FISHEYE", k1=0, k2=0, k3=0, k4=0),
    "is_fisheye": _top(is_fisheye=True, k1=0.05),
    "applied_transform": _top(applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]),
    "applied_scale": _top(applied_scale=0.5),
    "instant-ngp's hints": _top(aabb_scale=16, scale=0.33, offset=[0.5, 0.5, 0.5]),
    "paths with ./": _each(lambda f, k: {**f, "file_path": f"./{f['file_path']}"}),
    "paths without suffix": _each(lambda f, k: {**f, "file_path": f"images/{k}"}),
    "paths with ../": _each(lambda f, k: {**f, "file_path": f"images/../images/{k}.png"}),
    "a missing image": _frame(file_path="images/none.png"),
    "a frame twice": lambda data: {**data, "frames": [*data["frames"], data["frames"][0]]},
    "splits": _top(train_filenames=NAMES[:2], val_filenames=NAMES[2:3], test_filenames=NAMES[3:]),
    "splits with ./": _top(train_filenames=[f"./{n}" for n in NAMES[:3]],
                           test_filenames=NAMES[3:]),
    "splits without suffix": _top(train_filenames=["images/0", "images/1", "images/2"],
                                  test_filenames=["images/3"]),
    "a split of no frame": _top(train_filenames=["images/9.png"]),
    "a split of some": _top(train_filenames=NAMES[:2]),
    "mask_path": _frame(mask_path="images/0.png"),
    "mask_path empty": _frame(mask_path=""),
    "depth_file_path": _frame(depth_file_path="images/0.png"),
    "skew": _top(skew=0.5),
    "rolling shutter": _top(rolling_shutter=[0, 0.1, 0, 0]),
    "unknown key": _top(camera_maker="a word"),
    "3 x 4 matrices": _pose(lambda m: m[:3]),
    "transposed matrices": _pose(lambda m: m.T),
    "six digits": _pose(lambda m: np.round(m, 6)),
    "float32": _pose(lambda m: m.astype(np.float32).astype(float)),
    "scaled rotations": _pose(lambda m: m * [[2, 2, 2, 1]] * 1.0),
    "mirrored": _pose(lambda m: m * [[-1, 1, 1, 1]]),
    "far from the origin": _pose(lambda m: m + np.pad([[1e5]], ((0, 3), (3, 0)))),
    "matrix of words": _frame(transform_matrix=[["1", "0", "0", "0"]] * 4),
    "nan in a matrix": _frame(transform_matrix=[[math.nan] * 4] * 4),
    "no matrix": _frame(transform_matrix=None),
    "size of another picture": _top(w=80, h=60),
    "size as a decimal": _top(w=40.0, h=30.0),
    "focal length as a word": _top(fl_x="35"),
    "focal length negative": _top(fl_x=-35.0),
    "no frames": _top(frames=[]),
    "no file_path": _each(lambda f, k: {"transform_matrix": f["transform_matrix"]}),
    "missing points": _top(ply_file_path="none.ply"),
}  # fmt: skip
"""Changes to a plain file, by name."""


def write(folder: Path, name: str, seed: int) -> Path:
    """One variant with its images in a folder of its own."""
    rng = np.random.default_rng(seed)
    place = folder / "".join(c if c.isalnum() else "-" for c in name)
    (place / "images").mkdir(parents=True)
    for k in range(FRAMES):
        pixels = rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
        Image.fromarray(pixels).save(place / "images" / f"{k}.png")
    file = place / "transforms.json"
    file.write_text(json.dumps(VARIANTS[name](copy.deepcopy(base(rng)))))
    return file
