"""Result of a cell, typed from probe to report; JSON only in ``to_json``, ``from_json``."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from attnwarp_eval.canonical_json import without_nan

Json = dict[str, Any]


class Extra(Protocol):
    """Entries that the records of one probe hold besides figures."""

    def to_json(self) -> Json:
        """Entries of the record; entries under ``cost`` go into the record's cost."""
        ...


E = TypeVar("E", bound=Extra)


@dataclass(frozen=True)
class NoExtra:
    """Extra of a record that holds figures alone."""

    def to_json(self) -> Json:
        """No entry."""
        return {}


@dataclass(frozen=True)
class View:
    """Figures of one target view.

    Attributes:
        name: target name, or ``task/target``, where the task may be an edit.
        yaw: degrees from the source, in [0, 180]; 0 if the figures involve no camera.
        metrics: figures by name; NaN where undefined.
    """

    name: str
    yaw: float
    metrics: Mapping[str, float]

    def to_json(self) -> Json:
        """Entry of a record's file: null where undefined, integers as integers."""
        return {"view": self.name, "yaw": self.yaw, "metrics": finite(self.metrics)}

    @classmethod
    def from_json(cls, data: Json) -> View:
        """Rebuild from :meth:`to_json`."""
        return cls(data["view"], float(data["yaw"]), with_nan(data["metrics"]))


@dataclass(frozen=True)
class PictureFile:
    """A picture of one view, its path relative to the run's folder."""

    view: str
    content: str
    path: str
    sha256: str

    def to_json(self) -> Json:
        """Entry of a record's file."""
        return {
            "view": self.view,
            "what": self.content,
            "path": self.path,
            "sha256": self.sha256,
        }

    @classmethod
    def from_json(cls, data: Json) -> PictureFile:
        """Rebuild from :meth:`to_json`."""
        return cls(data["view"], data["what"], data["path"], data["sha256"])


@dataclass(frozen=True)
class Cost:
    """Cost of a cell.

    Attributes:
        seconds: seconds by stage; None for an empty stage.
        counters: counts of work, such as pixels or pairs.
        peak_memory_mb: peak memory of the process during the cell, MiB, including memory it held
            before; of the whole process so far if the system cannot reset the peak (not Linux).
    """

    seconds: Mapping[str, float | None]
    counters: Mapping[str, int]
    peak_memory_mb: float
    threads: int

    def to_json(self) -> Json:
        """Entry of a record's file."""
        return {
            "seconds": dict(self.seconds),
            "counters": dict(self.counters),
            "peak_memory_mb": self.peak_memory_mb,
            "threads": self.threads,
        }

    @classmethod
    def from_json(cls, data: Json) -> Cost:
        """Rebuild from :meth:`to_json`; ignores further entries of the probe."""
        return cls(data["seconds"], data["counters"], data["peak_memory_mb"], data["threads"])


_environments: dict[tuple[Any, ...], Environment] = {}
"""Environments read so far. A run's records share a few; copies would fill most of the memory."""


@dataclass(frozen=True)
class Environment:
    """Environment in which a cell was computed.

    Attributes:
        versions: versions of Python and packages.
        machine: ``system``, ``arch`` and ``cores``.
        revision: revision of the source; None for an installed copy.
        dirty: whether the source had local changes.
        source: SHA-256 of the source.
    """

    versions: Mapping[str, str]
    machine: Mapping[str, Any]
    revision: str | None
    dirty: bool | None
    source: str

    def to_json(self) -> Json:
        """Entry of a record's file, as :func:`attnwarp_eval.cost.environment` gives it."""
        return {
            "versions": dict(self.versions),
            "machine": dict(self.machine),
            "git": {"sha": self.revision, "dirty": self.dirty},
            "source": self.source,
        }

    @classmethod
    def from_json(cls, data: Json) -> Environment:
        """Rebuild from :meth:`to_json`; one object for all records of the same environment."""
        versions, machine, git = data["versions"], data["machine"], data["git"]
        code = (git["sha"], git["dirty"], data["source"])
        key = (cls, *versions.items(), *machine.items(), *code)
        if key not in _environments:
            _environments[key] = cls(versions, machine, *code)
        return _environments[key]

    def same_code(self, other: Environment) -> bool:
        """Return True if both were computed by the same state of the source and the same packages.

        The hash of the source decides: revisions that differ only in documents are the same code.
        """
        return (self.versions, self.source) == (other.versions, other.source)


@dataclass(frozen=True)
class Record(Generic[E]):
    """The result of one cell.

    Attributes:
        id, spec: id and spec of the cell; see :class:`attnwarp_eval.study.cell.Cell`.
        pictures: picture files in the run's folder.
        extra: entries specific to this probe.
    """

    id: str
    spec: Json
    views: tuple[View, ...]
    pictures: tuple[PictureFile, ...]
    cost: Cost
    environment: Environment
    extra: E

    @property
    def comparable(self) -> bool:
        """False if the source's edit failed: the figures then say nothing about the method."""
        return bool(getattr(self.extra, "comparable", True))

    def to_json(self) -> Json:
        """Entries for :meth:`attnwarp_eval.study.store.Store.write`."""
        own = self.extra.to_json()
        cost = {**self.cost.to_json(), **own.pop("cost", {})}
        return {
            "id": self.id,
            "spec": self.spec,
            "views": [view.to_json() for view in self.views],
            "pictures": [picture.to_json() for picture in self.pictures],
            **own,
            "cost": cost,
            "environment": self.environment.to_json(),
        }

    @classmethod
    def from_json(cls, data: Json, extra: E) -> Record[E]:
        """Rebuild from :meth:`to_json`, with the extra that its probe read."""
        return cls(
            data["id"],
            data["spec"],
            tuple(map(View.from_json, data["views"])),
            tuple(map(PictureFile.from_json, data["pictures"])),
            Cost.from_json(data["cost"]),
            Environment.from_json(data["environment"]),
            extra,
        )


@dataclass(frozen=True)
class Failure:
    """Reason why a cell has no record."""

    scene: str
    variant: str
    probe: str
    error: str
    title: str = ""
    traceback: str = field(default="", repr=False)
    id: str = ""

    @classmethod
    def from_json(cls, data: Json) -> Failure:
        """Read from a failure's file."""
        names = ("scene", "variant", "probe", "error", "title", "traceback", "id")
        return cls(**{name: str(data.get(name, "")) for name in names})


def finite(figures: Mapping[str, float]) -> dict[str, float | int | None]:
    """Figures as JSON numbers: null for NaN and infinities."""
    return dict(without_nan(figures))


def with_nan(figures: Mapping[str, float | int | None]) -> dict[str, float]:
    """Inverse of :func:`finite`: NaN for null. The records of a run share the name strings."""
    return {
        sys.intern(name): math.nan if value is None else value for name, value in figures.items()
    }
