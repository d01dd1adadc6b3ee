"""Structure from motion: a separate program, ``python -m attnwarp.sfm photographs FOLDER NAMES``,
which :func:`run` starts.

In one process with other packages pycolmap corrupts memory: its compression library replaces
theirs. So nothing else imports it.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from attnwarp.errors import InputError, MissingExtraError
from attnwarp.reporting import SILENT, Reporter

STEPS = {
    "features": r"Processed file \[(\d+)/(\d+)\]",
    "matches": r"Processing block \[(\d+)/(\d+), (\d+)/(\d+)\]",
    "poses": r"num_reg_frames=(\d+)",
}
"""Lines of COLMAP's log that tell how far it is."""


def run(task: str, *paths: Path, program: str = "attnwarp.sfm", report: Reporter = SILENT) -> None:
    """Run a task of a program that imports pycolmap.

    Args:
        task: a function of ``program``, called with ``paths``.

    Raises:
        InputError: the package pycolmap stopped, or is missing (MissingExtraError).
    """
    if find_spec("pycolmap") is None:
        raise MissingExtraError("pycolmap", "colmap")
    command = [sys.executable, "-m", program, task, *map(str, paths)]
    last = "nothing"
    with subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    ) as process:
        assert process.stderr is not None
        try:
            for line in process.stderr:
                last = line.strip() or last
                for name, pattern in STEPS.items():
                    if found := re.search(pattern, line):
                        report.step(*_count(*map(int, found.groups())), name)
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        raise InputError(f"{task}: pycolmap stopped with exit status {process.returncode}: {last}")


def _count(row: int, rows: int = 0, column: int = 0, columns: int = 0) -> tuple[int, int]:
    """Finished and total steps of a line: of pictures, or of blocks when one begins."""
    return ((row - 1) * columns + column - 1, rows * columns) if columns else (row, rows)


def summary(reconstruction: Any) -> dict[str, float]:
    """Figures of a ``pycolmap.Reconstruction``."""
    return {
        "registered": reconstruction.num_reg_images(),
        "points": reconstruction.num_points3D(),
        "track_length": reconstruction.compute_mean_track_length(),
        "reprojection_error": reconstruction.compute_mean_reprojection_error(),
    }


def photographs(folder: Path, names: Path) -> None:
    """Write the largest model of photographs, ``sparse/0``, and its figures, ``result.json``; null
    without a model.

    Features and matches that ``database.db`` has are not computed again.

    Args:
        names: JSON file of the pictures' folder, their names in it, whether one camera took all,
            and the files' times.
    """
    import pycolmap

    images, listed, alike, _ = json.loads(names.read_text())
    database = folder / "database.db"
    pycolmap.extract_features(
        database,
        images,
        image_names=listed,
        camera_mode=pycolmap.CameraMode.SINGLE if alike else pycolmap.CameraMode.PER_IMAGE,
    )
    # Smaller blocks than the default, whose log tells of progress only every 50 pictures.
    pairs = pycolmap.ExhaustivePairingOptions(block_size=10)
    pycolmap.match_exhaustive(database, pairing_options=pairs)
    found = pycolmap.incremental_mapping(database, images, folder / "models")
    largest = max(found.values(), key=lambda one: one.num_reg_images(), default=None)
    if largest is not None:
        (folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
        largest.write(folder / "sparse" / "0")
    (folder / "result.json").write_text(json.dumps(None if largest is None else summary(largest)))


if __name__ == "__main__":
    photographs(*map(Path, sys.argv[2:]))
