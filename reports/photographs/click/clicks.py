"""Overlap after one, two and three clicks, each next one in the middle of what is most wrong.

    python reports/photographs/click/clicks.py CAPTURES FITS NAME ...

Two views of known outline are clicked; the overlap is that of the others. Writes clicks.json.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from measure import HERE, SIDE, drawn

from attnwarp.command.edit import marked
from attnwarp.command.marks import Marks
from attnwarp.fit import load_views
from attnwarp.io import read_dataset, read_image, read_ply
from attnwarp.reporting import SILENT

LEAST = 3
"""Distance inward, px, below which nobody would click on what is wrong."""

VIEWS = (4, 11, 18, 25, 32)
"""Views of a drawn thing."""


def middle(wrong: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Largest distance inward, px, and the centre of its pixel."""
    inward = cv2.distanceTransform(np.pad(wrong, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.unravel_index(inward.argmax(), inward.shape)
    return float(inward.max()), (float(x + 0.5), float(y + 0.5))


def overlaps(name: str, captures: Path, fits: Path) -> dict:
    """Clicks, and mean overlap in the other views, by clicked view."""
    dataset = read_dataset(captures / name)
    about = json.loads((HERE / "outlines.json").read_text()).get(name)
    if about:
        stems = [Path(camera.name).stem for camera in dataset.cameras]
        outlines = about["outlines"]
        indices = [stems.index(view) for view in outlines]
        masks = [drawn(outlines[stems[k]], *about["size"]) for k in indices]
    else:
        indices = list(VIEWS)
        files = [Path(dataset.image_paths[k]).name for k in indices]
        masks = [read_image(captures / name / "masks/thing" / f)[..., 0] > 127 for f in files]
    dataset = dataset.select(indices)
    views = load_views(dataset, max_size=SIDE)
    splats = read_ply(fits / name / "splats.ply")
    result = {}
    for source in (0, 2):
        camera = dataset.cameras[source]
        scale = camera.width / masks[source].shape[1]
        points: dict[str, list[float]] = {"--at": [], "--not": []}
        found, steps = np.zeros_like(masks[source]), []
        for _ in range(3):
            wrong = {"--at": masks[source] & ~found, "--not": found & ~masks[source]}
            option = max(wrong, key=lambda way: middle(wrong[way])[0])
            if steps and middle(wrong[option])[0] < LEAST:
                break
            points[option] += [scale * v for v in middle(wrong[option])[1]]
            marks = Marks(at=tuple(points["--at"]), away=tuple(points["--not"]) or None)
            with tempfile.TemporaryDirectory() as out:
                lift = marked(marks, "", dataset, views, source, Path(out), "cpu", SILENT)
                lifted = [share > 0.5 for share in lift(splats)]
            found = lifted[source]
            others = [k for k in range(len(masks)) if k != source]
            each = [(lifted[k] & masks[k]).sum() / (lifted[k] | masks[k]).sum() for k in others]
            steps.append([option, round(float(np.mean(each)), 3)])
        result[camera.name] = steps
    return result


if __name__ == "__main__":
    captures, fits, *names = sys.argv[1:]
    file = HERE / "clicks.json"
    for name in names:
        known = json.loads(file.read_text()) if file.is_file() else {}
        known[name] = overlaps(name, Path(captures), Path(fits))
        file.write_text(json.dumps(known, indent=1) + "\n")
        print(name, known[name], flush=True)
