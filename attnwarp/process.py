"""What the processes of both commands do: attnwarp and attnwarp-eval."""

from __future__ import annotations

import atexit
import gc


def skip_last_collection() -> None:
    """End this process without a last search for garbage.

    The interpreter searches once more as it ends: half a second of torch's objects.
    """
    atexit.register(gc.freeze)
