"""What the processes of both commands do: attnwarp and attnwarp-eval."""

from __future__ import annotations

import _thread
import atexit
import gc
import sys
import threading
from typing import Any

RETRY_SECONDS = 0.01
"""Pause before a lost interrupt is sent again: the destructor that lost it is left by then."""


def skip_last_collection() -> None:
    """End this process without a last search for garbage.

    The interpreter searches once more as it ends: half a second of torch's objects.
    """
    atexit.register(gc.freeze)


def resend_lost_interrupts() -> None:
    """Send Ctrl-C again where a destructor has swallowed it.

    Python raises KeyboardInterrupt in whatever runs. Out of a destructor no exception leaves, so
    it is printed as ignored and the program goes on. The renderer's memory pool runs one for every
    freed array.
    """
    report = sys.unraisablehook

    def resend(lost: Any) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            threading.Timer(RETRY_SECONDS, _thread.interrupt_main).start()
        else:
            report(lost)

    sys.unraisablehook = resend
