"""Report of the audit: each figure's detections, misses, false alarms, rewards and cost."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy import stats

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.metrics.registry import metric
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_eval.study.probe_report import Layout, Place, ProbeReport, register_report
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.encoders import encoders_named
from attnwarp_lab.probes.audit.auroc import Auroc, auroc
from attnwarp_lab.probes.audit.figures import FIGURES, Figure
from attnwarp_lab.probes.audit.flaws import CONDITIONS, COUNTED, ELSEWHERE, FLAWS, Flaw
from attnwarp_lab.probes.audit.measure import REFIT_SIZE, Seconds
from attnwarp_lab.probes.audit.views import METAL, RIGHT, VARNISHED

NEAR = 60.0
"""Largest yaw in degrees in the first table and the recommendation."""

SEES, BLIND = 0.9, 0.6
"""AUROC from which a metric detects a flaw, and below which it counts as blind to it."""

ALARM = 0.05
"""Share of right pairs without highlights that lie above the threshold for false alarms."""

MANY_ALARMS = 0.2
"""Share of glossy pairs flagged as flawed above which the recommendation warns of the metric."""


Values = dict[str, list[float]]


class Pairs:
    """Figures of a run's pairs, signed so that larger is more flawed.

    Args:
        records: (scene, record) of the finished cells.
    """

    def __init__(self, records: Sequence[tuple[str, Record[Seconds]]]) -> None:
        self.records = records
        self.scenes = len({scene for scene, _ in records})
        self.yaws = [float(yaw) for yaw in records[0][1].spec["yaws"]]
        first = records[0][1].views[0].metrics
        self.rows = [row for row in FIGURES if f"{row.key}.{RIGHT[0]}" in first]
        self._kept: dict[tuple[object, ...], Auroc] = {}

    @cached_property
    def near(self) -> list[float]:
        """Yaws up to :data:`NEAR`; all if there are none."""
        return [yaw for yaw in self.yaws if abs(yaw) <= NEAR] or self.yaws

    def plain(self, row: Figure, conditions: Sequence[str], yaw: float) -> Values:
        """Scene -> unsigned values of conditions at a yaw."""
        values: Values = {}
        for scene, record in self.records:
            for view, at in zip(record.views, self.yaws, strict=True):
                if at == yaw:
                    of_scene = values.setdefault(scene, [])
                    of_scene += [
                        view.metrics.get(f"{row.key}.{one}", math.nan) for one in conditions
                    ]
        return values

    def values(self, row: Figure, conditions: Sequence[str], yaw: float) -> Values:
        """Scene -> values that rise with disagreement."""
        sign = -1.0 if metric(row.key).direction == "higher" else 1.0
        plain = self.plain(row, conditions, yaw)
        return {scene: [sign * value for value in numbers] for scene, numbers in plain.items()}

    def area(
        self,
        row: Figure,
        conditions: Sequence[str],
        yaws: Sequence[float],
        right: Sequence[str] = RIGHT,
    ) -> Auroc:
        """Mean AUROC of conditions at yaws, against right pairs of the same yaw."""
        key = (row.key, tuple(conditions), tuple(yaws), tuple(right))
        if key not in self._kept:
            self._kept[key] = auroc(
                [
                    (self.values(row, [one], yaw), self.values(row, right, yaw))
                    for one in conditions
                    for yaw in yaws
                ]
            )
        return self._kept[key]

    def shown(self, row: Figure, flaw: Flaw) -> Auroc:
        """AUROC of a flaw at its reference size, up to :data:`NEAR` degrees."""
        return self.area(row, [flaw.key(flaw.reference)], self.near)

    def counted(self, row: Figure, yaws: Sequence[float], right: Sequence[str] = RIGHT) -> Auroc:
        """Mean AUROC of the most important flaws, against right pairs."""
        return self.area(row, [flaw.key(flaw.reference) for flaw in COUNTED], yaws, right)

    def lowest(self, row: Figure) -> float:
        """Lowest AUROC among the most important flaws; NaN if one is undefined."""
        return float(np.min([self.shown(row, flaw).value for flaw in COUNTED]))

    def alarms(self, row: Figure, trap: str = VARNISHED) -> float:
        """Share of a trap's right pairs above the threshold that :data:`ALARM` of the other right
        pairs pass, mean over the near yaws.
        """
        shares = []
        for yaw in self.near:
            right, shiny = (
                np.array([v for numbers in self.values(row, names, yaw).values() for v in numbers])
                for names in (RIGHT, [trap])
            )
            right, shiny = right[np.isfinite(right)], shiny[np.isfinite(shiny)]
            if len(right) and len(shiny):
                shares.append(float((shiny > np.quantile(right, 1 - ALARM)).mean()))
        return float(np.mean(shares)) if shares else math.nan

    def smallest(self, row: Figure, flaw: Flaw) -> float | None:
        """Smallest size from which every size is detected; None if the largest is not."""
        found = None
        for size in reversed(flaw.sizes):
            if not self.area(row, [flaw.key(size)], self.near).value >= SEES:
                break
            found = size
        return found

    def follows(self, row: Figure, flaw: Flaw) -> Interval:
        """Rank correlation of a flaw's size, 0 for the right pair, with disagreement: mean over
        pairs up to :data:`NEAR` degrees.
        """
        names = [RIGHT[0], *map(flaw.key, flaw.sizes)]
        ranks: Values = {}
        for yaw in self.near:
            for scene, numbers in self.values(row, names, yaw).items():
                pairs = np.reshape(numbers, (-1, len(names)))  # one for each seed
                ranks.setdefault(scene, []).extend(
                    rank_correlation((0.0, *flaw.sizes), pair) for pair in pairs
                )
        return interval(ranks)

    def undefined(self, row: Figure, yaw: float) -> float:
        """Share of the pairs at a yaw, of right ones and of shown flaws, without a value."""
        names = [*RIGHT, *(flaw.key(flaw.reference) for flaw in COUNTED)]
        values = [v for numbers in self.plain(row, names, yaw).values() for v in numbers]
        return float(np.isnan(values).mean())

    def seconds(self, row: Figure) -> Interval | None:
        """Median seconds of a pair, mean over scenes."""
        taken: Values = {}
        for scene, record in self.records:
            if rounds := record.extra.seconds.get(row.key):
                taken.setdefault(scene, []).append(float(np.median(rounds)))
        return interval(taken) if taken else None

    def known(self) -> list[Figure]:
        """Metrics without truth that have a value."""
        usable = [row for row in self.rows if not row.truth]
        return [row for row in usable if math.isfinite(self.counted(row, self.near).value)]

    def best(self) -> Figure | None:
        """Metric without truth with the largest mean AUROC of the most important flaws."""
        return max(self.known(), key=lambda row: self.counted(row, self.near).value, default=None)


@register_report
class AuditReport(ProbeReport):
    """Presentation of the metrics and their reliability."""

    name = "audit"
    measures = "which flaws of an edit each consistency metric sees"

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """The answer, a sentence a metric, yaw, size, cost, and all figures."""
        records = [(cell.scene, record) for cell, record in results.finished(self.name)]
        if not records:
            return
        pairs = Pairs(records)
        yield Place.ANSWER, _answer(results, pairs, layout)
        sentences = "\n".join(f"- {_sentence(pairs, row)}" for row in pairs.rows)
        yield Place.INSTRUMENT, Section("A sentence a metric", [sentences])
        yield Place.INSTRUMENT, _by_yaw(pairs, layout)
        yield Place.INSTRUMENT, _sizes(pairs)
        if layout.timings:
            yield Place.INSTRUMENT, _cost(pairs, layout)
        yield Place.APPENDIX, _everything(pairs)


def area_text(value: Auroc, intervals: bool = True) -> str:
    """AUROC with its interval, if any; a dash if undefined.

    Example:
        >>> area_text(Auroc(0.951, 0.9, 1.0, 24, 0.0, 0.9))
        '0.95 [0.90, 1.00]'
    """
    if not math.isfinite(value.value):
        return "–"
    if not intervals or not math.isfinite(value.low):
        return f"{value.value:.2f}"
    return f"{value.value:.2f} [{value.low:.2f}, {value.high:.2f}]"


def _two(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "–"


def percent(share: float) -> str:
    """A share in percent; a dash where it is undefined.

    Example:
        >>> percent(0.256), percent(float("nan"))
        ('26 %', '–')
    """
    return f"{100 * share:.0f} %" if math.isfinite(share) else "–"


def rank_correlation(sizes: Any, values: Any) -> float:
    """Spearman's correlation; 0 for values that never change, NaN for fewer than three.

    Example:
        >>> round(rank_correlation((0, 1, 2, 3, 4), (1, 2, 3, 5, 4)), 9)  # 1 - 6 * 2 / (5 * 24)
        0.9
    """
    known = np.isfinite(values)
    x, y = np.asarray(sizes)[known], np.asarray(values)[known]
    if len(y) < 3:
        return math.nan
    return float(stats.spearmanr(x, y).statistic) if np.ptp(y) > 0 else 0.0


def _answer(results: Results, pairs: Pairs, layout: Layout) -> Section:
    spec = pairs.records[0][1].spec
    shown = np.array([[pairs.shown(row, flaw).value for flaw in FLAWS] for row in pairs.rows])
    path = layout.figure("audit.svg")
    with charts.drawing(path, height=1.4 + 0.3 * len(pairs.rows), width=12.0) as (axes,):
        charts.heatmap(
            axes,
            shown,
            rows=[row.title for row in pairs.rows],
            columns=[flaw.at(flaw.reference) for flaw in FLAWS],
            framed=np.broadcast_to([flaw.counts for flaw in FLAWS], shown.shape),
            title=f"AUROC of flawed against right pairs, up to {max(pairs.near):g} degrees",
        )
    table = []
    for row in pairs.rows:
        counted = pairs.counted(row, pairs.near)
        seconds = pairs.seconds(row)
        table.append(
            [
                row.title,
                row.needs,
                area_text(counted),
                _two(pairs.lowest(row)),
                percent(counted.paired),
                area_text(pairs.shown(row, ELSEWHERE), intervals=False),
                percent(pairs.alarms(row)),
                percent(pairs.alarms(row, METAL)),
                area_text(pairs.counted(row, pairs.near, [METAL]), intervals=False),
                percent(float(np.mean([pairs.undefined(row, yaw) for yaw in pairs.near]))),
                number(1000 * seconds.mean) if seconds else "–",
            ]
        )
    columns = [
        "metric", "needs", "AUROC, five flaws", "lowest of five", "within a scene",
        "another scene", "false alarms: varnish", "metal", "AUROC against metal", "undefined",
        "ms a pair",
    ]  # fmt: skip
    what = "; ".join(flaw.at(flaw.reference) for flaw in COUNTED)
    text = [
        *advice(pairs),
        (
            f"Every pair is the source view and one that is turned by"
            f" {', '.join(f'{yaw:g}' for yaw in pairs.yaws)} degrees, of"
            f" {results.study.scenes_in_words}, at {spec['size']} px. Both views show a true edit"
            f" (`{spec['edit']}`); in a flawed pair the second view has one flaw of known size, or"
            " both have it alike: then they agree, and a figure of agreement is right to be blind."
            " **AUROC: the probability that a metric ranks a flawed pair below a right one of any"
            " scene at the same yaw. 1 sees every flaw, 0.5 is blind, below 0.5 the flaw is"
            " preferred.** Intervals are of 95 %, over scenes. **Within a scene**: the share of"
            " pairs with one of the five flaws that rank below the mean of the right pairs of their"
            " own scene and yaw, as methods are compared on the same scenes."
        ),
        (
            f"Five flaws are named as those that matter most, and are"
            f" framed: {what}. The first table is of yaws up to {max(pairs.near):g} degrees."
            f" A pair without a value is left out and counted. False alarms: right pairs whose"
            f" object is varnished, so that highlights move over its paint, or of metal, so that it"
            f" mirrors its surroundings everywhere, above the threshold that {percent(ALARM)} of"
            f" the matt right pairs pass. Edit PSNR is that of the scene's splats, whose colours"
            f" alone were fitted to the two pictures at {min(spec['size'], REFIT_SIZE)} px: a fit"
            f" of all that splats have would cost hours, and hide more."
        ),
        encoders_named(results.study, spec),
    ]
    if spec.get("colmap"):
        text.append(
            f"COLMAP reconstructs all {len(pairs.yaws) + 1} views at once, with known intrinsics"
            f" and unknown poses; in a flawed set {len(pairs.yaws[::2])} of them have the flaw. Its"
            " figures are those of the set at every yaw, and its seconds too."
        )
    if pairs.scenes < len(results.study.scenes):
        text.insert(0, f"**Measured on {pairs.scenes} of {len(results.study.scenes)} scenes.**")
    picture = Picture(
        "figures/audit.svg",
        "Which metric sees which flaw: 1 every time, 0.5 blind; framed: the five.",
    )
    timed = ("ms a pair",)
    tables = [Table(columns, table, timed=timed)]
    return Section("Which consistency metric can be believed", text, tables, [picture])


def advice(pairs: Pairs) -> list[str]:
    """Advice on the metric to report without truth, and on the metrics' limits."""
    best = pairs.best()
    if best is None:
        return ["**No metric without truth has a value.**"]
    value, lowest = pairs.counted(best, pairs.near), pairs.lowest(best)
    reach = [yaw for yaw in pairs.yaws if pairs.counted(best, [yaw]).value >= SEES]
    where = f"at {', '.join(f'{yaw:g}' for yaw in reach)} degrees" if reach else "at no yaw"
    worst = min(COUNTED, key=lambda flaw: pairs.shown(best, flaw).value)
    goal = (
        f"It sees each of the five (lowest: {worst.title}, {lowest:.2f})."
        if lowest >= SEES
        else f"It does not see all five: {worst.title} has {lowest:.2f}."
    )
    text = [
        f"**Without truth, report {best.title!r}** (needs {best.needs}): AUROC {area_text(value)}"
        f" over the five flaws; its mean over them reaches {SEES:g} {where}. {goal}"
    ]
    alarms = pairs.alarms(best)
    if alarms > MANY_ALARMS:
        careful = [row for row in pairs.known() if pairs.alarms(row) <= MANY_ALARMS]
        calm = max(careful, key=lambda row: pairs.counted(row, pairs.near).value, default=None)
        text.append(
            f"**A threshold of matt pairs does not serve glossy ones**: above it are"
            f" {percent(alarms)} of right pairs whose object is varnished. Against these the five"
            f" flaws have an AUROC of {area_text(pairs.counted(best, pairs.near, [VARNISHED]))}."
            + (
                f" Of the metrics that do so in at most {percent(MANY_ALARMS)},"
                f" {calm.title!r} sees most: AUROC {area_text(pairs.counted(calm, pairs.near))}."
                if calm
                else f" None without truth does so in at most {percent(MANY_ALARMS)}."
            )
        )
    # A single scene has no view of another one.
    measured = any(math.isfinite(pairs.shown(row, ELSEWHERE).value) for row in pairs.rows)
    unable = [
        row.title
        for row in pairs.rows
        if measured and not pairs.shown(row, ELSEWHERE).value >= SEES and not row.truth
    ]
    if unable:
        text.append(
            "**Cannot tell a view of another scene from a right pair** (AUROC below"
            f" {SEES:g}): {', '.join(unable)}."
        )
    return text


def _sentence(pairs: Pairs, row: Figure) -> str:
    values = [(flaw, pairs.shown(row, flaw)) for flaw in FLAWS]
    alone = [(flaw, area) for flaw, area in values if not flaw.alike]
    sees = [flaw.title for flaw, area in alone if area.value >= SEES]
    parts = [
        f"**{row.title}** sees {len(sees)} of {len(alone)} flaws of one view"
        + (f" ({', '.join(sees)})" if sees else "")
    ]
    for text, titles in (
        ("is blind to", [flaw.title for flaw, area in alone if area.value < BLIND]),
        ("sees in", [f.title for f, area in values if f.alike and area.value >= SEES]),
        ("rates above a right edit", [flaw.title for flaw, area in values if area.high < 0.5]),
    ):
        if titles:
            parts.append(f"{text} {', '.join(titles)}")
    parts.append(f"takes highlights for a flaw in {percent(pairs.alarms(row))} of pairs")
    lacking = {yaw: pairs.undefined(row, yaw) for yaw in pairs.yaws}
    if any(lacking.values()):
        shares = ", ".join(f"{percent(lacking[yaw])} at {yaw:g}" for yaw in pairs.yaws)
        parts.append(f"has no value in {shares} degrees")
    return "; ".join(parts) + "."


def _by_yaw(pairs: Pairs, layout: Layout) -> Section:
    order = sorted(
        (row for row in pairs.rows if math.isfinite(pairs.counted(row, pairs.near).value)),
        key=lambda row: -pairs.counted(row, pairs.near).value,
    )[:8]
    path = layout.figure("audit-yaw.svg")
    with charts.drawing(path, height=4.2, width=9.0) as (axes,):
        series = [
            charts.Line(
                row.title, pairs.yaws, [_interval(pairs.counted(row, [yaw])) for yaw in pairs.yaws]
            )
            for row in order
        ]
        title = "The eight best metrics by the yaw between the views"
        y = "AUROC, mean of five flaws"
        charts.lines(axes, series, x="yaw in degrees", y=y, title=title, share=True)
    areas = [
        [row.title, *(area_text(pairs.counted(row, [yaw])) for yaw in pairs.yaws)]
        for row in pairs.rows
    ]
    return Section(
        "At which baselines",
        [],
        [Table(["metric", *(f"{yaw:g} degrees" for yaw in pairs.yaws)], areas)],
        [Picture("figures/audit-yaw.svg", "AUROC of the five flaws against the yaw.")],
    )


def _interval(area: Auroc, missed: bool = False) -> Interval:
    """Interval of an AUROC, or of 1 minus it, for charts."""
    mean, low, high = area.value, area.low, area.high
    if missed:
        mean, low, high = 1 - mean, 1 - high, 1 - low
    return Interval(mean, low, high, area.scenes, area.scenes, 0, math.nan, math.nan)


def _sizes(pairs: Pairs) -> Section:
    graded = [flaw for flaw in FLAWS if len(flaw.sizes) > 1]
    columns = ["metric", *(f"{flaw.title}, {flaw.unit} ({_range(flaw)})" for flaw in graded)]
    smallest, follows = [], []
    for row in pairs.rows:
        found = [pairs.smallest(row, flaw) for flaw in graded]
        smallest.append([row.title, *("none" if one is None else f"{one:g}" for one in found)])
        follows.append(
            [row.title, *(spread(pairs.follows(row, flaw), pairs.scenes) for flaw in graded)]
        )
    text = (
        f"Up to {max(pairs.near):g} degrees; in brackets the sizes tried. Smallest: the size from"
        f" which on every size has an AUROC of at least {SEES:g}. Rank correlation: Spearman's of a"
        " flaw's size, 0 for the right pair, with a metric's values on the same pair; 1 when every"
        " step moves it the right way."
    )
    return Section(
        "Which sizes of a flaw are told apart",
        [text],
        [
            Table(columns, smallest, "The smallest flaw that is seen"),
            Table(columns, follows, "Rank correlation with the size of a flaw"),
        ],
    )


def _range(flaw: Flaw) -> str:
    return f"{flaw.sizes[0]:g} to {flaw.sizes[-1]:g}"


def _cost(pairs: Pairs, layout: Layout) -> Section:
    points: dict[str, tuple[Interval, Interval]] = {}
    for row in pairs.rows:
        seconds, value = pairs.seconds(row), pairs.counted(row, pairs.near)
        if seconds is not None and math.isfinite(value.value) and not row.truth:
            points[row.title] = seconds, _interval(value, missed=True)
    path = layout.figure("audit-cost.svg")
    with charts.drawing(path, height=4.6, width=7.5) as (axes,):
        title, y = "What a metric misses against what it costs", "1 - AUROC, mean of five flaws"
        front = charts.cost_front(axes, points, x="seconds a pair", y=y, title=title, log=False)
    spec = pairs.records[0][1].spec
    text = [
        f"Wall seconds of one pair at {spec['size']} px: median of {spec['rounds']} rounds in which"
        " all metrics took turns, mean over scenes. Each makes all that it needs anew: keypoints,"
        " embeddings, flow, the depth of both views. On the front, cheapest first:"
        f" {', '.join(front) or 'none'}. Metrics that know the truth are left out."
    ]
    picture = Picture("figures/audit-cost.svg", f"{title}.")
    return Section("What a metric costs", text, figures=[picture])


def _everything(pairs: Pairs) -> Section:
    tables = []
    for yaw in pairs.yaws:
        rows = [
            [flaw.at(size), *(area_text(pairs.area(row, [name], [yaw])) for row in pairs.rows)]
            for name, (flaw, size) in CONDITIONS.items()
        ]
        columns = ["flaw", *(row.title for row in pairs.rows)]
        tables.append(Table(columns, rows, f"AUROC at {yaw:g} degrees", folded=True))
    paired = [
        [row.title, *(_two(pairs.shown(row, flaw).paired) for flaw in FLAWS)] for row in pairs.rows
    ]
    heads = ["metric", *(flaw.at(flaw.reference) for flaw in FLAWS)]
    within = f"Flawed pairs ranked below the right ones of their own scene, up to {NEAR:g} degrees"
    tables.append(Table(heads, paired, within, folded=True))
    floor = [
        [
            f"{row.title}, {metric(row.key).unit}",
            *(spread(interval(pairs.plain(row, RIGHT, yaw)), pairs.scenes) for yaw in pairs.yaws),
        ]
        for row in pairs.rows
    ]
    heads = ["metric", *(f"{yaw:g} degrees" for yaw in pairs.yaws)]
    tables.append(
        Table(heads, floor, "Floor: values of right pairs, means over scenes", folded=True)
    )
    return Section("All figures of the audit", [], tables)
