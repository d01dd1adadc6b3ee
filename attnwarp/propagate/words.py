"""Masks of views by words. Each is kept as soon as it is made, since one may take a network many
seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.camera import Camera
from attnwarp.digest import digest
from attnwarp.editing.segment import Mask, Segmenter, segmenter_digest, segments_of
from attnwarp.errors import InputError
from attnwarp.io.file import FileFormatError
from attnwarp.propagate.folder import Folder, record_of
from attnwarp.propagate.pictures import mask_picture
from attnwarp.propagate.progress import Step
from attnwarp.propagate.scene import to_float

WORDS_FOLDER = "words"


def masks_by_words(
    segmenter: Segmenter,
    words: str,
    cameras: Sequence[Camera],
    images: Sequence[npt.NDArray[Any]],
    folder: Path,
    watch: Callable[[Step], object],
) -> tuple[list[Mask], int]:
    """The mask of each view, made or read back.

    ``folder/words/NAME.png`` is the mask of a view, and NAME.json beside it says of which words,
    segmenter and picture. Another segmenter's, another picture's or a damaged one is made anew.

    Args:
        segmenter: see :class:`attnwarp.editing.segment.Segmenter`.
        words: of what is edited.
        cameras: of the views, whose names the files have.
        images: (H, W, 3) of each view, as :class:`attnwarp.propagate.scene.Scene` holds them.
        folder: of the edit.
        watch: told how it stands after each view.

    Returns:
        (H, W) bool of each view, and how many were read back.

    Raises:
        NoDetectionError: a view shows nothing that the words name. Masks of the views before it
            are kept.
        InputError: a picture is there that no such run wrote.

    Example:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.editing.segment import load_segmenter
        >>> from attnwarp.propagate.words import masks_by_words
        >>> camera = Camera(np.eye(3), np.eye(4), 64, 64, "a.png")
        >>> red = np.full((64, 64, 3), 0.2, np.float32)
        >>> red[16:48, 16:48] = (0.8, 0.1, 0.1)
        >>> arguments = load_segmenter("clip-parts"), "red", [camera], [red], Path("edit")
        >>> (mask,), kept = masks_by_words(*arguments, print)
        Step(done=1, total=1, text='mask of a')
        >>> bool(mask[32, 32]), kept, masks_by_words(*arguments, lambda step: None)[1]
        (True, 0, 1)
    """
    files = Folder(folder, cameras)
    (folder / WORDS_FOLDER).mkdir(parents=True, exist_ok=True)
    whose = segmenter_digest(segmenter)
    segment = segments_of(segmenter, words, [camera.name for camera in cameras])
    masks, kept = [], 0
    for k, (name, image) in enumerate(zip(files.names, images, strict=True)):
        picture, of = f"{WORDS_FOLDER}/{name}.png", digest([words, whose], image)
        mask = _kept(files, picture, of)
        kept += mask is not None
        if mask is None:
            mask = segment(k, to_float(image))
            # The record first: a picture without one is taken for somebody's own.
            files.write_json(record_of(picture), {"of": of, "sha256": digest(mask)})
            files.write_picture(picture, mask_picture(torch.from_numpy(mask)))
        masks.append(mask)
        watch(Step(k + 1, len(images), f"mask of {name}"))
    return masks, kept


def _kept(files: Folder, picture: str, of: str) -> Mask | None:
    """The mask of a view that is there already; None where it has to be made."""
    if not files.has(record_of(picture)):
        if files.has(picture):
            raise InputError(
                f"{files.path / picture}: is there without {record_of(picture)}, and the mask of a"
                " view would replace it; name another folder, or remove it"
            )
        return None
    try:
        record = files.read_json(record_of(picture))
        mask = np.asarray(files.read_picture(picture)[..., 0] > 127)
    except (FileFormatError, FileNotFoundError):
        return None
    return mask if (record.get("of"), record.get("sha256")) == (of, digest(mask)) else None
