"""Wavefront OBJ: vertices with or without colours, and polygons."""

from __future__ import annotations

import codecs
from collections import Counter

import numpy as np

from attnwarp_eval.scene.meshes.surface import (
    Surface,
    clip,
    decimal,
    lines,
    polygons,
    unit_colors,
    whole,
)

UNUSED = frozenset([
    "vn", "vt", "vp", "g", "o", "s", "mg", "usemtl", "mtllib", "maplib", "usemap", "lod", "bevel",
    "c_interp", "d_interp", "shadow_obj", "trace_obj", "ctech", "stech", "deg", "cstype", "bmat",
    "step", "parm", "trim", "hole", "scrv", "sp", "end", "con", "call", "csh",
])  # fmt: skip
"""Keywords that do not affect polygons."""

NOT_SURFACES = {"l": "lines", "p": "points", "curv": "curves", "curv2": "curves",
                "surf": "free-form surfaces"}  # fmt: skip


def read_obj(data: bytes) -> Surface:
    """Read the polygons of an OBJ file (Wavefront's Advanced Visualizer manual, appendix B).

    Raises:
        ValueError: text in UTF-16, a line that cannot be read, or an undefined vertex.
    """
    if data[:2] in (b"\xfe\xff", b"\xff\xfe"):
        raise ValueError("is text in UTF-16, expected ASCII or UTF-8; save it as UTF-8")
    data = data.removeprefix(codecs.BOM_UTF8)  # written by Windows editors
    vertices: list[list[float]] = []
    colors: list[list[float]] = []
    faces: list[list[int]] = []
    ignored: Counter[str] = Counter()
    materials = False
    number, pending = 0, ""
    for number, raw in lines(data):
        line = pending + raw
        if line.endswith("\\"):
            pending = line[:-1] + " "
            continue
        pending = ""
        words = line.partition("#")[0].split()
        if not words:
            continue
        key, rest = words[0], words[1:]
        if key == "v":
            if len(rest) not in (3, 4, 6, 7, 8):
                raise ValueError(f"line {number}: a vertex has {len(rest)} numbers, expected 3")
            values = [decimal(word, number) for word in rest]
            vertices.append(values[:3])
            if len(values) >= 6:
                colors.append(values[3:6])
        elif key in ("f", "fo"):
            faces.append(_face(rest, len(vertices), number))
        elif key in NOT_SURFACES:
            ignored[NOT_SURFACES[key]] += 1
        elif key in UNUSED:
            materials |= key == "usemtl"
        else:
            raise ValueError(f"line {number}: got the keyword {clip(key)}, which OBJ does not have")
    if pending:
        raise ValueError(f"line {number}: ends in a continuation that does not come")
    words_ignored = [f"{count} {name}" for name, count in ignored.items()]
    if materials:
        words_ignored.append("materials and their textures")
    tint = None
    if colors and len(colors) == len(vertices):
        tint = unit_colors(np.array(colors))
    elif colors:
        words_ignored.append(f"colours of {len(colors)} of {len(vertices)} vertices")
    corners, sizes = polygons(faces)
    cut_off = None if data.endswith((b"\n", b"\r")) else "its last line has no end"
    points = np.array(vertices).reshape(-1, 3)
    return Surface(points, corners, sizes, tint, tuple(words_ignored), cut_off, first=1)


def _face(words: list[str], vertices: int, line: int) -> list[int]:
    if len(words) < 3:
        raise ValueError(f"line {line}: a face has {len(words)} corners, expected at least 3")
    face = []
    for word in words:
        corner = word.partition("/")[0]  # v, v/vt, v//vn or v/vt/vn
        index = whole(corner, line)
        # Counted from 1; a negative one counts back from the vertices so far.
        index = index - 1 if index > 0 else vertices + index if index < 0 else -1
        if index < 0:
            raise ValueError(
                f"line {line}: a face names vertex {clip(corner)}, but there are {vertices}"
            )
        face.append(index)
    return face
