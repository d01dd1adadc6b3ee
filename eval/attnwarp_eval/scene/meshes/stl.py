"""STL: triangles, in binary or in text."""

from __future__ import annotations

import re
import struct

import numpy as np

from attnwarp_eval.scene.meshes.surface import Surface, clip, decimal, lines

RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

FACET = [
    "facet", "normal", None, None, None, "outer", "loop",
    *["vertex", None, None, None] * 3, "endloop", "endfacet",
]  # fmt: skip
"""Words of a facet; None stands for a number."""


def read_stl(data: bytes) -> Surface:
    """Read the triangles of an STL file, three vertices for each.

    Raises:
        ValueError: a size that differs from the header's, or an incomplete facet.
    """
    count = struct.unpack("<I", data[80:84])[0] if len(data) >= 84 else -1
    if len(data) == 84 + RECORD.itemsize * count:
        points = np.frombuffer(data, RECORD, offset=84)["corners"].astype(np.float64)
    elif data[:5].lower() == b"solid":
        points = _text(data)
    else:
        raise ValueError(
            f"announces {max(count, 0)} triangles, which take {84 + 50 * max(count, 0)} bytes, but"
            f" has {len(data)}"
        )
    vertices = points.reshape(-1, 3)
    return Surface(
        vertices, np.arange(len(vertices), dtype=np.int64), np.full(len(vertices) // 3, 3, np.int64)
    )


def _text(data: bytes) -> np.ndarray:
    values: list[float] = []
    inside, facet = False, 0
    for line, raw in lines(data):
        # The rest of the line after solid and endsolid is a name.
        words = re.split(r"\s+", raw.strip()) if raw.strip() else []
        while words:
            if facet == 0 and words[0].lower() == ("endsolid" if inside else "solid"):
                inside, words = not inside, []
                continue
            wanted = FACET[facet]
            if not inside or (wanted is not None and words[0].lower() != wanted):
                expected = "solid" if not inside else wanted
                raise ValueError(f"line {line}: got {clip(words[0])}, expected {expected}")
            if wanted is None:
                value = decimal(words[0], line) if facet > 4 else 0.0  # normals may be anything
                if facet > 4:
                    values.append(value)
            facet = (facet + 1) % len(FACET)
            words = words[1:]
    if inside or facet:
        raise ValueError("ends before endsolid")
    return np.array(values).reshape(-1, 3, 3)
