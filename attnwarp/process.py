"""Process-wide parts of both commands: attnwarp and attnwarp-eval."""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from attnwarp.reporting import SILENT, Reporter


def skip_last_collection() -> None:
    """End this process without a last garbage collection.

    The interpreter collects once more at exit: half a second for torch's objects.
    """
    atexit.register(gc.freeze)


def keep_freed_memory() -> None:
    """Let the C library keep freed memory for the next steps, which need as much again.

    By default glibc gives it back, and the system clears its pages anew: a tenth of an edit's time.
    """
    trim, map_ = -1, -3  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
    with suppress(AttributeError, OSError, TypeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(trim, 256 << 20)
        mallopt(map_, 32 << 20)


def core_count() -> int:
    """Count the cores available to this process; all cores if the system cannot tell (macOS)."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def cache_dir() -> Path:
    """Return the folder of derived files: ``$ATTNWARP_CACHE``, else ``$XDG_CACHE_HOME/attnwarp``,
    else ``~/.cache/attnwarp``.

    All its files can be recomputed and may be deleted at any time.
    """
    if folder := os.environ.get("ATTNWARP_CACHE"):
        return Path(folder).expanduser()
    # Not Path.home(), which raises for a container's user without a home.
    home = os.path.expanduser("~/.cache")  # noqa: PTH111
    return Path(os.environ.get("XDG_CACHE_HOME") or home) / "attnwarp"


def kernel_folders(name: str) -> Iterator[Path]:
    """Iterate over this user's folders for compiled kernels, created if missing: in the cache, then
    in the temporary folder.

    Files there are executed, so a folder is skipped if another user may have created it, or a
    parent between it and the temporary folder.
    """
    import tempfile

    folders = [cache_dir() / name]
    with suppress(FileNotFoundError):  # no temporary folder either
        folders.append(Path(tempfile.gettempdir()) / f"attnwarp-{os.getuid()}-{name}")
    for folder in folders:
        with suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(folder, os.W_OK) and folder.lstat().st_uid == os.getuid():
                yield folder


STOPS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that ask a program to end, besides Ctrl-C: SIGTERM, and SIGHUP where it exists (not on
Windows).
"""


def heeded(numbers: tuple[int, ...]) -> list[int]:
    """Select the signals that this process does not ignore: background jobs of a shell ignore
    Ctrl-C, and nohup makes SIGHUP ignored.
    """
    return [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]


interrupted = False
"""True after a stop signal, which may make an interrupted import fail with another error."""


def interrupt(*_: Any) -> None:
    """Handle a signal: record it and raise KeyboardInterrupt."""
    global interrupted
    interrupted = True
    raise KeyboardInterrupt


@contextmanager
def _handled(numbers: tuple[int, ...], handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Handle the signals that this process heeds while the block runs."""
    before = {number: signal.signal(number, handler) for number in heeded(numbers)}
    try:
        yield
    finally:
        for number, own in before.items():
            signal.signal(number, own)


@contextmanager
def stops_interrupt() -> Iterator[None]:
    """Make SIGTERM and SIGHUP raise KeyboardInterrupt inside the block, like Ctrl-C."""
    with _handled(STOPS, interrupt):
        yield


@contextmanager
def asked_to_stop(report: Reporter = SILENT) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True after Ctrl-C, SIGTERM or SIGHUP; a second signal stops at
    once, as by default."""
    asked = False

    def note(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        report.log("stopping after this iteration; press Ctrl-C again to leave at once")

    with _handled((signal.SIGINT, *STOPS), note):
        yield lambda: asked
