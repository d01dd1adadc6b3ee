"""OpenGL, which VTK draws with, and a clear error if it is missing."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress

from attnwarp.errors import InputError

OSMESA = ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
"""Names of the software renderer that VTK falls back to."""

WITHOUT_DRAWING = "--export FILE.glb needs no OpenGL, --pixel prints the numbers"


def has_display() -> bool:
    """Return True if this machine has a display for windows."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def require_gl(*, display: bool) -> None:
    """Refuse to draw if VTK would crash, or would draw nowhere.

    VTK chooses a display, else EGL, else OSMesa, and crashes if it finds none of them.

    Args:
        display: whether a window on the screen is needed, rather than a picture.

    Raises:
        InputError: no display, or no OpenGL.
    """
    import pyvista  # noqa: F401, so that a missing extra is named before what it could draw

    if display and not has_display():
        raise InputError(
            "inspect: this machine has no display; draw a picture with --screenshot FILE, serve a"
            " browser with --web, or write a file to share with --export FILE.html"
        )
    window = _vtk_window()
    if window == "vtkOSOpenGLRenderWindow" and not any(_loads(name) for name in OSMESA):
        raise InputError(
            "inspect: no OpenGL: neither a display, EGL nor OSMesa can be used; install one"
            " (Debian, Ubuntu: apt-get install libegl1 libgl1-mesa-dri), or do without:"
            f" {WITHOUT_DRAWING}"
        )
    if display and window in ("vtkOSOpenGLRenderWindow", "vtkEGLRenderWindow"):
        name = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        raise InputError(
            f"inspect: the display {name!r} cannot be opened; start its server, or draw a picture"
            " with --screenshot FILE, or serve a browser with --web"
        )


def _vtk_window() -> str:
    """Class of the window that VTK chooses; VTK reports each choice it rejects as a warning."""
    from vtkmodules import vtkRenderingOpenGL2  # noqa: F401, registers the windows
    from vtkmodules.vtkCommonCore import vtkLogger
    from vtkmodules.vtkRenderingCore import vtkRenderWindow

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    name: str = vtkRenderWindow().GetClassName()
    return name


def _loads(library: str) -> bool:
    with suppress(OSError):
        ctypes.CDLL(library)
        return True
    return False
