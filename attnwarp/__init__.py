"""Attention warping for consistent 3D scene editing: the method as a library.

- :mod:`attnwarp.io`: splats and posed pictures from files and to files.
- :mod:`attnwarp.fit` and :mod:`attnwarp.render`: pictures to splats, and splats to pictures.
- :mod:`attnwarp.warp`: correspondences, visibility and sampling between two views.
- :mod:`attnwarp.editing`: editors, and recording, warping and injection of their attention.
- :mod:`attnwarp.methods`: Algorithm 1 (:mod:`attnwarp.methods.algorithms.attention_warping`), from
  one edited view to an edited scene, and its baselines.
- :mod:`attnwarp.encoders` and :mod:`attnwarp.losses`: helpers of tuning and metrics.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attnwarp.camera import Camera
    from attnwarp.gaussians import Gaussians

__all__ = ["Camera", "Gaussians"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    # Imported on first use, so that `attnwarp --help` need not wait a second for torch.
    if name == "Camera":
        from attnwarp.camera import Camera

        return Camera
    if name == "Gaussians":
        from attnwarp.gaussians import Gaussians

        return Gaussians
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
