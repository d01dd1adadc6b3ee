"""What commands read and write."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp.cli.options import Kind, Reading

if TYPE_CHECKING:
    from attnwarp.gaussians import Gaussians
    from attnwarp.io import Dataset


def read_views(path: Path, reading: Reading, **options: Any) -> Dataset:
    """The data set at ``path``; whoever gives a scene in its place is told how a scene becomes
    one.

    Args:
        path: as typed.
        reading: the options that a person may type.
        options: the command's own keywords of `attnwarp.io.read_dataset`, which go before those.
    """
    from attnwarp.io import read_dataset

    export = f"attnwarp-eval scenes export {path} DIR"
    if path.suffix in (".yaml", ".yml") and not path.is_dir():
        raise ValueError(
            f"{path}: expected transforms.json, its folder or a COLMAP folder; for a scene:"
            f" {export}, then give DIR"
        )
    if path.name == str(path) and not path.exists():
        raise FileNotFoundError(
            f"{path}: no such file or folder; for a scene: {export}, then give DIR"
        )
    typed = {**vars(reading), "ignore_keys": reading.ignore_keys or ()}
    return read_dataset(path, **(typed | options))


def read_splats(path: Path, kind: Kind | None, antialiased: bool | None) -> Gaussians:
    """The splats of a .ply or .splat file; ``kind`` and ``antialiased`` overrule what it says."""
    from dataclasses import replace

    from attnwarp.io import read_ply, read_splat

    if path.suffix.lower() == ".splat":
        if kind is Kind.two:
            raise ValueError(f"--kind: {path} is a .splat, which holds 3DGS alone")
        return replace(read_splat(path), antialiased=bool(antialiased))
    return read_ply(
        path,
        kind=None if kind is None else "2d" if kind is Kind.two else "3d",
        antialiased=antialiased,
    )


def write_image(path: Path, rgb: Any) -> None:
    """(H, W, 3) sRGB in [0, 1] as an 8-bit PNG, atomically."""
    import numpy as np

    from attnwarp.io.file import write_atomically
    from attnwarp.io.images import encode_png

    data = encode_png(np.round(255 * np.clip(rgb, 0, 1)).astype(np.uint8))
    write_atomically(path, lambda stream: stream.write(data))
