"""Mesh formats written from their specifications: no library chooses what is in a file."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable

import numpy as np

from scripts.survey.solids import Solid


def _rows(values: np.ndarray) -> list[str]:
    return [" ".join(repr(float(x)) for x in row) for row in values]


def obj(solid: Solid, corner: str = "{0}", *, back: bool = False) -> bytes:
    """Polygons; ``corner`` writes one corner, ``back`` counts from the last vertex."""
    n = len(solid.vertices)
    lines = ["# a comment", "o part", *(f"v {row}" for row in _rows(solid.vertices))]
    if "/" in corner:
        lines += ["vt 0.5 0.5"] * n + ["vn 0 0 1"] * n
    for face in solid.faces:
        lines.append("f " + " ".join(corner.format(k - n if back else k + 1) for k in face))
    return ("\n".join(lines) + "\n").encode()


def off(solid: Solid) -> bytes:
    """Polygons, without colours."""
    faces = [f"{len(face)} {' '.join(map(str, face))}" for face in solid.faces]
    head = ["OFF", f"{len(solid.vertices)} {len(faces)} 0"]
    return ("\n".join([*head, *_rows(solid.vertices), *faces]) + "\n").encode()


def ply(solid: Solid, form: str, *, normals: bool = False) -> bytes:
    """``form``: "ascii", "binary_little_endian" or "binary_big_endian"."""
    extra = ["nx", "ny", "nz", "s", "t"] if normals else []
    head = [
        "ply", f"format {form} 1.0", f"element vertex {len(solid.vertices)}",
        *(f"property float {name}" for name in ["x", "y", "z", *extra]),
        f"element face {len(solid.faces)}", "property list uchar int vertex_indices",
        "end_header\n",
    ]  # fmt: skip
    values = np.column_stack([solid.vertices, np.zeros((len(solid.vertices), len(extra)))])
    if form == "ascii":
        faces = [f"{len(face)} {' '.join(map(str, face))}" for face in solid.faces]
        body = ("\n".join([*_rows(values), *faces]) + "\n").encode()
    else:
        order = "<" if "little" in form else ">"
        body = values.astype(f"{order}f4").tobytes() + b"".join(
            struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in solid.faces
        )
    return "\n".join(head).encode() + body


def stl(solid: Solid, *, text: bool) -> bytes:
    """Triangles with normals of zero, which STL allows."""
    points = solid.vertices[np.array(solid.triangles)]
    if not text:
        record = np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("rest", "<u2")])
        records = np.zeros(len(points), record)
        records["points"] = points
        return bytes(80) + struct.pack("<I", len(points)) + records.tobytes()
    lines = ["solid part"]
    for triangle in points:
        vertices = [f"vertex {row}" for row in _rows(triangle)]
        lines += ["facet normal 0 0 0", "outer loop", *vertices, "endloop", "endfacet"]
    return ("\n".join([*lines, "endsolid part"]) + "\n").encode()


def glb(solid: Solid, kind: str) -> bytes:
    """``kind``: "u1", "u2" or "u4" for indices of that type, "plain" for none, "strip" and "fan"
    for one primitive of that mode for each quadrilateral, "node" for a turned and scaled node.
    """
    vertices, order, mode = solid.vertices, np.array(solid.triangles).ravel(), 4
    groups = [order]
    if kind == "plain":
        vertices, groups = vertices[order], []
    elif kind in ("strip", "fan"):
        mode = 5 if kind == "strip" else 6
        # A pair of triangles (a, b, c), (a, c, d) is the strip b c a d and the fan a b c d.
        groups, k = [], 0
        while k < len(solid.triangles):
            one = solid.triangles[k]
            two = solid.triangles[k + 1] if k + 1 < len(solid.triangles) else []
            if two[:2] == [one[0], one[2]]:
                a, b, c, d = *one, two[2]
                groups.append(np.array([b, c, a, d] if kind == "strip" else [a, b, c, d]))
                k += 2
            else:
                groups.append(np.array(one))
                k += 1
    node: dict[str, object] = {"mesh": 0}
    if kind == "node":
        # The file's vertices are smaller and turned; the node turns them back.
        vertices = vertices[:, [2, 0, 1]] / 2
        node = {"mesh": 0, "matrix": [0, 0, 2, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 1]}
    width = kind if kind in ("u1", "u2", "u4") else "u4"
    binary = vertices.astype("<f4").tobytes()
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": len(binary)}]
    accessors: list[dict[str, object]] = [{
        "bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3",
        "min": vertices.min(0).tolist(), "max": vertices.max(0).tolist(),
    }]  # fmt: skip
    primitives: list[dict[str, object]] = []
    for group in groups:
        part = group.astype(f"<{width}").tobytes()
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)})
        binary += part + bytes(-len(part) % 4)
        accessors.append({
            "bufferView": len(views) - 1, "count": len(group), "type": "SCALAR",
            "componentType": {"u1": 5121, "u2": 5123, "u4": 5125}[width],
        })  # fmt: skip
        primitives.append(
            {"attributes": {"POSITION": 0}, "indices": len(accessors) - 1, "mode": mode}
        )
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node],
        "meshes": [{"primitives": primitives or [{"attributes": {"POSITION": 0}, "mode": 4}]}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(binary)}],
    }  # fmt: skip
    head = json.dumps(document).encode()
    head += b" " * (-len(head) % 4)
    size = 12 + 8 + len(head) + 8 + len(binary)
    return (
        struct.pack("<4sII", b"glTF", 2, size)
        + struct.pack("<I4s", len(head), b"JSON") + head
        + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )  # fmt: skip


POLYGONS: dict[str, Callable[[Solid], bytes]] = {
    "plain.obj": obj,
    "uv.obj": lambda solid: obj(solid, "{0}/{0}"),
    "normals.obj": lambda solid: obj(solid, "{0}//{0}"),
    "both.obj": lambda solid: obj(solid, "{0}/{0}/{0}"),
    "backward.obj": lambda solid: obj(solid, back=True),
    "plain.off": off,
    "text.ply": lambda solid: ply(solid, "ascii"),
    "little.ply": lambda solid: ply(solid, "binary_little_endian"),
    "big.ply": lambda solid: ply(solid, "binary_big_endian"),
    "normals.ply": lambda solid: ply(solid, "binary_little_endian", normals=True),
}
TRIANGLES: dict[str, Callable[[Solid], bytes]] = {
    "text.stl": lambda solid: stl(solid, text=True),
    "binary.stl": lambda solid: stl(solid, text=False),
    **{f"{kind}.glb": (lambda solid, kind=kind: glb(solid, kind))  # type: ignore[misc]
       for kind in ("u1", "u2", "u4", "plain", "strip", "fan", "node")},
}  # fmt: skip
"""Writers by the ending of the file's name."""
