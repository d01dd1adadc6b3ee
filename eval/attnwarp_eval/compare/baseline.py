"""The baseline's file: sorted JSON lines, one per cell, and one per (cell, metric)."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from attnwarp.errors import InputError
from attnwarp_eval.canonical_json import canonical_json, without_nan
from attnwarp_eval.compare.snapshot import Figure, Measured, Snapshot
from attnwarp_eval.files import write_atomic

FORMAT = 1
"""Version of the file's layout; readers refuse other versions."""

REMEDY = "take the file from version control again, or delete it and write it anew with --update"


class BaselineError(InputError):
    """A baseline that cannot be used; the message names it and the remedy."""


def write_baseline(path: Path, snapshot: Snapshot) -> None:
    """Write a baseline atomically.

    Raises:
        BaselineError: cells of the run are missing.
    """
    if snapshot.missing:
        raise BaselineError(
            f"{path}: not written, as {len(snapshot.missing)} cells of the run are missing; run"
            " the study again to measure them"
        )
    lines = list(_lines(snapshot))
    header = {
        "baseline": FORMAT,
        "study": snapshot.study,
        "digest": snapshot.digest,
        "lines": len(lines),
    }
    header["sha256"] = _seal(header, lines)
    write_atomic(path, "".join(f"{line}\n" for line in (canonical_json(header), *lines)).encode())


def _seal(header: dict[str, Any], lines: list[str]) -> str:
    """The checksum over the first line, without the checksum, and all following lines."""
    first = canonical_json({key: value for key, value in header.items() if key != "sha256"})
    return hashlib.sha256("\n".join([first, *lines]).encode()).hexdigest()


def _lines(snapshot: Snapshot) -> Iterator[str]:
    for cell in snapshot.cells:
        name = {
            "scene": cell.scene,
            "probe": cell.probe,
            "variants": list(cell.variants),
            "seed": cell.seed,
        }
        yield canonical_json(
            {**name, "counters": dict(cell.counters), "definition": cell.definition}
        )
        for key, figure in sorted(cell.figures.items()):
            values = without_nan(figure.values)
            yield canonical_json(
                {**name, "metric": key, "version": figure.version, "values": values}
            )


def read_baseline(path: Path) -> Snapshot:
    """Read a baseline's file, the JSON lines that ``compare --update`` wrote.

    Raises:
        BaselineError: the file is not a baseline, or was changed after it was written.
        OSError: the file cannot be read.
    """
    try:
        text = path.read_bytes().decode()
    except UnicodeDecodeError:
        raise BaselineError(f"{path}: not a baseline (no text); {REMEDY}") from None
    first, *lines = text.split("\n")
    if lines and lines[-1] == "":
        lines.pop()
    try:
        return _parse(first, lines)
    except ValueError as error:
        raise BaselineError(f"{path}: {error}; {REMEDY}") from None


def _parse(first: str, lines: list[str]) -> Snapshot:
    if not first:
        raise ValueError("not a baseline (empty)")
    try:
        header = json.loads(first)
    except ValueError:
        raise ValueError("not a baseline (line 1 is not JSON)") from None
    if not isinstance(header, dict) or "baseline" not in header:
        raise ValueError("not a baseline (its first line has no key 'baseline')")
    if header["baseline"] != FORMAT:
        raise ValueError("made by an older version")
    if len(lines) != header.get("lines"):
        raise ValueError(f"{len(lines)} lines behind the first, which says {header.get('lines')!r}")
    if _seal(header, lines) != header.get("sha256"):
        raise ValueError("its checksum does not fit its content")
    cells: list[Measured] = []
    for line in lines:
        _add(cells, json.loads(line))
    return Snapshot(str(header.get("study")), str(header.get("digest")), tuple(cells))


def _add(cells: list[Measured], data: dict[str, Any]) -> None:
    """Add a line to the cells: a new cell, or a figure of the last one."""
    name = (data["scene"], data["probe"], tuple(map(str, data["variants"])), int(data["seed"]))
    if "counters" in data:
        counters = {key: int(value) for key, value in data["counters"].items()}
        cells.append(Measured(*name, data["definition"], counters, {}))
        return
    values = {
        view: math.nan if value is None else float(value) for view, value in data["values"].items()
    }
    figure = Figure(int(data["version"]), values)
    cells[-1] = replace(cells[-1], figures={**cells[-1].figures, data["metric"]: figure})
