"""Folders of edits: their files, deaths in the middle of writing them, and what older ones held."""

import json
from pathlib import Path

from attnwarp import workdir
from attnwarp.io import ply
from attnwarp.reporting import Reporter


def files(folder):
    """Everything that has to be the same after a kill: all but the seconds."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file() and path.name != "times.json"
    }


def without(folder, key):
    """Make a folder's manifest what it was before it had a key."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest[key]
    path.write_text(json.dumps(manifest))


class Watched(Reporter):
    """Calls functions with (done, total, text) of a step, and with a line."""

    def __init__(self, step=lambda *_: None, log=lambda _: None):
        self.step, self.log = step, log


class Killed(BaseException):
    """Leaves the files as a kill would: nothing catches it but the atomic write."""


def events(monkeypatch, stop):
    """Count steps of progress and writes; die at number ``stop``, before a write or after it.

    Returns:
        What to call at a step of progress, and what returns the count.
    """
    count = 0

    def event(*_):
        nonlocal count
        count += 1
        if count == stop:
            raise Killed

    def wrapped(write):
        def around(*args, **kwargs):
            event()
            write(*args, **kwargs)
            event()

        return around

    for module in (ply, workdir):
        monkeypatch.setattr(module, "write_atomically", wrapped(module.write_atomically))
    return event, lambda: count
