"""Text files of other systems and editors: byte order marks and line ends."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
"""Encodings by byte order mark, as written by Windows' editors and shells."""

_LINE_ENDS = re.compile(rb"\r\n|\n|\r")


def read_text(path: Path, errors: str = "strict") -> str:
    """Read a text file, in UTF-8 or with a byte order mark, with line ends ``\\n``.

    Example:
        >>> from pathlib import Path
        >>> written = Path("a.txt").write_bytes("a\\r\\nb\\rc".encode("utf-16"))
        >>> read_text(Path("a.txt"))
        'a\\nb\\nc'
    """
    data = path.read_bytes()
    encoding = next((name for mark, name in MARKS.items() if data.startswith(mark)), "utf-8")
    text = data.decode(encoding, errors)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def split_ply(data: bytes) -> tuple[list[bytes], int] | None:
    """Split a PLY file into its header's lines up to ``end_header`` and the offset of its body;
    None if the header does not end.

    Only a separate line ends the header: a comment may contain the word.
    """
    lines, start = [], 0
    for match in _LINE_ENDS.finditer(data):
        lines.append(data[start : match.start()])
        start = match.end()
        if lines[-1].strip() == b"end_header":
            return lines, start
    return None


def plain_ply(data: bytes) -> bytes:
    """Convert the line ends of a PLY file's header and text body to ``\\n``."""
    found = split_ply(data)
    if found is None:
        return data
    lines, start = found
    body = data[start:]
    if is_text(lines):
        body = _LINE_ENDS.sub(b"\n", body)
    return b"\n".join(lines) + b"\n" + body


def overstated(lines: list[bytes], size: int) -> tuple[str, str] | None:
    """Find the first element for which a PLY header announces more rows than the file has bytes,
    and its announced number; None without one. Readers allocate memory for announced rows.

    Example:
        >>> overstated([b"ply", b"element vertex 8", b"element face 200000000"], 300)
        ('face', '200000000')
    """
    found = re.findall(rb"^\s*element\s+(\S+)\s+(\d+)", b"\n".join(lines), re.MULTILINE)
    for name, digits in found:
        if len(digits) > 18 or int(digits) > size:
            return name.decode("ascii", "replace"), digits[:30].decode()
    return None


def is_text(lines: list[bytes]) -> bool:
    """Return True if a PLY header announces a text body."""
    return any(line.split()[:2] == [b"format", b"ascii"] for line in lines)
