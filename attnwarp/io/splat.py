"""``.splat`` files: the 32 bytes a splat that web viewers load."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

from attnwarp.gaussians import SH_C0, Gaussians
from attnwarp.io.file import write_atomically
from attnwarp.io.ply import THIRD_SCALE

RECORD = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)]
)
"""One splat of a ``.splat`` file, 32 bytes, no header (layout of github.com/antimatter15/splat)."""


def write_splat(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    third_scale: float = THIRD_SCALE,
    relative_to_origin: bool = False,
) -> None:
    """Write splats as ``.splat``, for viewing; the format keeps neither view-dependent colour nor
    the origin.

    Each record holds the position, the linear scales, the colour 0.5 + SH_C0 f_dc and the opacity
    as bytes (255 c), and the unit quaternion wxyz as bytes (128 + 128 q); all bytes are rounded and
    clipped to 0..255. Records are sorted by size times opacity, largest first, since viewers draw
    them while the file still loads; size is the product of the scales (of the two scales for the 2D
    kind). Ties keep their order.

    Args:
        path: the file; an older one is replaced, atomically.
        gaussians: what to write.
        third_scale: third scale of 2D splats, in scene units.
        relative_to_origin: write positions without ``gaussians.origin``. World positions are
            written otherwise.

    Raises:
        ValueError: a value of ``gaussians`` is out of range, ``third_scale`` is not positive, or
            float32 world positions would move a splat by more than a tenth of its largest scale.
    """
    g = replace(gaussians.detach().to(device="cpu"))
    if not (np.isfinite(third_scale) and third_scale > 0):
        raise ValueError(
            f"third_scale: got {third_scale}, expected a positive length such as {THIRD_SCALE}"
        )
    scales = g.scales.numpy().astype(np.float64)
    exact = g.means.numpy().astype(np.float64) if relative_to_origin else g.world_means()
    position = exact.astype(np.float32)
    error = np.abs(position - exact).max(axis=1) if len(g) else np.zeros(0)
    bad = error > 0.1 * scales.max(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise ValueError(
            f"means: float32 world positions, all that .splat holds, would move splat {row} by"
            f" {error[row]:.3g} ({int(bad.sum())} of {len(g)} move by more than a tenth of their"
            " scale); pass relative_to_origin=True and place the scene in the viewer"
        )
    opacity = g.opacities.numpy().astype(np.float64)
    order = np.argsort(-scales.prod(axis=1) * opacity, kind="stable")
    if g.kind == "2d":
        scales = np.concatenate([scales, np.full((len(g), 1), third_scale)], axis=1)
    quats = g.quats.numpy().astype(np.float64)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    color = 0.5 + SH_C0 * g.sh.numpy()[:, 0].astype(np.float64)
    rows = np.empty(len(g), RECORD)
    rows["position"] = position
    rows["scale"] = scales
    rows["rgba"] = np.clip(
        np.round(255 * np.concatenate([color, opacity[:, None]], axis=1)), 0, 255
    )
    rows["quat"] = np.clip(np.round(128 + 128 * quats), 0, 255)
    write_atomically(path, lambda stream: stream.write(rows[order].tobytes()))
