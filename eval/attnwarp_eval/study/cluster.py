"""Cells on a local cluster of worker processes (dask)."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probes import probe
from attnwarp_eval.study.record import Failure
from attnwarp_eval.study.work import compute_and_write, failure


def run_on_workers(
    cells: list[Cell], root: Path, jobs: int, started: Callable[[Cell], None]
) -> Iterator[tuple[Cell, Failure | None]]:
    """Compute and write cells, one process a worker, at most one cell in flight per worker.

    A worker that dies takes only the cell it was at: that one is tried once more elsewhere, then
    reported.

    Args:
        cells: what to compute.
        root: the run's folder.
        jobs: number of workers.
        started: called with each cell as it is handed out.

    Yields:
        Each cell as it ends, with what went wrong.
    """
    import dask
    from distributed import Client, LocalCluster, as_completed

    threads = max(1, len(os.sched_getaffinity(0)) // jobs)
    # dask has workers give freed memory back at once; image-sized arrays then cost more page faults
    # than arithmetic.
    memory = {
        "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 30,
        "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 30,
    }
    settings = {
        **memory,
        "distributed.scheduler.allowed-failures": 1,
        "distributed.worker.memory.terminate": False,
        "distributed.nanny.pre-spawn-environ.OMP_NUM_THREADS": threads,
        "distributed.nanny.pre-spawn-environ.MKL_NUM_THREADS": threads,
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        with _signals_wait():
            cluster = stack.enter_context(
                # No memory limit: near one dask pauses a worker for good, since a world's caches
                # are never given back.
                LocalCluster(
                    n_workers=jobs,
                    processes=True,
                    threads_per_worker=1,
                    memory_limit=0,
                    silence_logs=50,
                    dashboard_address=None,
                )
            )
        client = stack.enter_context(Client(cluster))
        queue = _Queue(cells)
        running: dict[Any, Cell] = {}
        pool = as_completed()

        def submit(scene: str | None) -> None:
            cell = queue.take(scene)
            if cell is not None:
                started(cell)
                # The probe travels with its cell, so that a worker needs no registration.
                future = client.submit(
                    compute_and_write,
                    probe(cell.probe),
                    cell,
                    str(root.resolve()),
                    threads,
                    pure=False,
                )
                running[future.key] = cell
                pool.add(future)

        for _ in range(jobs):
            submit(None)
        for future in pool:
            cell = running.pop(future.key)
            if future.status == "error":
                yield cell, failure(cell, future.exception())
            else:
                yield cell, future.result()
            submit(cell.scene)


@contextlib.contextmanager
def _signals_wait() -> Iterator[None]:
    """Worker processes that start inside ignore Ctrl-C: this process receives it and ends them.

    A polite kill waits until they run: dask cannot end a cluster that has started by half, and
    would leave its workers behind.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    killed: list[int] = []
    interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)
    terminate = signal.signal(signal.SIGTERM, lambda number, frame: killed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, interrupt)
        signal.signal(signal.SIGTERM, terminate)
        if killed:  # in place of dask's error where the workers received the signal too
            signal.raise_signal(signal.SIGTERM)


class _Queue:
    """Cells by scene. A worker stays with the scene whose truth it has computed, then helps where
    most is left.
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
