"""Masks of views by words. Each is kept as soon as it is made, since one may take a network many
seconds.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.camera import Camera
from attnwarp.digest import digest
from attnwarp.editing.segment import (
    Mask,
    NoDetectionError,
    Segmenter,
    segmenter_digest,
    segments_of,
)
from attnwarp.errors import InputError
from attnwarp.io.file import FileFormatError
from attnwarp.io.lock import alone_in
from attnwarp.io.names import file_stems
from attnwarp.methods.pictures import mask_picture
from attnwarp.methods.scene import to_float
from attnwarp.reporting import Reporter
from attnwarp.workdir import Workdir, record_of

WORDS_FOLDER = "words"


def masks_by_words(
    segmenter: Segmenter,
    words: str,
    cameras: Sequence[Camera],
    images: Sequence[npt.NDArray[Any]],
    folder: Path,
    report: Reporter,
) -> tuple[list[Mask], int]:
    """The mask of each view, made or read back.

    They are in a folder of their own for these words and this segmenter, so that others write over
    none of them. NAME.json beside NAME.png says of which picture a mask is. One of another picture,
    or whose file is damaged, is made anew.

    Args:
        segmenter: see :class:`attnwarp.editing.segment.Segmenter`.
        words: of what is edited.
        cameras: of the views, whose names the files have.
        images: (H, W, 3) of each view, as :class:`attnwarp.methods.scene.Scene` holds them.
        folder: of the masks: :func:`words_folder`.
        report: receives how it stands after each view.

    Returns:
        (H, W) bool of each view, empty where it shows nothing that the words name, and how many
        were read back.

    Raises:
        NoDetectionError: no view shows anything that the words name.
        InputError: a mask was painted over, a picture is there that no such run wrote, or another
            run writes to the folder.

    Example:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.editing.segment import load_segmenter
        >>> from attnwarp.methods.words import masks_by_words, words_folder
        >>> from attnwarp.reporting import SILENT
        >>> camera = Camera(np.eye(3), np.eye(4), 64, 64, "a.png")
        >>> red = np.full((64, 64, 3), 0.2, np.float32)
        >>> red[16:48, 16:48] = (0.8, 0.1, 0.1)
        >>> segmenter = load_segmenter("clip-parts")
        >>> folder = words_folder(Path("edit"), segmenter, "red")
        >>> folder.name.rpartition("-")[0]
        'red'
        >>> (mask,), kept = masks_by_words(segmenter, "red", [camera], [red], folder, SILENT)
        >>> bool(mask[32, 32]), kept
        (True, 0)
    """
    segment = segments_of(segmenter, words, [camera.name for camera in cameras])
    masks, kept = [], 0
    with alone_in(folder):
        files = Workdir(folder, "masks by words")
        for k, (name, image) in enumerate(zip(file_stems(cameras), images, strict=True)):
            picture, of = f"{name}.png", digest(image)
            mask = _kept(files, picture, of)
            kept += mask is not None
            if mask is None:
                try:
                    mask = segment(k, to_float(image))
                except NoDetectionError:  # seen from elsewhere, the thing may be out of the picture
                    mask = np.zeros(image.shape[:2], np.bool_)
                # The record first: a picture without one is taken for somebody's own.
                files.write_json(record_of(picture), {"of": of, "sha256": digest(mask)})
                files.write_picture(picture, mask_picture(torch.from_numpy(mask)))
            masks.append(mask)
            report.step(k + 1, len(images), f"mask of {name}")
    if not any(mask.any() for mask in masks):
        first = cameras[0].name
        raise NoDetectionError(words, f"{first} or any other" if len(masks) > 1 else first)
    return masks, kept


def words_folder(out: Path, segmenter: Segmenter, words: str) -> Path:
    """Folder in which an edit keeps masks by these words and this segmenter."""
    plain = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")[:24] or "masks"
    return out / WORDS_FOLDER / f"{plain}-{digest([words, segmenter_digest(segmenter)])[:8]}"


def _kept(files: Workdir, picture: str, of: str) -> Mask | None:
    """The mask of a view that is there already; None where it has to be made."""
    path, record = files.path / picture, record_of(picture)
    if not files.has(record):
        if files.has(picture):
            raise InputError(
                f"{path}: is there without {record}, and a mask would replace it; remove it"
            )
        return None
    try:
        said = files.read_json(record)
        mask = np.asarray(files.read_picture(picture)[..., 0] > 127)
    except (FileFormatError, FileNotFoundError):
        return None
    if said.get("of") != of:
        return None
    if said.get("sha256") != digest(mask):
        raise InputError(
            f"{path}: is not the mask that was made; if it was painted over, give the masks with"
            " --masks; remove it to have it made anew"
        )
    return mask
