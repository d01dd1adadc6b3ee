"""PLY: vertices with or without colours, and polygons, in text or binary."""

from __future__ import annotations

import numpy as np

from attnwarp.io.ply_elements import SIZE, parse_ply
from attnwarp_eval.scene.meshes.surface import Surface, unit_colors


def read_ply(data: bytes) -> Surface:
    """Read the polygons of a PLY file.

    Raises:
        ValueError: a damaged file, or no faces.
    """
    elements, _ = parse_ply(data)
    if "vertex" not in elements or not ({"face", "tristrips"} & set(elements)):
        raise ValueError("holds no faces (a point cloud?); export it as a mesh")
    if "face" not in elements:
        raise ValueError("keeps its triangles in strips (tristrips); export it with faces")
    vertex, face = elements["vertex"].scalars(), elements["face"]
    if not {"x", "y", "z"} <= set(vertex):
        raise ValueError("its vertices have no x, y, z")
    vertices = np.stack([vertex[name] for name in "xyz"], axis=-1).astype(np.float64)
    tint = None
    if {"red", "green", "blue"} <= set(vertex):
        colors = np.stack([vertex[name] for name in ("red", "green", "blue")], axis=-1)
        tint = unit_colors(colors / 255 if colors.dtype.kind in "iu" else colors)
    name = next((n for n in ("vertex_indices", "vertex_index") if SIZE + n in face.columns), None)
    if name is None:
        raise ValueError("its faces have no list vertex_indices")
    corners, sizes = face.columns[name], face.columns[SIZE + name]
    if (corners != np.floor(corners)).any():
        raise ValueError(f"{name} of its faces are no whole numbers")
    if (sizes < 3).any():
        k = int(np.flatnonzero(sizes < 3)[0])
        raise ValueError(f"face {k} has {sizes[k]} corners, expected at least 3")
    other = [
        f"{element.count} {name}"
        for name, element in elements.items()
        if name not in ("vertex", "face") and element.count
    ]
    if {"red", "green", "blue"} & set(face.scalars()):
        other.append(f"colours of {face.count} faces")
    return Surface(vertices, corners.astype(np.int64), sizes.astype(np.int64), tint, tuple(other))
