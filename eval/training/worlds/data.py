"""Pictures of random worlds on disk, in files that are rendered where they are missing: the same whatever the number
of workers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt


def render_missing(
    title: str, files: Mapping[Path, int], render: Callable[[Path, int], object], workers: int
) -> list[Path]:
    """Render the files that are not there, each from its number; all of them are returned in order."""
    from rich.progress import Progress

    missing = [pair for pair in files.items() if not pair[0].exists()]
    if missing:
        with Progress() as bar, ProcessPoolExecutor(workers) as pool:
            task = bar.add_task(title, total=len(files), completed=len(files) - len(missing))
            for finished in as_completed([pool.submit(render, *pair) for pair in missing]):
                finished.result()
                bar.advance(task)
    return list(files)


def joined(files: Sequence[Path]) -> dict[str, npt.NDArray[Any]]:
    """The arrays of files of one kind, one file after the other."""
    columns: dict[str, list[npt.NDArray[Any]]] = {}
    for path in files:
        with np.load(path) as stored:
            for key in stored.files:
                columns.setdefault(key, []).append(stored[key])
    return {key: np.concatenate(parts) for key, parts in columns.items()}
