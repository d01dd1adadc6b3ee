"""Reconstruction of edited views as one scene by COLMAP's structure from motion, whose figures
papers report as consistency.

Only the intrinsics of the scene's cameras are used: COLMAP estimates poses from SIFT
matches of all pairs of views.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp.camera import Camera
from attnwarp_eval import sfm
from attnwarp_eval.metrics._pictures import picture
from attnwarp_eval.metrics.arrays import share


@dataclass(frozen=True)
class Reconstruction:
    """Figures of COLMAP's largest model of a set of views.

    Attributes:
        registered: number of pictures in the model; 0 without a model.
        points: number of the model's 3D points.
        track_length: mean number of views that see a point; NaN without a model.
        reprojection_error: mean over the points, in px; NaN without a model.
    """

    views: int
    registered: int = 0
    points: int = 0
    track_length: float = math.nan
    reprojection_error: float = math.nan

    def figures(self) -> dict[str, float]:
        """The ``consistency.colmap_*`` figures; a failure registers no view."""
        return {
            "consistency.colmap_registered": share(self.registered, self.views),
            "consistency.colmap_points": self.points,
            "consistency.colmap_track_length": self.track_length,
            "consistency.colmap_error": self.reprojection_error,
            "consistency.colmap_failed": float(not self.registered),
        }


def reconstruct(images: Sequence[Any], cameras: Sequence[Camera]) -> Reconstruction:
    """Reconstruct views by COLMAP, with known intrinsics and unknown poses.

    Features are SIFT, matched between all pairs, so the time grows with the square of the number of
    views: about 1 s of CPU for 9 pictures of 384 px. One thread and a fixed seed: the same pictures
    give the same figures.

    Args:
        images: at least two, (H, W, 3) sRGB in [0, 1].
        cameras: one for each picture, of its size; only the intrinsics are read.

    Raises:
        InputError: the package pycolmap crashed, or is missing (MissingExtraError).
        ValueError: numbers or sizes that differ, fewer than two views, or a picture that is not
            sRGB in [0, 1].

    Source: J. L. Schoenberger, J.-M. Frahm, "Structure-from-Motion Revisited", CVPR 2016.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp_eval import metrics
        >>> view = dict(width=64, height=64, fov_y=60)
        >>> cameras = [Camera.look_at((x, -4, 0), (0, 0, 0), **view) for x in (0, 1)]
        >>> black = np.zeros((64, 64, 3))
        >>> metrics.reconstruct([black, black], cameras).registered  # nothing to match
        0
    """
    if len(images) != len(cameras) or len(images) < 2:
        raise ValueError(
            f"images: got {len(images)} pictures and {len(cameras)} cameras, expected at least two,"
            " one camera a picture"
        )
    pictures = [
        picture(image, f"images[{i}]", shape=(camera.height, camera.width))
        for i, (image, camera) in enumerate(zip(images, cameras, strict=True))
    ]
    with tempfile.TemporaryDirectory(prefix="attnwarp-colmap-") as name:
        folder = Path(name)
        sfm.write_pictures(
            folder, [np.round(255 * one).astype(np.uint8) for one in pictures], cameras
        )
        sfm.run("reconstruct", folder)
        found = json.loads((folder / "result.json").read_text())
    return Reconstruction(len(pictures), **(found or {}))
