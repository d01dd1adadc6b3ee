"""The paper's tables with one's own figures beside the published ones."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp.errors import InputError
from attnwarp_eval.canonical_json import without_nan, write_json
from attnwarp_eval.document import write
from attnwarp_eval.document.model import Gallery, Picture, Report, Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.files import write_atomic
from attnwarp_eval.reproduce.cells import Made, Planned, cell_folder, made_of
from attnwarp_eval.reproduce.manifest import FIGURES, Row, TablePart, lacking
from attnwarp_eval.statistics.contrasts import Contrast, contrast
from attnwarp_eval.statistics.intervals import benjamini_hochberg, interval, over_scenes
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.shared.method_run import PARTS
from attnwarp_eval.study.store import Store

NOT_AT_HAND = "not at hand"
"""Stands for a published figure that this package does not know."""

RESULTS, NAME, PAGE = "results.json", "reproduction", "userstudy.html"
"""Files of the run's folder: figures, the report without its suffix, the page that asks people."""

Value = Callable[[Made], Mapping[str, float]]

VERSIONS: dict[str, Value] = {
    "as the paper's authors compute them": lambda made: made.authors or {},
    "with the encoders' published preprocessing": lambda made: made.figures,
}
"""Versions of the figures. Edit PSNR has one alone."""


@dataclass(frozen=True)
class Results:
    """Measurements of a run.

    Attributes:
        planned: its cells.
        root: its folder.
        records: cells with their records, those that are there.
    """

    planned: Planned
    root: Path
    records: list[tuple[Cell, Any]]

    @property
    def rows(self) -> Mapping[str, Row]:
        """Rows of the manifest by name."""
        return self.planned.loaded.manifest.methods

    def edits(self, method: str | None = None) -> Iterator[tuple[Cell, Any]]:
        """Edits, of one method alone if it is named."""
        for cell, record in self.records:
            if cell.spec["kind"] == "edit" and (method is None or method in cell.labels):
                yield cell, record

    def values(self, method: str, title: str, value: Value) -> dict[str, dict[str, float]]:
        """Scene -> edit and seed -> figure."""
        found: dict[str, dict[str, float]] = {}
        for cell, record in self.edits(method):
            figures = (
                {**record.extra.figures} if title == FIGURES["Edit PSNR"] else value(record.extra)
            )
            if figures:
                key = f"{cell.spec['edit']}/{cell.seed}"
                found.setdefault(cell.scene, {})[key] = figures.get(title, math.nan)
        return found

    @property
    def missing(self) -> int:
        """Cells without a record."""
        return len(self.planned.cells) - len(self.records)


def write_report(planned: Planned, store: Store) -> list[Path]:
    """Write ``results.json``, the report and the page that asks people; return their paths.

    Nothing in ``results.json`` was measured in seconds, so that two runs can give the same bytes.
    """
    results = Results(planned, store.root, list(made_of(planned, store)))
    write_json(store.root / RESULTS, without_nan(results_json(results)), sort_keys=False)
    paths = [store.root / RESULTS, *write.write_files(report(results), store.root, NAME)]
    page = _ask_people(results)
    return paths if page is None else [*paths, page]


def results_json(results: Results) -> dict[str, Any]:
    """Figures of every cell, in the order of the manifest."""
    checked = results.planned.checked
    return {
        "title": results.planned.loaded.manifest.title,
        "weights": {k: {"sha256": sha, "probe": p} for k, (sha, p) in checked.weights.items()},
        "captures": checked.captures,
        "cells": [
            {
                "id": cell.id, "kind": cell.spec["kind"], "scene": cell.scene,
                "edit": cell.spec.get("edit"), "methods": list(cell.labels), "seed": cell.seed,
                "figures": dict(record.extra.figures), "authors": dict(record.extra.authors),
                "counts": dict(record.extra.counts), "files": list(record.extra.files),
            }
            for cell, record in results.records
        ],
    }  # fmt: skip


def report(results: Results) -> Report:
    """The run as a document."""
    m = results.planned.loaded.manifest
    scenes = len(m.captures)
    lead = [
        f"{scenes} scene{'s' * (scenes > 1)}, {sum(1 for _ in results.planned.loaded.edits())}"
        f" edits, {m.size} px. Behind ± stands half of a 95 % interval over scenes; of fewer than"
        " six scenes the lowest and the highest are shown, from which nothing follows for others."
    ]
    ours = [
        f"{scene} / {name}: {', '.join(edit.ours)}"
        for scene, capture in m.captures.items()
        for name, edit in capture.edits.items()
        if edit.ours
    ]
    if ours:
        lead.append(f"Prompts that were not published and are this manifest's: {'; '.join(ours)}.")
    if unknown := lacking(m):
        lead.append(
            f"**Which checkpoint {', '.join(unknown)} held was not checked**: the manifest has no"
            " probe value of the published weights, so others of the same shapes pass."
        )
    if results.missing:
        lead.append(
            f"**{results.missing} of {len(results.planned.cells)} cells are missing; the same"
            " command computes them.**"
        )
    bundled = [k for k in ("clip", "dino") if ":" not in results.planned.loaded.encoder(k)]
    if bundled:
        lead.append(
            f"**The encoders of {' and '.join(bundled)} are bundled ones, whose figures do not"
            " compare with published ones.**"
        )
    sections = [section for table in m.tables for section in _table(results, table)]
    sections += [*_geometry(results), *_variability(results), _cost(results), _people(results)]
    return Report(m.title, lead, sections)


def _table(results: Results, table: TablePart) -> list[Section]:
    """A table of the paper: figures in both versions, and verdicts on its orderings."""
    tables: list[Table] = []
    for version, value in VERSIONS.items():
        rows = [_row(results, name, value) for name in table.rows]
        if any(cell != "–" for row in rows for cell in row[3::2]):
            columns = ["method", *(c for head in FIGURES for c in (head, f"{head}, paper"))]
            tables.append(Table(columns, rows, f"Figures {version}.", folded=bool(tables)))
    text = ["Higher is better. Edit PSNR also rewards a scene that hardly changes."]
    lost = [
        name for name in table.rows
        if any(math.isnan(r.extra.figures.get(FIGURES["DINO img"], math.nan))
               for _, r in results.edits(name))
    ]  # fmt: skip
    if lost:
        text.append(
            "Single-image similarities compare renders with the method's own edit of the source"
            f" view. Of {', '.join(lost)} some cells have none, as the method did not edit it."
        )
    if table.against is not None and (verdicts := _verdicts(results, table)) is not None:
        tables.append(verdicts)
        text.append(
            "Orderings are paired over scenes, edits and seeds, and tested by sign flips over"
            " scenes, adjusted for all rows together (Benjamini-Hochberg). Below six scenes there"
            " is no verdict."
        )
    return [Section(table.title, text, tables)]


def _row(results: Results, name: str, value: Value) -> list[str]:
    cells = [name]
    for k, title in enumerate(FIGURES.values()):
        values = results.values(name, title, value)
        cells.append(spread(over_scenes(values), len(values)))
        paper = results.rows[name].paper
        cells.append(NOT_AT_HAND if paper is None else f"{paper[k]:.3f}")
    return cells


def _verdicts(results: Results, table: TablePart) -> Table | None:
    """Each ordering of the paper's, row against row, and what this run says of it."""
    against = str(table.against)
    first = results.rows[against].paper
    made: list[tuple[str, str, float, Contrast, str]] = []
    for name in table.rows:
        paper = results.rows[name].paper
        if name == against or paper is None or first is None:
            continue
        for k, (head, title) in enumerate(FIGURES.items()):
            for version, value in VERSIONS.items():
                a, b = (results.values(n, title, value) for n in (against, name))
                if any(math.isfinite(v) for row in b.values() for v in row.values()):
                    sign = paper[k] - first[k]
                    made.append((name, head, sign, contrast(a, b, "plain"), version))
                    break  # the authors' version goes first
    if not made:
        return None
    adjusted = benjamini_hochberg([c.flips.p for *_, c, _ in made])
    rows = []
    for (name, head, sign, apart, _), p in zip(made, adjusted, strict=True):
        verdict = apart.verdict("higher", adjusted_p=p)
        order = "above" if sign > 0 else "below"
        agrees = {"better": sign > 0, "worse": sign < 0}.get(verdict)
        said = verdict if agrees is None else "holds" if agrees else "fails"
        here = difference(apart, apart.level(p))
        rows.append([f"{name} {order} {against}", head, f"{sign:+.3f}", here, str(said)])
    columns = ["the paper's ordering", "figure", "paper", "here [95 % interval]", "verdict"]
    return Table(columns, rows, "The paper's orderings.")


def difference(apart: Contrast, level: float = 0.95) -> str:
    """Mean of a contrast with its interval over scenes, where there are enough for one."""
    mean, low, high = apart.shown(level)
    bounded = math.isfinite(low) and math.isfinite(high)
    return f"{number(mean)} [{number(low)}, {number(high)}]" if bounded else number(mean)


def _geometry(results: Results) -> list[Section]:
    """Warps of the source by 2DGS and 3DGS, with the mask of validity."""
    records = [(c, r) for c, r in results.records if c.spec["kind"] == "warp"]
    if not records:
        return []
    rows, pictures = [], []
    for cell, record in records:
        folder = cell_folder(Path(), cell.id).as_posix()
        rows.append([
            f"{cell.scene}, {cell.variant}",
            *(number(record.extra.figures.get(f"{what}, {kind}gs"))
              for what in ("valid", "apart") for kind in ("2d", "3d")),
        ])  # fmt: skip
        shown = {
            "source": "source", "target": "target", "warped-2d": "2DGS", "valid-2d": "2DGS, valid",
            "warped-3d": "3DGS", "valid-3d": "3DGS, valid",
        }  # fmt: skip
        pictures.append((
            f"**{cell.scene}, {cell.variant}**",
            [Picture(f"{folder}/{name}.png", text) for name, text in shown.items()],
        ))  # fmt: skip
    columns = ["view", "valid, 2DGS", "valid, 3DGS", "apart, 2DGS", "apart, 3DGS"]
    text = [
        "The source's picture, warped into a target by the depth of both kinds of splats, under the"
        " rules of the preset `paper`. Black is not valid. **Apart** is the mean absolute"
        " difference to the target's picture where valid, of values in [0, 1]."
    ]
    return [Section("2DGS against 3DGS", text, [Table(columns, rows)], gallery=Gallery(pictures))]


def _variability(results: Results) -> list[Section]:
    """Spread between seeds."""
    rows, pictures = [], []
    for name in results.planned.loaded.manifest.variability:
        seeds = {cell.seed for cell, _ in results.edits(name)}
        if len(seeds) < 2:
            continue
        cells = [name, str(len(seeds))]
        for title in FIGURES.values():
            value = next((v for v in VERSIONS.values() if results.values(name, title, v)), None)
            values = {} if value is None else results.values(name, title, value)
            deviations = {scene: _deviations(by_edit) for scene, by_edit in values.items()}
            cells.append(spread(interval(deviations), len(deviations)))
        rows.append(cells)
        first = next(iter(results.planned.loaded.edits()))
        row = [
            Picture(
                f"{cell_folder(Path(), c.id).as_posix()}/renders/view-0000.png", f"seed {c.seed}"
            )
            for c, _ in results.edits(name)
            if (c.scene, c.spec["edit"]) == first
        ]
        pictures.append((f"**{name}, {first[0]}**", row))
    if not rows:
        return []
    text = ["Standard deviation between seeds of one edit, averaged over edits, then scenes."]
    table = Table(["method", "seeds", *FIGURES], rows)
    return [Section("Variability over seeds", text, [table], gallery=Gallery(pictures))]


def _deviations(values: Mapping[str, float]) -> list[float]:
    by_edit: dict[str, list[float]] = {}
    for key, value in values.items():
        by_edit.setdefault(key.rpartition("/")[0], []).append(value)
    return [float(np.std(v, ddof=1)) for v in by_edit.values() if len(v) > 1]


def _cost(results: Results) -> Section:
    """Seconds, memory and work of a method's cell, on average."""
    rows = []
    for name in results.rows:
        records = [record for _, record in results.edits(name)]
        if not records:
            continue

        def mean(value: Callable[[Any], float], records: Sequence[Any] = records) -> str:
            return number(float(np.mean([value(record) for record in records])))

        edited, views = (
            sorted({int(r.extra.counts[k]) for r in records}) for k in ("edited", "views")
        )
        rows.append([
            name, results.rows[name].editor, _range(edited), _range(views),
            mean(lambda r: r.extra.counts["network_rows"]),
            mean(lambda r: r.extra.counts["iterations"]),
            mean(lambda r: sum(r.extra.seconds.get(part, 0.0) for part in PARTS)),
            mean(lambda r: r.cost.peak_memory_mb / 1024), mean(lambda r: r.extra.gpu),
        ])  # fmt: skip
    timed = ("seconds", "memory, GiB", "GPU, GiB")
    columns = [
        "method", "editor", "views edited", "of views", "network rows", "iterations", *timed,
    ]  # fmt: skip
    text = [
        "Means of a cell. Methods edit different numbers of views: their figures are of renders of"
        " all views, but Edit PSNR is of edited ones. Memory is the process's at most."
    ]
    return Section("Cost by method", text, [Table(columns, rows, timed=timed)])


def _range(values: Sequence[int]) -> str:
    return str(values[0]) if values[0] == values[-1] else f"{values[0]} to {values[-1]}"


def _people(results: Results) -> Section:
    return Section(
        "Selection frequency",
        [
            f"`{PAGE}` asks people which edit they prefer, and `attnwarp-eval userstudy score`"
            " gives each method's selection frequency from the files that they save. The paper's"
            f" frequencies are {NOT_AT_HAND}."
        ],
    )


def asked_about(
    planned: Planned, edits: Iterable[Cell]
) -> dict[tuple[str, str, int], dict[str, Cell]]:
    """Cells of the first table that people choose between, by row: of one capture, edit, seed."""
    m = planned.loaded.manifest
    named = m.tables[0].rows if m.tables else list(m.methods)
    groups: dict[tuple[str, str, int], dict[str, Cell]] = {}
    for cell in edits:
        for name in set(named).intersection(cell.labels):
            groups.setdefault((cell.scene, cell.spec["edit"], cell.seed), {})[name] = cell
    return {key: cells for key, cells in groups.items() if len(cells) > 1}


def _ask_people(results: Results) -> Path | None:
    """Write the page that compares the rows of the first table; None where there is no pair."""
    from attnwarp_lab.userstudy.material import CAPTURED, read_items
    from attnwarp_lab.userstudy.page import Design, build_page

    folders = []
    groups = asked_about(results.planned, (cell for cell, _ in results.edits()))
    for (scene, edit, seed), cells in groups.items():
        folder = results.root / "asked" / f"{scene}-{edit}-{seed}"
        words = results.planned.loaded.manifest.captures[scene].edits[edit]
        data = {
            "words": {"instruction": words.instruction},
            "views": list(range(results.planned.checked.views[scene])),
            "originals": os.path.relpath(results.root / "originals" / scene, folder),
            "variants": {
                name: {"folder": os.path.relpath(cell_folder(results.root, cell.id), folder)}
                for name, cell in cells.items()
            },
        }
        text = json.dumps(data, indent=1) + "\n"
        write_atomic(folder / CAPTURED, text.encode())
        folders.append(folder)
    if not folders:
        return None
    try:
        items = read_items(folders, within=results.root)
        text = build_page(items, Design(), "Which edit do you prefer?")
    except InputError:  # views of different numbers
        return None
    write_atomic(results.root / PAGE, text.encode())
    return results.root / PAGE
