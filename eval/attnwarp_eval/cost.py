"""What a figure cost: seconds by stage, work counters, peak memory, and the machine it was measured
on.
"""

from __future__ import annotations

import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = (
    "attnwarp",
    "numpy",
    "torch",
    "numba",
    "open3d",
    "mitsuba",
    "scikit-image",
    "opencv-contrib-python-headless",
)


class Meter:
    """Seconds and counters of one cell.

    The method's own work is timed view by view: the first view pays for compilation and cold caches
    ("warm"), the others give the steady figure. Everything else (truth, splats, the checks
    themselves) is set-up and checking, and never mixed into what a method costs.
    """

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._stages: dict[str, float] = {}
        self._views: list[float] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside to stage ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._stages[name] = self._stages.get(name, 0.0) + time.perf_counter() - start

    @contextmanager
    def view(self) -> Iterator[None]:
        """Time the method's work for one view."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._views.append(time.perf_counter() - start)

    def count(self, **counters: int) -> None:
        """Add to the work counters, such as rays, pairs or taps."""
        self.counters.update({k: int(v) for k, v in counters.items()})

    def seconds(self) -> dict[str, float | None]:
        """Seconds by stage; ``warm`` is the first view's, ``steady`` the median of the others'
        (None without them).
        """
        steady = statistics.median(self._views[1:]) if len(self._views) > 1 else None
        warm = self._views[0] if self._views else None
        return {**self._stages, "warm": warm, "steady": steady, "method": sum(self._views)}


def peak_memory_mb() -> float:
    """Peak resident memory of this process so far, in MiB; earlier cells of the process are in
    it."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1024 if sys.platform != "darwin" else peak / 1024**2


@cache
def environment() -> dict[str, Any]:
    """Versions, machine and source revision: what a person needs to reproduce a figure."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return {
        "versions": versions,
        "machine": {
            "system": platform.system(),
            "arch": platform.machine(),
            "cores": len(os.sched_getaffinity(0)),
        },
        "git": _git(Path(__file__).resolve().parent),
    }


def _git(folder: Path) -> dict[str, Any]:
    def ask(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    # An installed copy may lie inside somebody else's repository, whose revision says nothing about
    # this code.
    if ask("ls-files", "--error-unmatch", str(Path(__file__).resolve())) is None:
        return {"sha": None, "dirty": None}
    sha = ask("rev-parse", "HEAD")
    status = ask("status", "--porcelain", "--untracked-files=no")
    return {"sha": sha, "dirty": bool(status) if status is not None else None}
