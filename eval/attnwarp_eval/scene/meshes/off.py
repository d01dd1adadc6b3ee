"""Geomview's OFF: vertices with or without colours, and polygons."""

from __future__ import annotations

import re

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

HEADER = re.compile(r"(ST)?(C)?(N)?(4)?(n)?OFF")


def read_off(data: bytes) -> Surface:
    """Read the polygons of a text OFF file (Geomview manual, section 4.2.5).

    Raises:
        ValueError: another dimension, a binary file, or numbers of vertices, faces and
            corners that differ from the header's.
    """
    rows = [
        (number, words) for number, line in lines(data) if (words := line.partition("#")[0].split())
    ]
    match = HEADER.fullmatch(rows[0][1][0]) if rows else None
    if match is None:
        start = clip(rows[0][1][0]) if rows else "nothing"
        raise ValueError(f"begins with {start}, expected OFF")
    texture, color, normal, four, other = (bool(group) for group in match.groups())
    if four or other or "BINARY" in rows[0][1]:
        raise ValueError(f"{match[0]} of another dimension or in binary is not read; write OFF")
    rows[0] = (rows[0][0], rows[0][1][1:])
    if not rows[0][1]:
        rows.pop(0)
    if not rows or len(rows[0][1]) not in (2, 3):
        raise ValueError("expected the numbers of vertices, faces and edges after OFF")
    line, counts = rows[0]
    n_vertices, n_faces = (whole(word, line) for word in counts[:2])
    rows = rows[1:]
    if min(n_vertices, n_faces) < 0 or n_vertices + n_faces != len(rows):
        raise ValueError(
            f"announces {n_vertices} vertices and {n_faces} faces, but {len(rows)} lines follow"
        )
    columns = 3 + 3 * normal
    widths = {columns + c + 2 * texture for c in ((3, 4) if color else (0,))}
    values = np.zeros((n_vertices, columns + 3 * color))
    for k, (line, words) in enumerate(rows[:n_vertices]):
        if len(words) not in widths:
            raise ValueError(
                f"line {line}: a vertex has {len(words)} numbers, expected"
                f" {' or '.join(map(str, sorted(widths)))}"
            )
        values[k] = [decimal(word, line) for word in words[: values.shape[1]]]
    faces, painted = [], 0
    for line, words in rows[n_vertices:]:
        size = whole(words[0], line)
        extra = len(words) - 1 - size
        if size < 3 or extra not in (0, 1, 3, 4):
            raise ValueError(
                f"line {line}: a face announces {size} corners, and {len(words) - 1} numbers follow"
            )
        faces.append([whole(word, line) for word in words[1 : size + 1]])
        painted += extra > 0
    corners, sizes = polygons(faces)
    tint = unit_colors(values[:, columns : columns + 3]) if color else None
    ignored = (f"colours of {painted} faces",) if painted else ()
    return Surface(values[:, :3].copy(), corners, sizes, tint, ignored)
