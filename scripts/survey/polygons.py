"""A third reader, of the polygons of OBJ and OFF: their areas by Newell's formula, untriangulated.

trimesh cuts every polygon into a fan, which is wrong for concave ones, and misreads OFF files whose
faces differ in size. Newell's sum needs no triangles, so it decides where the two readers differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

PLANAR = 1e-6
"""Largest height of a corner over its polygon's plane, relative to the file's largest coordinate;
single precision and six written digits leave less."""


@dataclass(frozen=True, eq=False)
class Polygons:
    """The polygons of a file.

    Attributes:
        vertices: (V, 3).
        faces: indices into ``vertices``, a list for each polygon.
    """

    vertices: Array
    faces: list[list[int]]

    def sums(self) -> tuple[int, float, float, float]:
        """Number of triangles, area, volume about the origin, and the largest relative height.

        Area and volume hold for planar polygons. Of others, the area is the least that any
        surface with the same rims has.
        """
        by_size: dict[int, list[list[int]]] = {}
        for face in self.faces:
            by_size.setdefault(len(face), []).append(face)
        area = volume = height = 0.0
        for faces in by_size.values():
            points = self.vertices[faces]  # (G, n, 3)
            local = points - points.mean(axis=1, keepdims=True)
            twice = np.cross(local, np.roll(local, -1, axis=1)).sum(axis=1)
            length = np.linalg.norm(twice, axis=1)
            area += float(length.sum()) / 2
            volume += float(np.einsum("gi,gi->", points.mean(axis=1), twice)) / 6
            normal = twice / np.maximum(length, 1e-300)[:, None]
            height = max(height, float(np.abs(np.einsum("gki,gi->gk", local, normal)).max()))
        span = float(np.abs(self.vertices[[k for face in self.faces for k in face]]).max()) or 1.0
        return sum(len(face) - 2 for face in self.faces), area, volume, height / span


def read_polygons(path: Path) -> Polygons:
    """The polygons of a whole .obj or .off file.

    Raises:
        ValueError: another format, or a file that is not as its format has it.
    """
    text = path.read_text("latin-1")
    if path.suffix.lower() == ".obj":
        return _obj(text)
    if path.suffix.lower() == ".off":
        return _off(text)
    raise ValueError(f"{path.suffix} is not read here")


def _obj(text: str) -> Polygons:
    vertices, faces = [], []
    for line in text.replace("\\\n", " ").splitlines():
        words = line.split("#")[0].split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] in (["f"], ["fo"]):
            named = [int(word.split("/")[0]) for word in words[1:]]
            faces.append([k - 1 if k > 0 else len(vertices) + k for k in named])
    return Polygons(np.array(vertices), faces)


def _off(text: str) -> Polygons:
    lines = [words for line in text.splitlines() if (words := line.split("#")[0].split())]
    if lines[0][0] not in ("OFF", "COFF", "NOFF", "STOFF", "CNOFF"):
        raise ValueError(f"{lines[0][0]} is not read here")
    if len(lines[0]) == 1:
        counts, rest = lines[1], lines[2:]
    else:
        counts, rest = lines[0][1:], lines[1:]
    n, m = int(counts[0]), int(counts[1])
    vertices = [[float(word) for word in words[:3]] for words in rest[:n]]
    faces = [[int(word) for word in words[1 : 1 + int(words[0])]] for words in rest[n : n + m]]
    return Polygons(np.array(vertices), faces)
