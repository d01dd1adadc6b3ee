"""Cost of a figure: seconds by stage, work counters, peak memory, and the machine."""

from __future__ import annotations

import hashlib
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

import attnwarp
from attnwarp.process import core_count

T = TypeVar("T")

PACKAGES = (
    "attnwarp",
    "numpy",
    "scipy",
    "torch",
    "numba",
    "open3d",
    "mitsuba",
    "scikit-image",
    "opencv-contrib-python-headless",
    "diffusers",
    "transformers",
    "tokenizers",
)
"""Packages that figures depend on, besides the source."""


class Meter:
    """Seconds and counters of one cell.

    The method's work is timed view by view: the first view pays for compilation and cold caches
    ("warm"), the others give the steady figure. Everything else (truth, splats, checks) is set-up
    and checking, and never part of a method's cost.
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
            self.add(name, time.perf_counter() - start)

    def add(self, name: str, seconds: float) -> None:
        """Add externally measured seconds to stage ``name``."""
        self._stages[name] = self._stages.get(name, 0.0) + seconds

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
        """Seconds by stage; ``warm``: the first view, ``steady``: median of others, or None."""
        steady = statistics.median(self._views[1:]) if len(self._views) > 1 else None
        warm = self._views[0] if self._views else None
        return {**self._stages, "warm": warm, "steady": steady, "method": sum(self._views)}


@dataclass(frozen=True)
class Turns(Generic[T]):
    """Results and seconds of contestants that ran in turn.

    Attributes:
        results: contestant -> round -> returned value.
        seconds: contestant -> round -> wall seconds.
        cpu: contestant -> round -> seconds of all of this process's threads together.
        again: round -> wall seconds of the first contestant's second run.
    """

    results: list[list[T]]
    seconds: list[list[float]]
    cpu: list[list[float]]
    again: list[float]


AGAIN = 10_000
"""Offset of the round number for the first contestant's second run, so that its noise differs.
"""


def in_turn(
    contestants: Sequence[Callable[[int], T]],
    rounds: int,
    *,
    seed: int = 0,
    before: Callable[[int], None] = lambda _: None,
) -> Turns[T]:
    """Time contestants round by round in one process, each round in a random order.

    The speed of a machine drifts. Contestants of one round see the same machine, so the ratio of
    two within a round is reliable where two separate means are not. The first contestant runs
    twice a round: its ratio to itself is the effect of noise alone on this machine. An extra
    first round compiles and fills caches; it is discarded.

    Args:
        contestants: at least one; called with the number of the round, from 1.
        before: untimed callback with the index of the next contestant.

    >>> turns = in_turn([lambda turn: "a", lambda turn: "b"], rounds=3)
    >>> turns.results
    [['a', 'a', 'a'], ['b', 'b', 'b']]
    >>> len(turns.seconds[1]), len(turns.again)
    (3, 3)
    """
    count = len(contestants)
    rng = np.random.default_rng(seed)
    results: list[list[T]] = [[] for _ in contestants]
    seconds: list[list[float]] = [[] for _ in range(count + 1)]
    cpu: list[list[float]] = [[] for _ in range(count + 1)]
    for turn in range(rounds + 1):
        for place in rng.permutation(count + 1):
            index, again = int(place) % count, place == count
            before(index)
            start, start_cpu = time.perf_counter(), time.process_time()
            result = contestants[index](turn + AGAIN if again else turn)
            taken, taken_cpu = time.perf_counter() - start, time.process_time() - start_cpu
            if turn:
                seconds[place].append(taken)
                cpu[place].append(taken_cpu)
                if not again:
                    results[index].append(result)
    return Turns(results, seconds[:count], cpu[:count], seconds[count])


def reset_peak_memory() -> None:
    """Count this process's peak memory from now on, if the system can (Linux).

    Memory that was freed and kept for later use still counts.
    """
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_mb() -> float:
    """Peak resident memory of this process in MiB, since :func:`reset_peak_memory` on Linux."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1024 if sys.platform != "darwin" else peak / 1024**2


@cache
def environment() -> dict[str, Any]:
    """Versions, machine and source revision: all that is needed to reproduce a figure."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        versions[name] = "not installed"
        for package in (name, f"{name}-cpu"):  # the build of Open3D without CUDA
            with suppress(metadata.PackageNotFoundError):
                versions[name] = metadata.version(package)
    return {
        "versions": versions,
        "machine": {
            "system": platform.system(),
            "arch": platform.machine(),
            "cores": core_count(),
        },
        "git": _git(Path(__file__).resolve().parent),
        "source": source_hash(),
    }


_plugins: dict[str, str] = {}
"""SHA-256 of the source of each plugin as it was imported."""


def count_plugin(module: str, file: Path) -> None:
    """Include a plugin's source, all files of a package, in the hash of the code."""
    whole = file.name == "__init__.py"
    _plugins[module] = _hash_of(file.parent, file.parent.rglob("*.py") if whole else [file])
    source_hash.cache_clear()
    environment.cache_clear()


@cache
def source_hash() -> str:
    """SHA-256 of every source file of both packages, and of the plugins that are loaded.

    A revision is not enough: an installed copy has none, and a checkout may have local changes.
    """
    packages = [Path(attnwarp.__file__).parent, Path(__file__).parent]
    parts = {package.name: _hash_of(package, package.rglob("*.py")) for package in packages}
    total = hashlib.sha256()
    for name, part in (*parts.items(), *sorted(_plugins.items())):
        total.update(f"{name} {part}\n".encode())
    return total.hexdigest()


def _hash_of(folder: Path, files: Iterable[Path]) -> str:
    """SHA-256 of the names and contents of files below a folder."""
    total = hashlib.sha256()
    for path in sorted(files):
        total.update(f"{path.relative_to(folder).as_posix()}\n".encode())
        total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()


def _git(folder: Path) -> dict[str, Any]:
    def ask(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    # An installed copy may lie inside an unrelated repository, whose revision says nothing about
    # this code.
    if ask("ls-files", "--error-unmatch", str(Path(__file__).resolve())) is None:
        return {"sha": None, "dirty": None}
    sha = ask("rev-parse", "HEAD")
    status = ask("status", "--porcelain", "--untracked-files=no")
    return {"sha": sha, "dirty": bool(status) if status is not None else None}
