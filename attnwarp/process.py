"""Process-wide parts of both commands: attnwarp and attnwarp-eval."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from attnwarp.reporting import SILENT, Reporter

RETRY_SECONDS = 0.01
"""Pause before a lost interrupt is sent again: the destructor that lost it is left by then."""


def skip_last_collection() -> None:
    """End this process without a last search for garbage.

    The interpreter searches once more as it ends: half a second of torch's objects.
    """
    atexit.register(gc.freeze)


def core_count() -> int:
    """Cores that this process may use; all of the machine's where the system cannot tell (macOS).

    Example:
        >>> core_count() >= 1
        True
    """
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def cache_dir() -> Path:
    """The folder of derived files: ``$ATTNWARP_CACHE``, else ``$XDG_CACHE_HOME/attnwarp``, else
    ``~/.cache/attnwarp``.

    Everything in it can be recomputed and may be deleted at any time.
    """
    if folder := os.environ.get("ATTNWARP_CACHE"):
        return Path(folder).expanduser()
    # Not Path.home(), which raises where a container's user has none.
    home = os.path.expanduser("~/.cache")  # noqa: PTH111
    return Path(os.environ.get("XDG_CACHE_HOME") or home) / "attnwarp"


def kernel_folders(name: str) -> Iterator[Path]:
    """Folders for compiled kernels that belong to this user, made if need be: in the cache, then in
    the temporary folder.

    What lies there is run, and in a shared place another user may have made the folder, or one
    between it and the temporary folder: there is none.

    Args:
        name: name of the compiler, such as "numba".
    """
    folders = [cache_dir() / name]
    with suppress(FileNotFoundError):  # no temporary folder either
        folders.append(Path(tempfile.gettempdir()) / f"attnwarp-{os.getuid()}-{name}")
    for folder in folders:
        with suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(folder, os.W_OK) and folder.lstat().st_uid == os.getuid():
                yield folder


def resend_lost_interrupts() -> None:
    """Send Ctrl-C again where a destructor has swallowed it.

    Python raises KeyboardInterrupt in whatever runs. Out of a destructor no exception leaves, so
    it is printed as ignored and the program goes on. The renderer's memory pool runs one for every
    freed array.
    """
    report, main = sys.unraisablehook, threading.get_ident()

    def resend(lost: Any) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            threading.Timer(RETRY_SECONDS, signal.pthread_kill, (main, signal.SIGINT)).start()
        else:
            report(lost)

    sys.unraisablehook = resend


STOPS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that ask a program to end, besides Ctrl-C: a polite kill, and the terminal's end where it
has one (not on Windows).
"""


def heeded(numbers: tuple[int, ...]) -> list[int]:
    """Those that this process does not ignore: a shell has its background jobs ignore Ctrl-C, and
    nohup the terminal's end.
    """
    return [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]


interrupted = False
"""True after a stop. An import that it meets may end in an error of its own, such as numpy's."""


def interrupt(*_: Any) -> None:
    """Raise KeyboardInterrupt, and remember it: the handler of a signal."""
    global interrupted
    interrupted = True
    raise KeyboardInterrupt


@contextmanager
def stops_interrupt() -> Iterator[None]:
    """A polite kill, or the terminal's end, raises KeyboardInterrupt inside, as Ctrl-C does."""
    handlers = {number: signal.signal(number, interrupt) for number in heeded(STOPS)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def asked_to_stop(report: Reporter = SILENT) -> Iterator[Callable[[], bool]]:
    """Yield a function that is True once Ctrl-C, a polite kill or the terminal's end came; a second
    one stops at once, as it would without this.

    Args:
        report: receives a line at the first.
    """
    asked = False

    def note(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        report.log("stopping after this iteration; press Ctrl-C again to leave at once")

    handlers = {number: signal.signal(number, note) for number in heeded((signal.SIGINT, *STOPS))}
    try:
        yield lambda: asked
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
