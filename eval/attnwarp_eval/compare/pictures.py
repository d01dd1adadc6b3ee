"""Pictures of the largest changes: the baseline's next to the run's."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from attnwarp.io.file import inside
from attnwarp_eval.compare.snapshot import Figure, Measured, Snapshot, definition
from attnwarp_eval.files import write_atomic
from attnwarp_eval.metrics.gates import Margin, margin
from attnwarp_eval.metrics.registry import METRICS
from attnwarp_eval.study.results import Results

Pictures = Mapping[tuple[str, int, str], Mapping[str, Path]]
"""(definition of the cell, seed, view) -> content -> file."""


@dataclass(frozen=True)
class Change:
    """A view whose figures changed, and its pictures on both sides.

    Attributes:
        metric: metric with the value that moved by the most margins.
        before, now: values of the metric.
        margins: size of the change in margins; infinite if only one side is defined.
        pictures: content -> the files of the baseline and of the run.
    """

    scene: str
    probe: str
    variant: str
    view: str
    metric: str
    before: float
    now: float
    margins: float
    pictures: Mapping[str, tuple[Path, Path]]


def pictures_of_run(results: Results, root: Path) -> Pictures:
    """The pictures of a run's cells."""
    table: dict[tuple[str, int, str], dict[str, Path]] = {}
    for cell in results.cells:
        if (record := cell.record) is None:
            continue
        for picture in record.pictures:
            key = (definition(record.spec), cell.seed, picture.view)
            table.setdefault(key, {})[picture.content] = root / picture.path
    return table


def folder_of(baseline: Path) -> Path:
    """Folder of a baseline's pictures, next to its file."""
    return baseline.with_suffix(".pictures")


def pictures_of_baseline(baseline: Path, snapshot: Snapshot) -> Pictures:
    """The pictures next to a baseline's file; none if it was written without them."""
    table = {}
    for cell in snapshot.cells:
        for view in _views(cell):
            folder = _folder(folder_of(baseline), cell.definition, cell.seed, view)
            if files := {file.stem: file for file in sorted(folder.glob("*.jpg"))}:
                table[cell.definition, cell.seed, view] = files
    return table


def write_pictures(baseline: Path, pictures: Pictures) -> None:
    """Save a run's pictures next to a baseline's file, in place of former ones.

    The former ones are removed after all new ones are saved.
    """
    folder = folder_of(baseline)
    new, former = folder.with_suffix(".pictures-new"), folder.with_suffix(".pictures-former")
    for left in (new, former):  # by an interrupted call
        if left.is_dir():
            shutil.rmtree(left)
    for (cell, seed, view), files in pictures.items():
        for content, file in files.items():
            path = inside(_folder(new, cell, seed, view), f"{content}.jpg")
            write_atomic(path, file.read_bytes())
    if folder.is_dir():
        folder.rename(former)
    if new.is_dir():
        new.rename(folder)
    if former.is_dir():
        shutil.rmtree(former)


def _folder(pictures: Path, cell: str, seed: int, view: str) -> Path:
    """Folder of the pictures of a view; its name may have a slash, as in ``edit/yaw030``."""
    return inside(pictures, f"{cell}-{seed}/{view.replace('/', '__')}")


def _views(cell: Measured) -> list[str]:
    return sorted({view for figure in cell.figures.values() for view in figure.values})


def largest_changes(
    baseline: Snapshot, run: Snapshot, before: Pictures, after: Pictures, most: int = 6
) -> list[Change]:
    """The pictured views whose figures changed by the most margins."""
    changes = [
        change
        for first, second, variant in _shared(baseline, run)
        for change in _of_cell(first, second, variant, before, after)
    ]
    return sorted(changes, key=lambda change: -change.margins)[:most]


def _shared(baseline: Snapshot, run: Snapshot) -> Iterator[tuple[Measured, Measured, str]]:
    """The cells of each variant on both sides, with the first seed."""
    sides: list[dict[tuple[str, str, str], Measured]] = [{}, {}]
    for side, snapshot in zip(sides, (baseline, run), strict=True):
        for cell in snapshot.cells:
            for variant in cell.variants:
                side.setdefault((cell.scene, cell.probe, variant), cell)
    for key in sorted(sides[0].keys() & sides[1].keys()):
        yield sides[0][key], sides[1][key], key[2]


def _of_cell(
    first: Measured, second: Measured, variant: str, before: Pictures, after: Pictures
) -> Iterator[Change]:
    for view in _views(first):
        files = before.get((first.definition, first.seed, view), {})
        others = after.get((second.definition, second.seed, view), {})
        both = {
            content: (files[content], others[content]) for content in files if content in others
        }
        moved = [
            (margins, key, figure.values[view], second.figures[key].values[view])
            for key, figure in sorted(first.figures.items())
            if (margins := _margins(key, figure, second.figures.get(key), view)) > 0
        ]
        if both and moved:
            margins, key, old, new = max(moved, key=lambda item: item[0])
            yield Change(first.scene, first.probe, variant, view, key, old, new, margins, both)


def _margins(key: str, first: Figure, second: Figure | None, view: str) -> float:
    """Number of margins by which a view's figure changed; 0 within the registry's tolerance."""
    if second is None or view not in first.values or view not in second.values:
        return 0.0
    old, new = first.values[view], second.values[view]
    if math.isnan(old) or math.isnan(new):
        return 0.0 if math.isnan(old) and math.isnan(new) else math.inf
    if METRICS[key].direction == "zero":
        old, new = abs(old), abs(new)
    tolerance = Margin(METRICS[key].atol, METRICS[key].rtol).around(old)
    change = abs(new - old)
    return change / margin(key).around(old) if change > tolerance else 0.0
