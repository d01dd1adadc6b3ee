"""Read a run's folder, and write its results.jsonl."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from attnwarp_eval.canonical_json import canonical_json
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.record import Failure, Record
from attnwarp_eval.study.results import Outcome, Results
from attnwarp_eval.study.run import stored_study
from attnwarp_eval.study.store import Store, StoreError


def read_results(store: Store) -> Results:
    """Read the finished cells of a run, and add a failure for each damaged record.

    Raises:
        StoreError: as for :func:`attnwarp_eval.study.run.stored_study`.

    Example:
        >>> from attnwarp_eval.study import parse_study
        >>> from attnwarp_eval.study.run import expected, plan
        >>> content = dict(name="my", scenes=["spheres"], variants={"a": {}})
        >>> study = parse_study(content | {"probes": {"depth": ["a"]}})
        >>> store = Store("run")
        >>> store.write_study(expected(plan(study, store)))
        >>> [(outcome.probe, outcome.record) for outcome in read_results(store).cells]
        [('calibration', None), ('depth', None)]
    """
    stored = stored_study(store)
    done = store.done()
    # The folder may hold failures of cells from before the study's content changed.
    ids = {cell["id"] for cell in stored.cells}
    failures = [Failure.from_json(f) for f in store.failures() if f["id"] in ids]
    cells = []
    for cell in stored.cells:
        record: Record[Any] | None = None
        if cell["id"] in done:
            try:
                record = store.read_as(cell["id"], probe(cell["probe"]).read)
            except StoreError as error:
                # One damaged file must not prevent a report of the others.
                failures.append(
                    Failure(
                        cell["scene"],
                        cell["variants"][0],
                        cell["probe"],
                        str(error),
                        id=cell["id"],
                    )
                )
        cells.append(Outcome.of(cell, record))
    return Results(stored.study, cells, failures, stored.notices)


def lines(results: Results, timings: bool = True) -> Iterable[str]:
    """Lines of results.jsonl: one per (cell, figure of quality), sorted, so that a diff can
    be read.
    """
    rows = []
    for cell in results.cells:
        record = cell.record
        if record is None:
            continue
        for name in sorted({name for view in record.views for name in view.metrics}):
            metric = probe(cell.probe).metric(name)
            if metric.is_count:
                continue  # descriptive counts; they stay in the cell's file
            values = {v.name: _shortened(v.metrics.get(name, math.nan)) for v in record.views}
            defined = [v for v in values.values() if v is not None]
            row = {
                "scene": cell.scene,
                "probe": cell.probe,
                "variant": cell.variants[0],
                "also": list(cell.variants[1:]),
                "seed": cell.seed,
                "cell": cell.id,
                "metric": name,
                "unit": metric.unit,
                "direction": metric.direction,
                "version": metric.version,
                "value": _shortened(sum(defined) / len(defined)) if defined else None,
                "n": len(defined),
                "undefined": len(values) - len(defined),
                "views": values,
                "counters": dict(record.cost.counters),
            }
            if timings:
                row["seconds"] = dict(record.cost.seconds)
                row["peak_memory_mb"] = record.cost.peak_memory_mb
            key = tuple(str(row[k]) for k in ("scene", "probe", "variant", "seed", "metric"))
            rows.append((key, canonical_json(row)))
    return [text for _, text in sorted(rows)]


def _shortened(value: float) -> float | None:
    """Round to nine significant digits: more than any tolerance needs. Cells keep every bit."""
    return None if math.isnan(value) else float(f"{value:.9g}")
