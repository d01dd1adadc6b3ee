"""Work outside studies, stored and resumed like a study's cells."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

from attnwarp.reporting import SILENT, Part, Reporter
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.cost import environment
from attnwarp_eval.study.record import Environment, Json
from attnwarp_eval.study.store import Store

T = TypeVar("T")


@dataclass(frozen=True)
class Task(Generic[T]):
    """Unit of work whose record is a cell of a folder.

    Attributes:
        spec: all inputs that decide the result, and no others.
        compute: function that computes the rest of the record, as JSON.
        read: function from record to result; a record that it refuses is computed again.
    """

    title: str
    spec: Json
    compute: Callable[[Reporter], Json]
    read: Callable[[Json], T]


def results(
    store: Store, tasks: Iterable[Task[T]], total: int, report: Reporter = SILENT
) -> Iterator[T]:
    """Compute the results of tasks, in order. After an interruption only missing ones are computed.

    A record has the environment that computed it. One of other code, versions or another machine is
    computed again: what is written of results has one environment, that of now.

    Args:
        store: store of the folder, locked during the call.
        tasks: tasks, consumed one by one, so that each can be freed.
        report: callback for each task and its progress.

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
    this = Environment.from_json(environment())

    def read(record: Json, task: Task[T]) -> T:
        before = Environment.from_json(record["environment"])
        if not before.same_code(this) or before.machine != this.machine:
            raise ValueError("computed in another environment")
        return task.read(record)

    with store.lock():
        for number, task in enumerate(tasks):
            report.step(number, total, task.title)
            cell_id = digest(task.spec)
            result = store.whole(cell_id, partial(read, task=task))
            if result is None:
                body = task.compute(Part(report, number, total))
                about = {"id": cell_id, "spec": task.spec, "environment": this.to_json()}
                store.write({**about, **body})
                result = store.read_as(cell_id, task.read)  # as a resumed run reads it
            yield result
    report.step(total, total, "done")
