"""Files by the names that other systems and programs write for them."""

from __future__ import annotations

import contextlib
import re
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote

from attnwarp.io.file import is_file


def name_key(name: str) -> str:
    """Key that all spellings of one name share: backslashes are slashes, URL escapes their
    characters, and neither case nor the form of accents (NFC, NFD) counts.

    Example:
        >>> from attnwarp.io.find import name_key
        >>> name_key("Images\\\\A%20b.PNG")
        'images/a b.png'
    """
    plain = unquote(name).replace("\\", "/")
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", plain).casefold())


class FileFinder:
    """The files below a folder, by names that may be those of another system.

    A folder's list is read once, and only where a name is not there as it is.

    Args:
        folder: that names are relative to.
        suffixes: that a name may lack, in the order in which they are tried.

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
        """The file that a name means, if there is one and no second: its own before those of
        another spelling. Otherwise the path of the name as it is.
        """
        for suffix in self.suffixes:
            if is_file(path := self.folder / f"{name}{suffix}"):
                return path
        others = self.others(name)
        return others[0] if len(others) == 1 else self.folder / name

    def others(self, name: str) -> list[Path]:
        """The files that a name may mean in another spelling."""
        plain = name.replace("\\", "/")
        if plain.startswith("/") or re.match("[A-Za-z]:", plain):
            return []
        return sorted(set(self._below(self.folder, [p for p in plain.split("/") if p not in "."])))

    def entries(self, name: str) -> list[Path]:
        """The files and folders in the folder itself that are of this name in some spelling."""
        return self._entries(self.folder).get(name_key(name), [])

    def tail(self, name: str) -> list[Path]:
        """The files below the folder that have the longest last part of a path in common with
        ``name``, whatever folder of whatever machine that begins with.
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
        # A backslash may be part of a file's name, as some programs unpack archives.
        rest, entries = "/".join(parts), self._entries(folder)
        for suffix in self.suffixes:
            yield from filter(is_file, entries.get(name_key(f"{rest}{suffix}"), []))
        for path in entries.get(name_key(parts[0]), []) if len(parts) > 1 else []:
            yield from self._below(path, parts[1:])

    def _entries(self, folder: Path) -> dict[str, list[Path]]:
        """The entries of a folder by the keys of their names; none of what is no folder."""
        if folder not in self._lists:
            entries: dict[str, list[Path]] = {}
            with contextlib.suppress(OSError):
                for path in sorted(folder.iterdir()):
                    entries.setdefault(name_key(path.name), []).append(path)
            self._lists[folder] = entries
        return self._lists[folder]
