"""Report of a probe: columns, contrasts and sections on its records.

>>> report_of("depth").columns["AbsRel"]
'depth.abs_rel'
"""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from attnwarp_eval.document.model import Grid, Section, Table
from attnwarp_eval.document.numbers import pooled, spread
from attnwarp_eval.study.probe import Probe, probe, probes
from attnwarp_eval.study.record import Record, View
from attnwarp_eval.study.results import Results

K = TypeVar("K", bound="type[ProbeReport]")


@dataclass(frozen=True)
class Layout:
    """Layout of a report.

    Attributes:
        root: the run's folder; figures go below it.
        timings: whether measured seconds and memory are shown.
    """

    root: Path
    timings: bool = True

    def figure(self, name: str) -> Path:
        """Path of a figure's file; its link is ``figures/name``."""
        return self.root / "figures" / name


class ProbeReport:
    """Presentation of a probe's records in a report.

    It is defined in the probe's module, or in ``report.py`` next to the probe's ``measure.py``,
    and decorated by :func:`register_report`. It measures nothing.

    Attributes:
        columns: columns of the table of variants, title -> metric; ``{layer}`` stands for a feature
            grid. Without any, every metric of the probe under its name. Metrics with a ``column``
            in the registry follow them.
        tabulates_all: whether its section has every variant, also those in no table of the study.
        contrasts: metrics in which a variant is tested against a baseline.
        stage: stage of :class:`~attnwarp_eval.study.probe.InTurn` that gives the cost of its
            figures.
        cost, cost_of, cost_text: fallback without timings in turn: stage of a cell's seconds, what
            is timed, and what the seconds include.
        measures: measured quantity, for the first sentence of a report; the probe's name if empty.
        picture_label: title of the pictures; the variant's name if empty.
    """

    name: str = ""
    measures: ClassVar[str] = ""
    columns: ClassVar[Mapping[str, str]] = {}
    tabulates_all: ClassVar[bool] = False
    contrasts: ClassVar[Sequence[str]] = ()
    stage: ClassVar[str] = ""
    cost: ClassVar[str] = "steady"
    cost_of: ClassVar[str] = "a view"
    cost_text: ClassVar[str] = (
        "Seconds are those of the method alone: a render of the target for depth; render,"
        " correspondence, mask and feature grids for a warp. The source's render serves all targets"
        " and is not in them, nor are set-up and checks."
    )
    picture_label: ClassVar[str] = ""

    def __init__(self, own: Probe[Any]) -> None:
        self.probe, self.name = own, own.name

    def columns_at(self, layer: int) -> dict[str, str]:
        """Columns of the table of variants, title -> metric; a grid has ``layer`` cells a side."""
        columns = self.columns or {
            name: name for name, metric in self.probe.metrics.items() if not metric.is_count
        }
        own = {m.column: name for name, m in self.probe.metrics.items() if m.column}
        return {
            title.format(layer=layer): metric.format(layer=layer)
            for title, metric in {**columns, **own}.items()
        }

    def contrasts_at(self, layer: int) -> list[str]:
        """Metrics in which variants are tested; a grid has ``layer`` cells a side."""
        return [metric.format(layer=layer) for metric in self.contrasts]

    def problems(self, results: Results) -> list[str]:
        """Faults of the instrument found in this probe's records, one line each."""
        return []

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Sections of the report; none if the run has no record of this probe."""
        return iter(())

    def gallery(self, results: Results) -> Section | None:
        """A separate section for its pictures; None if the shared gallery shows them."""
        return None

    def details(self, results: Results, names: Sequence[str]) -> list[Table]:
        """Folded tables below a table of variants, whose first one is the baseline."""
        return []


class PlainReport(ProbeReport):
    """Default report of a probe: a table of its metrics."""

    tabulates_all = True

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """The table, if the probe has figures."""
        columns = self.columns_at(results.layer)
        measured = dict.fromkeys(
            v for cell, _ in results.finished(self.name) for v in cell.variants
        )
        rows = [[v, *mean_values(results, self.name, v, columns.values())] for v in measured]
        if rows and columns:
            yield Section(f"Figures of {self.name}", [], [Table(["variant", *columns], rows)])


_registered: dict[str, type[ProbeReport]] = {}


def register_report(kind: K) -> K:
    """Class decorator: make a report available under its probe's name."""
    _registered[kind.name] = kind
    return kind


def report_of(name: str) -> ProbeReport:
    """Report of a probe, by default a plain one. KeyError: no probe of that name."""
    own = probe(name)
    _discover(type(own).__module__)
    return _registered.get(name, PlainReport)(own)


@cache
def _discover(module: str) -> None:
    """Import ``report.py`` next to a probe's ``measure.py``."""
    folder, _, last = module.rpartition(".")
    if last == "measure" and find_spec(f"{folder}.report"):
        importlib.import_module(f"{folder}.report")


def reports() -> list[ProbeReport]:
    """Reports of all probes, in their order."""
    return [report_of(each.name) for each in probes()]


def in_degrees(names: Iterable[str], views: Iterable[View]) -> list[str]:
    """Heads of columns of views: each view's degrees from the source, or its name if it has no yaw,
    a yaw that differs between records, or the yaw of another view. Names are without the task.

    Example:
        >>> views = [View("near", 12.2, {}), View("left", 30, {}), View("right", 30, {})]
        >>> in_degrees(["source", "near", "left"], views)
        ['source', '12°', 'left']
    """
    found: dict[str, set[int]] = {}
    for view in views:
        found.setdefault(view.name.rpartition("/")[2], set()).add(round(view.yaw))
    times = Counter(yaw for yaws in found.values() for yaw in yaws if yaw)
    heads = {
        name: f"{yaw}°" for name, (yaw, *others) in found.items() if not others and times[yaw] == 1
    }
    return [heads.get(name, name) for name in names]


def views_of(records: Iterable[Record[Any]]) -> Iterator[View]:
    """Views of records."""
    return (view for record in records for view in record.views)


def side_by_side(
    results: Results,
    probe: str,
    variants: Sequence[str],
    content: str,
    scene: str,
    caption: str,
    first: Mapping[str, str],
) -> Grid | None:
    """Pictures of variants in the views of one scene; None if the run has none.

    Args:
        probe, variants: probe and variants of the pictures; variants are the rows.
        scene: scene of the pictures; the first one with pictures if this has none.
        first: label of a leading row -> its content, the same for all variants.
    """
    found: dict[str, dict[str, dict[tuple[str, str], str]]] = {}
    records: dict[str, list[Record[Any]]] = {}
    for variant in variants:
        for name, _, record in results.records(probe, variant):
            if record.pictures:
                records.setdefault(name, []).append(record)
                own = found.setdefault(name, {}).setdefault(variant, {})
                for picture in record.pictures:
                    own.setdefault((picture.view, picture.content), picture.path)
    if not found:
        return None
    shown_scene = scene if scene in found else next(iter(found))
    rows = found[shown_scene]
    views = list(dict.fromkeys(view for own in rows.values() for view, _ in own))
    heads = in_degrees(views, views_of(records[shown_scene]))

    shared = next(iter(rows.values()))
    above = [
        (label, [shared.get((view, above)) for view in views]) for label, above in first.items()
    ]
    below = [(name, [of.get((view, content)) for view in views]) for name, of in rows.items()]
    return Grid.of(caption, heads, above + below)


def scenes_side_by_side(
    results: Results, probe: str, content: str, first: Mapping[str, str]
) -> list[Grid]:
    """Grids of :func:`side_by_side`, one for each scene that the probe has measured."""
    variants = results.study.probes.get(probe, [])
    scenes = dict.fromkeys(cell.scene for cell, _ in results.finished(probe))
    grids = (side_by_side(results, probe, variants, content, s, s, first) for s in scenes)
    return [grid for grid in grids if grid]


def mean_values(results: Results, probe: str, name: str, metrics: Iterable[str]) -> list[str]:
    """Cells of a table: means over scenes of a variant's metrics, with intervals. A mean
    squared error is shown in decibels, as a pooled PSNR.
    """
    scenes, metrics_of = len(results.study.scenes), report_of(probe).probe.metrics
    return [
        (pooled if metrics_of[metric].squared else spread)(
            results.mean(probe, name, metric), scenes
        )
        for metric in metrics
    ]
