"""Text files of other systems and editors: byte order marks and line ends."""

from __future__ import annotations

import codecs
from pathlib import Path

MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
"""Encodings by byte order mark, as written by Windows' editors and shells."""


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
