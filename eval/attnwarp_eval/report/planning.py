"""Scenes needed by each claim of a study, estimated from a run, and the cost of the rest."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from attnwarp_eval.document.model import Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.metrics.registry import Metric
from attnwarp_eval.report.claims import load_claims
from attnwarp_eval.report.compared import differences_of
from attnwarp_eval.report.judging import count_of, measured
from attnwarp_eval.statistics.contrasts import Contrast
from attnwarp_eval.statistics.planning import scenes_needed
from attnwarp_eval.statistics.scales import Scale
from attnwarp_eval.statistics.signflips import FEWEST
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results

INTEREST = {
    "ratio": math.log(1.1),
    "odds": math.log(1.5),
    "share": 0.05,
    "dB": 0.5,
    "dE00": 1.0,
    "cosine": 0.02,
}
"""Smallest difference of interest: by scale, or by unit for plain differences."""

COLUMNS = (
    "claim or row", "metric", "difference of interest", "spread between scenes", "scenes needed",
    "for the difference seen here",
)  # fmt: skip


def needed(value: Contrast, difference: float) -> int:
    """Scenes, at least six, with which a test at 5 % detects a true difference on the contrast's
    scale in 80 % of studies.
    """
    return max(FEWEST, scenes_needed(difference, value.deviation))


def plan_scenes(results: Results) -> Table:
    """Scenes needed for each claim and each row of the study's tables of differences; no row if
    fewer than three scenes are done.
    """
    rows = []
    for title, name, metric, value in _contrasts(results):
        if len(value.by_scene) < 3:
            continue
        aim, spread = INTEREST.get(value.scale, INTEREST.get(metric.unit)), value.deviation
        shown = "–" if aim is None else _difference(aim, value.scale)
        count = "–" if aim is None else count_of(needed(value, aim))
        own = count_of(needed(value, value.flips.mean)) if value.flips.mean else "–"
        rows.append([title, name, shown, number(spread), count, own])
    return Table(list(COLUMNS), rows)


def _contrasts(results: Results) -> Iterator[tuple[str, str, Metric, Contrast]]:
    for one in measured(results, load_claims()):
        assert one.claim is not None
        yield one.claim.text, one.metric, one.specification, one.contrast
    for table in results.study.ablations:
        for variant, key, value in differences_of(results, table):
            metric = probe(table.probe).metric(key)
            if metric.direction in ("higher", "lower"):
                yield f"{variant} against {table.baseline}", key, metric, value


def _difference(value: float, scale: Scale) -> str:
    if scale == "odds":
        return f"odds × {number(math.exp(value))}"
    return f"{100 * math.expm1(value):.0f} %" if scale == "ratio" else number(value)


@dataclass(frozen=True)
class Cost:
    """Cost of the cells to do.

    Attributes:
        gigabytes: added to the run's folder.
        unknown: number of cells of unmeasured kinds; ``hours`` and ``gigabytes`` exclude them.
    """

    hours: float
    gigabytes: float
    unknown: int


def cost_of(
    kinds: Iterable[tuple[str, tuple[str, ...]]], measured: tuple[Results, Path] | None
) -> Cost:
    """Estimate the cost of cells of some probes and variants from the means of finished ones."""
    seconds: dict[tuple[str, tuple[str, ...]], list[float]] = {}
    size = 0.0
    if measured is not None:
        results, folder = measured
        for cell in results.cells:
            if cell.record is not None:
                kind = (cell.probe, cell.variants)
                seconds.setdefault(kind, []).append(seconds_of(cell.record))
        size = _bytes(folder) / max(1, results.measured)
    todo = list(kinds)
    known = [fmean(seconds[kind]) for kind in todo if kind in seconds]
    return Cost(sum(known) / 3600, size * len(known) / 1e9, len(todo) - len(known))


def _bytes(folder: Path) -> int:
    parts = (folder / name for name in ("cells", "pictures"))
    return sum(path.stat().st_size for part in parts for path in part.rglob("*") if path.is_file())


def seconds_of(record: Record[Any]) -> float:
    """Seconds of a cell, each counted once: the stages of the first and the other views are within
    other stages, and parts of an edit within its whole.
    """
    inner = ("warm", "steady", "method: ") if "whole" in record.cost.seconds else ("warm", "steady")
    return sum(
        seconds or 0.0
        for stage, seconds in record.cost.seconds.items()
        if not stage.startswith(inner)
    )
