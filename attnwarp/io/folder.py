"""Common reader for folders of posed images of any format."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from attnwarp import check
from attnwarp.io.blendedmvs import is_blendedmvs, read_blendedmvs
from attnwarp.io.colmap import find_model, read_colmap
from attnwarp.io.dataset import Dataset, Distorted, Missing
from attnwarp.io.file import FileFormatError
from attnwarp.io.transforms import SPLITS, read_transforms

Format = Literal["transforms", "colmap", "blendedmvs"]

SCALES = (1, 2, 4, 8)
"""Scales of image folders in nerfstudio and Mip-NeRF 360: images, images_2 and so on."""


def read_dataset(
    path: str | os.PathLike[str],
    *,
    format: Format | None = None,
    images: str | os.PathLike[str] | None = None,
    missing_images: Missing = "error",
    resize_cameras: bool = False,
    points: bool = True,
    distorted: Distorted = "error",
    ignore_keys: Sequence[str] = (),
    scale: int = 1,
) -> Dataset:
    """Read a transforms.json, a COLMAP model or a scene of BlendedMVS.

    - A file is a transforms.json, and so is a folder with transforms.json, transforms_train.json or
      another split.
    - A folder with a sparse model is COLMAP's: ``cameras.bin`` or ``.txt`` in it, in ``sparse/0``
      or in ``sparse``.
    - A folder of both kinds needs ``format``. A model under ``colmap/`` does not count: nerfstudio
      derived the transforms.json from it.
    - A folder with ``cams`` and ``blended_images`` is a scene of BlendedMVS.

    Args:
        path: file or folder of the dataset.
        format: "transforms", "colmap" or "blendedmvs", for a folder of several kinds.
        images: folder of the images of a COLMAP model; see :func:`read_colmap`.
        missing_images: "error", or "none" to set the path of a missing image to None.
        resize_cameras: True resizes a camera whose image has another size; False refuses
            it.
        points: False skips the points; their file is then not read, and may be missing or
            damaged.
        distorted: "error" to refuse lens distortion, or "keep" to return it in
            ``Dataset.lenses`` for :func:`undistort`.
        ignore_keys: keys of a transforms.json to ignore although they change a picture's content,
            such as "white_transparent", or "mask_path" to use whole pictures.
        scale: one of 1, 2, 4 and 8; 4 reads images from ``images_4`` instead of ``images`` and
            resizes the cameras to them.

    Raises:
        FileNotFoundError: no readable dataset was found.
        FileFormatError: both kinds exist, or the dataset is damaged or unusable.

    Example:
        >>> from attnwarp import Camera
        >>> from attnwarp.io import Dataset, read_dataset, write_transforms
        >>> camera = Camera.look_at((3, 0, 0), (0, 0, 0), width=8, height=6, fov_y=40, name="a")
        >>> write_transforms(".", Dataset([camera], [None]))
        >>> read_dataset(".", missing_images="none").cameras[0].position.round(9).tolist()
        [3.0, 0.0, 0.0]
    """
    path = Path(path)
    if format is not None:
        check.one_of(format, ("transforms", "colmap", "blendedmvs"), "format")
    if scale not in SCALES:
        raise ValueError(
            f"scale (--scale): got {scale!r}, expected one of {', '.join(map(str, SCALES))}"
        )
    if scale > 1 and images is not None:
        raise ValueError("scale: given with images (--images); name the folder or the scale")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if format is None:
        names = ["transforms.json", *(f"transforms_{split}.json" for split in SPLITS)]
        transforms = path.is_file() or any((path / name).is_file() for name in names)
        model = None if path.is_file() else find_model(path)
        if transforms and model is not None and model.relative_to(path).parts[:1] != ("colmap",):
            raise FileFormatError(
                path,
                f"holds both a transforms.json and a COLMAP model ({model}); pass"
                " format='transforms' or 'colmap' (--format)",
            )
        if transforms or model is not None:
            format = "transforms" if transforms else "colmap"
        elif is_blendedmvs(path):
            format = "blendedmvs"
        else:
            raise FileNotFoundError(
                f"{path}: neither a transforms.json nor a COLMAP model (cameras.bin or cameras.txt,"
                " here, in sparse/0 or in sparse) is there; photographs get poses first, by"
                " attnwarp poses"
            )
    if format == "blendedmvs":
        if scale > 1 or images is not None:
            raise ValueError(
                "scale, images: a scene of BlendedMVS has one folder of images; leave them out"
            )
        return read_blendedmvs(path, missing_images=missing_images)
    shared: dict[str, Any] = {
        "missing_images": missing_images,
        "resize_cameras": resize_cameras,
        "points": points,
        "distorted": distorted,
        "scale": scale,
    }
    if format == "colmap":
        return read_colmap(path, images=images, **shared)
    if images is not None:
        raise ValueError(
            "images (--images): only COLMAP models take a folder of images; a transforms.json names"
            " its own"
        )
    return read_transforms(path, ignore_keys=ignore_keys, **shared)
