"""Splat files of phones and viewers: SPZ, SOG, KSPLAT and compressed PLY, read by gaussforge."""

from __future__ import annotations

import importlib.util
import io
import json
import subprocess
import sys
import tempfile
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.errors import MissingExtraError
from attnwarp.io.file import FileFormatError

PACKED = {".spz": "spz", ".sog": "sog", ".ksplat": "ksplat"}
"""Suffixes, and gaussforge's names of their formats."""

CONVERSION = """
import resource, sys
from pathlib import Path
data = Path(sys.argv[1]).read_bytes()
most = (2 << 30) + 64 * len(data)
resource.setrlimit(resource.RLIMIT_AS, (most, most))
import gaussforge
result = gaussforge.GaussForge().convert(data, sys.argv[2], "ply")
Path(sys.argv[3]).write_bytes(result.get("data") or b"")
sys.exit(result.get("error"))
"""
"""Program of a conversion, a process of its own: of a damaged file gaussforge 0.6 crashes, or takes
all memory, and of an SPZ it prints lines on standard output."""

TURNED = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)
"""Signs of the harmonics of degree 1 to 3 after half a turn about x, in the order of PLY files."""


def packed_format(path: Path) -> str | None:
    """Return gaussforge's name of a file's format; None for plain PLY and anything else.

    Example:
        >>> packed_format(Path("scene.spz"))
        'spz'
    """
    if (name := PACKED.get(path.suffix.lower())) is not None:
        return name
    with path.open("rb") as stream:
        head = stream.read(1 << 14)
    compressed = head.startswith(b"ply") and b" packed_position" in head.partition(b"end_header")[0]
    return "compressed.ply" if compressed else None


def unpack(path: Path, format: str) -> tuple[bytes, list[str]]:
    """Convert a file to a plain PLY; return its bytes, and comments of what the conversion drops.

    Raises:
        MissingExtraError: gaussforge is not installed.
        FileFormatError: the file is damaged or not of its format.
    """
    if importlib.util.find_spec("gaussforge") is None:
        raise MissingExtraError("gaussforge", "formats")
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder, "plain.ply")
        command = [sys.executable, "-c", CONVERSION, str(path), format, str(plain)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        converted = plain.read_bytes() if plain.exists() else b""
    if done.returncode or not converted:
        reason = (done.stderr.strip().splitlines() or ["the file is damaged"])[-1]
        raise FileFormatError(path, f"cannot be read as {format} ({reason}); get it again")
    try:
        return converted, [f"antialiased {int(_antialiased(path.read_bytes(), format))}"]
    except (zipfile.BadZipFile, zlib.error, ValueError, LookupError) as error:
        raise FileFormatError(path, f"cannot be read as {format} ({error}); get it again") from None


def turn(columns: dict[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Turn splats of an SPZ, whose y points up and z backward, into the axes of PLY files."""
    rest = sum(name.startswith("f_rest_") for name in columns) // 3
    signs = {f"f_rest_{i}": TURNED[i % rest] for i in range(3 * rest)}
    signs |= dict.fromkeys(("y", "z", "rot_2", "rot_3"), -1)
    return {name: column * np.float32(signs.get(name, 1)) for name, column in columns.items()}


def _antialiased(data: bytes, format: str) -> bool:
    """Read the flag of splats fitted with an antialiased rasteriser."""
    if format == "spz":
        head = data if data[:4] == b"NGSP" else zlib.decompressobj(31).decompress(data, 16)
        return bool(head[14] & 1)
    if format == "sog":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if (damaged := archive.testzip()) is not None:  # gaussforge compares no checksum
                raise zipfile.BadZipFile(f"{damaged} is damaged")
            return bool(json.loads(archive.read("meta.json")).get("antialias"))
    return False
