"""Lookup of files by names written by other systems and programs."""

from __future__ import annotations

import contextlib
import re
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote

from attnwarp.io.file import is_file


def name_key(name: str) -> str:
    """Compute a key shared by all spellings of a name: backslashes become slashes, URL escapes
    their characters; case and the form of accents (NFC, NFD) are ignored.

    Example:
        >>> from attnwarp.io.find import name_key
        >>> name_key("Images\\\\A%20b.PNG")
        'images/a b.png'
    """
    plain = unquote(name).replace("\\", "/")
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", plain).casefold())


class FileFinder:
    """Finder of files below a folder by names that may come from another system.

    A folder is listed once, and only if a name does not exist literally.

    Args:
        suffixes: suffixes to try for a name without suffix, in order.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp.io.find import FileFinder
        >>> Path("views").mkdir()
        >>> Path("views/a.png").touch()
        >>> FileFinder(Path("."), [".png"]).find(".\\\\Views\\\\A").as_posix()
        'views/a.png'
    """

    def __init__(self, folder: Path, suffixes: Sequence[str] = ()) -> None:
        self.folder = folder
        self.suffixes = ("", *suffixes)
        self._lists: dict[Path, dict[str, list[Path]]] = {}

    def find(self, name: str) -> Path:
        """Find the file of a name: the exact spelling first, else a unique file of another
        spelling. Without one, return the path of the name unchanged.
        """
        for suffix in self.suffixes:
            if is_file(path := self.folder / f"{name}{suffix}"):
                return path
        others = self.others(name)
        return others[0] if len(others) == 1 else self.folder / name

    def others(self, name: str) -> list[Path]:
        """List the files that match a name in another spelling."""
        plain = name.replace("\\", "/")
        if plain.startswith("/") or re.match("[A-Za-z]:", plain):
            return []
        return sorted(set(self._below(self.folder, [p for p in plain.split("/") if p not in "."])))

    def entries(self, name: str) -> list[Path]:
        """List direct children of the folder that match this name in some spelling."""
        return self._entries(self.folder).get(name_key(name), [])

    def tail(self, name: str) -> list[Path]:
        """List the files below the folder that share the longest trailing part of a path with
        ``name``, ignoring the leading folders of the original machine.
        """
        parts = [part for part in re.split(r"[\\/]", name) if part not in (".", "..", "")]
        tails = ("/".join(parts[start:]) for start in range(len(parts)))
        return next((found for each in tails if (found := self.others(each))), [])

    def _below(self, folder: Path, parts: list[str]) -> Iterator[Path]:
        if not parts:
            return
        if parts[0] == "..":
            yield from self._below(folder / "..", parts[1:])
            return
        # A backslash may be part of a file's name, as some archive programs create.
        rest, entries = "/".join(parts), self._entries(folder)
        for suffix in self.suffixes:
            yield from filter(is_file, entries.get(name_key(f"{rest}{suffix}"), []))
        for path in entries.get(name_key(parts[0]), []) if len(parts) > 1 else []:
            yield from self._below(path, parts[1:])

    def _entries(self, folder: Path) -> dict[str, list[Path]]:
        """Map name keys to the entries of a folder; empty for a path that is no folder."""
        if folder not in self._lists:
            entries: dict[str, list[Path]] = {}
            with contextlib.suppress(OSError):
                for path in sorted(folder.iterdir()):
                    entries.setdefault(name_key(path.name), []).append(path)
            self._lists[folder] = entries
        return self._lists[folder]
