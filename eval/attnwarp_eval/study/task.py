"""Work that no study names, stored and resumed as a study's cells are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from attnwarp.reporting import SILENT, Part, Reporter
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.store import Store

T = TypeVar("T")


@dataclass(frozen=True)
class Task(Generic[T]):
    """A unit of work whose record is a cell of a folder.

    Attributes:
        title: for the display of progress.
        spec: everything that decides the result, and nothing else.
        compute: makes the rest of the record, as JSON.
        read: makes the result of a record; a record that it cannot read is computed again.
    """

    title: str
    spec: Json
    compute: Callable[[Reporter], Json]
    read: Callable[[Json], T]


def results(
    store: Store, tasks: Iterable[Task[T]], total: int, report: Reporter = SILENT
) -> Iterator[T]:
    """The results of tasks, in their order. After an interruption only missing ones are computed.

    Args:
        store: store of the folder, which is locked meanwhile.
        tasks: taken one by one, so that what one of them holds can be freed.
        report: receives each task, and what is at work in it.

    Raises:
        StoreError: another run is writing to the folder.

    Example:
        >>> squares = [
        ...     Task(f"{x} squared", {"x": x}, lambda report, x=x: {"y": x * x}, lambda r: r["y"])
        ...     for x in (2, 3)
        ... ]
        >>> list(results(Store("run"), squares, 2))
        [4, 9]
    """
    with store.lock():
        for number, task in enumerate(tasks):
            report.step(number, total, task.title)
            cell_id = digest(task.spec)
            result = store.whole(cell_id, task.read)
            if result is None:
                store.write(
                    {"id": cell_id, "spec": task.spec, **task.compute(Part(report, number, total))}
                )
                result = store.read_as(cell_id, task.read)  # as a resumed run reads it
            yield result
    report.step(total, total, "done")
