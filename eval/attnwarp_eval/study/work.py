"""Computation of one cell, in any process."""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import Any

import torch

from attnwarp.process import core_count
from attnwarp.render.threads import set_thread_count, thread_count
from attnwarp_eval.cost import Meter, environment, peak_memory_mb, reset_peak_memory
from attnwarp_eval.plugins import load_plugins
from attnwarp_eval.scene.base import silence_notices
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Probe, Work
from attnwarp_eval.study.record import Cost, Environment, Failure, Record
from attnwarp_eval.study.store import Store
from attnwarp_eval.world import changed, world


def compute(probe: Probe[Any], cell: Cell, root: Path, threads: int | None = None) -> Record[Any]:
    """Compute a cell.

    Args:
        root: the run's folder; pictures are saved below it.
        threads: threads of the renderer; by default every core available to this process.

    Raises:
        InputError: the scene's file has changed since the cell was planned.
    """
    load_plugins()  # a worker has only the data sent with the cell
    silence_notices()  # the run's plan reports them
    # Image-sized tensor operations gain little from threads and slow down when other processes need
    # the cores; the renderer's threads are set separately.
    torch.set_num_threads(1)
    set_thread_count(threads or core_count())
    meter = Meter()
    reset_peak_memory()
    scene_world = None
    if probe.needs_scenes:
        with meter.stage("setup"):
            scene_world = world(cell.scene_file, cell.spec["size"])
        if scene_world.content_hash != cell.spec["scene"]:
            raise changed(f"scene {cell.scene!r}")
    work = Work(cell, root, scene_world, meter)
    extra = probe.compute(work)
    _check_metrics(probe, work)
    return Record(
        cell.id,
        cell.spec,
        tuple(work.views),
        tuple(work.pictures),
        Cost(
            meter.seconds(),
            dict(sorted(meter.counters.items())),
            peak_memory_mb(),
            thread_count(),
        ),
        Environment.from_json(environment()),
        extra,
    )


def _check_metrics(probe: Probe[Any], work: Work) -> None:
    """Require a specification of every figure, which reports need."""
    for view in work.views:
        for key in view.metrics:
            try:
                probe.metric(key)
            except KeyError:
                raise LookupError(
                    f"probe {probe.name!r} gives {key!r}, which its metrics do not specify"
                ) from None


def compute_and_write(
    probe: Probe[Any], cell: Cell, root: str, threads: int | None = None
) -> Failure | None:
    """Compute one cell and write its record; return its failure, or None.

    The cell is written where it is computed, so a lost connection loses no result. Every error
    becomes a row of the table of failed cells: one bad cell must not cost the others.
    """
    try:
        Store(root).write(compute(probe, cell, Path(root), threads).to_json())
    except Exception as error:
        if _is_interrupt(error):
            raise KeyboardInterrupt from error
        return failure(cell, error)
    return None


def _is_interrupt(error: BaseException | None) -> bool:
    """Return True if an error began as Ctrl-C: native code interrupted by it raises its own error,
    such as "returned a result with an exception set".
    """
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, KeyboardInterrupt):
            return True
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return False


def failure(cell: Cell, error: BaseException) -> Failure:
    """Convert an exception to a row of the table of failed cells."""
    return Failure(
        cell.scene,
        cell.variant,
        cell.probe,
        f"{type(error).__name__}: {error}",
        cell.title,
        "".join(traceback.format_exception(error)),
        cell.id,
    )
