"""Reader of mesh files: format by suffix, checks shared by all formats, and counts."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from attnwarp_eval.scene.base import FARTHEST
from attnwarp_eval.scene.meshes.glb import read_glb
from attnwarp_eval.scene.meshes.ply import read_ply
from attnwarp_eval.scene.meshes.polygons import triangulate
from attnwarp_eval.scene.meshes.surface import Surface
from attnwarp_eval.scene.shapes import Mesh, MeshNotice

READER_PROTOCOL = 2
"""Version; raised when the same file would give another surface or other colours; part of the hash
of every scene's content."""

# No .gltf: it keeps its vertices in another file, which a hash of the .gltf would miss.
READERS = {".ply": read_ply, ".glb": read_glb}
MESH_SUFFIXES = tuple(READERS)


INSIDE_OUT = (
    "its faces look inward, so that it gets no splats, shines inward as a lamp and is a hollow as"
    " glass: turn them over and export it again"
)


@dataclass(frozen=True, eq=False)
class MeshFile:
    """A mesh with statistics of its file.

    Attributes:
        polygons: number of polygons in the file.
        crossed: number of polygons dropped because they cross themselves.
        flat: number of triangles dropped because they have no area.
        unused: number of vertices that no polygon uses.
        ignored: unused contents of the file, in words.
        inside_out: whether the faces of a closed surface look inward.
    """

    mesh: Mesh
    polygons: int
    crossed: int
    flat: int
    unused: int
    ignored: tuple[str, ...]
    inside_out: bool

    def __str__(self) -> str:
        left_out = [
            f"{count} {what}"
            for count, what in (
                (self.crossed, "polygons that cross themselves"),
                (self.flat, "triangles without area"),
                (self.unused, "vertices of no polygon"),
            )
            if count
        ]
        return (
            f"{self.polygons} polygons in, {len(self.mesh.faces)} triangles out"
            + (f"; left out: {', '.join(left_out)}" if left_out else "")
            + (f"; not used: {', '.join(self.ignored)}" if self.ignored else "")
            + (f"; {INSIDE_OUT}" if self.inside_out else "")
        )


def read_mesh(path: Path) -> Mesh:
    """A triangle mesh from a file (.ply, .glb), all its parts joined.

    Vertex colours, if present, become the tint (taken as sRGB, but linear in .glb, as
    that format defines). Dropped parts are reported by a :class:`~attnwarp_eval.scene.shapes
    .MeshNotice`, with its number.

    Raises:
        ValueError: the format is not known, or the file is damaged or holds no triangles.
    """
    return read_mesh_file(path).mesh


def read_mesh_file(path: Path) -> MeshFile:
    """:func:`read_mesh` with the counts of read and dropped elements."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(
            f"{path}: mesh format {path.suffix!r} is not read; use one of"
            f" {', '.join(MESH_SUFFIXES)}; trimesh writes one:"
            f" trimesh.load({path.name!r}, force='mesh').export({path.stem + '.glb'!r})"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    key = str(path), hashlib.sha256(data).hexdigest()
    if key not in _recent:
        result = _read(path, reader, data)
        if len(_recent) >= MOST_RECENT:
            _recent.pop(next(iter(_recent)))
        _recent[key] = result
    result = _recent[key]
    if result.crossed or result.flat or result.unused or result.ignored or result.inside_out:
        warnings.warn(f"{path.name}: {result}", MeshNotice, stacklevel=3)
    return result


MOST_RECENT = 2
"""Cached meshes: a scene is built more than once, and a large one takes seconds to read."""

_recent: dict[tuple[str, str], MeshFile] = {}
"""Meshes by path and SHA-256 of the file."""


def _read(path: Path, reader: Callable[[bytes], Surface], data: bytes) -> MeshFile:
    """Read the mesh in a file."""
    try:
        surface = reader(data)
        if not len(surface.sizes):
            raise ValueError("holds no triangles (a point cloud?); export it as a mesh")
        outside = (surface.corners < 0) | (surface.corners >= len(surface.vertices))
        if outside.any():
            raise ValueError(
                f"a face names vertex {int(surface.corners[outside][0])}, but"
                f" there are {len(surface.vertices)}"
            )
        named = np.zeros(len(surface.vertices), dtype=bool)
        named[surface.corners] = True
        bad = np.flatnonzero(named & ~np.isfinite(surface.vertices).all(axis=1))
        if bad.size:
            raise ValueError(f"vertex {int(bad[0])} is not finite")
        reach = np.abs(surface.vertices[named]).max(axis=1)
        if reach.max() > FARTHEST:
            farthest = int(np.flatnonzero(named)[reach.argmax()])
            raise ValueError(
                f"vertex {farthest} lies {reach.max():.3g} from the origin, expected at most"
                f" {FARTHEST:g}"
            )
        unused = int((~named).sum())
        faces, crossed = triangulate(surface.vertices, surface.corners, surface.sizes)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; repair or export the file again") from error
    if not len(faces):
        raise ValueError(f"{path}: all {len(crossed)} polygons cross themselves; repair the file")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MeshNotice)  # reported below, with the rest
        mesh = Mesh(surface.vertices, faces, None, surface.tint).cleaned(str(path))
    result = MeshFile(
        mesh,
        len(surface.sizes),
        len(crossed),
        len(faces) - len(mesh.faces),
        unused,
        surface.ignored,
        _inside_out(mesh),
    )
    for array in (mesh.vertices, mesh.faces):
        array.setflags(write=False)  # shared with later callers
    return result


def _inside_out(mesh: Mesh) -> bool:
    """Return True if a surface is closed except for small holes, and its volume by the divergence
    theorem is negative by more than a thousandth of a ball's of the same area.
    """
    corners = mesh.vertices[mesh.faces]
    corners = corners - corners.mean((0, 1))
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    area = float(np.linalg.norm(facing, axis=1).sum())
    volume = float(np.einsum("ij,ij->", corners[:, 0], facing)) / 3
    closed = np.linalg.norm(facing.sum(0)) < 1e-2 * area
    return bool(closed and volume < -1e-3 * area**1.5 / (6 * np.sqrt(np.pi)))
