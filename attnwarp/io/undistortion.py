"""Undistortion of pictures: resample them to pinhole cameras and write them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError
from attnwarp.io.dataset import Dataset
from attnwarp.io.file import is_file, write_atomically
from attnwarp.io.images import encode_png, read_image, read_mask
from attnwarp.io.lens import undistorted_camera, undistorted_image
from attnwarp.io.names import numbered
from attnwarp.io.transforms import write_transforms
from attnwarp.reporting import SILENT, Reporter


def undistort(
    dataset: Dataset,
    folder: str | os.PathLike[str],
    *,
    report: Reporter = SILENT,
) -> Dataset:
    """Write undistorted pictures, and a transforms.json for them.

    Focal lengths, poses, points and splits are unchanged. A new picture is the largest window of
    pixels without a blank one; pictures of pinhole cameras are copied pixel by pixel.

    Args:
        dataset: dataset read with ``distorted="keep"``; cameras without a picture are left out.
        folder: target of transforms.json, images/NAME.png and masks/NAME.png, numbered for equal
            names; created if missing.
        report: receiver of progress, picture by picture.

    Returns:
        Written dataset.

    Raises:
        FileFormatError: a picture is unreadable.
        InputError: a result would overwrite a transforms.json or an input picture.
        ValueError: no camera has a picture, or a lens folds its picture over.

    Example:
        >>> from pathlib import Path
        >>> from PIL import Image
        >>> from attnwarp import Camera
        >>> from attnwarp.io import Dataset, Lens, undistort
        >>> camera = Camera.look_at((3, 0, 0), (0, 0, 0), width=40, height=30, fov_y=60, name="a")
        >>> Image.new("RGB", (40, 30)).save("a.png")
        >>> bent = Dataset([camera], [Path("a.png")], lenses=[Lens("brown", (-0.1,))])
        >>> flat = undistort(bent, "flat")
        >>> flat.cameras[0].width, flat.lenses
        (42, [None])
    """
    folder = Path(folder)
    dataset = dataset.with_pictures()
    if not len(dataset):
        raise ValueError(
            "dataset: none of its cameras has an image that is there; put the images where the data"
            " set names them"
        )
    # Checked before the first picture, so that a lens without an inverse costs no work.
    cameras = [
        camera if lens is None else undistorted_camera(camera, lens)
        for camera, lens in zip(dataset.cameras, dataset.lenses, strict=True)
    ]
    names = numbered([_name(camera.name, i) for i, camera in enumerate(dataset.cameras)])
    paths: list[Path | None] = [folder / "images" / name for name in names]
    _check_apart(folder, paths, dataset.image_paths)
    masks: list[Path | None] = [None] * len(cameras)
    for i, (camera, lens, target, source, path) in enumerate(
        zip(dataset.cameras, dataset.lenses, cameras, dataset.image_paths, paths, strict=True)
    ):
        assert source is not None and path is not None
        image = read_image(source)
        if lens is not None:
            image = undistorted_image(image, camera, lens, target)
        _write(path, image)
        mask = dataset.mask_paths[i]
        if mask is not None:
            kept = read_mask(mask, camera.height, camera.width)
            flat = np.repeat(kept[..., None], 3, axis=2).astype(np.uint8) * 255
            if lens is not None:
                flat = undistorted_image(flat, camera, lens, target)
            _write(folder / "masks" / names[i], np.where(flat == 255, flat, 0))
            masks[i] = folder / "masks" / names[i]
        report.step(i + 1, len(cameras), names[i])
    result = replace(
        dataset, cameras=cameras, image_paths=paths, mask_paths=masks,
        lenses=[None] * len(cameras),
    )  # fmt: skip
    write_transforms(folder, result)
    return result


def _write(path: Path, image: npt.NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    data = encode_png(image)
    write_atomically(path, lambda stream: stream.write(data))


def _check_apart(folder: Path, written: list[Path | None], read: list[Path | None]) -> None:
    """Refuse to overwrite a transforms.json or any input picture, also another camera's."""
    scene = folder / "transforms.json"
    if is_file(scene):
        raise InputError(
            f"{scene}: is there; name another folder for the result, or remove it if it is an"
            " earlier result"
        )
    # Compared by device and inode, so other names and links are recognised.
    files = [path.stat() for path in read if path is not None and is_file(path)]
    sources = {(file.st_dev, file.st_ino) for file in files}
    for path in written:
        if path is None or not is_file(path):
            continue
        file = path.stat()
        if (file.st_dev, file.st_ino) in sources:
            raise InputError(
                f"{path}: is a picture to undistort; name another folder for the result"
            )


def _name(name: str, index: int) -> str:
    """Build a path below the folder for a camera's picture, for any camera name."""
    parts = [part for part in PurePosixPath(name).parts if part not in ("/", "..", ".", "images")]
    if not parts:
        return f"{index:06d}.png"
    return str(PurePosixPath(*parts).with_suffix(".png"))
