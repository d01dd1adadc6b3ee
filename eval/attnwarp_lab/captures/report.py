"""Tables of a run on captures, next to published figures where available."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp.editing.small import say_foreign
from attnwarp.errors import InputError
from attnwarp_eval.canonical_json import without_nan, write_json
from attnwarp_eval.document import write
from attnwarp_eval.document.model import Gallery, Grid, Picture, Report, Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.files import write_atomic
from attnwarp_eval.statistics.contrasts import Contrast, contrast
from attnwarp_eval.statistics.intervals import benjamini_hochberg, interval, over_scenes
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.shared.method_run import PARTS
from attnwarp_eval.study.store import Store
from attnwarp_lab.captures.capture import ORIGINALS
from attnwarp_lab.captures.cells import Made, Planned, cell_folder, made_of, picture_name
from attnwarp_lab.captures.manifest import FIGURES, Row, TablePart, lacking
from attnwarp_lab.userstudy.material import RESULTS

NOT_AT_HAND = "not at hand"
"""Mark of an unknown published figure."""

NAME, ASKING = "report", "userstudy.html"
"""Files of the run's folder: the report without its suffix, and the page for the user study."""

PICTURED = 4
"""Views of each edit side by side in the report, evenly spread; fewer with several edits, at least
one."""

Value = Callable[[Made], Mapping[str, float]]

PUBLISHED = "with the encoders' published preprocessing"

VERSIONS: dict[str, Value] = {
    "as the paper's authors compute them": lambda made: made.authors or {},
    PUBLISHED: lambda made: made.figures,
}
"""Versions of the figures. Edit PSNR has a single version."""


@dataclass(frozen=True)
class Results:
    """Measurements of a run.

    Attributes:
        planned: its cells.
        root: its folder.
        records: finished cells with their records.
    """

    planned: Planned
    root: Path
    records: list[tuple[Cell, Any]]

    @property
    def rows(self) -> Mapping[str, Row]:
        """Variants of the manifest by name."""
        return self.planned.loaded.manifest.variants

    def edits(self, variant: str | None = None) -> Iterator[tuple[Cell, Any]]:
        """Edits, optionally of one variant only."""
        for cell, record in self.records:
            if cell.spec["kind"] == "edit" and (variant is None or variant in cell.labels):
                yield cell, record

    def values(self, variant: str, title: str, value: Value) -> dict[str, dict[str, float]]:
        """Scene -> edit and seed -> figure."""
        found: dict[str, dict[str, float]] = {}
        for cell, record in self.edits(variant):
            figures = (
                {**record.extra.figures} if title == FIGURES["Edit PSNR"] else value(record.extra)
            )
            if figures:
                key = f"{cell.spec['edit']}/{cell.seed}"
                found.setdefault(cell.scene, {})[key] = figures.get(title, math.nan)
        return found


def write_report(planned: Planned, store: Store) -> list[Path]:
    """Write ``results.json``, the report and the page of the user study; return their paths.

    ``results.json`` has no measured seconds, so that two runs can give the same bytes.
    """
    results = Results(planned, store.root, list(made_of(planned, store)))
    write_json(store.root / RESULTS, without_nan(results_json(results)), sort_keys=False)
    asking = _ask_people(results)
    return [store.root / RESULTS, *write.write_files(report(results), store.root, NAME), *asking]


def results_json(results: Results) -> dict[str, Any]:
    """Figures of every cell, in the order of the manifest."""
    checked, captures = results.planned.checked, results.planned.loaded.manifest.captures
    return {
        "title": results.planned.loaded.manifest.title,
        "weights": {k: {"sha256": sha, "probe": p} for k, (sha, p) in checked.weights.items()},
        "captures": {
            name: {
                "sha256": sha, "views": checked.views[name], "originals": f"{ORIGINALS}/{name}",
                "edits": {title: edit.instruction for title, edit in captures[name].edits.items()},
            }
            for name, sha in checked.captures.items()
        },
        "cells": [
            {
                "id": cell.id, "kind": cell.spec["kind"], "scene": cell.scene,
                "edit": cell.spec.get("edit"), "variants": list(cell.labels), "seed": cell.seed,
                "folder": _folder(cell), "figures": dict(record.extra.figures),
                "authors": dict(record.extra.authors), "counts": dict(record.extra.counts),
                "cut": record.extra.cut, "files": list(record.extra.files),
            }
            for cell, record in results.records
        ],
    }  # fmt: skip


def _folder(cell: Cell) -> str:
    return cell_folder(Path(), cell.id).as_posix()


def report(results: Results) -> Report:
    """Report of the run."""
    loaded = results.planned.loaded
    m, edits = loaded.manifest, [*loaded.edits()]
    size = f"{m.size} px" if m.size else "each editor's own size"
    lead = [
        f"{_count(len(m.captures), 'scene')}, {_count(len(edits), 'edit')}, {size}. Behind ± stands"
        " half of a 95 % interval over scenes; of fewer than six scenes the lowest and the highest"
        " are shown, from which nothing follows for others.",
        *(f"{note[0].upper()}{note[1:]}." for note in results.planned.notes),
    ]
    ours = [
        f"{scene} / {name}: {', '.join(given)}"
        for scene, name in edits
        if (given := m.captures[scene].edits[name].ours)
    ]
    if ours:
        lead.append(f"Prompts that were not published and are this manifest's: {'; '.join(ours)}.")
    for key, figure in (("target", "CLIP similarity"), ("source", "CLIP directional similarity")):
        if any(getattr(m.captures[scene].edits[name], key) is None for scene, name in edits):
            lead.append(f"Edits without words for `{key}` have no {figure}.")
    if cut := sorted({n for cell, r in results.edits() if r.extra.cut for n in cell.labels}):
        lead.append(f"**Did not finish within their budget: {', '.join(cut)}.**")
    if unknown := lacking(m):
        lead.append(
            f"**Which checkpoint {', '.join(unknown)} held was not checked**: the manifest has no"
            " probe value of the published weights, so others of the same shapes pass."
        )
    if missing := len(results.planned.cells) - len(results.records):
        lead.append(
            f"**{missing} of {len(results.planned.cells)} cells are missing; the same command"
            " computes them.**"
        )
    bundled = [k for k in ("clip", "dino") if ":" not in loaded.encoder(k)]
    if bundled:
        lead.append(
            f"**The encoders of {' and '.join(bundled)} are bundled ones, whose figures do not"
            " compare with published ones.**"
        )
    foreign = {say_foreign(loaded.editor(row.editor)) for row in m.variants.values()}
    lead += [f"{text}." for text in sorted(foreign - {""})]
    sections = [_table(results, table) for table in loaded.tables()]
    sections += [_pictures(results), *_geometry(results), *_variability(results), _cost(results)]
    if (results.root / ASKING).is_file():
        sections.append(_people())
    return Report(m.title, lead, sections)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _table(results: Results, table: TablePart) -> Section:
    """A table: the paper's figures in both versions, all others, and verdicts on its orderings."""
    tables: list[Table] = []
    for version, value in VERSIONS.items():
        if any(value(record.extra) for _, record in results.edits()):
            tables += _figures(results, table, f"Figures {version}.", FIGURES, value, bool(tables))
    measured = dict.fromkeys(t for _, record in results.edits() for t in record.extra.figures)
    others = {title: title for title in measured if title not in FIGURES.values()}
    tables += _figures(results, table, "Other figures.", others, VERSIONS[PUBLISHED], True)
    text = [
        "Higher is better, but of distances. Edit PSNR also rewards a scene that hardly changes."
    ]
    lost = [
        name for name in table.rows
        if any(math.isnan(r.extra.figures.get(FIGURES["DINO img"], math.nan))
               for _, r in results.edits(name))
    ]  # fmt: skip
    if lost:
        text.append(
            "Single-image similarities compare renders with the variant's own edit of the source"
            f" view. Of {', '.join(lost)} some cells have none, as the method did not edit it."
        )
    if table.against is not None and (verdicts := _verdicts(results, table)) is not None:
        tables.append(verdicts)
        text.append(
            "Orderings are paired over scenes, edits and seeds, and tested by sign flips over"
            " scenes, adjusted for all rows together (Benjamini-Hochberg). Below six scenes there"
            " is no verdict."
        )
    return Section(table.title, text, tables)


def _figures(
    results: Results, table: TablePart, caption: str, titles: Mapping[str, str], value: Value,
    folded: bool,
) -> Iterator[Table]:  # fmt: skip
    """A table of figures, with published ones if a row has some; none without values."""
    published = titles is FIGURES and any(results.rows[name].paper for name in table.rows)
    rows, found = [], False
    planned = {name for cell in results.planned.edits for name in cell.labels}
    for name in filter(planned.__contains__, table.rows):
        row, paper = [name], results.rows[name].paper
        for k, title in enumerate(titles.values()):
            values = results.values(name, title, value)
            row.append(spread(over_scenes(values), len(values)))
            found |= row[-1] != "–"
            if published:
                row.append(NOT_AT_HAND if paper is None else f"{paper[k]:.3f}")
        rows.append(row)
    heads = [c for head in titles for c in ([head, f"{head}, paper"] if published else [head])]
    if found:
        yield Table(["variant", *heads], rows, caption, folded=folded)


def _pictures(results: Results) -> Section:
    """Edited scenes side by side, for each edit's first seed, with links to each variant's page."""
    edits, checked = [*results.planned.loaded.edits()], results.planned.checked
    grids, pages = [], []
    for scene, title in edits:
        names = checked.views[scene]
        count = min(max(1, PICTURED // len(edits)), len(names))
        views = [k * len(names) // count for k in range(count)]
        folders = {"before": f"{ORIGINALS}/{scene}"}
        for cell, record in results.edits():
            label = " = ".join(cell.labels)
            if (cell.scene, cell.spec["edit"]) == (scene, title) and label not in folders:
                folders[label] = f"{_folder(cell)}/renders"
                pages.append([f"{scene} / {title}", label, f"`{record.extra.page or '–'}`"])
        rows: list[tuple[str, list[Picture | None]]] = [
            (label, [Picture(f"{folder}/{picture_name(k)}", f"{label}, {names[k]}") for k in views])
            for label, folder in folders.items()
        ]
        if len(rows) > 1:
            heads = [Path(names[k]).stem for k in views]  # folders would run into each other
            grids.append(Grid(f"{scene} / {title}", heads, rows))
    table = Table(["edit", "variant", "page"], pages, "The splats, and all else of a variant.",
                  folded=len(edits) > 1)  # fmt: skip
    return Section("Edited scenes", ["Renders of the tuned splats."], [table], grids=grids)


def _verdicts(results: Results, table: TablePart) -> Table | None:
    """Each ordering of rows in the paper, with this run's verdict."""
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
    """Mean of a contrast with its interval over scenes, if there are enough."""
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
        folder = _folder(cell)
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
    """Spread between seeds of the variants that have several."""
    rows, pictures = [], []
    first = next(iter(results.planned.loaded.edits()))
    for name in results.rows:
        seeds = {cell.seed for cell, _ in results.edits(name)}
        if len(seeds) < 2:
            continue
        row = [name, str(len(seeds))]
        for title in FIGURES.values():
            value = next((v for v in VERSIONS.values() if results.values(name, title, v)), None)
            values = {} if value is None else results.values(name, title, value)
            deviations = {scene: _deviations(by_edit) for scene, by_edit in values.items()}
            row.append(spread(interval(deviations), len(deviations)))
        rows.append(row)
        shown = [
            Picture(f"{_folder(c)}/renders/{picture_name(0)}", f"seed {c.seed}")
            for c, _ in results.edits(name)
            if (c.scene, c.spec["edit"]) == first
        ]
        pictures.append((f"**{name}, {first[0]}**", shown))
    if not rows:
        return []
    text = ["Standard deviation between seeds of one edit, averaged over edits, then scenes."]
    table = Table(["variant", "seeds", *FIGURES], rows)
    return [Section("Variability over seeds", text, [table], gallery=Gallery(pictures))]


def _deviations(values: Mapping[str, float]) -> list[float]:
    by_edit: dict[str, list[float]] = {}
    for key, value in values.items():
        by_edit.setdefault(key.rpartition("/")[0], []).append(value)
    return [float(np.std(v, ddof=1)) for v in by_edit.values() if len(v) > 1]


def _cost(results: Results) -> Section:
    """Seconds, memory and work of a variant's cell, on average."""
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
        "variant", "editor", "views edited", "of views", "network rows", "iterations", *timed,
    ]  # fmt: skip
    text = [
        "Means of a cell. Variants edit different numbers of views: their figures are of renders of"
        " all views, but Edit PSNR is of edited ones. Memory is the process's at most."
    ]
    return Section("Cost by variant", text, [Table(columns, rows, timed=timed)])


def _range(values: Sequence[int]) -> str:
    return str(values[0]) if values[0] == values[-1] else f"{values[0]} to {values[-1]}"


def _people() -> Section:
    text = (
        f"`{ASKING}` asks people which edit they prefer, and `attnwarp-eval userstudy score` gives"
        " each variant's selection frequency from the files that they save. The paper's frequencies"
        f" are {NOT_AT_HAND}."
    )
    return Section("Selection frequency", [text])


def _ask_people(results: Results) -> list[Path]:
    """Write the page that compares the rows of the first table, if there is a pair."""
    from attnwarp_lab.userstudy.material import read_items
    from attnwarp_lab.userstudy.page import Design, build_page

    path = results.root / ASKING
    path.unlink(missing_ok=True)
    rows = [row for row in results.planned.loaded.tables()[0].rows if any(results.edits(row))]
    try:
        text = build_page(read_items([results.root], rows), Design(), "Which edit do you prefer?")
    except InputError:  # no pair, or views of different numbers
        return []
    write_atomic(path, text.encode())
    return [path]
