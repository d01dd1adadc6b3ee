"""Scenes of other people's meshes, on drawn ground in drawn light."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError
from attnwarp.io.file import visible
from attnwarp_eval.drawn.draft import SATURATED, Thing, index, marks
from attnwarp_eval.drawn.scenes import SceneDraft
from attnwarp_eval.drawn.worlds import COLORS, Look
from attnwarp_eval.scene.meshes import MESH_SUFFIXES, read_mesh

Array = npt.NDArray[np.float64]

LONGEST_EDGE = 0.03
"""Edges of things, in units of the scene: textures have their colours at vertices."""


def mesh_files(folder: Path) -> list[Path]:
    """Meshes of a folder, by name.

    Raises:
        InputError: no such folder, or no mesh in it.
    """
    if not folder.is_dir():
        raise InputError(f"meshes: there is no folder {folder}")
    found = [path for path in visible(folder.iterdir()) if path.suffix.lower() in MESH_SUFFIXES]
    if not found:
        raise InputError(f"meshes: {folder} has no mesh; expected {', '.join(MESH_SUFFIXES)}")
    return found


@dataclass
class MeshDraft(SceneDraft):
    """A scene of meshes while it is drawn: two or three things, regardless of the axis.

    Attributes:
        meshes: files of :func:`mesh_files`.
        up: upright axis of all files.
    """

    meshes: list[Path] = field(default_factory=list)
    up: Literal["y", "z"] = "y"
    word: ClassVar[str] = "mesh"

    def stream(self, what: str) -> np.random.Generator:
        """Random numbers for one aspect, different from those of a drawn scene of that number."""
        return super().stream(f"mesh {what}")

    def colors_of(self, kind: str) -> list[int]:
        """Bright colours: training has none of these shapes."""
        return [COLORS.index(name) for name in SATURATED]

    def choose_things(self) -> None:
        """Two or three meshes, the first the largest."""
        rng = self.stream("meshes")
        count = 2 + index(rng, 2)
        shiny, patterned = (
            marks(rng, count, share) for share in (0.7 * self.axes.highlights, self.axes.texture)
        )
        left: list[Path] = []
        for k in range(count):
            left = left or list(self.meshes)
            path = left.pop(index(rng, len(left)))
            own = self.stream(f"mesh {k}")
            look = self.look_of(own, path.stem, shiny[k], patterned[k])
            size = 1.15 if k == 0 else 0.5 + 0.5 * self.axes.occlusion
            self.things.append(self._thing(k, path, look, size, round(360 * own.random(), 1)))

    def _thing(self, number: int, path: Path, look: Look, size: float, yaw: float) -> Thing:
        try:
            mesh = read_mesh(path)
        except ValueError as error:
            raise InputError(str(error)) from error
        points = mesh.vertices
        if self.up == "y":
            points = points[:, [0, 2, 1]] * np.array([1, -1, 1])
        a = math.radians(yaw)
        turn = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
        points = points @ turn.T
        low, high = points.min(0), points.max(0)
        scale = float(f"{size / float((high - low).max()):.6g}")
        offset = -scale * np.array([*(low + high)[:2] / 2, low[2]])
        file = f"meshes/{path.name}"
        self.files[file] = path
        shape: dict[str, Any] = {
            "type": "mesh", "file": file, "up": self.up, "yaw": yaw, "scale": scale,
            "position": [float(x) for x in offset], "longest_edge": LONGEST_EDGE,
        }  # fmt: skip
        # A readable word, and a unique name for each thing.
        word = "".join(c if c.isalnum() else " " for c in path.stem.lower()).strip() or "thing"
        thing = {"name": f"thing{number}", "shape": shape, **self.surface(look)}
        extent = scale * (high - low)
        reach = (0.5 * float(np.hypot(*extent[:2])), float(extent[2]))
        return Thing(word, number, look, [thing], reach, scale * _on_surface(points, mesh.faces))


def _on_surface(vertices: Array, faces: npt.NDArray[np.int64], count: int = 3000) -> Array:
    """(count, 3) points spread evenly over triangles, the same for the same mesh."""
    rng = np.random.default_rng(count)
    corners = vertices[faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    at = np.searchsorted(np.cumsum(area), rng.random(count) * area.sum())
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    return (weights[:, :, None] * corners[np.minimum(at, len(faces) - 1)]).sum(axis=1)
