"""Folder of a run: its owner, records, checkpoints and seconds, from which a stopped run resumes.

Every file is complete or absent. The folder is the only state, so a killed run resumes from its
files. Fits and all methods store:

manifest.json       settings of the run, with hashes of its inputs
NAME.png NAME.json  a picture, and the record that marks it as finished
*.pt                a checkpoint
times.json          seconds by part, over all processes
"""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.digest import digest
from attnwarp.errors import InputError, InputWarning
from attnwarp.io.file import FileFormatError, write_atomically
from attnwarp.io.images import encode_png, read_image
from attnwarp.io.lock import alone_in
from attnwarp.settings import Number, Settings, Weight

FORMAT = 4
"""Format version, raised when files of a run's folder, or a run's results, change meaning; folders
of another format are refused."""

MANIFEST = "manifest.json"
TIMES = "times.json"

CHECKPOINT_SHARE = 0.05
"""Largest share of the time spent on checkpoints."""


@dataclass(frozen=True)
class Budget(Settings):
    """Limits of a run. No batch of edits and no iteration of tuning begins beyond them.

    Args:
        seconds: limit on seconds of editing and tuning, over all processes; None for no limit. A
            run cut by seconds depends on the machine. A method that tunes after all of its edits
            may end before tuning.
        network_rows: limit on rows through the UNet; None for no limit. A batch of edits that would
            exceed it does not begin, and the round's tuning is the last.

    Raises:
        ValueError: a limit is not a finite number >= 0, or rows are not an integer.

    Example:
        >>> from attnwarp.workdir import Budget
        >>> Budget(network_rows=600)
        Budget(seconds=None, network_rows=600)
    """

    seconds: Weight | None = None
    network_rows: Number | None = None


@contextmanager
def results_in(folder: Path | str | None) -> Iterator[Path]:
    """Hold a folder against writes by other runs; None holds a temporary folder.

    Raises:
        InputError: another run writes to the folder.
    """
    if folder:
        with alone_in(folder):
            yield Path(folder)
    else:
        with tempfile.TemporaryDirectory() as place:
            yield Path(place)


class Workdir:
    """Folder of one run."""

    def __init__(
        self,
        path: Path,
        what: str,
        folders: Sequence[str] = (),
        results: Sequence[str] = (),
    ) -> None:
        self.path, self.what = path, what
        self.folders, self.results = folders, results
        self.seconds = Seconds(self)

    # --- ownership

    def claim(self, manifest: dict[str, Any]) -> None:
        """Write the manifest, or compare it with the existing one; create the folders."""
        manifest = {"format": FORMAT, **manifest}
        self.check_claimed(manifest, whole=True)
        for name in self.folders:
            (self.path / name).mkdir(parents=True, exist_ok=True)
        if not self.has(MANIFEST):
            self.write_json(MANIFEST, manifest)

    def check_claimed(self, known: dict[str, Any], *, whole: bool = False) -> None:
        """Compare the known settings of a run with the folder, before any work.

        Raises:
            InputError: the folder holds a run of other settings or inputs, which the message lists;
                or result files without a manifest that identifies their run.
        """
        self.check_unclaimed()
        if not self.has(MANIFEST):
            return
        known, stored = json.loads(json.dumps(known)), self.read_json(MANIFEST)
        if stored.get("format") != FORMAT:
            raise InputError(
                f"{self.path}: holds {self.what} made by an older version; run it again in another"
                " folder"
            )
        differing = differences(stored if whole else _part(stored, known), known)
        if differing:
            raise InputError(
                f"{self.path}: holds {self.what} of other {'; '.join(differing[:3])}"
                f"{'; ...' if len(differing) > 3 else ''}. Go on with the same ones, or name"
                " another folder"
            )

    def check_unclaimed(self) -> None:
        """Refuse result files in a folder without a manifest: they would be overwritten, or taken
        for results of this run."""
        if self.has(MANIFEST):
            return
        places = [self.path / name for name in (*self.results, *self.folders)]
        files = (
            file for place in places for file in (place.iterdir() if place.is_dir() else [place])
        )
        first = next((file for file in files if file.is_file()), None)
        if first is not None:
            raise InputError(
                f"{self.path}: has no {MANIFEST}, so it can't be told what {first} is of; name"
                f" another folder, or remove what {self.what} left in this one"
            )

    # --- files

    def has(self, name: str) -> bool:
        """Return True if a file exists, and is therefore complete."""
        return (self.path / name).is_file()

    def write_json(self, name: str, value: Any) -> None:
        """Write JSON atomically."""
        text = json.dumps(value, indent=2, allow_nan=False) + "\n"
        write_atomically(self.path / name, lambda stream: stream.write(text.encode()))

    def read_json(self, name: str) -> Any:
        """Read the object of a JSON file."""
        path = self.path / name
        # Without its manifest, a folder's results have unknown settings.
        remedy = "name another folder" if name == MANIFEST else "remove it, it is made anew"
        try:
            value = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(value, dict):
                raise ValueError("expected an object")
            return value
        except (ValueError, RecursionError) as error:
            raise FileFormatError(path, f"not JSON ({error}); {remedy}") from None

    def write_picture(self, name: str, pixels: npt.NDArray[np.uint8]) -> None:
        """Write an (H, W, 3) uint8 PNG atomically."""
        data = encode_png(pixels)
        write_atomically(self.path / name, lambda stream: stream.write(data))

    def read_picture(self, name: str) -> npt.NDArray[np.uint8]:
        """Read a PNG written by :meth:`write_picture`, (H, W, 3) uint8."""
        path = self.path / name
        try:
            return read_image(path)
        except FileFormatError:
            raise FileFormatError(path, "damaged; remove it, it is made anew") from None

    # --- pictures written once

    def write_record(
        self, picture: str, pixels: npt.NDArray[np.uint8], about: dict[str, Any]
    ) -> None:
        """Write a picture, then its record, which has its hash and marks it as finished. A picture
        written again must be the same, since later results depend on the first version."""
        self.check_same(picture, pixels)
        self.write_picture(picture, pixels)
        self.write_json(record_of(picture), {**about, "sha256": digest(pixels)})

    def check_same(self, picture: str, pixels: npt.NDArray[np.uint8]) -> None:
        """Compare a picture computed again with its record, if any."""
        if self.has(record_of(picture)) and self.record(picture)["sha256"] != digest(pixels):
            raise InputError(
                f"{self.path}: the edit is not the one that {picture} was; go on with the same"
                " device, number of threads and versions, or name another folder"
            )

    def record(self, picture: str) -> dict[str, Any]:
        """Read the record of a picture."""
        record: dict[str, Any] = self.read_json(record_of(picture))
        if "sha256" not in record:
            path = self.path / record_of(picture)
            raise FileFormatError(path, "is no record of a picture; remove it, it is made anew")
        return record

    def made(self, picture: str) -> bool:
        """Return True for a picture with a record. The record's "pictures" are files written with
        the picture.

        A missing or changed picture with a record is computed again, and must match the
        record.

        Raises:
            FileFormatError: the record or the picture is damaged.

        Warns:
            InputWarning: a picture will be computed again.
        """
        if not self.has(record_of(picture)):
            return False
        record = self.record(picture)
        names = (picture, *record.get("pictures", ()))
        again, what = next((name for name in names if not self.has(name)), None), "missing"
        if again is None and record["sha256"] != digest(self.read_picture(picture)):
            again, what = picture, "not the picture that the edit made"
        if again is None:
            return True
        message = f"{self.path / again}: {what}; the view is edited again"
        warnings.warn(message, InputWarning, stacklevel=2)
        return False

    # --- checkpoints

    def save(self, name: str, state: dict[str, Any]) -> None:
        """Write a checkpoint: a line with the SHA-256, then tensors and plain values."""
        import torch

        buffer = io.BytesIO()
        torch.save(state, buffer)
        data = buffer.getbuffer()
        head = b"%s %d %s\n" % (_MAGIC, FORMAT, hashlib.sha256(data).hexdigest().encode())

        def write(stream: Any) -> None:
            stream.write(head)
            stream.write(data)

        write_atomically(self.path / name, write)

    def load(self, name: str, remedy: str = "remove it to begin again") -> dict[str, Any]:
        """Load a file written by :meth:`save`. Only tensors and plain values are read; a file
        cannot run code.

        Raises:
            FileFormatError: the file is damaged, from an older version, or not a checkpoint.
        """
        import torch

        path = self.path / name
        head, _, data = path.read_bytes().partition(b"\n")
        start, _, rest = head.partition(_MAGIC + b" ")
        version, _, checksum = rest.partition(b" ")
        if start or not rest:
            raise FileFormatError(path, f"not a checkpoint; {remedy}")
        if version != b"%d" % FORMAT:
            raise FileFormatError(path, f"made by an older version; {remedy}")
        if checksum != hashlib.sha256(data).hexdigest().encode():
            raise FileFormatError(path, f"its checksum does not match, so it is damaged; {remedy}")
        state: dict[str, Any] = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise FileFormatError(path, f"not a checkpoint; {remedy}")
        return state


_MAGIC = b"attnwarp checkpoint"


class CheckpointClock:
    """Clock of checkpoints: the next is due ``seconds`` after the last, or later if writing is
    slow, so that checkpoints take at most :data:`CHECKPOINT_SHARE` of the time.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds, self._last, self._cost = seconds, time.perf_counter(), 0.0

    @property
    def due(self) -> bool:
        """True if a checkpoint is due."""
        wait = max(self.seconds, self._cost * (1 / CHECKPOINT_SHARE - 1))
        return time.perf_counter() - self._last >= wait

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Time a block as the writing of a checkpoint."""
        began = time.perf_counter()
        yield
        self._last = time.perf_counter()
        self._cost = self._last - began


class Seconds:
    """Seconds by part of a run's work, stored in its folder and summed over its processes."""

    def __init__(self, folder: Workdir) -> None:
        self.folder = folder
        self._ended: dict[str, float] = folder.read_json(TIMES) if folder.has(TIMES) else {}
        self._part, self._since = "", 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count a block's seconds for a part, and not for an enclosing part."""
        outer = self._begin(name)
        try:
            yield
        finally:
            self._begin(outer)

    def _begin(self, name: str) -> str:
        """Start counting for a part; return the previous part."""
        before, self._ended = self._part, self._exact()
        self._part, self._since = name, time.perf_counter()
        return before

    def write(self) -> None:
        """Write the file; the current part counts up to now."""
        self.folder.write_json(TIMES, self.parts)

    @property
    def parts(self) -> dict[str, float]:
        """Seconds by part, the current part up to now, rounded as in the file, so that a finished
        run compares with a limit alike in every process.
        """
        return {part: round(seconds, 3) for part, seconds in self._exact().items()}

    def _exact(self) -> dict[str, float]:
        seconds = dict(self._ended)
        if self._part:
            running = time.perf_counter() - self._since
            seconds[self._part] = seconds.get(self._part, 0.0) + running
        return seconds


def record_of(picture: str) -> str:
    """Return the file of a picture's record.

    Example:
        >>> record_of("views/a.1.png")
        'views/a.1.json'
    """
    return str(Path(picture).with_suffix(".json").as_posix())


def _part(stored: Any, known: Any) -> Any:
    """Restrict JSON entries to the keys of another value."""
    if not isinstance(stored, dict) or not isinstance(known, dict):
        return stored
    return {key: _part(stored.get(key), value) for key, value in known.items()}


def differences(stored: Any, now: Any, name: str = "") -> list[str]:
    """List differences between two JSON values, by the path of the key."""
    if isinstance(stored, dict) and isinstance(now, dict):
        return [
            line
            for key in {**stored, **now}
            for line in differences(stored.get(key), now.get(key), f"{name}.{key}".lstrip("."))
        ]
    if stored == now:
        return []
    # The value of a hash is meaningless to a user.
    hashes = name.startswith("inputs.")
    return [name if hashes else f"{name} ({_short(stored)}, now {_short(now)})"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
