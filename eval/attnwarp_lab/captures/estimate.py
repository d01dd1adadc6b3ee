"""Hours, disk and memory of a run on captures, from a few measured edits of each variant."""

from __future__ import annotations

import gc
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from attnwarp.methods import METHODS, Budget
from attnwarp.reporting import Reporter
from attnwarp_eval.cost import peak_memory_mb, reset_peak_memory
from attnwarp_eval.study.cell import Cell
from attnwarp_lab.captures.capture import ready
from attnwarp_lab.captures.cells import Job, Made, Planned

STEPS = (1, 3)
"""Denoising steps of a method's two pilots: their difference gives the cost of a step."""

EDITS, BRANCHES, ITERATIONS = 8, 3, 8
"""Edits of a pilot, limited by a budget for its branches, and iterations of its tuning."""

EDITING = ("source", "warp", "edit", "write")
"""Parts of a method's seconds that grow with its edits."""


@dataclass(frozen=True)
class Unit:
    """Measured costs of a method on one capture.

    Attributes:
        whole: seconds of a cell besides edits and tuning: renders, files, figures.
        edit: seconds of an edit with all its steps.
        iteration: seconds of a tuning iteration.
        rows, edits, iterations, rounds: rows, edits, iterations and rounds of a whole run on this
            capture; rows through the UNet.
        views: views of the capture.
        files, state, picture: bytes of a cell's other files, including the capture's pictures; of a
            round's end; of an edit.
        memory: GiB of the process, with the features of all steps.
        gpu: GiB of a GPU; NaN without one.
    """

    whole: float
    edit: float
    iteration: float
    rows: int
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
        """Seconds of a cell on a capture of ``views`` views."""
        whole = self.whole * views / self.views
        return whole + self._edits(views) * self.edit + self.iterations * self.iteration

    def network_rows(self, views: int) -> float:
        """Rows through the UNet of a cell on a capture of ``views`` views."""
        return self.rows * self._edits(views) / self.edits

    def gigabytes(self, views: int) -> float:
        """Gigabytes of a cell's files on a capture of ``views`` views."""
        files = self.files * views / self.views
        return (files + self.rounds * self.state + self._edits(views) * self.picture) / 1e9

    def _edits(self, views: int) -> float:
        """Edits of a cell; some methods edit more in a larger capture."""
        return self.edits * views / self.views if self.edits >= self.views else self.edits


def estimate(
    planned: Planned, left: Sequence[Cell], devices: Sequence[str], report: Reporter
) -> Iterator[str]:
    """Yield lines about each method and about all cells to do.

    A capture whose splats are not fitted yet is piloted with first splats.
    """
    views = {name: len(views) for name, views in planned.checked.views.items()}
    units: dict[str, Unit] = {}
    every = [cell for cell in left if cell.spec["kind"] == "edit"]
    edits = [cell for cell in every if cell.spec["method"] in METHODS]
    firsts = {cell.variant: cell for cell in reversed(edits)}
    with tempfile.TemporaryDirectory() as place:
        warm = True
        for name, cell in reversed(firsts.items()):
            report.log(f"measuring a few edits of {name}")
            folder = Path(place) / str(len(units))
            if warm:  # warm up kernels, networks and caches
                _pilot(planned, cell, folder / "warm", devices[0], STEPS[0])
                warm = False
            units[name] = _measured(planned, cell, folder, devices[0])
        fits = [
            _fit_cost(planned, cell, Path(place) / f"fit-{number}", devices[0])
            for number, cell in enumerate(left)
            if cell.spec["kind"] == "fit"
        ]
    total, disk = (sum(costs) for costs in zip((0.0, 0.0), *fits, strict=True))
    hours, fitted = total / 3600, disk
    for name, unit in units.items():
        own = [cell for cell in edits if cell.variant == name]
        seconds = sum(unit.seconds(views[cell.scene]) for cell in own)
        gigabytes = sum(unit.gigabytes(views[cell.scene]) for cell in own)
        rows = sum(unit.network_rows(views[cell.scene]) for cell in own)
        gpu = "" if math.isnan(unit.gpu) else f", {unit.gpu:.1f} GiB of the GPU"
        yield (
            f"{name}: {len(own)} cells, {rows:,.0f} network rows, {seconds / 3600:.2g} hours,"
            f" {gigabytes:.2g} GB, {unit.memory:.1f} GiB of memory{gpu}"
        )
        total, disk = total + seconds, disk + gigabytes
    if fits:
        yield (
            f"fits: {len(fits)}, {hours:.2g} hours, {fitted:.2g} GB while splats are as few as at"
            " the beginning"
        )
    if len(edits) < len(every):
        yield f"{len(every) - len(edits)} cells of methods from outside: not foreseen"
    count = len(devices)
    yield (
        f"to do: {len(left)} cells, {total / 3600:.3g} hours of one device"
        f"{f', {total / 3600 / count:.3g} of {count}' if count > 1 else ''}, {disk:.2g} GB of disk"
    )


def _measured(planned: Planned, cell: Cell, folder: Path, device: str) -> Unit:
    """Costs of a cell's method from its plan and two short cells."""
    plan = _job(planned, cell, folder / "plan", device, 0)
    rounds = plan.run_method()[0].rounds
    gc.collect()
    reset_peak_memory()
    (short, _, whole), (long, last, _) = (
        _pilot(planned, cell, folder / str(steps), device, steps) for steps in STEPS
    )
    one, three = (_spent(made, EDITING) / made.counts["edits"] for made in (short, long))
    step = max(0.0, three - one) / (STEPS[1] - STEPS[0])
    tuned = sum(_spent(made, ("tune",)) for made in (short, long))
    steps, edits = cell.spec["settings"]["steps"], long.counts["edits"]
    views = len(planned.checked.views[cell.scene])
    state, pictures = _bytes(last, (".pt", ".ply")), _bytes(last / "run" / "rounds", (".png",))
    features = long.counts.get("feature_bytes", 0) / STEPS[1] * steps / 2**30
    return Unit(
        whole,
        one + step * (steps - STEPS[0]),
        tuned / max(1, sum(made.counts["iterations"] for made in (short, long))),
        sum(part.rows for part in rounds),
        sum(len(part.views) for part in rounds),
        sum(part.iterations for part in rounds),
        len(rounds),
        views,
        _bytes(last.parents[1]) - state - 3 * pictures,
        state,
        3 * pictures / edits,
        peak_memory_mb() / 1024 + features,
        math.nan if device == "cpu" else max(short.gpu, long.gpu),
    )


def _job(planned: Planned, cell: Cell, run: Path, device: str, rows: int) -> Job:
    budget = Budget(network_rows=rows)
    return Job(planned.loaded, run, device, cell, budget=budget, first_splats=True)


def _pilot(
    planned: Planned, cell: Cell, run: Path, device: str, steps: int
) -> tuple[Made, Path, float]:
    """Result and folder of a short cell, and its seconds without edits and tuning."""
    settings = {**cell.spec["settings"], "steps": steps}
    settings["iterations"] = min(ITERATIONS, settings["iterations"])
    pilot = replace(cell, spec={**cell.spec, "settings": settings})
    rows = EDITS * BRANCHES * steps
    while True:  # a method whose first batch is larger than the budget edits nothing
        job = _job(planned, pilot, run / str(rows), device, rows)
        began = time.perf_counter()
        made = job.edit()
        if made.counts["edits"]:
            seconds = time.perf_counter() - began - _spent(made, (*EDITING, "tune"))
            return made, job.folder(), seconds
        rows *= 2


def _spent(made: Made, parts: Sequence[str]) -> float:
    return sum(made.seconds.get(part, 0.0) for part in parts)


def _fit_cost(planned: Planned, cell: Cell, folder: Path, device: str) -> tuple[float, float]:
    """Seconds and GB of a fit, from some iterations on its first splats."""
    from attnwarp.fit import FitSettings, first_splats, fit

    capture = ready(planned.loaded, cell.scene)
    settings = FitSettings.from_dict(cell.spec["settings"])
    start = first_splats(capture.dataset, capture.cameras, settings).to(device=device)
    short = settings.changed(iterations=2 * ITERATIONS, densify=False)
    fit(start, capture.views, short.changed(iterations=1))  # compiles
    seconds = fit(start, capture.views, short, folder=folder).seconds / (2 * ITERATIONS)
    return seconds * settings.iterations, _bytes(folder) / 1e9


def _bytes(folder: Path, ends: Sequence[str] | None = None) -> float:
    return float(
        sum(
            path.stat().st_size
            for path in folder.rglob("*")
            if path.is_file() and (ends is None or path.suffix in ends)
        )
    )
