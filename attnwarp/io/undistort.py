"""Pictures with lens distortion, written anew as pinhole cameras see them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from attnwarp.camera import Camera
from attnwarp.errors import InputError
from attnwarp.io.dataset import Dataset
from attnwarp.io.file import is_file, write_atomically
from attnwarp.io.images import encode_png, read_image
from attnwarp.io.lens import undistorted_camera, undistorted_image
from attnwarp.io.names import numbered
from attnwarp.io.transforms import read_transforms, write_transforms
from attnwarp.reporting import SILENT, Reporter


def undistort(
    dataset: Dataset,
    folder: str | os.PathLike[str],
    *,
    report: Reporter = SILENT,
) -> Dataset:
    """Write undistorted pictures, and a transforms.json for them.

    Focal lengths, poses, points and splits stay. Each new picture is the largest window of whole
    pixels without a blank one; pictures of pinhole cameras are copied pixel by pixel.

    Args:
        dataset: read with ``distorted="keep"``; cameras without a picture are left out.
        folder: receives transforms.json and images/NAME.png, numbered where names are the same;
            made if need be.
        report: receives each picture that is done.

    Returns:
        The data set that was written.

    Raises:
        FileFormatError: a picture that cannot be read.
        InputError: a picture would be written over one that is read, or transforms.json over one
            of a folder that holds a picture that is read.
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
    dataset = dataset.select([i for i, path in enumerate(dataset.image_paths) if path is not None])
    if not len(dataset):
        raise ValueError(
            "dataset: none of its cameras has an image that is there; put the images where the data"
            " set names them"
        )
    # Before the first picture is written: a lens that cannot be undone costs no work.
    cameras = [
        camera if lens is None else undistorted_camera(camera, lens)
        for camera, lens in zip(dataset.cameras, dataset.lenses, strict=True)
    ]
    names = numbered([_name(camera.name, i) for i, camera in enumerate(dataset.cameras)])
    paths: list[Path | None] = [folder / "images" / name for name in names]
    _check_apart(folder, paths, dataset.image_paths)
    _check_own(folder, cameras, names)
    for i, (camera, lens, target, source, path) in enumerate(
        zip(dataset.cameras, dataset.lenses, cameras, dataset.image_paths, paths, strict=True)
    ):
        assert source is not None and path is not None
        image = read_image(source)
        if lens is not None:
            image = undistorted_image(image, camera, lens, target)
        path.parent.mkdir(parents=True, exist_ok=True)
        data = encode_png(image)
        write_atomically(path, lambda stream, data=data: stream.write(data))  # type: ignore[misc]
        report.step(i + 1, len(cameras), names[i])
    result = replace(dataset, cameras=cameras, image_paths=paths, lenses=[None] * len(cameras))
    write_transforms(folder, result)
    return result


def _check_apart(folder: Path, written: list[Path | None], read: list[Path | None]) -> None:
    """Refuse to write over any picture that is read, that of another camera too, or over the
    transforms.json of the folder that they come from.
    """
    scene, place = folder / "transforms.json", folder.resolve()
    if is_file(scene) and any(path and path.resolve().is_relative_to(place) for path in read):
        raise InputError(
            f"{scene}: stands in the folder of the pictures to undistort; name another folder for"
            " the result, or remove it if it is an earlier result"
        )
    # By what the system calls a file, so under another name or by a link as well.
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


def _check_own(folder: Path, cameras: list[Camera], names: list[str]) -> None:
    """Refuse to write over a transforms.json that is no earlier result of the same cameras."""
    path = folder / "transforms.json"
    if not is_file(path):
        return
    try:
        there = read_transforms(path, missing_images="none", points=False)
        same = len(there.cameras) == len(cameras) and all(
            (image is None or image.resolve() == (folder / "images" / name).resolve())
            and np.allclose(old.world_to_camera, new.world_to_camera)
            for old, image, new, name in zip(
                there.cameras, there.image_paths, cameras, names, strict=True
            )
        )
    except (InputError, OSError, ValueError):
        same = False
    if not same:
        raise InputError(
            f"{path}: is of other pictures than these; name another folder for the result, or"
            " remove it if it is an earlier result"
        )


def _name(name: str, index: int) -> str:
    """A path below the folder for the picture of a camera, whatever the camera's name is."""
    parts = [part for part in PurePosixPath(name).parts if part not in ("/", "..", ".", "images")]
    if not parts:
        return f"{index:06d}.png"
    return str(PurePosixPath(*parts).with_suffix(".png"))
