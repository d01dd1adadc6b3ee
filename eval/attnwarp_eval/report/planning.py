"""Scenes needed by each claim of a study, estimated from a run."""

from __future__ import annotations

import math
from collections.abc import Iterator

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
