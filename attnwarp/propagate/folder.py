"""The folder of an edit: every file whole or absent, and a manifest that says whose they are.

manifest.json            settings, plan, hashes of the inputs
source.png  source.json  the source's edit; features.png: its recorded features as colours
views/NAME.png  .json    each edited view, and what its edit was
segments/                what is edited of each view, where segments are given
words/                   masks by words as they are made (attnwarp edit)
masks/  features/        where features were injected, and the warped features as colours
stages/1.ply  1.pt       the splats after each stage, and the state of their optimiser
renders/before/  after/  the scene from every view
edited.ply  result.json  the edited splats; Edit PSNR and counters
edited-3dgs.ply          2D splats as thin 3D ones, for other viewers (attnwarp edit)
times.json               seconds by part, over all sittings
"""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.digest import digest
from attnwarp.errors import InputError, InputWarning
from attnwarp.io.file import FileFormatError, write_atomically
from attnwarp.io.images import encode_png, read_image
from attnwarp.io.lock import alone_in
from attnwarp.io.names import file_stems
from attnwarp.io.ply import read_ply

FORMAT = 2
"""Raised when a folder's files change meaning; older folders are then refused. 2: records have the
hash of their picture, and the editor's hash tells all guidance apart."""

PROTOCOL = 3
"""Raised when the same settings come to edit views otherwise, so that no folder mixes both. 2:
warps and depth have the pictures' near plane, and ``mask=False`` leaves out what has no depth. 3:
sides of pictures are multiples of two halvings of the latents, 32 px for Stable Diffusion.
"""

MANIFEST = "manifest.json"
SEGMENTS_FOLDER = "segments"
VIEWER_PLY = "edited-3dgs.ply"
"""Edited 2D splats as thin 3D ones, for viewers of 3DGS; the command writes it."""

RESULTS = ("source.json", "source.png", "features.png", "edited.ply", VIEWER_PLY, "result.json")
"""Files beside the manifest."""

FOLDERS = ("views", "masks", "features", "stages", "renders/before", "renders/after")


@contextmanager
def results_in(folder: Path | str | None) -> Iterator[Path]:
    """Where a run writes: a folder that no other run writes to meanwhile, or a temporary one.

    Raises:
        InputError: another run writes to it.
    """
    if folder:
        with alone_in(folder):
            yield Path(folder)
    else:
        with tempfile.TemporaryDirectory() as place:
            yield Path(place)


class Folder:
    """Files of one edit.

    Args:
        path: made by :meth:`claim` if need be.
        cameras: of the views, whose names the files have.
        folders: inside it, made likewise.

    Attributes:
        path: see there.
        names: file names of the views, without suffix.
    """

    def __init__(
        self, path: Path, cameras: Sequence[Camera], folders: Sequence[str] = FOLDERS
    ) -> None:
        self.path, self.folders = path, folders
        self._again: set[str] = set()  # edits that are made again
        self.names = file_stems(cameras)

    def claim(self, manifest: dict[str, Any]) -> None:
        """Write the manifest, or hold the one that is there against it; make the folders.

        Raises:
            InputError: the folder holds an edit of other settings or inputs, by name; or files
                where results go, and no manifest that says whose they are.
        """
        path = self.path / MANIFEST
        self.check_unclaimed()
        manifest = json.loads(json.dumps({"format": FORMAT, "protocol": PROTOCOL, **manifest}))
        stored = self.read_json(MANIFEST) if path.exists() else manifest
        differing = list(_differences(stored, manifest))
        if differing:
            raise InputError(
                f"{self.path}: holds an edit of other {'; '.join(differing[:3])}"
                f"{'; ...' if len(differing) > 3 else ''}. Go on with the same ones, or name"
                " another folder"
            )
        for name in self.folders:
            (self.path / name).mkdir(parents=True, exist_ok=True)
        if not path.exists():
            self.write_json(MANIFEST, manifest)

    def check_unclaimed(self) -> None:
        """Refuse files where results go, in a folder without a manifest: they would be written
        over, or taken for results of these settings.

        Raises:
            InputError: there is such a file.
        """
        if self.has(MANIFEST):
            return
        places = [self.path / name for name in (*RESULTS, SEGMENTS_FOLDER, *self.folders)]
        files = (
            file for place in places for file in (place.iterdir() if place.is_dir() else [place])
        )
        first = next((file for file in files if file.is_file()), None)
        if first is not None:
            raise InputError(
                f"{self.path}: has no {MANIFEST}, so it can't be told what {first} is of; name"
                " another folder, or remove what an edit left in this one"
            )

    def write_json(self, name: str, value: Any) -> None:
        """Write JSON atomically."""
        text = json.dumps(value, indent=2, allow_nan=False) + "\n"
        write_atomically(self.path / name, lambda stream: stream.write(text.encode()))

    def read_json(self, name: str) -> Any:
        """Read the object of a JSON file.

        Raises:
            FileFormatError: it is damaged.
        """
        path = self.path / name
        # Without its manifest, a folder's results are of no known settings.
        remedy = "name another folder" if name == MANIFEST else "remove it, it is made anew"
        try:
            value = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise FileFormatError(path, f"not JSON ({error}); {remedy}") from None
        if not isinstance(value, dict):
            raise FileFormatError(path, f"holds no JSON object; {remedy}")
        return value

    def write_picture(self, name: str, pixels: npt.NDArray[np.uint8]) -> None:
        """Write an (H, W, 3) uint8 PNG atomically."""
        data = encode_png(pixels)
        write_atomically(self.path / name, lambda stream: stream.write(data))

    def read_picture(self, name: str) -> npt.NDArray[np.uint8]:
        """(H, W, 3) uint8 of a PNG that :meth:`write_picture` wrote."""
        return read_image(self.path / name)

    def write_edit(self, picture: str, pixels: npt.NDArray[np.uint8]) -> None:
        """Write the picture of an edit. Made again, it has to be the same: what was tuned since
        rests on the former one.

        Raises:
            InputError: it is another one.
        """
        self.check_edit(picture, pixels)
        self.write_picture(picture, pixels)

    def write_record(self, picture: str, about: dict[str, Any]) -> None:
        """Write what an edit was, with the hash of its picture, which is there already: by this
        record the view counts as edited.
        """
        sha256 = digest(self.read_picture(picture))
        self.write_json(record_of(picture), {**about, "sha256": sha256})
        self._again.discard(picture)

    def check_edit(self, picture: str, pixels: npt.NDArray[np.uint8]) -> None:
        """Hold an edit that is made again against its record, if there is one.

        Raises:
            InputError: it is another one.
        """
        record = record_of(picture)
        if self.has(record) and self.read_record(picture)["sha256"] != digest(pixels):
            raise InputError(
                f"{self.path}: the edit is not the one that {picture} was; go on with the same"
                " device, number of threads and versions, or name another folder"
            )

    def read_record(self, picture: str, *keys: str) -> dict[str, Any]:
        """What the edit of a picture was.

        Raises:
            FileFormatError: the record is damaged, or lacks one of the keys.
        """
        record: dict[str, Any] = self.read_json(record_of(picture))
        for key in ("sha256", *keys):
            if key not in record:
                raise FileFormatError(
                    self.path / record_of(picture), f"lacks {key!r}; remove it, it is made anew"
                )
        return record

    def edited(self, picture: str, *further: str) -> bool:
        """Whether a view is edited: beside its picture stands a record, NAME.json.

        A picture that is missing, damaged or another one all the same leaves no edit: the view is
        edited again, and its record says what has to come out.

        Args:
            picture: of the edit.
            further: pictures that were written with it.

        Raises:
            FileFormatError: the record is damaged.

        Warns:
            InputWarning: a view is edited again; once for each.
        """
        record = record_of(picture)
        if not self.has(record) or picture in self._again:
            return False
        damaged = next((name for name in (picture, *further) if not self.has_picture(name)), None)
        what = "missing or damaged"
        stored = self.read_record(picture)["sha256"]
        if damaged is None and stored != digest(self.read_picture(picture)):
            damaged, what = picture, "not the picture that the edit made"
        if damaged is not None:
            self._again.add(picture)
            warnings.warn(
                f"{self.path / damaged}: {what}; the view is edited again",
                InputWarning,
                stacklevel=2,
            )
            return False
        return True

    def has_picture(self, name: str) -> bool:
        """Whether a picture is there and can be read: a disk or a person may have damaged it."""
        try:
            self.read_picture(name)
        except (FileFormatError, FileNotFoundError):
            return False
        return True

    def has_splats(self, name: str) -> bool:
        """Whether splats are there and can be read, as :meth:`has_picture`."""
        try:
            read_ply(self.path / name)
        except (FileFormatError, FileNotFoundError):
            return False
        return True

    def has(self, name: str) -> bool:
        """Whether a file is there, and so whole."""
        return (self.path / name).is_file()


def record_of(picture: str) -> str:
    """The file that says what an edit was, of the file of its picture.

    Example:
        >>> record_of("views/a.1.png")
        'views/a.1.json'
    """
    return str(Path(picture).with_suffix(".json").as_posix())


def _differences(stored: Any, now: Any, name: str = "") -> list[str]:
    """What differs between two JSON values, by the path of its key."""
    if isinstance(stored, dict) and isinstance(now, dict):
        return [
            line
            for key in {**stored, **now}
            for line in _differences(stored.get(key), now.get(key), f"{name}.{key}".lstrip("."))
        ]
    if stored == now:
        return []
    # A hash tells a person nothing.
    hashes = name.startswith("inputs.")
    return [name if hashes else f"{name} ({_short(stored)}, now {_short(now)})"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
