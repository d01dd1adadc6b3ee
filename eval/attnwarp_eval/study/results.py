"""A run's records as tables of numbers: variant x scene x view -> value."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import median
from typing import Any

from attnwarp_eval.statistics.intervals import ByView, Interval, common, over_scenes
from attnwarp_eval.study.record import Failure, Record
from attnwarp_eval.study.schema import Study


@dataclass(frozen=True)
class Outcome:
    """An expected cell of a run, with all variants of its content; not done without a record."""

    id: str
    title: str
    scene: str
    variants: tuple[str, ...]
    probe: str
    seed: int
    record: Record[Any] | None

    @classmethod
    def of(cls, cell: Mapping[str, Any], record: Record[Any] | None) -> Outcome:
        """The outcome of a cell as ``study.json`` lists it."""
        return cls(
            cell["id"], cell["title"], cell["scene"], tuple(cell["variants"]), cell["probe"],
            cell["seed"], record,
        )  # fmt: skip


@dataclass(frozen=True)
class Shared:
    """Metric of several variants over their shared views.

    Attributes:
        tables: variant -> scene -> view (and seed) -> value, without NaN.
        apart: variants with too few views, whose tables are over all of their views.
        views: number of views that the others share.
    """

    tables: dict[str, dict[str, dict[str, float]]]
    apart: tuple[str, ...]
    views: int
    of: int

    def mean(self, variant: str) -> Interval:
        """Mean over the scenes of the means over the views."""
        return over_scenes(self.tables[variant])

    def text(self, title: str) -> list[str]:
        """Paragraph on the views of the means; none if these are all views."""
        if self.views == self.of and not self.apart:
            return []
        text = f"{title}: over the {self.views} of {self.of} views in which all have a value."
        if self.apart:
            text += (
                f" Left out, since they have one in fewer than half of the views of the variant"
                f" with most: {', '.join(self.apart)}."
            )
        return [text]


def _value(figures: Mapping[str, float], metric: str) -> float:
    """A figure of a view, NaN if absent."""
    return figures.get(metric, math.nan)


COST = "cost."
"""Prefix of figures that are counters of a cell's cost: ``cost.network_rows`` is
``network_rows``."""


def _count(table: ByView) -> int:
    return sum(map(len, table.values()))


@dataclass(frozen=True)
class Results:
    """The finished cells of a run.

    Attributes:
        cells: one entry for each expected cell, in the study's order.
        notices: notices to the reader, by scene.
    """

    study: Study
    cells: list[Outcome]
    failures: list[Failure]
    notices: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def layer(self) -> int:
        """Feature grid of tables: an eighth of the image, as in a UNet, or the next smaller."""
        size, sizes = self.study.size, self.study.feature_sizes
        return (
            size // 8
            if size // 8 in sizes
            else max((s for s in sizes if s < size), default=max(sizes))
        )

    @property
    def measured(self) -> int:
        """Number of the expected cells that are done."""
        return len(self.all_records())

    def all_records(self) -> list[Record[Any]]:
        """Records of the finished cells, in the study's order."""
        return [cell.record for cell in self.cells if cell.record is not None]

    def finished(self, probe: str) -> list[tuple[Outcome, Record[Any]]]:
        """The finished cells of a probe with their records, in the study's order."""
        return self._by_probe.get(probe, [])

    @cached_property
    def _by_probe(self) -> dict[str, list[tuple[Outcome, Record[Any]]]]:
        table: dict[str, list[tuple[Outcome, Record[Any]]]] = {}
        for cell in self.cells:
            if cell.record is not None:
                table.setdefault(cell.probe, []).append((cell, cell.record))
        return table

    def records(self, probe: str, variant: str) -> list[tuple[str, int, Record[Any]]]:
        """(scene, seed, record) of the finished cells of a variant, in the study's order."""
        return self._by_variant.get((probe, variant), [])

    @cached_property
    def _by_variant(self) -> dict[tuple[str, str], list[tuple[str, int, Record[Any]]]]:
        """Index of the records, since a search for every variant would be quadratic."""
        table: dict[tuple[str, str], list[tuple[str, int, Record[Any]]]] = {}
        for name, cells in self._by_probe.items():
            for cell, record in cells:
                for variant in dict.fromkeys(cell.variants):
                    entry = (cell.scene, cell.seed, record)
                    table.setdefault((name, variant), []).append(entry)
        return table

    def by_edit(self, probe: str) -> dict[str, Results]:
        """Name of each edit -> results without the probe's cells of the others, for a probe of
        several edits; else all results under an empty name.

        An edit with one right answer and one with several are different populations.
        """
        names = {
            id(cell): (record.spec.get("edit") or {}).get("name", "")
            for cell, record in self.finished(probe)
        }
        if len(set(names.values())) < 2:
            return {"": self}
        return {
            name: replace(self, cells=[c for c in self.cells if names.get(id(c), name) == name])
            for name in dict.fromkeys(names.values())
        }

    def views(
        self, probe: str, variant: str, metric: str, yaw: tuple[float, float] | None = None
    ) -> dict[str, dict[str, float]]:
        """Scene -> view (and seed) -> value; NaN where undefined, as is every figure of an edit
        whose source edit failed: comparisons skip such edits. A figure of cost appears once a cell,
        at its first view, whether or not the edit succeeded.

        Args:
            yaw: closed range of views' yaws from the source, in degrees; any if None.
        """
        table: dict[str, dict[str, float]] = {}
        for scene, seed, record in self.records(probe, variant):
            cost = metric.startswith(COST)
            for view in record.views[:1] if cost else record.views:
                if yaw is None or yaw[0] <= view.yaw <= yaw[1]:
                    value = math.nan
                    if cost:
                        value = _value(record.cost.counters, metric.removeprefix(COST))
                    elif record.comparable:
                        value = _value(view.metrics, metric)
                    table.setdefault(scene, {})[f"{view.name}/{seed}"] = float(value)
        return table

    def mean(self, probe: str, variant: str, metric: str) -> Interval:
        """Mean over scenes of a variant's metric, with its interval."""
        return over_scenes(self.views(probe, variant, metric))

    def shared(self, probe: str, variants: Sequence[str], metric: str) -> Shared:
        """Collect a metric of several variants over their shared views.

        A variant with values in fewer than half of the views of the largest variant would leave too
        few views: it is set apart, over all of its views.
        """
        tables = {name: self.views(probe, name, metric) for name in variants}
        own = {name: common([table])[0] for name, table in tables.items()}
        counts = {name: _count(table) for name, table in own.items()}
        most = max(counts.values(), default=0)
        apart = tuple(name for name in tables if 2 * counts[name] < most)
        together = [name for name in tables if name not in apart]
        reduced = common([tables[name] for name in together])
        return Shared(
            own | dict(zip(together, reduced, strict=True)),
            apart,
            _count(reduced[0]) if reduced else 0,
            max(map(_count, tables.values()), default=0),
        )

    def seconds(self, probe: str, variant: str, stage: str) -> dict[str, float]:
        """Scene -> seconds of a stage ("steady", "warm", ...), mean over seeds."""
        by_scene: dict[str, list[float]] = {}
        for scene, _, record in self.records(probe, variant):
            value = record.cost.seconds.get(stage)
            if value is not None:
                by_scene.setdefault(scene, []).append(float(value))
        return {scene: sum(v) / len(v) for scene, v in by_scene.items()}

    def usual_seconds(self, probe: str, variant: str, stage: str) -> float:
        """Median over scenes of a stage's seconds, NaN without any. The first cell of a
        process compiles kernels, a hundred times as long as an edit; hence no mean.
        """
        taken = self.seconds(probe, variant, stage).values()
        return median(taken) if taken else math.nan

    def counters(self, probe: str, variant: str) -> Counter[str]:
        """Work counters summed over a variant's cells."""
        total: Counter[str] = Counter()
        for _, _, record in self.records(probe, variant):
            total.update(record.cost.counters)
        return total
