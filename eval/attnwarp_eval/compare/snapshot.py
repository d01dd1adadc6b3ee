"""Parts of a run that a comparison reads: gated figures by view, counters, definitions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from attnwarp_eval.canonical_json import digest
from attnwarp_eval.metrics.gates import gated
from attnwarp_eval.report.results import read_results
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Outcome, Results
from attnwarp_eval.study.store import Store

NOT_MEASURED = "not measured"
"""Reason for a missing cell that was never started."""


@dataclass(frozen=True)
class Figure:
    """One gated metric of one cell: values by view, to nine significant digits."""

    version: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class Measured:
    """One measured cell.

    Attributes:
        variants: all names of its content in the study.
        definition: hash of all inputs of its figures except the seed.
        counters: counts of work.
        figures: gated metrics by key.
    """

    scene: str
    probe: str
    variants: tuple[str, ...]
    seed: int
    definition: str
    counters: Mapping[str, int]
    figures: Mapping[str, Figure]

    @property
    def key(self) -> tuple[str, str, tuple[str, ...], int]:
        """Unique sort key of cells."""
        return self.scene, self.probe, self.variants, self.seed


@dataclass(frozen=True)
class Snapshot:
    """One side of a comparison.

    Attributes:
        digest: hash of the resolved study.
        cells: sorted by their key.
        missing: expected cells without a record -> the reason.
    """

    study: str
    digest: str
    cells: tuple[Measured, ...]
    missing: Mapping[tuple[str, str, str, int], str] = field(default_factory=dict)


def read_snapshot(store: Store) -> Snapshot:
    """The snapshot of a run's folder, read by the report's reader.

    Raises:
        StoreError: the folder is not a run, or its study cannot be read.
    """
    return snapshot(read_results(store))


def snapshot(results: Results) -> Snapshot:
    """The snapshot of loaded results."""
    reasons = {failure.id: failure.error for failure in results.failures}
    cells, missing = [], {}
    for cell in results.cells:
        if cell.record is not None:
            cells.append(_measured(cell, cell.record))
            continue
        reason = reasons.get(cell.id, NOT_MEASURED)
        for variant in cell.variants:
            missing[cell.scene, cell.probe, variant, cell.seed] = reason
    return Snapshot(
        results.study.name,
        digest(results.study.model_dump(mode="json")),
        tuple(sorted(cells, key=lambda cell: cell.key)),
        missing,
    )


def _measured(cell: Outcome, record: Record[Any]) -> Measured:
    names = {key for view in record.views for key in view.metrics}
    keys = sorted(filter(gated, names))
    figures = {
        key: Figure(
            probe(cell.probe).metric(key).version,
            {
                view.name: shortened(view.metrics[key])
                for view in record.views
                if key in view.metrics
            },
        )
        for key in keys
    }
    return Measured(
        cell.scene,
        cell.probe,
        cell.variants,
        cell.seed,
        definition(record.spec),
        dict(record.cost.counters),
        figures,
    )


def definition(spec: Mapping[str, Any]) -> str:
    """Hash of all inputs of a cell's figures except the seed."""
    return digest(without_seed(dict(spec)))[:16]


def shortened(value: float) -> float:
    """Round to nine significant digits, more than any tolerance needs; NaN for the infinities."""
    return float(f"{value:.9g}") if math.isfinite(value) else math.nan


def without_seed(value: Any) -> Any:
    """A cell's spec without its seeds, at any depth.

    >>> without_seed({"seed": 1, "fit": {"iterations": 4, "seed": 1}})
    {'fit': {'iterations': 4}}
    """
    if isinstance(value, dict):
        return {key: without_seed(item) for key, item in value.items() if key != "seed"}
    if isinstance(value, list):
        return [without_seed(item) for item in value]
    return value
