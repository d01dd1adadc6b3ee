"""Attention warping for consistent 3D scene editing: cameras, splats, warps and visibility."""

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians

__all__ = ["Camera", "Gaussians"]
__version__ = "0.1.0"
