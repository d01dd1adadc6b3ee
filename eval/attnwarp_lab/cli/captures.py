"""The command that measures methods on captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import typer

from attnwarp.cli.options import Marking, MaxSizeOption, option, options_of
from attnwarp.cli.shell import fail
from attnwarp.errors import InputError
from attnwarp.reporting import reporter
from attnwarp_eval.cli.shell import TOO_LITTLE, clear_errors, resumable

ONE = "One capture"
"""Name of the help panel."""


@dataclass(frozen=True)
class One:
    """Options that define a manifest of one capture and one edit."""

    data: Annotated[
        Path | None,
        option(
            "Measure this capture: transforms.json, its folder, or one of COLMAP or BlendedMVS.",
            "DATA",
            panel=ONE,
        ),
    ] = None
    instruction: Annotated[
        str | None, option("Say what to change, for editors that take pictures.", panel=ONE)
    ] = None
    target_prompt: Annotated[
        str | None,
        option(
            "Say what the edited scene shows, for CLIP and editors that take depth maps.",
            panel=ONE,
        ),
    ] = None
    source_prompt: Annotated[
        str | None,
        option("Say what it shows before, for CLIP and methods that invert.", panel=ONE),
    ] = None
    ply: Annotated[
        Path | None, option("Edit these splats (default fitted).", "SPLATS", panel=ONE)
    ] = None
    max_size: MaxSizeOption = None

    @property
    def name(self) -> str:
        """Name of the capture: that of its folder."""
        path = Path(str(self.data)).resolve()
        return path.parent.name if path.suffix == ".json" else path.name

    def keys(self, marking: Marking) -> dict[str, Any] | None:
        """Keys of a manifest; None without a capture.

        Raises:
            InputError: an option that needs another one, or incompatible marks.
        """
        from attnwarp.io import read_ply

        if self.data is None:
            given = [f.name for part in (self, marking) for f in fields(part)
                     if getattr(part, f.name) != f.default]  # fmt: skip
            for name in given:
                option = {"words": "where"}.get(name, name.replace("_", "-"))
                raise InputError(f"--{option}: needs --data; a manifest says it by itself")
            return None
        if self.instruction is None:
            raise InputError(f"--data {self.data}: needs --instruction, such as 'make it golden'")
        marks = marking.marks()
        mask = {
            "folder": _place(marks.masks), "source": _place(marks.mask), "box": marks.box,
            "at": marks.at, "words": marks.words, "segmenter": marks.segmenter,
        }  # fmt: skip
        edit = {
            "instruction": self.instruction, "target": self.target_prompt,
            "source": self.source_prompt,
        }  # fmt: skip
        capture = {
            "data": _place(self.data), "source": marking.source,
            "mask": mask if marks.option else None,
            "splats": {read_ply(self.ply).kind: _place(self.ply)} if self.ply else {},
            "edits": {self.instruction: edit},
        }  # fmt: skip
        return {
            "title": f"Methods on {self.name}", "captures": {self.name: capture},
            "max_size": self.max_size,
        }  # fmt: skip


def _place(path: Path | None) -> str | None:
    return None if path is None else str(path.resolve())


@options_of(One, Marking)
def captures(
    manifest: Annotated[
        str | None,
        typer.Argument(
            help="A manifest's YAML, or one that ships: `paper`; with --data, `one` if left out.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path | None, option("The run's folder; in runs/captures if left out.")] = None,
    variant: Annotated[
        list[str] | None, option("Only this one of the manifest's; may be repeated.", "NAME")
    ] = None,
    editor: Annotated[
        list[str] | None,
        option(
            "In place of the editors of its kind, whose variants alone run; may be repeated.",
            "NAME|FOLDER|BASE,CONTROLNET",
        ),
    ] = None,
    device: Annotated[
        str, option("Where the networks run: cpu, cuda, or one of several, such as cuda:1.")
    ] = "cpu",
    dry_run: Annotated[
        bool,
        option("Check everything, count network rows, and run nothing.", None, "--dry-run"),
    ] = False,
    *,
    one: One,
    marking: Marking,
) -> None:
    """Edit captures by several methods, and measure what came out.

    MANIFEST names captures, edits and variants; --data and --instruction make one of one capture.
    Everything is checked before anything runs. Killed and started again, it goes on.
    """
    from attnwarp.devices import device_of
    from attnwarp.reporting import Part
    from attnwarp_eval.study.store import Store
    from attnwarp_lab.captures.cells import Run
    from attnwarp_lab.captures.manifest import load_manifest
    from attnwarp_lab.captures.report import write_report

    if manifest is None and one.data is None:
        raise fail("name a manifest, such as paper, or one capture: --data DIR --instruction TEXT")
    with clear_errors(), reporter(every=True) as report:
        loaded = load_manifest(manifest or "one", one.keys(marking))
        loaded = loaded.with_editors(editor) if editor else loaded
        loaded = loaded.only(variant) if variant else loaded
        device_of(device)
        named = one.name if one.data else Path(str(manifest)).stem
        store = Store(out or Path("runs/captures") / named)
        store.refuse_strangers("manifest")
        report.log("checking captures and weights")
        run = Run(loaded, store.root, device, report)
        cells, notes = run.plan()
        for note in notes:
            report.log(note)
        if dry_run:
            _count_rows(run, cells)
            return
        records, failures = [], []
        with store.lock(), resumable(lambda: f"{len(store.done())} cells are kept"):
            about = loaded.manifest.model_dump(mode="json")
            store.write_study({"manifest": about, "cells": [cell.id for cell in cells]})
            for number, cell in enumerate(cells):
                title = f"{cell.scene} / {cell.spec['edit']} / {cell.variant} / seed {cell.seed}"
                report.step(number, len(cells), title)
                record = store.whole(cell.id, dict)
                if record is None:
                    try:
                        computed = run.compute(cell, Part(report, number, len(cells)))
                    except Exception as error:  # the others are worth their hours
                        failures.append(f"{title}: {type(error).__name__}: {error}")
                        continue
                    store.write({"id": cell.id, "spec": cell.spec, **computed})
                    record = store.read(cell.id)
                records.append((cell, record))
            report.step(len(cells), len(cells), "done")
            paths = write_report(run, records, len(failures), notes)
        for path in paths:
            typer.echo(path)
    if failures:
        raise fail(
            f"{len(failures)} cells failed; the same command tries them again:"
            f" {'; '.join(failures)}",
            TOO_LITTLE,
        )


def _count_rows(run: Any, cells: Sequence[Any]) -> None:
    """Print the cells and network rows of each variant, and of all."""
    total, unknown = 0, 0
    by_variant: dict[str, list[int | None]] = {}
    for cell in cells:
        by_variant.setdefault(" = ".join(cell.labels), []).append(run.rows(cell))
    for variant, counts in by_variant.items():
        known = [rows for rows in counts if rows is not None]
        total, unknown = total + sum(known), unknown + len(counts) - len(known)
        rows = f"{sum(known):,} network rows" if known else "rows not told by its method"
        typer.echo(f"{variant}: {len(counts)} cells, {rows}")
    lacking = f", without those of {unknown} cells whose method does not tell them"
    typer.echo(f"all: {len(cells)} cells, {total:,} network rows{lacking if unknown else ''}")
