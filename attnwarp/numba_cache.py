"""Folder of compiled kernels: next to their modules, or a folder writable by this user, which
several checkouts may share.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from numba.core.caching import UserProvidedCacheLocator

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


def kernel_sources(package: Path = HERE) -> list[Path]:
    """List the modules whose text is compiled into the kernels of attnwarp, apart from a kernel's
    own module.

    A kernel elsewhere uses its own module alone, whose text numba itself compares.
    """
    beside = [package / "render" / name for name in ("constants.py", "harmonics.py")]
    return [*sorted(package.glob("*/_kernels/*.py")), *beside, package / "numba_cache.py"]


def kernel_key(package: Path = HERE) -> str:
    """Hash the sources of all kernels, and the version of their compiler's back end."""
    key = hashlib.sha256(version("llvmlite").encode())
    for path in kernel_sources(package):
        key.update(f"\0{path.relative_to(package)}\0".encode() + path.read_bytes())
    return key.hexdigest()[:16]


class BySource(UserProvidedCacheLocator):
    """Locator of kernels by the text that they are compiled from, so that checkouts share them.

    numba finds it by ``NUMBA_CACHE_LOCATOR_CLASSES=attnwarp.numba_cache.BySource``, with
    ``NUMBA_CACHE_DIR``. numba itself tells versions of Python and numba, and processors, apart.
    """

    def __init__(self, py_func: Callable[..., Any], py_file: str):
        super().__init__(py_func, py_file)
        self._cache_path = str(Path(os.environ["NUMBA_CACHE_DIR"], KEY, py_func.__module__))

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> BySource | None:
        """Locate a kernel of attnwarp's packages; None leaves others to numba's next locator."""
        if not py_func.__module__.startswith("attnwarp"):
            return None
        return super().from_function(py_func, py_file)


KEY = kernel_key()
