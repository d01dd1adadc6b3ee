"""The seconds that a run took, by part of its work, over all sittings."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from attnwarp.io.file import FileFormatError
from attnwarp.propagate.folder import Folder

FILE = "times.json"


class Times:
    """Seconds by part, in a file of the run's folder; those of earlier sittings are read from it.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Folder) -> None:
        self.folder = folder
        stored = folder.read_json(FILE) if folder.has(FILE) else {}
        for name, value in stored.items():
            if not isinstance(value, int | float):
                raise FileFormatError(
                    folder.path / FILE,
                    f"got {value!r}, expected seconds; remove it, it is made anew", field=name,
                )  # fmt: skip
        self._ended: dict[str, float] = dict(stored)
        self._part, self._since = "", 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count a block's seconds as those of a part; parts do not nest."""
        self._part, self._since = name, time.perf_counter()
        try:
            yield
        finally:
            self._ended = self._exact()
            self._part = ""

    def write(self) -> None:
        """Write the file; the part at work counts up to now."""
        self.folder.write_json(FILE, self.seconds)

    @property
    def seconds(self) -> dict[str, float]:
        """By part, the part at work up to now, as the file has them: a limit in the seconds of a
        finished run is then the same in every sitting.
        """
        return {part: round(seconds, 3) for part, seconds in self._exact().items()}

    def _exact(self) -> dict[str, float]:
        seconds = dict(self._ended)
        if self._part:
            running = time.perf_counter() - self._since
            seconds[self._part] = seconds.get(self._part, 0.0) + running
        return seconds
