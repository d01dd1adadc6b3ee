"""Report of the audit: what each consistency metric sees, misses, mistakes and costs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.metrics.registry import metric
from attnwarp_eval.statistics.auroc import Auroc, auroc
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_eval.study.flaws import CONDITIONS, FLAWS, Flaw
from attnwarp_eval.study.probe_report import Layout, Place, ProbeReport, register_report
from attnwarp_eval.study.probes.audit.measure import REFIT_SIZE, Seconds
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.encoders import encoders_named
from attnwarp_eval.study.shared.right_views import METAL, RIGHT, VARNISHED

NEAR = 60.0
"""Largest yaw in degrees that the first table and the recommendation speak of."""

SEES, BLIND = 0.9, 0.6
"""AUROC from which a metric sees a flaw, and below which it is called blind to it."""

ALARM = 0.05
"""Share of right pairs without highlights that lie above the threshold for false alarms."""

MANY_ALARMS = 0.2
"""Share of glossy pairs that a metric may take for flawed before the recommendation warns of it."""


@dataclass(frozen=True)
class Row:
    """A metric as tables show it.

    Attributes:
        key, title: key and title of the metric.
        needs: inputs beside the edited pictures.
        truth: whether that is the truth.
    """

    key: str
    title: str
    needs: str
    truth: bool = False


ROWS = (
    Row("consistency.tsed_2px", "TSED at 2 px", "poses"),
    Row("consistency.tsed_distance", "epipolar distance", "poses"),
    Row("consistency.flow_delta_e.dis", "flow warp error, DIS", "originals"),
    Row("consistency.flow_delta_e.farneback", "flow warp error, Farneback", "originals"),
    Row("embedding.match_similarity", "DINO match similarity", "originals"),
    Row("embedding.direction_consistency", "CLIP direction consistency", "originals"),
    Row("embedding.clip_directional", "CLIP directional similarity", "originals, prompts"),
    Row("embedding.clip_similarity", "CLIP similarity", "prompt"),
    Row("embedding.clip_image", "CLIP image similarity", "nothing"),
    Row("embedding.dino_image", "DINO image similarity", "nothing"),
    Row("consistency.edit_psnr", "Edit PSNR, colours refitted", "splats"),
    Row("consistency.features.rendered", "features, rendered depth", "splats"),
    Row("consistency.perceptual", "perceptual, rendered depth", "splats"),
    Row("consistency.rendered_delta_e", "colour, rendered depth", "splats"),
    Row("consistency.edit_delta_e", "colour the edit adds", "splats, originals"),
    Row("consistency.edit_delta_e_p90", "colour the edit adds, p90", "splats, originals"),
    Row("consistency.features.exact", "features, exact", "truth", truth=True),
    Row("consistency.delta_e", "colour, exact", "truth", truth=True),
    Row("multiview.delta_e_above", "colour above its floor, exact", "truth", truth=True),
)
"""Metrics, those that need no truth first."""

COUNTED = tuple(flaw for flaw in FLAWS if flaw.counts)
"""Flaws that matter most."""

Values = dict[str, list[float]]


class Pairs:
    """Figures of a run's pairs, so that larger is more flawed.

    Args:
        records: (scene, record) of the finished cells.
    """

    def __init__(self, records: Sequence[tuple[str, Record[Seconds]]]) -> None:
        self.records = records
        self.scenes = len({scene for scene, _ in records})
        self.yaws = [float(yaw) for yaw in records[0][1].spec["yaws"]]
        first = records[0][1].views[0].metrics
        self.rows = [row for row in ROWS if f"{row.key}.{RIGHT[0]}" in first]
        self._kept: dict[tuple[object, ...], Auroc] = {}

    @cached_property
    def near(self) -> list[float]:
        """Yaws up to :data:`NEAR`; all of them where there is none."""
        return [yaw for yaw in self.yaws if yaw <= NEAR] or self.yaws

    def plain(self, row: Row, conditions: Sequence[str], yaw: float) -> Values:
        """Scene -> values of conditions at a yaw, as they are."""
        values: Values = {}
        for scene, record in self.records:
            for view, at in zip(record.views, self.yaws, strict=True):
                if at == yaw:
                    own = values.setdefault(scene, [])
                    own += [view.metrics.get(f"{row.key}.{one}", math.nan) for one in conditions]
        return values

    def values(self, row: Row, conditions: Sequence[str], yaw: float) -> Values:
        """Scene -> values that rise with disagreement."""
        sign = -1.0 if metric(row.key).direction == "higher" else 1.0
        plain = self.plain(row, conditions, yaw)
        return {scene: [sign * value for value in own] for scene, own in plain.items()}

    def area(
        self,
        row: Row,
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

    def shown(self, row: Row, flaw: Flaw) -> Auroc:
        """AUROC of a flaw at the size that tables show, up to :data:`NEAR` degrees."""
        return self.area(row, [flaw.key(flaw.reference)], self.near)

    def counted(self, row: Row, yaws: Sequence[float], right: Sequence[str] = RIGHT) -> Auroc:
        """Mean AUROC of the flaws that matter most, against right pairs."""
        return self.area(row, [flaw.key(flaw.reference) for flaw in COUNTED], yaws, right)

    def lowest(self, row: Row) -> float:
        """Lowest AUROC among the flaws that matter most; NaN where one is undefined."""
        return float(np.min([self.shown(row, flaw).value for flaw in COUNTED]))

    def alarms(self, row: Row, trap: str = VARNISHED) -> float:
        """Share of a trap's right pairs above the threshold that :data:`ALARM` of the other right
        pairs pass, mean over the near yaws.
        """
        shares = []
        for yaw in self.near:
            right, shiny = (
                np.array([v for own in self.values(row, names, yaw).values() for v in own])
                for names in (RIGHT, [trap])
            )
            right, shiny = right[np.isfinite(right)], shiny[np.isfinite(shiny)]
            if len(right) and len(shiny):
                shares.append(float((shiny > np.quantile(right, 1 - ALARM)).mean()))
        return float(np.mean(shares)) if shares else math.nan

    def smallest(self, row: Row, flaw: Flaw) -> float | None:
        """Smallest size from which on every size is seen; None where the largest is not."""
        found = None
        for size in reversed(flaw.sizes):
            if not self.area(row, [flaw.key(size)], self.near).value >= SEES:
                break
            found = size
        return found

    def undefined(self, row: Row, yaw: float) -> float:
        """Share of the pairs at a yaw, of right ones and of shown flaws, without a value."""
        names = [*RIGHT, *(flaw.key(flaw.reference) for flaw in COUNTED)]
        values = [v for own in self.plain(row, names, yaw).values() for v in own]
        return float(np.isnan(values).mean())

    def seconds(self, row: Row) -> Interval | None:
        """Median seconds of a pair, mean over scenes."""
        taken: Values = {}
        for scene, record in self.records:
            if rounds := record.extra.seconds.get(row.key):
                taken.setdefault(scene, []).append(float(np.median(rounds)))
        return interval(taken) if taken else None

    def known(self) -> list[Row]:
        """Metrics without truth that have a value."""
        own = [row for row in self.rows if not row.truth]
        return [row for row in own if math.isfinite(self.counted(row, self.near).value)]

    def best(self) -> Row | None:
        """Metric without truth with the largest mean AUROC of the flaws that matter most."""
        return max(self.known(), key=lambda row: self.counted(row, self.near).value, default=None)


@register_report
class AuditReport(ProbeReport):
    """Presentation of the metrics: which of them can be believed."""

    name = "audit"
    measures = "which flaws of an edit each consistency metric sees"

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """The answer, a sentence a metric, yaw, size, cost, and all figures."""
        records = [(cell.scene, record) for cell, record in results.finished(self.name)]
        if not records:
            return
        pairs = Pairs(records)
        yield Place.ANSWER, _answer(results, pairs, layout)
        yield (
            Place.INSTRUMENT,
            Section(
                "A sentence a metric",
                ["\n".join(f"- {_sentence(pairs, row)}" for row in pairs.rows)],
            ),
        )
        yield Place.INSTRUMENT, _by_yaw(pairs, layout)
        yield Place.INSTRUMENT, _sizes(pairs)
        if layout.timings:
            yield Place.INSTRUMENT, _cost(pairs, layout)
        yield Place.APPENDIX, _everything(pairs)


def area_text(value: Auroc, intervals: bool = True) -> str:
    """AUROC with its interval, where it has one; a dash where it is undefined.

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


def _answer(results: Results, pairs: Pairs, layout: Layout) -> Section:
    spec = pairs.records[0][1].spec
    elsewhere = FLAWS[-1]
    shown = np.array([[pairs.shown(row, flaw).value for flaw in FLAWS] for row in pairs.rows])
    path = layout.figure("audit.svg")
    with charts.drawing(path, height=1.4 + 0.3 * len(pairs.rows), width=9.6) as (axes,):
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
                area_text(pairs.shown(row, elsewhere), intervals=False),
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
        *_advice(pairs),
        (
            f"Every pair is the source view and one that is turned by"
            f" {', '.join(f'{yaw:g}' for yaw in pairs.yaws)} degrees, of"
            f" {results.study.scenes_in_words}, at {spec['size']} px. Both views show a true edit"
            f" (`{spec['edit']}`); in a flawed pair the second view has one flaw of known size."
            " **AUROC: the probability that a metric ranks a flawed pair below a right one of any"
            " scene at the same yaw. 1 sees every flaw, 0.5 is blind.** Intervals are of 95 %,"
            " over scenes. **Within a scene**: the share of pairs with one of the five flaws that"
            " rank below the mean of the right pairs of their own scene and yaw, as methods are"
            " compared on the same scenes."
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
    if pairs.scenes < len(results.study.scenes):
        text.insert(0, f"**Measured on {pairs.scenes} of {len(results.study.scenes)} scenes.**")
    picture = Picture(
        "figures/audit.svg",
        "Which metric sees which flaw: 1 every time, 0.5 blind; framed: the five.",
    )
    timed = ("ms a pair",)
    return Section(
        "Which consistency metric can be believed", text, [Table(columns, table, timed=timed)],
        [picture],
    )  # fmt: skip


def _advice(pairs: Pairs) -> list[str]:
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
        other = max(careful, key=lambda row: pairs.counted(row, pairs.near).value, default=None)
        text.append(
            f"**A threshold of matt pairs does not serve glossy ones**: above it are"
            f" {percent(alarms)} of right pairs whose object is varnished. Against these the five"
            f" flaws have an AUROC of {area_text(pairs.counted(best, pairs.near, [VARNISHED]))}."
            + (
                f" Of the metrics that do so in at most {percent(MANY_ALARMS)},"
                f" {other.title!r} sees most: AUROC {area_text(pairs.counted(other, pairs.near))}."
                if other
                else f" None without truth does so in at most {percent(MANY_ALARMS)}."
            )
        )
    # One scene alone has no view of another one.
    measured = any(math.isfinite(pairs.shown(row, FLAWS[-1]).value) for row in pairs.rows)
    unable = [
        row.title
        for row in pairs.rows
        if measured and not pairs.shown(row, FLAWS[-1]).value >= SEES and not row.truth
    ]
    if unable:
        text.append(
            "**Cannot tell a view of another scene from a right pair** (AUROC below"
            f" {SEES:g}): {', '.join(unable)}."
        )
    return text


def _sentence(pairs: Pairs, row: Row) -> str:
    flaws = [(flaw, pairs.shown(row, flaw).value) for flaw in FLAWS]
    sees = [flaw.title for flaw, value in flaws if value >= SEES]
    blind = [flaw.title for flaw, value in flaws if value < BLIND]
    lacking = {yaw: pairs.undefined(row, yaw) for yaw in pairs.yaws}
    parts = [
        f"**{row.title}** sees {len(sees)} of {len(FLAWS)} flaws"
        + (f" ({', '.join(sees)})" if sees else "")
    ]
    if blind:
        parts.append(f"is blind to {', '.join(blind)}")
    parts.append(f"takes highlights for a flaw in {percent(pairs.alarms(row))} of pairs")
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
        charts.lines(
            axes, series, x="yaw between the views, degrees", y="AUROC, mean of five flaws",
            title="The eight best metrics by the yaw between the views", share=True,
        )  # fmt: skip
    headings = [f"{yaw:g} degrees" for yaw in pairs.yaws]
    areas = [
        [row.title, *(area_text(pairs.counted(row, [yaw])) for yaw in pairs.yaws)]
        for row in pairs.rows
    ]
    lacking = [
        [row.title, *(percent(pairs.undefined(row, yaw)) for yaw in pairs.yaws)]
        for row in pairs.rows
    ]
    return Section(
        "At which baselines",
        [],
        [
            Table(["metric", *headings], areas, "AUROC, mean of the five flaws"),
            Table(["metric", *headings], lacking, "Pairs without a value", folded=True),
        ],
        [Picture("figures/audit-yaw.svg", "AUROC of the five flaws against the yaw.")],
    )


def _interval(value: Auroc) -> Interval:
    return Interval(
        value.value, value.low, value.high, value.scenes, value.scenes, 0, math.nan, math.nan
    )


def _sizes(pairs: Pairs) -> Section:
    graded = [flaw for flaw in FLAWS if len(flaw.sizes) > 1]
    rows = []
    for row in pairs.rows:
        found = [pairs.smallest(row, flaw) for flaw in graded]
        rows.append([row.title, *("none" if size is None else f"{size:g}" for size in found)])
    columns = [
        "metric",
        *(f"{flaw.title}, {flaw.unit} ({_range(flaw)})" for flaw in graded),
    ]
    return Section(
        "The smallest flaw that is seen",
        [
            f"Smallest size from which on every size has an AUROC of at least {SEES:g}, up to"
            f" {max(pairs.near):g} degrees; in brackets the sizes tried."
        ],
        [Table(columns, rows)],
    )


def _range(flaw: Flaw) -> str:
    return f"{flaw.sizes[0]:g} to {flaw.sizes[-1]:g}"


def _cost(pairs: Pairs, layout: Layout) -> Section:
    points: dict[str, tuple[Interval, Interval]] = {}
    for row in pairs.rows:
        seconds, value = pairs.seconds(row), pairs.counted(row, pairs.near)
        if seconds is not None and math.isfinite(value.value) and not row.truth:
            missed = Interval(
                1 - value.value, 1 - value.high, 1 - value.low, value.scenes, value.scenes, 0,
                math.nan, math.nan,
            )  # fmt: skip
            points[row.title] = seconds, missed
    path = layout.figure("audit-cost.svg")
    with charts.drawing(path, height=4.6, width=7.5) as (axes,):
        on_front = charts.cost_front(
            axes, points, x="seconds a pair", y="1 - AUROC, mean of five flaws",
            title="What a metric misses against what it costs", log=False,
        )  # fmt: skip
    spec = pairs.records[0][1].spec
    text = [
        f"Wall seconds of one pair at {spec['size']} px: median of {spec['rounds']} rounds in which"
        " all metrics took turns, mean over scenes. Each makes all that it needs anew: keypoints,"
        " embeddings, flow, the depth of both views. On the front, cheapest first:"
        f" {', '.join(on_front) or 'none'}. Metrics that know the truth are left out."
    ]
    picture = Picture("figures/audit-cost.svg", "What a metric misses against what it costs.")
    return Section("What a metric costs", text, figures=[picture])


def _everything(pairs: Pairs) -> Section:
    tables = []
    for yaw in pairs.yaws:
        rows = [
            [
                flaw.at(size),
                *(area_text(pairs.area(row, [name], [yaw])) for row in pairs.rows),
            ]
            for name, (flaw, size) in CONDITIONS.items()
        ]
        columns = ["flaw", *(row.title for row in pairs.rows)]
        tables.append(Table(columns, rows, f"AUROC at {yaw:g} degrees", folded=True))
    paired = [
        [
            row.title,
            *(_two(pairs.shown(row, flaw).paired) for flaw in FLAWS),
        ]
        for row in pairs.rows
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
    tables.append(
        Table(
            ["metric", *(f"{yaw:g} degrees" for yaw in pairs.yaws)],
            floor,
            "Floor: values of right pairs, means over scenes",
            folded=True,
        )
    )
    correlations = _correlations(pairs)
    tables.append(
        Table(
            ["metric", *(row.title for row in pairs.rows)],
            [
                [row.title, *map(_two, line)]
                for row, line in zip(pairs.rows, correlations, strict=True)
            ],
            "Rank correlation of metrics over the flaws of a pair, mean over pairs up to"
            f" {max(pairs.near):g} degrees",
            folded=True,
        )
    )
    return Section("All figures of the audit", [], tables)


def _correlations(pairs: Pairs) -> list[list[float]]:
    """Spearman's between metrics over all conditions of one pair, mean over pairs."""
    sums: Mapping[tuple[int, int], list[float]] = {
        (i, j): [] for i in range(len(pairs.rows)) for j in range(len(pairs.rows))
    }
    names = [*RIGHT, *CONDITIONS]
    for yaw in pairs.near:
        columns = [pairs.values(row, names, yaw) for row in pairs.rows]
        for scene in columns[0]:
            table = np.array([column[scene] for column in columns])
            for (i, j), found in sums.items():
                both = np.isfinite(table[i]) & np.isfinite(table[j])
                x, y = table[i][both], table[j][both]
                if len(x) > 2 and np.ptp(x) > 0 and np.ptp(y) > 0:
                    found.append(float(stats.spearmanr(x, y).statistic))
    size = range(len(pairs.rows))
    return [[float(np.mean(v)) if (v := sums[i, j]) else math.nan for j in size] for i in size]
