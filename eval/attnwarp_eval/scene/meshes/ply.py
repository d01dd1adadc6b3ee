"""PLY: vertices with or without colours, and polygons, in text or binary."""

from __future__ import annotations

import io

import numpy as np

from attnwarp.io.text import overstated, plain_ply, split_ply
from attnwarp_eval.scene.meshes.surface import Surface, unit_colors


def read_ply(data: bytes) -> Surface:
    """Read the polygons of a PLY file with plyfile.

    Raises:
        ValueError: a damaged header, fewer or more bytes than the header announces, or no faces.
    """
    from plyfile import PlyData, PlyParseError

    data = plain_ply(data)
    found = split_ply(data)
    head, start = found or ([], 0)
    if (beyond := overstated(head, len(data))) is not None:
        raise ValueError(f"announces {beyond[1]} {beyond[0]}, but the file has {len(data)} bytes")
    stream = io.BytesIO(data)
    try:
        ply = PlyData.read(stream)
        if ply.text:
            lines = sum(bool(line.strip()) for line in data[start:].splitlines())
            announced = sum(element.count for element in ply.elements)
            if lines != announced:
                raise ValueError(f"announces {announced} items, but {lines} lines follow")
        elif data[stream.tell() :].strip(b"\0\r\n\t "):
            raise ValueError(f"{len(data) - stream.tell()} bytes follow its last element")
    except (
        PlyParseError,
        ValueError,
        ArithmeticError,
        LookupError,
        TypeError,
        MemoryError,
    ) as error:
        raise ValueError(f"damaged PLY: {' '.join(str(error).split())}") from error
    names = [element.name for element in ply.elements]
    if "vertex" not in names or not ({"face", "tristrips"} & set(names)):
        raise ValueError("holds no faces (a point cloud?); export it as a mesh")
    if "face" not in names:
        raise ValueError("keeps its triangles in strips (tristrips); export it with faces")
    vertex, face = ply["vertex"], ply["face"]
    columns = {prop.name for prop in vertex.properties}
    if not {"x", "y", "z"} <= columns:
        raise ValueError("its vertices have no x, y, z")
    vertices = np.stack([_column(vertex, name) for name in "xyz"], axis=-1)
    tint = None
    if {"red", "green", "blue"} <= columns:
        colors = np.stack([_column(vertex, c) for c in ("red", "green", "blue")], -1)
        integers = np.issubdtype(vertex.data.dtype["red"], np.integer)
        tint = unit_colors(colors / 255 if integers else colors)
    lists = {prop.name for prop in face.properties} & {"vertex_indices", "vertex_index"}
    if not lists:
        raise ValueError("its faces have no vertex_indices")
    name = lists.pop()
    if face.data.dtype[name].kind != "O":
        raise ValueError(f"{name} of its faces is no list")
    rows = face.data[name]
    sizes = np.fromiter((len(row) for row in rows), np.int64, len(rows))
    corners = np.concatenate([np.zeros(0), *rows])
    if not np.issubdtype(corners.dtype, np.number) or (corners != np.floor(corners)).any():
        raise ValueError(f"{name} of its faces are no whole numbers")
    if (sizes < 3).any():
        k = int(np.flatnonzero(sizes < 3)[0])
        raise ValueError(f"face {k} has {sizes[k]} corners, expected at least 3")
    other = [
        f"{element.count} {element.name}"
        for element in ply.elements
        if element.name not in ("vertex", "face") and element.count
    ]
    painted = {"red", "green", "blue"} & {prop.name for prop in face.properties}
    if painted:
        other.append(f"colours of {face.count} faces")
    return Surface(vertices, corners.astype(np.int64), sizes, tint, tuple(other))


def _column(element: object, name: str) -> np.ndarray:
    values = element[name]  # type: ignore[index]
    if values.dtype.kind == "O":
        raise ValueError(f"{name} of its vertices is a list")
    return np.asarray(values, dtype=np.float64)
