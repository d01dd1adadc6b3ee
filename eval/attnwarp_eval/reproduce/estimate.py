"""Hours, disk and memory of a reproduction, from a few measured edits of each method."""

from __future__ import annotations

import gc
import json
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from attnwarp.methods import Budget
from attnwarp.reporting import Reporter
from attnwarp_eval.cost import peak_memory_mb, reset_peak_memory
from attnwarp_eval.reproduce.captures import ready
from attnwarp_eval.reproduce.cells import Job, Planned, editor_of
from attnwarp_eval.study.cell import Cell

STEPS = (1, 3)
"""Steps of denoising of the two pilots of a method: their difference is what a step takes."""

EDITS, ITERATIONS = 4, 8
"""Edits of a pilot, as far as its budget goes, and iterations of its tuning."""

EDITING = ("source", "warp", "edit")
"""Parts of a method's seconds that grow with its edits."""


@dataclass(frozen=True)
class Unit:
    """Measured costs of a method on one capture.

    Attributes:
        whole: seconds of a cell that edits nothing: renders, files, figures.
        edit: seconds of an edit with all its steps.
        iteration: seconds of one of tuning.
        edits, iterations, rounds: of a whole run on this capture.
        views: of the capture.
        files, state, picture: bytes of a cell that edits nothing, of a round's end, of an edit.
        memory: GiB of the process, with the features of all steps.
        gpu: GiB of a GPU; NaN without one.
    """

    whole: float
    edit: float
    iteration: float
    edits: int
    iterations: int
    rounds: int
    views: int
    files: float
    state: float
    picture: float
    memory: float
    gpu: float

    def seconds(self, views: int) -> float:
        """Seconds of a cell on a capture of so many views."""
        whole = self.whole * views / self.views
        return whole + self._edits(views) * self.edit + self.iterations * self.iteration

    def gigabytes(self, views: int) -> float:
        """Files of a cell on a capture of so many views."""
        files = self.files * views / self.views
        return (files + self.rounds * self.state + self._edits(views) * self.picture) / 1e9

    def _edits(self, views: int) -> float:
        """Methods that edit all views, or more than once, edit more of a larger capture."""
        return self.edits * views / self.views if self.edits >= self.views else self.edits


def estimate(
    planned: Planned, left: Sequence[Cell], devices: Sequence[str], report: Reporter
) -> Iterator[str]:
    """Lines about each method and about all cells that are left.

    A capture whose splats are not fitted yet is piloted with first splats.
    """
    views = planned.checked.views
    units: dict[str, Unit] = {}
    edits = [cell for cell in left if cell.spec["kind"] == "edit"]
    firsts = {cell.variant: cell for cell in reversed(edits)}
    with tempfile.TemporaryDirectory() as place:
        warm = True
        for name, cell in reversed(firsts.items()):
            report.log(f"measuring a few edits of {name}")
            folder = Path(place) / str(len(units))
            if warm:  # kernels, networks and caches that a first call waits for
                _pilot(planned, cell, folder / "warm", devices[0], steps=1)
                warm = False
            units[name] = _measured(planned, cell, folder, devices[0])
        fits = [
            (cell, _fit_seconds(planned, cell, devices[0]))
            for cell in left
            if cell.spec["kind"] == "fit"
        ]
    total = sum(seconds for _, seconds in fits)
    disk, hours = 0.0, total / 3600
    for name, unit in units.items():
        own = [cell for cell in edits if cell.variant == name]
        seconds = sum(unit.seconds(views[cell.scene]) for cell in own)
        gigabytes = sum(unit.gigabytes(views[cell.scene]) for cell in own)
        gpu = "" if math.isnan(unit.gpu) else f", {unit.gpu:.1f} GiB of the GPU"
        yield (
            f"{name}: {len(own)} cells, {seconds / 3600:.2g} hours, {gigabytes:.2g} GB,"
            f" {unit.memory:.1f} GiB of memory{gpu}"
        )
        total, disk = total + seconds, disk + gigabytes
    if fits:
        yield f"fits: {len(fits)}, {hours:.2g} hours while splats are as few as at the beginning"
    count = len(devices)
    yield (
        f"to do: {len(left)} cells, {total / 3600:.3g} hours of one device"
        f"{f', {total / 3600 / count:.3g} of {count}' if count > 1 else ''}, {disk:.2g} GB of disk"
    )


def _measured(planned: Planned, cell: Cell, folder: Path, device: str) -> Unit:
    """Costs of a cell's method from a run without edits and two short ones."""
    began = time.perf_counter()
    made, _ = _pilot(planned, cell, folder / "none", device, steps=STEPS[0], rows=0)
    whole = time.perf_counter() - began
    rounds = json.loads((made / "run" / "manifest.json").read_text())["rounds"]
    gc.collect()
    reset_peak_memory()
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats(device)
    (_, short), (last, long) = (
        _pilot(planned, cell, folder / str(steps), device, steps=steps) for steps in STEPS
    )
    memory = peak_memory_mb() / 1024
    settings = cell.spec["settings"]

    def edit_seconds(result: Any) -> float:
        spent = sum(result.seconds.get(part, 0.0) for part in EDITING)
        return float(spent / max(1, result.counters["edits"]))

    one, three = map(edit_seconds, (short, long))
    step = max(0.0, three - one) / (STEPS[1] - STEPS[0])
    tuned = [result.seconds.get("tune", 0.0) for result in (short, long)]
    iterations = sum(r.counters["iterations"] for r in (short, long))
    state = _bytes(last, (".pt", ".ply"))
    files = _bytes(made)
    features = long.counters.get("feature_bytes", 0) / STEPS[1] * settings["steps"] / 2**30
    return Unit(
        whole,
        one + step * (settings["steps"] - STEPS[0]),
        sum(tuned) / max(1, iterations),
        sum(len(part["views"]) for part in rounds),
        sum(part["iterations"] for part in rounds),
        len(rounds),
        planned.checked.views[cell.scene],
        files,
        state,
        max(0.0, _bytes(last) - state - files) / max(1, long.counters["edits"]),
        memory + features,
        math.nan if device == "cpu" else torch.cuda.max_memory_allocated(device) / 2**30,
    )


def _pilot(
    planned: Planned, cell: Cell, run: Path, device: str, *, steps: int, rows: int | None = None
) -> tuple[Path, Any]:
    """Folder and result of a short run of a method; of a whole cell where ``rows`` is 0."""
    settings = {**cell.spec["settings"], "steps": steps, "iterations": 0}
    if rows is None and cell.spec["settings"]["iterations"]:
        settings["iterations"] = ITERATIONS
    pilot = replace(cell, spec={**cell.spec, "settings": settings})
    loaded = planned.loaded
    row = loaded.manifest.methods[cell.variant]
    editor = editor_of(loaded.editor(row.editor), device)
    branches = 3  # at most; a budget that is too large by one edit is no harm
    limit = EDITS * branches * steps if rows is None else rows
    job = Job(loaded, run, device, pilot, budget=Budget(network_rows=limit), first_splats=True)
    if rows is None:
        return job.folder(), job.run_method(editor)[0]
    job.edit()
    return job.folder(), None


def _fit_seconds(planned: Planned, cell: Cell, device: str) -> float:
    """Seconds of a fit, from some iterations on its first splats."""
    from attnwarp.fit import FitSettings, first_splats, fit

    capture = ready(planned.loaded, cell.scene)
    settings = FitSettings.from_dict(cell.spec["settings"])
    start = first_splats(capture.dataset, capture.cameras, settings).to(device=device)
    short = settings.changed(iterations=2 * ITERATIONS, densify=False)
    fit(start, capture.views, short.changed(iterations=1))  # compiles
    return fit(start, capture.views, short).seconds / (2 * ITERATIONS) * settings.iterations


def _bytes(folder: Path, ends: Sequence[str] | None = None) -> float:
    return float(
        sum(
            path.stat().st_size
            for path in folder.rglob("*")
            if path.is_file() and (ends is None or path.suffix in ends)
        )
    )
