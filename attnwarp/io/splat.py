"""``.splat`` files for web viewers, with 32 bytes per splat.

Layout of github.com/antimatter15/splat.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from attnwarp import check
from attnwarp.gaussians import SH_C0, Gaussians
from attnwarp.io.file import FileFormatError, existing_file, write_atomically
from attnwarp.io.ply import THIRD_SCALE, WORLD_TOLERANCE, world_error

RECORD = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)]
)
"""One splat of a ``.splat`` file, 32 bytes, no header (layout of github.com/antimatter15/splat)."""


def write_splat(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    third_scale: float = THIRD_SCALE,
    coordinates: Literal["world", "relative"] = "world",
) -> None:
    """Write splats as ``.splat``, for viewing; the format keeps neither view-dependent colour nor
    the origin.

    Each record holds the position and the linear scales in float32. The colour 0.5 + SH_C0 f_dc and
    the opacity are bytes (255 c), and so is the unit quaternion wxyz (128 + 128 q). Bytes are
    rounded and clipped to 0..255. Records are sorted by size times opacity, largest first, since
    viewers draw them while the file loads. Size is the product of the scales, of which the 2D kind
    has two. Ties keep their order.

    Args:
        path: path of the file; an older file is replaced, atomically.
        gaussians: splats to write.
        third_scale: normal scale of 2D splats, in scene units.
        coordinates: "world", or "relative" for positions without ``gaussians.origin``.

    Raises:
        ValueError: a value of ``gaussians`` is out of range, ``third_scale`` is not positive, or
            float32 world positions would move a splat by more than a hundredth of its largest
            scale.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp.io import write_splat
        >>> from attnwarp.trial import disc
        >>> write_splat("disc.splat", disc())
        >>> Path("disc.splat").stat().st_size  # bytes of one record
        32
    """
    g = replace(gaussians.detach().to(device="cpu"))
    single = np.finfo(np.float32)
    if not single.tiny <= third_scale <= single.max:
        raise ValueError(
            f"third_scale: got {third_scale}, expected a positive length such as {THIRD_SCALE}"
        )
    check.one_of(coordinates, ("world", "relative"), "coordinates")
    if coordinates == "relative":
        g = replace(g, origin=np.zeros(3))
    scales = g.scales.numpy().astype(np.float64)
    error = world_error(g)
    bad = ~(error <= WORLD_TOLERANCE)
    if bad.any():
        row = int(np.argmax(bad))
        raise ValueError(
            f"means: float32 world positions, all that .splat holds, would move splat {row} by"
            f" {error[row]:.3g} of its scale ({int(bad.sum())} of {len(g)} by more than"
            f" {WORLD_TOLERANCE:g}); pass coordinates='relative' (--coordinates relative) and place"
            " the scene in the viewer"
        )
    position = g.world_means().astype(np.float32)
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
    write_atomically(path, lambda stream: stream.write(rows[order].tobytes()), follow_link=True)


def read_splat(path: str | os.PathLike[str]) -> Gaussians:
    """Read ``.splat``: 3D splats with constant colour, as precise as their bytes.

    Args:
        path: path of the file.

    Returns:
        Gaussians in float32, of degree 0, in the order of the file.

    Raises:
        FileNotFoundError: the file does not exist.
        FileFormatError: the number of records is not whole, a value is not finite, a scale is not
            positive, or a quaternion is zero; the message names the first bad row.

    Example:
        >>> from attnwarp.io import read_splat, write_splat
        >>> from attnwarp.trial import disc
        >>> write_splat("disc.splat", disc())
        >>> read_splat("disc.splat").scales  # the third makes the disc thin
        tensor([[5.0000e-01, 5.0000e-01, 1.0000e-06]])
    """
    path = existing_file(path)
    data = path.read_bytes()
    if len(data) % RECORD.itemsize:
        raise FileFormatError(
            path,
            f"has {len(data)} bytes, expected a multiple of {RECORD.itemsize}; it is no .splat"
            " file, or not whole",
        )
    rows = np.frombuffer(data, RECORD)
    quats = (rows["quat"].astype(np.float32) - 128) / 128
    for field, bad, expected in (
        ("position", ~np.isfinite(rows["position"]).all(axis=1), "finite numbers"),
        ("scale", ~(np.isfinite(rows["scale"]) & (rows["scale"] > 0)).all(axis=1), "lengths > 0"),
        ("quaternion", ~quats.any(axis=1), "a rotation"),
    ):
        if bad.any():
            row = int(np.argmax(bad))
            value = rows["quat" if field == "quaternion" else field][row]
            raise FileFormatError(
                path,
                f"{value.tolist()} in row {row} ({int(bad.sum())} of {len(rows)} rows), expected"
                f" {expected}; the file is damaged",
                field=field,
                row=row,
            )
    rgba = rows["rgba"].astype(np.float32) / 255
    return Gaussians(
        "3d",
        torch.from_numpy(rows["position"].astype(np.float32)),
        torch.from_numpy(quats),
        torch.from_numpy(rows["scale"].astype(np.float32)),
        torch.from_numpy(rgba[:, 3].copy()),
        Gaussians.sh_from_rgb(torch.from_numpy(rgba[:, :3].copy())),
    )
