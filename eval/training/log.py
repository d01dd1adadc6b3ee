"""A training's log: a JSON line for each epoch beside its checkpoint.

A checkpoint tells what its weights took, a log how the losses fell.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from attnwarp.io.file import write_atomically


@dataclass(frozen=True)
class Entry:
    """An epoch that ended.

    Attributes:
        epoch: how many epochs have ended.
        steps: how many steps they had in all; None where the recipe does not count them.
        seconds: seconds of all of them, and of what came before the first.
        losses: their means in this epoch, by name.
    """

    stage: str
    epoch: int
    steps: int | None
    seconds: float
    losses: Mapping[str, float]


def log_path(checkpoint: Path) -> Path:
    """Path of the log of a checkpoint."""
    return checkpoint.with_suffix(".log.jsonl")


def read_log(path: Path) -> list[Entry]:
    """The entries of a log, none where there is no file. A last line without its end is left out."""
    text = path.read_text() if path.exists() else ""
    return [Entry(**json.loads(line)) for line in text.split("\n")[:-1]]


def cut_log(path: Path, epochs: int) -> None:
    """Leave the first epochs alone: a resumed training takes those after its checkpoint again.

    No file is made where there is none: a checkpoint may be older than logs.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        return
    entries = [entry for entry in read_log(path) if entry.epoch <= epochs]
    text = "".join(map(_line, entries)).encode()
    write_atomically(path, lambda file: file.write(text))


def append(path: Path, entry: Entry) -> None:
    """Add an epoch to a log."""
    with path.open("a") as file:
        file.write(_line(entry))


def _line(entry: Entry) -> str:
    return json.dumps(asdict(entry)) + "\n"
