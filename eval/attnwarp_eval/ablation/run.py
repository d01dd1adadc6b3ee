"""Run a study's cells: in this process, or on a local cluster of worker processes. Nothing finished is ever lost."""

from __future__ import annotations

import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp_eval.ablation.cell import Cell
from attnwarp_eval.ablation.store import Store
from attnwarp_eval.ablation.study import Study

if TYPE_CHECKING:
    from attnwarp_eval.scene import Scene


@dataclass
class Plan:
    """A resolved study: its scenes, its cells, and which of them are still to do."""

    study: Study
    scenes: dict[str, Scene]
    cells: list[Cell]
    todo: list[Cell]

    @property
    def reused(self) -> int:
        """Cells that an earlier run already finished."""
        return len(self.cells) - len(self.todo)


@dataclass
class Summary:
    """How a run ended."""

    expected: int
    reused: int
    computed: int = 0
    failures: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def complete(self) -> bool:
        """Whether every expected cell is there."""
        return not self.failures and self.reused + self.computed == self.expected


def plan(study: Study, store: Store) -> Plan:
    """Load the scenes, list the cells, and find out which are already in ``store``.

    Raises:
        InputError: something the study names cannot be used.
    """
    from attnwarp_eval.scene import load_scene

    scenes: dict[str, Scene] = {}
    for name in study.scenes:
        scenes[name] = load_scene(name)
    cells = study.cells(scenes)
    done = store.done()
    return Plan(study, scenes, cells, [c for c in cells if c.id not in done])


def expected(plan: Plan) -> dict[str, Any]:
    """What ``study.json`` keeps: the resolved study and the cells that a complete run has."""
    return {
        "study": plan.study.model_dump(mode="json"),
        "scenes": {name: {"hash": s.content_hash, "title": s.title} for name, s in plan.scenes.items()},
        "cells": [
            {
                "id": c.id,
                "title": c.title,
                "scene": c.scene,
                "variants": list(c.labels),
                "probe": c.probe,
                "seed": c.seed,
            }
            for c in plan.cells
        ],
    }


Listener = Callable[[str, dict[str, Any]], None]
"""Called with "start", "done" or "failed" and a dict with the cell's title (and the error)."""


def execute(
    plan: Plan, store: Store, *, jobs: int = 1, keep_going: bool = True, listen: Listener | None = None
) -> Summary:
    """Compute the cells that are still to do, writing each as soon as it is finished.

    Args:
        jobs: worker processes; 1 stays in this process. The numbers do not depend on it.
        keep_going: go on after a failed cell; else stop at the first.
        listen: told of every start and end.
    """
    tell = listen or (lambda event, info: None)
    start = time.perf_counter()
    store.write_study(expected(plan))
    summary = Summary(expected=len(plan.cells), reused=plan.reused)
    work = _here(plan, store, tell) if jobs == 1 else _cluster(plan, store, jobs, tell)
    for cell, error in work:
        if error is None:
            summary.computed += 1
            tell("done", {"title": cell.title})
            continue
        failure = {"title": cell.title, "scene": cell.scene, "variant": cell.variant, "probe": cell.probe, **error}
        store.write_failure(cell.id, failure)
        summary.failures.append(failure)
        tell("failed", failure)
        if not keep_going:
            break
    summary.seconds = time.perf_counter() - start
    return summary


Outcome = tuple[Cell, dict[str, str] | None]


def compute_and_write(cell: Cell, scene: str, root: str) -> dict[str, str] | None:
    """Compute one cell and write its record; return what went wrong, or None.

    The cell is written where it was computed, so a lost connection cannot lose a result. Every kind of error is
    turned into a row of the table of failed cells: one bad cell must not cost the others.
    """
    from attnwarp_eval.ablation.probes import compute

    try:
        Store(root).write(compute(cell, scene, Path(root)))
    except Exception as error:
        return describe(error)
    return None


def describe(error: BaseException) -> dict[str, str]:
    """An exception as plain text for the failure's file."""
    return {
        "error": f"{type(error).__name__}: {error}",
        "traceback": "".join(traceback.format_exception(error)),
    }


def _here(plan: Plan, store: Store, tell: Listener) -> Iterator[Outcome]:
    for cell in plan.todo:
        tell("start", {"title": cell.title})
        yield cell, compute_and_write(cell, cell.scene, str(store.root))


def _cluster(plan: Plan, store: Store, jobs: int, tell: Listener) -> Iterator[Outcome]:
    """A local dask cluster, one process a worker, at most one cell in flight per worker.

    A worker that dies takes only the cell it was at: that one is tried once more elsewhere, then reported.
    """
    import dask
    from distributed import Client, LocalCluster, as_completed

    threads = max(1, len(os.sched_getaffinity(0)) // jobs)
    root = str(store.root.resolve())
    # dask has workers give freed memory back at once; image-sized arrays then cost more page faults than arithmetic.
    keep_memory = {
        "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 30,
        "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 30,
    }
    settings = {
        **keep_memory,
        "distributed.scheduler.allowed-failures": 1,
        "distributed.worker.memory.terminate": False,
        "distributed.nanny.pre-spawn-environ.NUMBA_NUM_THREADS": threads,
        "distributed.nanny.pre-spawn-environ.OMP_NUM_THREADS": threads,
        "distributed.nanny.pre-spawn-environ.MKL_NUM_THREADS": threads,
    }
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=jobs, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
        ) as cluster,
        Client(cluster) as client,
    ):
        queue = _Queue(plan.todo)
        running: dict[Any, Cell] = {}
        pool = as_completed()

        def submit(scene: str | None) -> None:
            cell = queue.take(scene)
            if cell is not None:
                tell("start", {"title": cell.title})
                future = client.submit(compute_and_write, cell, cell.scene, root, pure=False)
                running[future.key] = cell
                pool.add(future)

        for _ in range(jobs):
            submit(None)
        for future in pool:
            cell = running.pop(future.key)
            error = describe(future.exception()) if future.status == "error" else future.result()
            yield cell, error
            submit(cell.scene)


class _Queue:
    """Cells by scene. A worker stays with the scene whose truth it has made, then helps where most is left."""

    def __init__(self, cells: list[Cell]) -> None:
        self.scenes: dict[str, deque[Cell]] = {}
        for cell in cells:
            self.scenes.setdefault(cell.scene, deque()).append(cell)
        self.started: set[str] = set()

    def take(self, scene: str | None) -> Cell | None:
        """The next cell for the worker that last computed one of ``scene``; None when nothing is left."""
        left = {name: cells for name, cells in self.scenes.items() if cells}
        if not left:
            return None
        if scene not in left:
            scene = max(left, key=lambda name: (name not in self.started, len(left[name])))
        self.started.add(scene)
        return left[scene].popleft()
