"""PLY, the polygon file format (Turk 1994): its elements as columns of numbers.

ASCII and binary of either byte order, as on paulbourke.net/dataformats/ply. The header's lines end
in LF, CRLF or CR. What the columns mean is up to their readers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
"""Types of properties, and numpy's."""

FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
"""Formats, and numpy's sign of the byte order of the binary ones."""

SIZE = "size "
"""Prefix of the column with a list's sizes; no property's name has a space."""

_LINE = re.compile(rb"([^\r\n]*)(?:\r\n|\n|\r)")


class PlyError(ValueError):
    """Error for bytes that are not a PLY file, or a damaged one.

    Attributes:
        name: faulty property or element, or None.
        row: faulty row of the element, counted from 0, or None.
    """

    def __init__(self, message: str, name: str | None = None, row: int | None = None) -> None:
        self.name, self.row = name, row
        super().__init__(message)


@dataclass
class Element:
    """Element of a PLY file, such as its vertices.

    Attributes:
        count: number of rows.
        types: numpy's type of each column, in the order of a row.
        columns: values by the property's name. A list has two columns: its values, row after row,
            and before them ``size NAME``, how many each row has.
    """

    count: int
    types: dict[str, str] = field(default_factory=dict)
    columns: dict[str, npt.NDArray[Any]] = field(default_factory=dict)

    def scalars(self) -> dict[str, npt.NDArray[Any]]:
        """Return the columns of properties that are not lists."""
        return {
            name: column
            for name, column in self.columns.items()
            if not name.startswith(SIZE) and SIZE + name not in self.columns
        }


def parse_ply(data: Any) -> tuple[dict[str, Element], list[str]]:
    """Read the elements of a PLY file by name, and the comments of its header.

    Args:
        data: bytes of the file, or a memory map, of which scalar columns are views.

    Raises:
        PlyError: not a PLY file, a damaged header, a value that its type cannot hold, or fewer or
            more rows than the header announces.

    Example:
        >>> head = b"ply\\nformat ascii 1.0\\nelement face 1\\nproperty list uchar int corners\\n"
        >>> elements, _ = parse_ply(head + b"end_header\\n3 0 1 2\\n")
        >>> elements["face"].columns["corners"].tolist()
        [0, 1, 2]
    """
    lines, at = [], 0
    for line in _LINE.finditer(data) if data[:3] == b"ply" else ():
        lines.append(line[1].decode("utf-8", "replace").strip())
        at = line.end()
        if lines[-1] == "end_header":
            break
    if lines[:1] != ["ply"] or lines[-1] != "end_header":
        raise PlyError("not a PLY file, or its header has no end")
    order, elements, comments = _parse_header(lines[1:-1])
    if order:
        for name, element in elements.items():
            at = _parse_binary(data, at, name, element, order)
        left, unit = len(data) - at, "bytes"
    else:
        rows = [line.split() for line in bytes(data[at:]).splitlines() if line.strip()]
        for name, element in elements.items():
            _parse_text(rows[: element.count], name, element)
            rows = rows[element.count :]
        left, unit = len(rows), "lines"
    if left:
        raise PlyError(
            f"{left} {unit} are left after the rows that the header announces; the file is damaged,"
            " so get it again"
        )
    return elements, comments


def write_vertices(
    stream: Any, vertices: npt.NDArray[np.void], comments: Sequence[str] = ()
) -> None:
    """Write one element ``vertex`` of scalar properties as binary little-endian PLY.

    Args:
        stream: binary stream.
        vertices: (N,) structured array, whose fields have little-endian types of the format.
        comments: lines of the header.
    """
    names = {kind: name for name, kind in reversed(TYPES.items())}
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    head += [f"element vertex {len(vertices)}"]
    for name in vertices.dtype.names or ():
        head += [f"property {names[vertices.dtype[name].str[1:]]} {name}"]
    stream.write("\n".join([*head, "end_header", ""]).encode())
    stream.write(vertices.tobytes())


# --------------------------------------------------------------------------------------------------


def _parse_header(lines: list[str]) -> tuple[str, dict[str, Element], list[str]]:
    """Parse a header: the byte order, "" for text; elements without their columns; comments."""
    order: str | None = None
    elements: dict[str, Element] = {}
    types: dict[str, str] = {}
    comments: list[str] = []
    for number, line in enumerate(lines, 2):
        match line.split():
            case ["comment", *_]:
                comments.append(line.removeprefix("comment").strip())
            case ["obj_info", *_] | []:
                pass
            case ["format", name, "1.0"] if name in FORMATS and order is None:
                order = FORMATS[name]
            case ["element", name, count] if (
                re.fullmatch("[0-9]{1,18}", count) and name not in elements
            ):
                elements[name] = Element(int(count))
                types = elements[name].types
            case ["property", kind, name] if elements and kind in TYPES and name not in types:
                types[name] = TYPES[kind]
            case ["property", "list", size, kind, name] if (
                elements and kind in TYPES and TYPES.get(size, "f")[0] in "iu" and name not in types
            ):
                # No size is negative: one that seems so is too large for the file.
                types[SIZE + name] = TYPES[size].replace("i", "u")
                types[name] = TYPES[kind]
            case _:
                raise PlyError(f"damaged header: line {number} is {line[:80]!r}")
    if order is None:
        raise PlyError("damaged header: it names no format of PLY 1.0")
    return order, elements, comments


def _cut_off(name: str, row: int, count: int) -> PlyError:
    message = f"the body ends in row {row} of the {count} that the header announces"
    return PlyError(f"{message}; get the file again, whole", name, row)


def _parse_binary(data: Any, at: int, name: str, element: Element, order: str) -> int:
    """Fill an element from binary rows at an offset; return the offset behind them.

    Rows whose lists have the sizes of the first one are read at once, then those of the next sizes.
    """
    runs: list[npt.NDArray[np.void]] = []
    done, most = 0, element.count
    while done < element.count and element.types:
        layout = _layout(data, at, element, order)
        whole = (len(data) - at) // layout.itemsize if layout else 0
        if not whole:
            raise _cut_off(name, done, element.count)
        rows = np.frombuffer(data, layout, min(whole, most, element.count - done), at)
        alike = np.ones(len(rows), bool)
        for key in element.types:
            if key.startswith(SIZE):
                alike &= rows[key] == rows[key][0]
        count = len(rows) if alike.all() else int(np.argmin(alike))
        runs.append(rows[:count])
        done, at, most = done + count, at + count * rows.itemsize, max(64, 2 * count)
    for key, kind in element.types.items():
        values = [run[key].reshape(-1) for run in runs] or [np.zeros(0, kind)]
        element.columns[key] = values[0] if len(values) == 1 else np.concatenate(values)
    return at


def _layout(data: Any, at: int, element: Element, order: str) -> np.dtype[np.void] | None:
    """Build numpy's type of rows with lists as long as in the row at an offset; None if the data
    end in that row.
    """
    fields: list[Any] = []
    size: int | None = None
    for key, kind in element.types.items():
        fields.append((key, order + kind, () if size is None else (size,)))
        begin, at = at, at + np.dtype(kind).itemsize * (1 if size is None else size)
        if at > len(data):
            return None
        size = int(np.frombuffer(data, order + kind, 1, begin)[0]) if key.startswith(SIZE) else None
    return np.dtype(fields)


def _parse_text(rows: list[list[bytes]], name: str, element: Element) -> None:
    """Fill an element from the words of its lines."""
    if len(rows) < element.count:
        raise _cut_off(name, len(rows), element.count)
    words: dict[str, list[bytes]] = {key: [] for key in element.types}
    for number, row in enumerate(rows):
        at, size = 0, 1
        try:
            for key in element.types:
                words[key] += row[at : at + size]
                begin, at = at, at + size
                size = int(row[begin]) if key.startswith(SIZE) else 1
        except (IndexError, ValueError):
            at = -1
        if at != len(row):
            raise PlyError(f"row {number} is damaged: {b' '.join(row)[:80]!r}", name, number)
    for key, kind in element.types.items():
        try:
            values = np.array([*map(float, words[key])])
        except ValueError as error:
            raise PlyError(f"{error}; the file is damaged", key) from None
        # A number too large for a float becomes infinite; whoever uses the column refuses it.
        with np.errstate(invalid="ignore", over="ignore"):
            column = values.astype(kind)
        if kind[0] != "f" and (column != values).any():
            raise PlyError("has values that its type cannot hold; the file is damaged", key)
        element.columns[key] = column
