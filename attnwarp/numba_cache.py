"""Folder of compiled kernels: next to their modules, or a folder writable by this user."""

from __future__ import annotations

import os
from pathlib import Path

from attnwarp.process import kernel_folders

HERE = Path(__file__).parent


def kernel_folder() -> Path | None:
    """Choose the folder of compiled kernels; None for numba's default, next to each module.

    In a container or another user's installation the default folder is not writable, and numba then
    refuses to compile at all.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return Path(os.environ["NUMBA_CACHE_DIR"])
    if os.access(HERE, os.W_OK):
        return None
    return next(kernel_folders("numba"), None)


def _chosen() -> bool:
    """Set numba's cache folder; return False if no folder is writable."""
    import numba

    folder = kernel_folder()
    if folder is not None:
        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    return folder is not None or os.access(HERE, os.W_OK)


CACHE = _chosen()
"""Value of numba's option ``cache`` for every kernel."""
