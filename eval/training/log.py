"""A training's log: a JSON line for each epoch beside its checkpoint, and a table of stages from their logs.

A checkpoint tells what its weights took, a log how the losses fell.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from attnwarp.io.file import write_atomically

LAST_EPOCHS = 10
"""Number of the last epochs whose mean loss a table gives."""


@dataclass(frozen=True)
class Entry:
    """An epoch that ended.

    Attributes:
        stage: name of the checkpoint.
        epoch: how many epochs have ended.
        steps: how many steps they had in all; None where the recipe does not count them.
        seconds: of all of them, and of what came before the first.
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


def table(paths: Iterable[Path]) -> str:
    """A Markdown table with a row for each log that has an entry.

    Milliseconds a step are those of the epochs after the first, which compiles and warms up.
    Losses are those of training, means of the last :data:`LAST_EPOCHS` epochs; "unedited" is the
    loss of the picture before the edit.
    """
    lines = ["| stage | steps | seconds | ms a step | losses |", "|---|---|---|---|---|"]
    for path in paths:
        entries = read_log(path)
        if not entries:  # of a training that was stopped in its first epoch
            continue
        first, last = entries[0], entries[-1]
        steps, each = "–", "–"
        if last.steps is not None:
            steps = f"{last.steps:,}"
            if first.steps is not None and first.steps < last.steps:
                each = f"{1000 * (last.seconds - first.seconds) / (last.steps - first.steps):.1f}"
        values: dict[str, list[float]] = {}
        for entry in entries[-LAST_EPOCHS:]:
            for name, value in entry.losses.items():
                values.setdefault(name, []).append(value)
        losses = ", ".join(f"{name} {np.mean(values[name]):.4f}" for name in sorted(values))
        lines.append(f"| `{last.stage}` | {steps} | {last.seconds:,.0f} | {each} | {losses} |")
    return "\n".join(lines)
