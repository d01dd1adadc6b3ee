"""Run a study's cells: in this process, or on a local cluster of worker processes. Nothing finished
is ever lost.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp.errors import InputError
from attnwarp_eval.cost import environment
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.store import Problems, Store, StoreError
from attnwarp_eval.study.study import Study, StudyError

if TYPE_CHECKING:
    from attnwarp_eval.scene.scene import Scene


@dataclass
class Plan:
    """A resolved study: its scenes, its cells, which are still to do, and how many were done by
    other code than this.
    """

    study: Study
    scenes: dict[str, Scene]
    cells: list[Cell]
    todo: list[Cell]
    other_code: int = 0

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
    from attnwarp_eval.scene.file import load_scene

    scenes: dict[str, Scene] = {}
    for name in study.scenes:
        scenes[name] = load_scene(name)
        for other, scene in scenes.items():
            if other != name and scene.content_hash == scenes[name].content_hash:
                raise StudyError(f"scenes: {other!r} and {name!r} are the same scene; name it once")
    cells = study.cells(scenes)
    done = store.done()
    finished: dict[str, dict[str, Any]] = {}
    for cell in cells:
        if cell.id in done:
            with contextlib.suppress(StoreError):  # a damaged record is computed again
                record = store.read(cell.id)
                if _has_pictures(cell, record, store):
                    finished[cell.id] = record
    here = environment()["git"]
    other_code = sum(record["environment"]["git"] != here for record in finished.values())
    return Plan(study, scenes, cells, [c for c in cells if c.id not in finished], other_code)


def _has_pictures(cell: Cell, record: dict[str, Any], store: Store) -> bool:
    """Whether the pictures that the study wants of a cell are there; what they show is no part of
    its id.
    """
    kept = [p for p in record.get("pictures", []) if (store.root / p["path"]).is_file()]
    return len(kept) == len(record.get("pictures", [])) and set(cell.pictures) <= {
        p["view"] for p in kept
    }


def verify(store: Store) -> Problems:
    """Recompute the hashes of a run's cells and pictures, and the list of expected cells from its
    study.

    Raises:
        InputError: the folder is no run, or a scene of it is gone.
    """
    kept = store.read_study()
    problems = store.verify()
    try:
        study = Study.model_validate(kept["study"])
        again = {c.id for c in plan(study, store).cells}
    except InputError as error:
        problems.damaged.append(f"the study's cells cannot be listed again: {error}")
        return problems
    if again != {c["id"] for c in kept["cells"]}:
        problems.damaged.append(
            "the study names other cells today: a scene or a protocol has changed since; run it"
            " again for the new ones"
        )
    return problems


def expected(plan: Plan) -> dict[str, Any]:
    """What ``study.json`` keeps: the resolved study and the cells that a complete run has."""
    return {
        "study": plan.study.model_dump(mode="json"),
        "scenes": {
            name: {"hash": s.content_hash, "title": s.title} for name, s in plan.scenes.items()
        },
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
    plan: Plan,
    store: Store,
    *,
    jobs: int = 1,
    keep_going: bool = True,
    listen: Listener | None = None,
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
        failure = {
            "title": cell.title,
            "scene": cell.scene,
            "variant": cell.variant,
            "probe": cell.probe,
            **error,
        }
        store.write_failure(cell.id, failure)
        summary.failures.append(failure)
        tell("failed", failure)
        if not keep_going:
            break
    summary.seconds = time.perf_counter() - start
    return summary


Outcome = tuple[Cell, dict[str, str] | None]


def compute_and_write(
    cell: Cell, scene: str, root: str, threads: int | None = None
) -> dict[str, str] | None:
    """Compute one cell and write its record; return what went wrong, or None.

    The cell is written where it was computed, so a lost connection cannot lose a result. Every kind
    of error is turned into a row of the table of failed cells: one bad cell must not cost the
    others.
    """
    from attnwarp_eval.study.work import compute

    try:
        Store(root).write(compute(cell, scene, Path(root), threads))
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

    A worker that dies takes only the cell it was at: that one is tried once more elsewhere, then
    reported.
    """
    import dask
    from distributed import Client, LocalCluster, as_completed

    threads = max(1, len(os.sched_getaffinity(0)) // jobs)
    root = str(store.root.resolve())
    # dask has workers give freed memory back at once; image-sized arrays then cost more page faults
    # than arithmetic.
    keep_memory = {
        "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 30,
        "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 30,
    }
    settings = {
        **keep_memory,
        "distributed.scheduler.allowed-failures": 1,
        "distributed.worker.memory.terminate": False,
        "distributed.nanny.pre-spawn-environ.OMP_NUM_THREADS": threads,
        "distributed.nanny.pre-spawn-environ.MKL_NUM_THREADS": threads,
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        with _deaf_to_interrupts():
            # No memory limit: near one dask pauses a worker for good, since a world's caches are
            # never given back.
            how = {
                "processes": True,
                "threads_per_worker": 1,
                "memory_limit": 0,
                "silence_logs": 50,
            }
            cluster = stack.enter_context(
                LocalCluster(n_workers=jobs, dashboard_address=None, **how)
            )
        client = stack.enter_context(Client(cluster))
        queue = _Queue(plan.todo)
        running: dict[Any, Cell] = {}
        pool = as_completed()

        def submit(scene: str | None) -> None:
            cell = queue.take(scene)
            if cell is not None:
                tell("start", {"title": cell.title})
                future = client.submit(
                    compute_and_write, cell, cell.scene, root, threads, pure=False
                )
                running[future.key] = cell
                pool.add(future)

        for _ in range(jobs):
            submit(None)
        for future in pool:
            cell = running.pop(future.key)
            error = describe(future.exception()) if future.status == "error" else future.result()
            yield cell, error
            submit(cell.scene)


@contextlib.contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Let worker processes that start inside ignore Ctrl-C: this process is the one to hear it, and
    it ends them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Queue:
    """Cells by scene. A worker stays with the scene whose truth it has made, then helps where most
    is left.
    """

    def __init__(self, cells: list[Cell]) -> None:
        self.scenes: dict[str, deque[Cell]] = {}
        for cell in cells:
            self.scenes.setdefault(cell.scene, deque()).append(cell)
        self.started: set[str] = set()

    def take(self, scene: str | None) -> Cell | None:
        """The next cell for the worker that last computed one of ``scene``; None when nothing is
        left.
        """
        left = {name: cells for name, cells in self.scenes.items() if cells}
        if not left:
            return None
        if scene not in left:
            scene = max(left, key=lambda name: (name not in self.started, len(left[name])))
        self.started.add(scene)
        return left[scene].popleft()
