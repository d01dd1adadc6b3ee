"""COLMAP's camera models: files that pycolmap writes, against pycolmap's own projection."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.io import Dataset, read_colmap
from scripts.survey.outcome import Outcome, Row, attempt, refusal

PART = "COLMAP"
SIZE = (64, 48)
TOLERANCE = 1e-9
"""Pixels: both compute in float64, and text files hold 17 digits."""


def model_names() -> list[str]:
    """Every camera model of the pycolmap that is installed."""
    import pycolmap

    return [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]


def write(folder: Path, model: str, seed: int, *, zero: bool, text: bool) -> Any:
    """A reconstruction of two images, written by pycolmap; returns it.

    Args:
        folder: to be made.
        model: name of the camera model.
        seed: of the poses and coefficients.
        zero: whether every coefficient keeps the value that pycolmap begins with.
        text: text files instead of binary ones.
    """
    import pycolmap

    rng = np.random.default_rng(seed)
    camera = pycolmap.Camera.create_from_model_name(1, model, 50.0, *SIZE)
    params = np.array(camera.params, dtype=np.float64)
    center = list(camera.principal_point_idxs())
    params[center] += rng.uniform(-2, 2, len(center))
    focal = list(camera.focal_length_idxs())
    params[focal] *= rng.uniform(0.9, 1.1, len(focal))
    if not zero:
        extra = list(camera.extra_params_idxs())
        params[extra] += rng.uniform(0.002, 0.03, len(extra)) * rng.choice([-1, 1], len(extra))
    camera.params = params.tolist()
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera)
    for k in (1, 2):
        quaternion = rng.normal(size=4) * [0.1, 0.1, 0.1, 1]
        pose = pycolmap.Rigid3d(
            pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)),
            np.array([*rng.uniform(-0.2, 0.2, 2), 4.0]),
        )
        image = pycolmap.Image(image_id=k, camera_id=1, name=f"{k}.png")
        reconstruction.add_image_with_trivial_frame(image, pose)
    folder.mkdir(parents=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(str(folder))
    return reconstruction


def compare(folder: Path, model: str, seed: int, *, zero: bool, text: bool) -> Row:
    """The row of one file; lenses are compared as they come for undistortion."""
    name = f"{model}{', no distortion' if zero else ''}, {'text' if text else 'binary'}"
    reconstruction = write(folder, model, seed, zero=zero, text=text)
    ours = attempt(lambda: read_colmap(folder, missing_images="none", distorted="keep"))
    if ours.error is not None:
        return refusal(PART, name, ours.error, folder, both=False)
    data = ours.result
    assert isinstance(data, Dataset)
    points = np.random.default_rng(seed).uniform(-0.8, 0.8, (20, 3))
    for k, (camera, lens) in enumerate(zip(data.cameras, data.lenses, strict=True), 1):
        local = points @ camera.rotation.T + camera.translation
        flat = local[:, :2] / local[:, 2:]
        seen: npt.NDArray[np.float64] = flat if lens is None else lens.distort(flat)
        pixels = (np.column_stack([seen, np.ones(len(seen))]) @ camera.K.T)[:, :2]
        image = reconstruction.image(k)
        theirs = np.array([image.project_point(point) for point in points], dtype=np.float64)
        gap = np.abs(pixels - theirs).max()
        if not gap <= TOLERANCE:
            outcome = Outcome.NOTICE if ours.notices else Outcome.SILENT
            return Row(PART, name, outcome, f"pixels {gap:.3g} apart")
        away = np.abs(camera.position - image.projection_center()).max()
        if camera.name != image.name or not away <= TOLERANCE:
            return Row(PART, name, Outcome.SILENT, f"image {k}: another name or centre")
        plain = attempt(lambda: read_colmap(folder, missing_images="none"))
        if lens is not None and plain.error is None:
            return Row(PART, name, Outcome.SILENT, "a lens is read as a pinhole")
    return Row(PART, name, Outcome.SAME)


def rows(folder: Path, models: list[str], seed: int) -> Iterator[Row]:
    """Every model, with and without distortion, in text and in binary."""
    for model in models:
        for zero in (True, False):
            for text in (True, False):
                place = folder / f"{model}-{zero:d}-{text:d}"
                yield compare(place, model, seed, zero=zero, text=text)
