"""Scores of pairs by networks that no package carries, made by whoever has them.

A study with ``audit: {pictures: true}`` writes, below its run's folder, ``audit/SCENE/EDIT``: a PNG
of each condition and view, and ``pairs.csv``, whose rows are the pairs that the audit judges:
``scene, edit, condition, source, target``. A network's score of the two pictures
``CONDITION/SOURCE.png`` and ``CONDITION/TARGET.png`` is a further column, its title the score's
name and what is better: ``MEt3R lower``, ``VGGT confidence higher``. A score of one picture is that
of the target. ``audit: {scores: FILE}`` reads the rows of all scenes in one file, and judges its
columns as any other figure; an empty cell is undefined.
"""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path

import numpy as np

from attnwarp_eval.files import write_atomic, write_picture
from attnwarp_eval.metrics.arrays import Array
from attnwarp_eval.metrics.score_table import read_scores
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.schema import StudyError
from attnwarp_eval.world import changed

COLUMNS = ("scene", "edit", "condition", "source", "target")


def keep(
    root: Path, cell: Cell, judged: Mapping[str, Sequence[Array]], views: Sequence[str]
) -> None:
    """Write a cell's pictures and its pairs.

    Args:
        root: the run's folder.
        judged: (H, W, 3) sRGB in [0, 1] of each view, by condition.
        views: names of the views, the source first.
    """
    folder = root / "audit" / cell.scene / cell.spec["edit"]
    text = StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for condition, pictures in judged.items():
        for view, picture in zip(views, pictures, strict=True):
            path = folder / condition / f"{view}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_picture(path, np.round(255 * picture.clip(0, 1)).astype(np.uint8))
        for view in views[1:]:
            table.writerow([cell.scene, cell.spec["edit"], condition, views[0], view])
    write_atomic(folder / "pairs.csv", text.getvalue().encode())


def digest_of(path: str) -> str:
    """SHA-256 of a file of scores. StudyError: it cannot be read."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise StudyError(f"audit.scores: {path} cannot be read ({error.strerror})") from None


def scores_of(cell: Cell) -> dict[str, dict[tuple[str, ...], float]]:
    """Scores of a cell by figure, then by (condition, source, target); none without a file.

    Raises:
        InputError: a file that cannot be used, or that has changed since the cell was planned.
    """
    path = cell.sources.get("scores")
    if path is None:
        return {}
    if digest_of(path) != cell.spec["scores"]:
        raise changed(f"file of scores {path}")
    own = (cell.scene, cell.spec["edit"])
    return {
        key: {pair[2:]: value for pair, value in scores.items() if pair[:2] == own}
        for key, scores in read_scores(Path(path), COLUMNS, "audit.scores").items()
    }
