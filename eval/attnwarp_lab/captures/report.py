"""The table of a run on captures, beside published figures where available, and its pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from attnwarp.editing.small import say_foreign
from attnwarp_eval.canonical_json import write_json
from attnwarp_eval.document import write
from attnwarp_eval.document.model import Grid, Report, Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.statistics.intervals import over_scenes
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.record import Json, with_nan
from attnwarp_lab.captures.capture import ORIGINALS, ready
from attnwarp_lab.captures.cells import Run, picture_name
from attnwarp_lab.captures.manifest import FIGURES
from attnwarp_lab.userstudy.material import RESULTS

PICTURED = 4
"""Views of each edit side by side in the report, evenly spread; fewer with several edits, at least
one."""

Records = Sequence[tuple[Cell, Json]]


def write_report(run: Run, records: Records, missing: int, notes: Sequence[str]) -> list[Path]:
    """Write ``results.json`` and the report of finished cells; return their paths.

    ``results.json`` has no measured seconds, so that two runs can give the same bytes.

    Args:
        missing: number of the cells that are not finished.
        notes: sentences on omitted cells.
    """
    path = run.root / RESULTS
    write_json(path, results_json(run, records), sort_keys=False)
    return [path, *write.write_files(_report(run, records, missing, notes), run.root, "report")]


def results_json(run: Run, records: Records) -> Json:
    """Figures of every cell, in the order of the manifest."""
    captures = run.loaded.manifest.captures
    kept = ("folder", "figures", "counts", "cut")
    return {
        "title": run.loaded.manifest.title,
        "captures": {
            name: {
                "sha256": ready(run.loaded, name).content,
                "views": [camera.name for camera in ready(run.loaded, name).views.cameras],
                "originals": f"{ORIGINALS}/{name}",
                "edits": {title: edit.instruction for title, edit in part.edits.items()},
            }
            for name, part in captures.items()
        },
        "cells": [
            {
                "id": cell.id, "scene": cell.scene, "edit": cell.spec["edit"],
                "variants": list(cell.labels), "seed": cell.seed,
                **{key: record[key] for key in kept},
            }
            for cell, record in records
        ],
    }  # fmt: skip


def _report(run: Run, records: Records, missing: int, notes: Sequence[str]) -> Report:
    loaded = run.loaded
    m, edits = loaded.manifest, [*loaded.edits()]
    lead = [
        "Behind ± stands half of a 95 % interval over scenes; of fewer than six scenes the lowest"
        " and the highest are shown, from which nothing follows for others.",
        *(f"{note[0].upper()}{note[1:]}." for note in notes),
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
    if cut := sorted({n for cell, record in records if record["cut"] for n in cell.labels}):
        lead.append(f"**Did not finish within their budget: {', '.join(cut)}.**")
    if missing:
        lead.append(f"**{missing} cells are missing; the same command computes them.**")
    if bundled := [kind for kind in ("clip", "dino") if ":" not in loaded.encoder(kind)]:
        lead.append(
            f"**The encoders of {' and '.join(bundled)} are bundled ones, whose figures do not"
            " compare with published ones.**"
        )
    foreign = {say_foreign(loaded.editor(row.editor)) for row in m.variants.values()}
    lead += [f"{text}." for text in sorted(foreign - {""})]
    return Report(m.title, lead, [_figures(run, records), _pictures(run, records)])


def _figures(run: Run, records: Records) -> Section:
    """The table: the paper's figures and cost by variant."""
    variants = run.loaded.manifest.variants
    published = any(row.paper for row in variants.values())
    rows = []
    for name, variant in variants.items():
        own = [(cell, record) for cell, record in records if name in cell.labels]
        if not own:
            continue
        row = [name]
        for k, title in enumerate(FIGURES.values()):
            values: dict[str, dict[str, float]] = {}
            for cell, record in own:
                key = f"{cell.spec['edit']}/{cell.seed}"
                figure = with_nan(record["figures"]).get(title, float("nan"))
                values.setdefault(cell.scene, {})[key] = figure
            row.append(spread(over_scenes(values), len(values)))
            if published:
                row.append("–" if variant.paper is None else f"{variant.paper[k]:.3f}")
        edited, views = (_range([record["counts"][key] for _, record in own])
                         for key in ("edited", "views"))  # fmt: skip
        row += [
            f"{edited} of {views}",
            _mean(own, lambda record: record["counts"].get("network_rows", np.nan)),
            _mean(own, lambda record: sum(record["seconds"].values())),
        ]
        rows.append(row)
    figures = [c for head in FIGURES for c in ([head, f"{head}, paper"] if published else [head])]
    columns = ["variant", *figures, "views edited", "network rows", "seconds"]
    text = [
        "Higher is better. Edit PSNR is of edited views, all else of renders of all views; it also"
        " rewards a scene that hardly changes. Single-image similarities compare renders with the"
        " variant's own edit of the source view, and are missing where the method did not edit it."
        " Rows and seconds are means of a cell."
    ]
    return Section("Figures", text, [Table(columns, rows, timed=("seconds",))])


def _mean(records: Records, value: Callable[[Json], float]) -> str:
    return number(float(np.mean([value(record) for _, record in records])))


def _range(values: Sequence[int]) -> str:
    low, high = min(values), max(values)
    return str(low) if low == high else f"{low} to {high}"


def _pictures(run: Run, records: Records) -> Section:
    """Edited scenes side by side, for each edit's first seed, with links to each variant's page."""
    edits = [*run.loaded.edits()]
    grids, pages = [], []
    for scene, title in edits:
        names = [camera.name for camera in ready(run.loaded, scene).views.cameras]
        count = min(max(1, PICTURED // len(edits)), len(names))
        views = [k * len(names) // count for k in range(count)]
        folders: dict[str, str] = {"before": f"{ORIGINALS}/{scene}"}
        for cell, record in records:
            label = " = ".join(cell.labels)
            if (cell.scene, cell.spec["edit"]) == (scene, title) and label not in folders:
                folders[label] = f"{record['folder']}/renders"
                pages.append([f"{scene} / {title}", label, f"`{record['page'] or '–'}`"])
        rows = [
            (label, [f"{folder}/{picture_name(k)}" for k in views])
            for label, folder in folders.items()
        ]
        if len(rows) > 1:
            heads = [Path(names[k]).stem for k in views]  # folders would run into each other
            grids.append(Grid.of(f"{scene} / {title}", heads, rows))
    table = Table(["edit", "variant", "page"], pages, "The splats, and all else of a variant.",
                  folded=len(edits) > 1)  # fmt: skip
    return Section("Edited scenes", ["Renders of the tuned splats."], [table], grids=grids)
