"""Structure from motion at known cameras: a separate program, ``python -m attnwarp_eval.sfm TASK
FOLDER [MODEL]``, since pycolmap corrupts memory in one process with other packages
(:mod:`attnwarp.sfm`, which starts it).

- ``reconstruct`` finds poses and points, and writes their figures to ``result.json``.
- ``triangulate`` finds points for the poses of ``poses.json``, and writes ``tracks.npz``.
- ``read`` writes ``tracks.npz`` from a sparse model.
"""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import attnwarp.sfm
from attnwarp.camera import Camera
from attnwarp.sfm import summary

SEED = 0
"""Seed of RANSAC; with one thread the same pictures give the same reconstruction."""

run = functools.partial(attnwarp.sfm.run, program="attnwarp_eval.sfm")
"""Run a task of this program; see :func:`attnwarp.sfm.run`."""


def write_pictures(
    folder: Path, images: Sequence[npt.NDArray[np.uint8]], cameras: Sequence[Camera]
) -> list[str]:
    """Write the input files of :func:`match`, and return the pictures' names in them."""
    names = [f"{i:05d}" for i in range(len(images))]
    alike: dict[tuple[float, ...], list[str]] = {}
    for name, camera in zip(names, cameras, strict=True):
        K = camera.K
        key = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height)
        alike.setdefault(tuple(map(float, key)), []).append(name)
    shown: dict[str, Any] = dict(zip(names, images, strict=True))
    np.savez(folder / "pictures.npz", **shown)
    (folder / "cameras.json").write_text(
        json.dumps([[key[:4], names] for key, names in alike.items()])
    )
    return names


def match(folder: Path) -> Any:
    """The database of the pictures of ``folder``: features, and matches of every pair.

    ``pictures.npz`` has (H, W, 3) uint8 arrays; ``cameras.json`` has for each intrinsics the names
    of the arrays that share them: [[fx, fy, cx, cy], names].
    """
    import pycolmap

    images, database = folder / "images", folder / "database.db"
    images.mkdir()
    with np.load(folder / "pictures.npz") as pictures:
        for name in pictures.files:
            pycolmap.Bitmap.from_array(pictures[name]).write(images / f"{name}.png")
    extraction = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    for intrinsics, names in json.loads((folder / "cameras.json").read_text()):
        pycolmap.extract_features(
            database,
            images,
            image_names=[f"{name}.png" for name in names],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(
                camera_model="PINHOLE", camera_params=",".join(map(str, intrinsics))
            ),
            extraction_options=extraction,
        )
    pycolmap.match_exhaustive(
        database, matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=1)
    )
    return database


def options() -> Any:
    """Mapping options that keep the cameras fixed."""
    import pycolmap

    return pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=SEED, ba_refine_focal_length=False, ba_refine_extra_params=False
    )


def reconstruct(folder: Path) -> None:
    """Write the figures of the largest model reconstructed from the pictures of ``folder``."""
    import pycolmap

    found = pycolmap.incremental_mapping(
        match(folder), folder / "images", folder / "models", options()
    )
    largest = max(found.values(), key=lambda one: one.num_reg_images(), default=None)
    (folder / "result.json").write_text(json.dumps(None if largest is None else summary(largest)))


def triangulate(folder: Path) -> None:
    """Write the tracks of the pictures of ``folder`` at the (3, 4) world-to-camera matrices of
    ``poses.json``, by name.
    """
    import pycolmap

    database = match(folder)
    posed = pycolmap.Reconstruction()
    poses = json.loads((folder / "poses.json").read_text())
    with pycolmap.Database.open(database) as known:
        for camera in known.read_all_cameras():
            posed.add_camera_with_trivial_rig(camera)
        for image in known.read_all_images():
            pose = pycolmap.Rigid3d(np.array(poses[Path(image.name).stem]))
            posed.add_image_with_trivial_frame(
                pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id),
                pose,
            )
    (folder / "model").mkdir()
    write_tracks(
        pycolmap.triangulate_points(
            posed, database, folder / "images", folder / "model", options=options()
        ),
        folder,
    )


def read(folder: Path, model: Path) -> None:
    """Write the tracks of a sparse model."""
    import pycolmap

    write_tracks(pycolmap.Reconstruction(model), folder)


def write_tracks(reconstruction: Any, folder: Path) -> None:
    """Write ``tracks.npz``: image names; of each observation the image, the point, and its place
    (x, y) at z = 1 in the camera's axes, the lens undone.
    """
    names: list[str] = []
    image: list[int] = []
    point: list[int] = []
    xy = []
    for one in reconstruction.images.values():
        seen = [each for each in one.points2D if each.has_point3D()]
        if seen:
            image += [len(names)] * len(seen)
            point += [each.point3D_id for each in seen]
            xy.append(
                reconstruction.cameras[one.camera_id].cam_from_img(
                    np.array([each.xy for each in seen])
                )
            )
        names.append(one.name)
    places = np.concatenate(xy) if xy else np.zeros((0, 2))
    np.savez(folder / "tracks.npz", names=names, image=image, point=point, xy=places)


if __name__ == "__main__":
    TASKS: dict[str, Callable[..., None]] = {
        "reconstruct": reconstruct,
        "triangulate": triangulate,
        "read": read,
    }
    TASKS[sys.argv[1]](*map(Path, sys.argv[2:]))
