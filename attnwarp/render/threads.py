"""Threads for kernels that release the GIL.

These are Python threads, not numba's parallel loops. numba's "workqueue" layer aborts if two
threads enter it at once, its OpenMP layer aborts after a fork, and both multiply the time of
compilation. The threads here work from any thread of any process, forked or not.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch

from attnwarp.render.dispatch import machine_code

_lock = threading.Lock()
_pools: dict[int, ThreadPoolExecutor] = {}
"""Pools by the configured number of threads: a pool per number of jobs would keep separate
threads.
"""


def _forget() -> None:
    # A forked child inherits the pool's bookkeeping but none of its threads.
    global _lock
    _lock = threading.Lock()
    _pools.clear()


os.register_at_fork(after_in_child=_forget)


_chosen: int | None = None


def set_thread_count(threads: int | None) -> None:
    """Set the number of threads, independent of torch's setting; None restores torch's setting."""
    global _chosen
    if threads is not None and threads < 1:
        raise ValueError(f"threads: got {threads}, expected at least 1")
    _chosen = threads


def thread_count() -> int:
    """Return the number of threads: the chosen one, or else ``torch.set_num_threads``'s."""
    return _chosen or max(1, torch.get_num_threads())


def run_jobs(work: Callable[..., None], jobs: Sequence[tuple]) -> None:
    """Call work(*job) for every job, on up to :func:`thread_count` threads.

    Jobs must not write to the same memory, and each argument has the same type in all jobs.
    """
    if jobs:
        work = machine_code(work, jobs[0])
    count = thread_count()
    threads = min(count, len(jobs))
    if threads <= 1:
        for job in jobs:
            work(*job)
        return
    with _lock:
        if count not in _pools:
            _pools[count] = ThreadPoolExecutor(count - 1, thread_name_prefix="attnwarp-render")
        pool = _pools[count]
    pending = list(jobs)[::-1]

    def drain() -> None:
        while True:
            try:
                job = pending.pop()
            except IndexError:
                return
            work(*job)

    helpers = [pool.submit(drain) for _ in range(threads - 1)]
    drain()
    for helper in helpers:
        helper.result()


def ranges(length: int, size: int) -> list[tuple[int, int]]:
    """Split a range into (begin, end) pieces of ``size``, independent of the number of threads."""
    return [(begin, min(begin + size, length)) for begin in range(0, length, size)]
