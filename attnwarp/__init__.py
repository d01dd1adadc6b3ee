"""Attention warping for consistent 3D scene editing: cameras, splats, warps and visibility."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attnwarp.camera import Camera
    from attnwarp.gaussians import Gaussians

__all__ = ["Camera", "Gaussians"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    # On first use: torch takes a second to import, which `attnwarp --help` should not.
    if name == "Camera":
        from attnwarp.camera import Camera

        return Camera
    if name == "Gaussians":
        from attnwarp.gaussians import Gaussians

        return Gaussians
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
