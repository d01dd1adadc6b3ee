"""A run's folder: one JSON file a cell, written to a temporary name, flushed to disk, then renamed.

Cells are in folders by the first two digits of their ids, since file systems list folders of
100,000 files slowly.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from attnwarp.errors import InputError
from attnwarp.io.file import inside, remove_abandoned
from attnwarp.io.lock import locked
from attnwarp_eval.canonical_json import digest, write_json

FORMAT = 2
"""Version of all files of a run; readers refuse other versions."""

OLDER = "made by an older version; run it again"

KINDS = {
    "study": "of a study (attnwarp-eval run)",
    "manifest": "on captures (attnwarp-eval captures, which writes its table)",
}
"""Key of a ``study.json`` that says what its run is of -> words for messages."""

T = TypeVar("T")


class StoreError(InputError):
    """A run's folder that cannot be used; the message names it and the remedy."""


@dataclass
class Problems:
    """Faults of a run; see :meth:`Store.verify`."""

    missing: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)
    unexpected: list[str] = field(default_factory=list)
    checked: int = 0

    @property
    def ok(self) -> bool:
        """True if every expected cell has a whole record."""
        return not (self.missing or self.failed or self.damaged)


class Store:
    """The folder of one run: ``study.json``, ``cells/``, ``failed/``, ``pictures/``.

    Example:
        >>> from attnwarp_eval.study import Store
        >>> store = Store("run")
        >>> from attnwarp_eval.canonical_json import digest
        >>> spec = {"scene": "bear"}
        >>> store.write({"id": digest(spec), "spec": spec, "answer": 42})
        >>> [store.whole(cell_id, lambda record: record["answer"]) for cell_id in store.done()]
        [42]
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self.cells = self.root / "cells"
        self.failed = self.root / "failed"
        self.pictures = self.root / "pictures"

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the folder against a second run.

        Raises:
            StoreError: another run holds the lock, or the folder cannot be a run's.
        """
        if self.root.exists() and not self.root.is_dir():
            raise StoreError(
                f"{self.root}: is a file, expected a run's folder (made if need be); choose another"
                " name"
            )
        self.root.mkdir(parents=True, exist_ok=True)
        with ExitStack() as held:
            lock = self.root / ".lock"
            try:
                held.enter_context(locked(lock, wait=False))
            except BlockingIOError:
                raise StoreError(
                    f"{self.root}: another run (process {lock.read_text()}) is writing to this"
                    " folder; wait for it, or name another with --out"
                ) from None
            self._sweep()
            yield

    def refuse_strangers(self, kind: str = "study") -> None:
        """Check that a run would overwrite only files of runs of its kind.

        Args:
            kind: subject of the run, a key of :data:`KINDS`.

        Raises:
            StoreError: the folder has files with a run's names and no study.json, or a run of
                another kind, or is the current folder with other files in it, as an empty path
                gives.
        """
        there: dict[str, Any] = {}
        with contextlib.suppress(OSError, ValueError):  # a damaged file is written anew
            there = _read_object(self.root / "study.json")
        self._check_kind(there, kind)
        if (self.root / "study.json").exists() or self.cells.is_dir():
            return  # the cells of a run whose study.json is lost are reused
        own = ("report.md", "report.html", "results.jsonl")
        files = [self.root / name for name in own if (self.root / name).exists()]
        if files:
            raise StoreError(
                f"{files[0]}: is there without a study.json, and a run would write over it; name"
                " another folder with --out, or move it away"
            )
        if self.root.resolve() == Path.cwd() and any(self.root.iterdir()):
            raise StoreError(
                f"--out: got {str(self.root)!r}, the current folder, which holds other things and"
                " no run; name a folder of its own"
            )

    def _sweep(self) -> None:
        """Remove the temporary files of runs that were killed."""
        folders = (self.root, self.cells, self.failed)
        for folder in (*folders, *self.cells.glob("*/"), *self.pictures.glob("*/")):
            remove_abandoned(folder)

    def write_study(self, study: dict[str, Any]) -> None:
        """Write the resolved study, its cells and a checksum; cells of another study stay."""
        # Keep the study's order: seconds are taken on a scene's first edit.
        write_json(self.root / "study.json", _sealed(study), sort_keys=False)

    def read_study(self) -> dict[str, Any]:
        """The content of a study's ``study.json``.

        Raises:
            StoreError: the folder is not a run, or one of another kind, an older version wrote it,
                or the file was changed after it was written.
        """
        path = self.root / "study.json"
        if not path.is_file():
            raise StoreError(
                f"{self.root}: not a run's folder (no study.json); "
                f"make one with: attnwarp-eval run quick --out {self.root}"
            )
        try:
            study = _read_object(path)
        except ValueError as error:
            problem: str | None = f"damaged ({error})"
        else:
            if study.get("format") != FORMAT:
                raise StoreError(f"{path}: {OLDER}")
            problem = _seal_problem(study)
        if problem:
            raise StoreError(
                f"{path}: {problem}; run the study again with --out {self.root}, which writes it"
                " anew"
            )
        self._check_kind(study, "study")
        return study

    def _check_kind(self, study: Mapping[str, Any], kind: str) -> None:
        """Raise StoreError if the content of a study.json is that of another kind of run."""
        other = next((name for name in KINDS if name in study and kind not in study), None)
        if other is not None:
            raise StoreError(f"{self.root}: is a run {KINDS[other]}; expected one {KINDS[kind]}")

    def path(self, cell_id: str) -> Path:
        """The path of a cell's record."""
        return self.cells / cell_id[:2] / f"{cell_id}.json"

    def done(self) -> set[str]:
        """Ids of the cells that have a record; a record's file is always whole."""
        return {path.stem for path in self.cells.glob("??/*.json")}

    def write(self, record: dict[str, Any]) -> None:
        """Write a finished cell's record, with its ``id``, and remove its earlier failure."""
        write_json(self.path(record["id"]), _sealed(record), durable=_flush_is_due())
        (self.failed / f"{record['id']}.json").unlink(missing_ok=True)

    def write_failure(self, cell_id: str, failure: dict[str, Any]) -> None:
        """Write the failure of a cell; the next run tries the cell again."""
        write_json(self.failed / f"{cell_id}.json", {**failure, "id": cell_id})

    def failures(self) -> list[dict[str, Any]]:
        """Failures of cells that have no record."""
        done = self.done()
        paths = sorted(self.failed.glob("*.json")) if self.failed.is_dir() else []
        failures = []
        for path in paths:
            if path.stem not in done:
                with contextlib.suppress(ValueError):
                    failures.append({**_read_object(path), "id": path.stem})
        return failures

    def read(self, cell_id: str) -> dict[str, Any]:
        """The record of a finished cell.

        Raises:
            StoreError: the file is missing, damaged, or written by an older version.
        """
        path = self.path(cell_id)
        try:
            record = _read_object(path)
        except FileNotFoundError:
            raise StoreError(f"{path}: no such cell") from None
        except ValueError as error:
            raise StoreError(
                f"{path}: not JSON ({error}); run again, which computes it anew"
            ) from None
        if record.get("format") != FORMAT:
            raise StoreError(f"{path}: {OLDER}")
        problem = _seal_problem(record) or self._path_problem(record)
        if _digest(record.get("spec")) != cell_id:
            problem = "the hash of its spec is not its id"
        if problem:
            raise StoreError(f"{path}: {problem}; run again, which computes it anew")
        return record

    def _path_problem(self, record: Mapping[str, Any]) -> str | None:
        """Fault of a record's file paths, which may come from another machine, or None."""
        try:
            for entry in (*record.get("pictures", ()), *record.get("files", ())):
                inside(self.root, entry["path"])
        except (InputError, LookupError, TypeError) as error:
            return f"names a file that is not of the run ({error})"
        return None

    def read_as(self, cell_id: str, read: Callable[[dict[str, Any]], T]) -> T:
        """Apply ``read`` to the record of a finished cell.

        Raises:
            StoreError: as :meth:`read`, or ``read`` refuses the record.
        """
        record = self.read(cell_id)
        try:
            return read(record)
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise StoreError(
                f"{self.path(cell_id)}: not a record of its probe ({type(error).__name__}:"
                f" {error}); run again, which computes it anew"
            ) from None

    def whole(self, cell_id: str, read: Callable[[dict[str, Any]], T]) -> T | None:
        """Apply ``read`` to a cell's record; None if it or a picture is missing or damaged."""
        with contextlib.suppress(StoreError):
            result, pictures = self.read_as(cell_id, lambda r: (read(r), r.get("pictures", [])))
            if not self.damaged_pictures(pictures):
                return result
        return None

    def keep_picture(self, path: Path, **about: str) -> dict[str, str]:
        """Entry of a record for a picture below the folder: ``about``, path and SHA-256."""
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        return {**about, "path": path.relative_to(self.root).as_posix(), "sha256": sha256}

    def verify(self) -> Problems:
        """Recompute every hash and compare with the list of expected cells."""
        study = self.read_study()
        expected = {c["id"]: c["title"] for c in study["cells"]}
        problems = Problems()
        done = self.done()
        failed = {f["id"]: f for f in self.failures()}
        for cell_id, title in expected.items():
            if cell_id in done:
                problems.checked += 1
                try:
                    record = self.read(cell_id)
                except StoreError as error:
                    problems.damaged.append(str(error))
                    continue
                problems.damaged += self.damaged_pictures(record.get("pictures", []))
            elif cell_id in failed:
                problems.failed.append(f"{title}: {failed[cell_id].get('error', 'failed')}")
            else:
                problems.missing.append(title)
        problems.unexpected = sorted(done - set(expected))
        return problems

    def damaged_pictures(self, pictures: Iterable[Mapping[str, Any]]) -> list[str]:
        """One line for each picture of a record that differs from its checksum."""
        remedy = f"run again with --out {self.root}, which makes it anew"
        bad = []
        for picture in pictures:
            path = self.root / picture["path"]
            if not path.is_file():
                bad.append(f"{path}: missing; {remedy}")
            elif hashlib.sha256(path.read_bytes()).hexdigest() != picture["sha256"]:
                bad.append(f"{path}: changed since it was written; {remedy}")
        return bad


FLUSH_SECONDS = 1.0
"""Least seconds between two flushes of cells to disk by one process.

A flush takes longer than a cheap cell. Between flushes the system writes the file within half a
minute; a record that a power cut damages fails its checksum and is computed again.
"""

_flushed = -FLUSH_SECONDS
"""Time at which this process last flushed a cell."""


def _flush_is_due() -> bool:
    global _flushed
    now = time.monotonic()
    if now - _flushed < FLUSH_SECONDS:
        return False
    _flushed = now
    return True


def _read_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        ValueError: the file is not JSON, or not an object; a one-line message.
    """
    value = json.loads(path.read_bytes())
    if not isinstance(value, dict):
        raise ValueError(f"got a {type(value).__name__}, expected an object")
    return value


def _sealed(content: dict[str, Any]) -> dict[str, Any]:
    """The content with the format's version, and the checksum of both."""
    body = {**_without_seal(content), "format": FORMAT}
    return {**body, "sha256": digest(body)}


def _without_seal(content: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in content.items() if key != "sha256"}


def _seal_problem(content: dict[str, Any]) -> str | None:
    if _digest(_without_seal(content)) != content.get("sha256"):
        return "its checksum does not fit its content"
    return None


def _digest(value: Any) -> str | None:
    """:func:`digest`, None for a value without one: numbers such as 1e999 are infinite."""
    try:
        return digest(value)
    except ValueError:
        return None
