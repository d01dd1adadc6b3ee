"""Place of compiled kernels: beside their modules, or where this user can write."""

from __future__ import annotations

import os
from pathlib import Path

from attnwarp.process import kernel_folders

HERE = Path(__file__).parent


def kernel_folder() -> Path | None:
    """The folder of compiled kernels; None for numba's own choice, beside each module.

    In a container or an installation of another user nothing can be written there, and numba then
    refuses to compile at all.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return Path(os.environ["NUMBA_CACHE_DIR"])
    if os.access(HERE, os.W_OK):
        return None
    return next(kernel_folders("numba"), None)


def _chosen() -> bool:
    """Tell numba the folder; False where nothing can be kept."""
    import numba

    folder = kernel_folder()
    if folder is not None:
        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    return folder is not None or os.access(HERE, os.W_OK)


CACHE = _chosen()
"""numba's option ``cache`` for every kernel."""
