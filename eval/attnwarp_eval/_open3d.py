"""The only module that imports Open3D."""

from __future__ import annotations

import contextlib
import ctypes
import functools
from typing import Any


@functools.cache
def open3d() -> Any:
    """Import the open3d module.

    Its shared library needs libusb-1.0.so.0 (for depth sensors, unused here), which a
    bare machine lacks. The wheel libusb-package carries that library under the same SONAME: loaded
    first and globally, it is the one the dynamic linker finds. A machine where it cannot be loaded
    may still have one installed.
    """
    with contextlib.suppress(ImportError, OSError):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
