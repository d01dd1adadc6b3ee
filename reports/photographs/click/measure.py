"""Overlap of what a click marks with outlines drawn by hand.

    python reports/photographs/click/measure.py CAPTURES FITS

CAPTURES/NAME are pinhole captures, FITS/NAME/splats.ply their splats. Draws the masks, PNG of one
bit, and writes results.json and the tables of click.md.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from attnwarp.command.edit import marked, view_of
from attnwarp.command.marks import Marks
from attnwarp.fit import load_views
from attnwarp.io import read_dataset, read_ply
from attnwarp.reporting import SILENT

HERE = Path(__file__).parent
SIDE = 256


def drawn(outline: dict, width: int, height: int) -> np.ndarray:
    """Fill an outline without its holes, (h, w) bool with a longest side of 256 px."""
    scale = SIDE / max(width, height)
    mask = np.zeros((round(scale * height), round(scale * width)), np.uint8)
    for points, value in ((outline["around"], 1), *((hole, 0) for hole in outline["holes"])):
        # Fractions of 1/16 px; pixel centres lie at +0.5.
        cv2.fillPoly(
            mask, [np.rint(16 * (scale * np.array(points) - 0.5)).astype(int)], value, shift=4
        )
    return mask > 0


def overlaps(name: str, about: dict, captures: Path, fits: Path) -> dict:
    """Intersection over union, by clicked view and drawn view."""
    masks = {view: drawn(outline, *about["size"]) for view, outline in about["outlines"].items()}
    for view, mask in masks.items():
        Image.fromarray(mask).save(HERE / f"{name}-{view}.png", bits=1, optimize=True)
    dataset = read_dataset(captures / name)
    views, splats = load_views(dataset, max_size=SIDE), read_ply(fits / name / "splats.ply")
    result = {}
    for source, at in about["clicks"].items():
        index, marks = view_of(dataset, source), Marks(at=tuple(at))
        with tempfile.TemporaryDirectory() as out:  # of the marked picture
            lifted = marked(marks, "", dataset, views, index, Path(out), "cpu", SILENT)(splats)
        found = {view: lifted[view_of(dataset, view)] > 0.5 for view in masks}
        result[source] = {
            view: round(float((found[view] & mask).sum() / (found[view] | mask).sum()), 3)
            for view, mask in masks.items()
        }
    return result


def tables(results: dict) -> str:
    """Write the clicks of photographs, and the mark beside growing over splats (growth.json)."""
    lines = [
        "| capture | clicked view | median (least to most) of five pictures |",
        "|---|---|---|",
    ]
    for name, clicks in results.items():
        for source, each in clicks.items():
            values = [*each.values()]
            text = f"{np.median(values):.2f} ({min(values):.2f} to {max(values):.2f})"
            lines.append(f"| {name} | `{source}` | {text} |")
    lines += ["", "| thing | the mark: overlap, recall, precision | grown |", "|---|---|---|"]
    for name, ways in json.loads((HERE / "growth.json").read_text())["things"].items():
        cells = [", ".join(f"{v:.2f}" for v in np.mean(ways[k], 0)) for k in ("mark", "grown")]
        lines.append(f"| {name} | {cells[0]} | {cells[1]} |")
    lines += [
        "",
        "| thing | clicked view | overlap in four others after each click |",
        "|---|---|---|",
    ]
    for name, views in json.loads((HERE / "clicks.json").read_text()).items():
        for view, steps in views.items():
            cells = ", ".join(f"`{option}` {value:.2f}" for option, value in steps)
            lines.append(f"| {name} | `{Path(view).stem}` | {cells} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    drawings = json.loads((HERE / "outlines.json").read_text())
    results = {
        name: overlaps(name, about, *map(Path, sys.argv[1:3])) for name, about in drawings.items()
    }
    (HERE / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    page = HERE.parent / "click.md"
    start, _, end = page.read_text().split("<!-- table -->\n")
    page.write_text("<!-- table -->\n".join([start, tables(results), end]))
