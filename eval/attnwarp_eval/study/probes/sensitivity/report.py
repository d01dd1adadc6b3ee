"""Report of sensitivity: what each metric sees, how it follows an edit's strength, its cost."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.metrics import registry
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_eval.study.flawed_edits import CONDITIONS, RIGHT, STRENGTHS
from attnwarp_eval.study.probe_report import Layout, Place, ProbeReport, register_report
from attnwarp_eval.study.probes.sensitivity.measure import Seconds
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.encoders import encoders_named

STEPS = tuple(c.name for c in CONDITIONS[: len(STRENGTHS)])
"""Conditions of rising strength; the last is the right result."""

FLAWS = tuple(c for c in CONDITIONS if c.name != RIGHT)

_EDIT = (*STEPS[:-1], "wrong_colour", "wrong_object")
_ALL = tuple(c.name for c in FLAWS)


@dataclass(frozen=True)
class Row:
    """A metric as the figure shows it.

    Attributes:
        key: metric that ranks. A PSNR ranks by its MSE, which is finite where pictures are equal.
        title: for people.
        meant: flaws that it is there to see; its discriminating power is the mean over them.
        cost: metric with its seconds.
    """

    key: str
    title: str
    meant: tuple[str, ...]
    cost: str


_CHANGED = ("wrong_object", "blurred", "noisy", "misplaced")

ROWS = (
    Row("embedding.clip_similarity", "CLIP, prompt", _EDIT, "embedding.clip_similarity"),
    Row("embedding.clip_directional", "CLIP, direction", _EDIT, "embedding.clip_directional"),
    Row(
        "embedding.clip_image",
        "CLIP, source edit",
        (*_EDIT, "inconsistent"),
        "embedding.clip_image",
    ),
    Row(
        "embedding.dino_image",
        "DINO, source edit",
        (*_EDIT, "inconsistent"),
        "embedding.dino_image",
    ),
    Row(
        "consistency.delta_e",
        "consistency, dE00",
        ("inconsistent", "noisy", "misplaced"),
        "consistency.delta_e",
    ),
    Row("fidelity.preserved_mse", "rest unchanged, PSNR", _CHANGED, "fidelity.mse"),
    Row("fidelity.preserved_ssim", "rest unchanged, SSIM", _CHANGED, "fidelity.ssim"),
    Row("fidelity.mse", "truth, PSNR", _ALL, "fidelity.mse"),
    Row("fidelity.ssim", "truth, SSIM", _ALL, "fidelity.ssim"),
    Row("fidelity.distance", "truth, perceptual", _ALL, "fidelity.distance"),
    Row("fidelity.mse.inside", "truth inside, PSNR", _ALL, "fidelity.mse"),
    Row("fidelity.ssim.inside", "truth inside, SSIM", _ALL, "fidelity.ssim"),
    Row("fidelity.distance.inside", "truth inside, perceptual", _ALL, "fidelity.distance"),
)
"""The metrics, those that need no truth first."""

Values = Mapping[str, float]
"""A view's figures by key; NaN where undefined."""


Records = Sequence[tuple[str, Record[Seconds]]]
"""(scene, record) of a run's finished cells."""


@register_report
class SensitivityReport(ProbeReport):
    """Shares of right results that metrics rank above flawed ones."""

    name = "sensitivity"
    measures = "which flaws each metric sees"

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """Sections on what each metric sees, how it follows the strength of an edit, and what it
        costs.
        """
        records = [(cell.scene, record) for cell, record in results.finished(self.name)]
        if not records:
            return
        rows = [
            row for row in ROWS if any(_has(values, row.key) for _, _, values in _views(records))
        ]
        shares = {row.key: {c.name: share(records, row.key, c.name) for c in FLAWS} for row in rows}
        yield Place.INSTRUMENT, _flaws(results, records, rows, shares, layout)
        yield Place.INSTRUMENT, _strengths(records, rows, layout)
        if layout.timings:
            yield Place.INSTRUMENT, _costs(records, rows, shares, layout)


def _has(values: Values, key: str) -> bool:
    return f"{key}.{RIGHT}" in values


def _value(values: Values, key: str, condition: str) -> float:
    return float(values.get(f"{key}.{condition}", math.nan))


def beats(key: str, right: float, flawed: float) -> float:
    """1 where a metric ranks the right result above the flawed one, 0 below, 0.5 where it cannot
    tell them apart.

    Values that differ by no more than two runs of the metric may (its ``atol`` and ``rtol``) are
    told apart by nothing but the machine. NaN where either is undefined.
    """
    if not (math.isfinite(right) and math.isfinite(flawed)):
        return math.nan
    specification = registry.metric(key)
    gain = flawed - right if specification.direction == "lower" else right - flawed
    if abs(gain) <= specification.atol + specification.rtol * max(abs(right), abs(flawed)):
        return 0.5
    return float(gain > 0)


def share(records: Records, key: str, condition: str) -> Interval:
    """Share of the edits and views in which a metric ranks the right result above one with a flaw;
    ties are half.

    A mean over scenes with its interval. 1: it sees the flaw every time; 0.5: blind; below: it
    prefers the flaw.
    """
    table: dict[str, list[float]] = {}
    for scene, _, values in _views(records):
        won = beats(key, _value(values, key, RIGHT), _value(values, key, condition))
        table.setdefault(scene, []).append(won)
    return interval(table)


def curve(values: Values, key: str) -> tuple[float, float]:
    """Course of a metric with the strength of an edit in one view.

    Returns:
        Spearman's rank correlation of strength and metric, signed so that 1 is the right way, 0 for
        a metric that does not change; and 1 or 0: whether each step up in strength moves it the
        right way by more than its tolerance. NaN with fewer than three strengths that are defined.
    """
    pairs = [(s, _value(values, key, name)) for s, name in zip(STRENGTHS, STEPS, strict=True)]
    pairs = [(s, v) for s, v in pairs if math.isfinite(v)]
    if len(pairs) < 3:
        return math.nan, math.nan
    strengths, measured = np.array(pairs).T
    sign = -1 if registry.metric(key).direction == "lower" else 1
    rises = [beats(key, high, low) == 1 for low, high in itertools.pairwise(measured)]
    if np.ptp(measured) == 0:
        return 0.0, 0.0
    return sign * float(stats.spearmanr(strengths, measured).statistic), float(all(rises))


def power(row: Row, shares: Mapping[str, Interval]) -> float:
    """Mean share over the flaws that a metric is meant for; NaN where none is defined."""
    means = [shares[name].mean for name in row.meant if math.isfinite(shares[name].mean)]
    return float(np.mean(means)) if means else math.nan


def _flaws(
    results: Results,
    records: Records,
    rows: list[Row],
    shares: Mapping[str, Mapping[str, Interval]],
    layout: Layout,
) -> Section:
    spec = records[0][1].spec
    views = {(scene, name) for scene, name, _ in _views(records)}
    edits = {(scene, name.rpartition("/")[0]) for scene, name in views}
    count = _scene_count(records)
    text = [
        (
            f"{len(edits)} right results of edits in {count} scenes, {len(views)} pairs of a"
            " result and a view. Each is compared with results that a method may have given in its"
            " place, each with one flaw. The figure: the share in which a metric ranks the right"
            " result above the flawed one. **1: it sees the flaw. 0.5: blind to it. Below 0.5: it"
            " prefers the flaw.** Differences within a metric's tolerance count as half."
        ),
        (
            "Framed: what a metric is meant to see. Metrics against the truth compare with the"
            " right result itself and lose only where nothing of a view shows the flaw; of the"
            " others, which a person has without a truth, a figure is news. Wrong colours, weak"
            " edits and blur are alike in all views, the source included: a metric of consistency"
            " should be blind to them."
        ),
        encoders_named(results.study, spec),
    ]
    if count < len(results.study.scenes):
        text.insert(0, f"**Measured on {count} of {len(results.study.scenes)} scenes.**")
    means = np.array([[shares[row.key][c.name].mean for c in FLAWS] for row in rows])
    framed = np.array([[c.name in row.meant for c in FLAWS] for row in rows])
    path = layout.figure("sensitivity.svg")
    with charts.drawing(path, height=0.8 + 0.34 * len(rows), width=9.6) as (axes,):
        charts.heatmap(
            axes,
            means,
            rows=[row.title for row in rows],
            columns=[c.title for c in FLAWS],
            framed=framed,
            title="share in which the right result is ranked above the flawed one",
        )
    drawn = Picture(
        "figures/sensitivity.svg",
        "Which metric can see what: 1 sees the flaw, 0.5 is blind, below 0.5 prefers it.",
    )
    table = [[row.title, *(spread(shares[row.key][c.name], count) for c in FLAWS)] for row in rows]
    columns = ["metric", *(c.title for c in FLAWS)]
    return Section(
        "Which metric can see what",
        text,
        [Table(columns, table, "Shares with intervals", folded=True)],
        [drawn],
    )


def _strengths(records: Records, rows: list[Row], layout: Layout) -> Section:
    count, table, drawn = _scene_count(records), [], []
    for row in rows:
        by_scene: dict[str, list[tuple[float, float]]] = {}
        for scene, _, values in _views(records):
            by_scene.setdefault(scene, []).append(curve(values, row.key))
        rank, steps = (
            interval({s: [pair[i] for pair in v] for s, v in by_scene.items()}) for i in (0, 1)
        )
        table.append([row.title, spread(rank, count), spread(steps, count)])
        if ".inside" not in row.key:
            drawn.append((row, [_mean(records, row.key, name) for name in STEPS]))
    columns = 3
    path = layout.figure("sensitivity-strength.svg")
    lines = -(-len(drawn) // columns)
    with charts.drawing(path, columns, 1.9 * lines, rows=lines, width=3.0 * columns) as axes:
        for panel, (row, means) in zip(axes, drawn, strict=False):
            unit = registry.metric(row.key).unit
            line = charts.Line(row.title, STRENGTHS, means)
            better = (
                "less is better"
                if registry.metric(row.key).direction == "lower"
                else "more is better"
            )
            label = row.title.replace("PSNR", "MSE")
            charts.lines(
                panel, [line], x="strength", y=unit, title=f"{label} ({better})", legend=False
            )
        for panel in axes[len(drawn) :]:
            panel.axis("off")
    text = [
        (
            "The right result at part of its strength, blended with the view before the edit in"
            " linear light. Rank correlation: Spearman's, between strength and metric, 1 when every"
            " step moves it the right way, 0 for none. The share beside it: edits and views in"
            " which each of the four steps is seen, beyond the metric's tolerance. At strength 0"
            " nothing has changed, and a direction of change is undefined."
        ),
    ]
    headings = ["metric", "rank correlation with strength", "share with every step seen"]
    caption = "Means over scenes against the strength of the edit, with 95 % intervals over scenes."
    picture = Picture("figures/sensitivity-strength.svg", caption)
    return Section(
        "Metrics against the strength of an edit", text, [Table(headings, table)], [picture]
    )


def _scene_count(records: Records) -> int:
    """A scene has a record for each seed."""
    return len({scene for scene, _ in records})


def _mean(records: Records, key: str, condition: str) -> Interval:
    table: dict[str, list[float]] = {}
    for scene, _, values in _views(records):
        table.setdefault(scene, []).append(_value(values, key, condition))
    return interval(table)


def _costs(
    records: Records,
    rows: list[Row],
    shares: Mapping[str, Mapping[str, Interval]],
    layout: Layout,
) -> Section:
    spec = records[0][1].spec
    points: dict[str, tuple[Interval, Interval]] = {}
    powers = {}
    for row in rows:
        taken: dict[str, list[float]] = {}
        for scene, record in records:  # one for each seed
            if rounds := record.extra.seconds.get(row.cost):
                taken.setdefault(scene, []).append(float(np.median(rounds)))
        if not taken:
            continue
        seconds = interval(taken)
        powers[row.title] = power(row, shares[row.key])
        missed = _point(1 - powers[row.title])
        points[row.title] = (seconds, missed)
    path = layout.figure("sensitivity-cost.svg")
    # The truth is what a metric is judged by here; those that know it are on a front of their own.
    apart = [
        (
            "without the truth",
            {
                row.title: points[row.title]
                for row in rows
                if row.title in points and row.meant != _ALL
            },
        ),
        (
            "against the truth",
            {
                row.title: points[row.title]
                for row in rows
                if row.title in points and row.meant == _ALL
            },
        ),
    ]
    on_front: list[str] = []
    with charts.drawing(path, columns=2, height=4.2, width=11.5) as axes:
        for panel, (title, some) in zip(axes, apart, strict=True):
            on_front += charts.cost_front(
                panel,
                some,
                x="seconds a picture",
                y="missed: 1 - discriminating power",
                title=title,
                log=False,
            )
    table = [
        [
            row.title,
            number(1000 * points[row.title][0].mean),
            number(powers[row.title]),
            "yes" if row.title in on_front else "no",
            (
                ", ".join(c.title for c in FLAWS if c.name in row.meant)
                if row.meant != _ALL
                else "all"
            ),
        ]
        for row in rows
        if row.title in points
    ]
    text = [
        (
            f"Milliseconds of one {spec['size']} x {spec['size']} px picture: median of"
            f" {spec['rounds']} rounds in which all metrics took turns in one process, on one"
            " thread, in an order drawn anew; mean over scenes. What is made once for all pictures"
            " is in none of them: truth, correspondences, the embeddings of the prompts, of the"
            " edited source view and of the view before the edit. Discriminating power: the mean"
            " share over the flaws that a metric is meant for. A metric is on the front when"
            " nothing cheaper of its kind sees as much."
        ),
    ]
    columns = ["metric", "ms a picture", "discriminating power", "on the front", "meant for"]
    drawn = Picture("figures/sensitivity-cost.svg", "What a metric misses against what it costs.")
    return Section(
        "What a metric costs and what it can see", text, [Table(columns, table)], [drawn]
    )


def _point(value: float) -> Interval:
    return Interval(value, math.nan, math.nan, 1, 1, 0, math.nan, math.nan)


def _views(records: Records) -> Iterator[tuple[str, str, Values]]:
    """(scene, task/view, figures)."""
    for scene, record in records:
        for view in record.views:
            yield scene, view.name, view.metrics
