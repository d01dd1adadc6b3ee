"""A run's folder: one JSON file a cell, written beside its name, flushed to disk, then renamed."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attnwarp.errors import InputError
from attnwarp.io.file import remove_abandoned
from attnwarp_eval.files import digest, write_json

FORMAT = 1
"""Version of the layout of a cell's file; a reader refuses others."""


class StoreError(InputError):
    """A run's folder that cannot be used; the message says which and what to do."""


@dataclass
class Problems:
    """What is wrong with a run; see :meth:`Store.verify`."""

    missing: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)
    unexpected: list[str] = field(default_factory=list)
    checked: int = 0

    @property
    def ok(self) -> bool:
        """Whether every expected cell has a whole record."""
        return not (self.missing or self.failed or self.damaged)


class Store:
    """The folder of one run: ``study.json``, ``cells/``, ``failed/``, ``pictures/``.

    Example:
        >>> from attnwarp_eval.study import Store
        >>> store = Store("run")
        >>> record = store.resumed({"scene": "bear"}, lambda: {"answer": 42})
        >>> again = store.resumed({"scene": "bear"}, lambda: {"answer": 0})  # read, not computed
        >>> again["answer"], store.done() == {record["id"]}
        (42, True)
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self.cells = self.root / "cells"
        self.failed = self.root / "failed"
        self.pictures = self.root / "pictures"

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the folder against a second run that would write to it."""
        self.root.mkdir(parents=True, exist_ok=True)
        with (self.root / ".lock").open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreError(
                    f"{self.root}: another run is writing to this folder; wait for it, or name"
                    " another with --out"
                ) from None
            self._sweep()
            yield

    def _sweep(self) -> None:
        """Remove the temporary files of runs that were killed."""
        for folder in (self.root, self.cells, self.failed, *self.pictures.glob("*/")):
            remove_abandoned(folder)

    def write_study(self, study: dict[str, Any]) -> None:
        """Write the resolved study and its expected cells. Cells of a former study stay."""
        write_json(self.root / "study.json", study)

    def read_study(self) -> dict[str, Any]:
        """The resolved study.

        Raises:
            StoreError: the folder is not a run.
        """
        path = self.root / "study.json"
        if not path.is_file():
            raise StoreError(
                f"{self.root}: not a run's folder (no study.json); "
                f"make one with: attnwarp-eval run quick --out {self.root}"
            )
        try:
            study: dict[str, Any] = json.loads(path.read_text())
            if "cells" in study:
                return study
        except (ValueError, AttributeError):
            pass
        raise StoreError(
            f"{path}: damaged; run the study again with --out {self.root}, which writes it anew"
        )

    def path(self, cell_id: str) -> Path:
        """The path of a cell's record."""
        return self.cells / f"{cell_id}.json"

    def done(self) -> set[str]:
        """Ids of the cells that have a record; a record's file is always whole."""
        return {p.stem for p in self.cells.glob("*.json")} if self.cells.is_dir() else set()

    def write(self, record: dict[str, Any]) -> None:
        """Write the record of a finished cell, and remove a former failure of it.

        Args:
            record: with at least ``id`` and ``spec``.
        """
        sealed = {**record, "format": FORMAT}
        sealed["sha256"] = digest(sealed)
        write_json(self.path(record["id"]), sealed)
        (self.failed / f"{record['id']}.json").unlink(missing_ok=True)

    def write_failure(self, cell_id: str, failure: dict[str, Any]) -> None:
        """Write why a cell failed; the next run tries it again."""
        write_json(self.failed / f"{cell_id}.json", {"id": cell_id, **failure})

    def failures(self) -> list[dict[str, Any]]:
        """Failures of cells that have no record."""
        done = self.done()
        paths = sorted(self.failed.glob("*.json")) if self.failed.is_dir() else []
        failures = []
        for path in paths:
            if path.stem not in done:
                with contextlib.suppress(ValueError):
                    failures.append(json.loads(path.read_text()))
        return failures

    def read(self, cell_id: str) -> dict[str, Any]:
        """The record of a finished cell.

        Raises:
            StoreError: the file is missing, damaged, or of another layout.
        """
        path = self.path(cell_id)
        try:
            record: dict[str, Any] = json.loads(path.read_text())
        except FileNotFoundError:
            raise StoreError(f"{path}: no such cell") from None
        except ValueError as error:
            raise StoreError(f"{path}: not JSON ({error}); delete it and run again") from None
        problem = self._problem(cell_id, record)
        if problem:
            raise StoreError(f"{path}: {problem}; delete it and run again")
        return record

    def resumed(
        self, spec: dict[str, Any], compute: Callable[[], dict[str, Any]]
    ) -> dict[str, Any]:
        """The record of a cell: read where it is finished and whole, else computed and written.

        Args:
            spec: everything that decides the result, and nothing else; its hash is the cell's id.
            compute: makes the rest of the record, as JSON.

        Returns:
            The record, as it is read back, so that a resumed run cannot differ from a whole one.
        """
        cell_id = digest(spec)
        if self.path(cell_id).is_file():
            with contextlib.suppress(StoreError):  # a damaged record is computed again
                record = self.read(cell_id)
                if not self._damaged_pictures(record):
                    return record
        self.write({"id": cell_id, "spec": spec, **compute()})
        return self.read(cell_id)

    def keep_picture(self, path: Path, **about: str) -> dict[str, str]:
        """What a record says of a picture that was written below the folder: ``about``, its path
        and its SHA-256.
        """
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        return {**about, "path": path.relative_to(self.root).as_posix(), "sha256": sha256}

    def _problem(self, cell_id: str, record: dict[str, Any]) -> str | None:
        if record.get("format") != FORMAT:
            return f"format {record.get('format')!r}, expected {FORMAT}"
        if digest(record.get("spec")) != cell_id:
            return "the hash of its spec is not its id"
        body = {k: v for k, v in record.items() if k != "sha256"}
        if digest(body) != record.get("sha256"):
            return "its checksum does not fit its content"
        return None

    def verify(self) -> Problems:
        """Recompute every hash and compare with the list of expected cells."""
        expected = {c["id"]: c["title"] for c in self.read_study()["cells"]}
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
                problems.damaged += self._damaged_pictures(record)
            elif cell_id in failed:
                problems.failed.append(f"{title}: {failed[cell_id].get('error', 'failed')}")
            else:
                problems.missing.append(title)
        problems.unexpected = sorted(done - set(expected))
        return problems

    def _damaged_pictures(self, record: dict[str, Any]) -> list[str]:
        bad = []
        for picture in record.get("pictures", []):
            path = self.root / picture["path"]
            if not path.is_file():
                bad.append(f"{path}: missing; delete {self.path(record['id'])} and run again")
            elif hashlib.sha256(path.read_bytes()).hexdigest() != picture["sha256"]:
                bad.append(
                    f"{path}: changed since it was written; delete {self.path(record['id'])} and"
                    " run again"
                )
        return bad
