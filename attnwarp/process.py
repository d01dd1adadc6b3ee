"""What the processes of both commands do: attnwarp and attnwarp-eval."""

from __future__ import annotations

import atexit
import gc
import os


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
