"""Report of the audit: what each figure sees, what it is blind to, what games it, and its cost."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from scipy import stats

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.metrics.registry import metric
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_eval.study.probe_report import Layout, ProbeReport, register_report
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.encoders import encoders_named
from attnwarp_lab.probes.audit.auroc import Auroc, auroc
from attnwarp_lab.probes.audit.figures import FIGURES, TRUTHS, Figure
from attnwarp_lab.probes.audit.flaws import CONDITIONS, COUNTED, FLAWS, Flaw
from attnwarp_lab.probes.audit.measure import ARM, REFIT_SIZE, Seconds
from attnwarp_lab.probes.audit.views import METAL, RIGHT, VARNISHED

NEAR = 60.0
"""Largest yaw in degrees in the first table."""

SEES, BLIND = 0.9, 0.6
"""Share of flawed pairs ranked below the right ones of their scene from which a metric sees a flaw,
and below which it is blind to it."""

ALARM = 0.05
"""Share of right pairs without highlights that lie above the threshold for false alarms."""

LEAST_ARMS = 3
"""Smallest number of edits of a scene by one editor whose order is compared."""

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
        scores = {
            key.rpartition(".")[0]: None
            for key in first
            if key.startswith("consistency.score_") and key.endswith(f".{RIGHT[0]}")
        }
        given = [Figure(key, key.partition(".")[2].partition(".")[2], "scores") for key in scores]
        self.rows = [r for r in (*given, *FIGURES) if f"{r.key}.{RIGHT[0]}" in first]
        self.arms = list(records[0][1].spec["arms"])
        self.by_editor: dict[str, list[str]] = {}
        for arm, spec in records[0][1].spec["arms"].items():
            self.by_editor.setdefault(str(spec.get("editor")), []).append(arm)
        self._kept: dict[tuple[object, ...], Auroc] = {}

    @cached_property
    def near(self) -> list[float]:
        """Yaws up to :data:`NEAR`; all if there are none."""
        return [yaw for yaw in self.yaws if abs(yaw) <= NEAR] or self.yaws

    @cached_property
    def kinds(self) -> dict[str, Pairs]:
        """Pairs of each edit, which are never pooled."""
        edits = dict.fromkeys(record.spec["edit"] for _, record in self.records)
        if len(edits) == 1:
            return dict.fromkeys(edits, self)
        return {
            edit: Pairs([(s, record) for s, record in self.records if record.spec["edit"] == edit])
            for edit in edits
        }

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
        """Mean AUROC of conditions at yaws, against right pairs of the same edit and yaw."""
        key = (row.key, tuple(conditions), tuple(yaws), tuple(right))
        if key not in self._kept:
            self._kept[key] = auroc(
                [
                    (kind.values(row, [one], yaw), kind.values(row, right, yaw))
                    for kind in self.kinds.values()
                    for one in conditions
                    for yaw in yaws
                ]
            )
        return self._kept[key]

    def counted(self, row: Figure, yaws: Sequence[float], right: Sequence[str] = RIGHT) -> Auroc:
        """Mean AUROC of the most important flaws, against right pairs."""
        return self.area(row, [flaw.key(flaw.reference) for flaw in COUNTED], yaws, right)

    def alarms(self, row: Figure, trap: str = VARNISHED) -> float:
        """Share of a trap's right pairs above the threshold that :data:`ALARM` of the other right
        pairs of the edit pass, mean over edits and near yaws.
        """
        shares = []
        for kind, yaw in product(self.kinds.values(), self.near):
            right, shiny = (
                np.array([v for numbers in kind.values(row, names, yaw).values() for v in numbers])
                for names in (RIGHT, [trap])
            )
            right, shiny = right[np.isfinite(right)], shiny[np.isfinite(shiny)]
            if len(right) and len(shiny):
                shares.append(float((shiny > np.quantile(right, 1 - ALARM)).mean()))
        return float(np.mean(shares)) if shares else math.nan

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
        """Median seconds of a pair, or of a set of views; mean over scenes."""
        taken: Values = {}
        for scene, record in self.records:
            if rounds := record.extra.seconds.get(row.key):
                taken.setdefault(scene, []).append(float(np.median(rounds)))
        return interval(taken) if taken else None

    def within(self, row: Figure, flaw: Flaw, level: float = 0.95) -> Interval:
        """Share of a flaw's pairs, at its reference size and up to :data:`NEAR` degrees, that rank
        below the mean of the right pairs of their own scene, edit and yaw; ties are half.
        """
        shares: Values = {}
        sign = -1.0 if metric(row.key).direction == "higher" else 1.0
        name = flaw.key(flaw.reference)
        for scene, record in self.records:
            for view, yaw in zip(record.views, self.yaws, strict=True):
                right, flawed = (
                    [sign * view.metrics.get(f"{row.key}.{one}", math.nan) for one in names]
                    for names in (RIGHT, [name])
                )
                if yaw in self.near and np.isfinite([flawed[0], *right]).all():
                    mean = float(np.mean(right))
                    won = float(flawed[0] > mean) + 0.5 * float(flawed[0] == mean)
                    shares.setdefault(scene, []).append(won)
        return interval(shares, level=level)

    def tau(self, row: Figure, truth: Figure) -> Interval:
        """Kendall's rank correlation of a figure with the true disagreement of a scene's edits by
        one editor, both means over the pairs up to :data:`NEAR` degrees; mean over the editors,
        whose edits differ too much for one list.
        """
        found: Values = {}
        for (scene, record), arms in product(self.records, self.by_editor.values()):
            means = np.array(
                [[self._mean(record, one, arm) for arm in arms] for one in (row, truth)]
            )
            known = np.isfinite(means).all(axis=0)
            if known.sum() >= LEAST_ARMS:
                found.setdefault(scene, []).append(kendall(*means[:, known]))
        return interval(found)

    def _mean(self, record: Record[Seconds], row: Figure, arm: str) -> float:
        sign = -1.0 if metric(row.key).direction == "higher" else 1.0
        values = np.array(
            [
                view.metrics.get(f"{row.key}.{ARM}{arm}", math.nan)
                for view, yaw in zip(record.views, self.yaws, strict=True)
                if yaw in self.near
            ]
        )
        return sign * float(np.nanmean(values)) if np.isfinite(values).any() else math.nan


@register_report
class AuditReport(ProbeReport):
    """Presentation of the metrics and their reliability."""

    name = "audit"
    measures = "which flaws of an edit each consistency metric sees"

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """The answer in one table; real edits, settings, yaws, sizes, and all figures."""
        records = [(cell.scene, record) for cell, record in results.finished(self.name)]
        if not records:
            return
        pairs = Pairs(records)
        yield _answer(results, pairs)
        if pairs.arms:
            yield _real(pairs)
        yield _settings(pairs)
        yield _sizes(pairs)
        yield _everything(pairs)


def area_text(value: Auroc, intervals: bool = True) -> str:
    """AUROC with its interval, if any; a dash if undefined.

    Example:
        >>> area_text(Auroc(0.951, 0.9, 1.0))
        '0.95 [0.90, 1.00]'
    """
    if not math.isfinite(value.value):
        return "–"
    if not intervals or not math.isfinite(value.low):
        return f"{value.value:.2f}"
    return f"{value.value:.2f} [{value.low:.2f}, {value.high:.2f}]"


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


def kendall(values: Any, truth: Any) -> float:
    """Kendall's tau-b; 0 for values that never change, NaN for a truth that never does.

    Example:
        >>> round(kendall((1, 2, 3, 4), (1, 2, 4, 3)), 3), kendall((1, 1, 1, 1), (1, 2, 3, 4))
        (0.667, 0.0)
    """
    if not np.ptp(truth) > 0:
        return math.nan
    return float(stats.kendalltau(values, truth).statistic) if np.ptp(values) > 0 else 0.0


def judged(pairs: Pairs, row: Figure) -> tuple[list[str], list[str], list[str]]:
    """Titles of the flaws of one view that a figure sees, and is blind to, and of those that it
    rates above a right edit, at 5 % over all figures and flaws (Bonferroni).

    A flaw of all views alike leaves them in agreement, so only what it is rewarded for counts.
    """
    level = 1 - 0.05 / (len(pairs.rows) * len(FLAWS))
    sees, blind, games = [], [], []
    for flaw in FLAWS:
        share = pairs.within(row, flaw, level)
        if not flaw.alike and share.mean >= SEES:
            sees.append(flaw.title)
        elif not flaw.alike and share.mean < BLIND:
            blind.append(flaw.title)
        rewarded = share.high < 0.5 if math.isfinite(share.high) else share.mean < 0.5
        if rewarded:
            games.append(flaw.title)
    return sees, blind, games


def _answer(results: Results, pairs: Pairs) -> Section:
    spec = pairs.records[0][1].spec
    order = sorted(pairs.rows, key=lambda row: (row.truth, -len(judged(pairs, row)[0])))
    alone = sum(not flaw.alike for flaw in FLAWS)
    table = []
    for row in order:
        sees, blind, games = judged(pairs, row)
        seconds = pairs.seconds(row)
        table.append(
            [
                row.title, row.needs, f"{len(sees)}: {', '.join(sees) or 'none'}",
                ", ".join(blind) or "none", ", ".join(games) or "none",
                " / ".join(percent(pairs.alarms(row, trap)) for trap in (VARNISHED, METAL)),
                *(
                    spread(pairs.tau(row, truth), pairs.scenes) if row is not truth else "–"
                    for truth in TRUTHS
                    if pairs.arms
                ),
                number(seconds.mean) if seconds else "–",
            ]
        )  # fmt: skip
    taus = [f"tau: {truth.title.removeprefix('truth: ')}" for truth in TRUTHS if pairs.arms]
    columns = [
        "figure", "needs", f"sees, of {alone} flaws", "is blind to", "is gamed by",
        "false alarms: varnish / metal", *taus, "seconds",
    ]  # fmt: skip
    yaws = ", ".join(f"{yaw:g}" for yaw in pairs.yaws)
    edits = ", ".join(f"`{edit}`" for edit in pairs.kinds)
    text = [
        (
            f"Every pair is the source view and one turned by {yaws} degrees, of"
            f" {results.study.scenes_in_words}, at {spec['size']} px; both show a true edit"
            f" ({edits}). In a flawed pair the second view has one flaw of known size, or both have"
            f" it alike. **Sees**: at least {percent(SEES)} of the flawed pairs up to {NEAR:g}"
            " degrees rank below the mean of the right pairs of their own scene, edit and yaw;"
            f" **blind**: fewer than {percent(BLIND)}. **Gamed by**: flaws, of one view or of all"
            " alike, that rank above the right pairs, the interval over scenes wholly so, at 5 %"
            " over all figures and flaws (Bonferroni)."
            f" False alarms: right pairs of a varnished or a metal object above the threshold that"
            f" {percent(ALARM)} of the matt right pairs pass."
        ),
        (
            f"Held-out PSNR is of splats whose colours alone were fitted at"
            f" {min(spec['size'], REFIT_SIZE)} px. Seconds are of a pair, of a set of views where"
            " a figure needs one, on one thread."
        ),
        encoders_named(results.study, spec),
    ]
    if pairs.arms:
        text.insert(
            1,
            f"**tau**: Kendall's rank correlation, within a scene and an editor, of"
            f" {' and '.join(str(len(arms)) for arms in pairs.by_editor.values())} edits by a"
            " figure with their true disagreement: colour above its floor at exact correspondences,"
            " labels and parts that show the same right answer. Mean over the editors.",
        )
    if pairs.scenes < len(results.study.scenes):
        text.insert(0, f"**Measured on {pairs.scenes} of {len(results.study.scenes)} scenes.**")
    tables = [Table(columns, table, timed=("seconds",))]
    return Section("Which consistency metric can be believed", text, tables, leads=True)


def _real(pairs: Pairs) -> Section:
    shown = [row for row in pairs.rows if row in TRUTHS]
    rows = []
    for arm in pairs.arms:
        cells = []
        for row in shown:
            values: Values = {}
            for yaw in pairs.near:
                for scene, numbers in pairs.plain(row, [f"{ARM}{arm}"], yaw).items():
                    values.setdefault(scene, []).extend(numbers)
            cells.append(spread(interval(values), pairs.scenes))
        rows.append([arm, *cells])
    return Section(
        "Real edits and their true disagreement",
        ["Edits of the same scenes by methods, each view with noise of its own."],
        [Table(["edit", *(row.title for row in shown)], rows)],
        folded=True,
    )


def _settings(pairs: Pairs) -> Section:
    """AUROC of the five flaws by kind of edit and by yaw."""
    kinds = pairs.kinds
    rows = [
        [
            row.title,
            *(area_text(kind.counted(row, kind.near)) for kind in kinds.values()),
            *(area_text(pairs.counted(row, [yaw]), intervals=False) for yaw in pairs.yaws),
            area_text(pairs.counted(row, pairs.near, [METAL]), intervals=False),
            percent(float(np.mean([pairs.undefined(row, yaw) for yaw in pairs.near]))),
        ]
        for row in pairs.rows
    ]
    what = "; ".join(flaw.at(flaw.reference) for flaw in COUNTED)
    text = (
        "AUROC: the probability that a figure ranks a flawed pair below a right one of any scene,"
        f" of the same kind of edit and yaw: 1 sees every flaw, 0.5 none. Means of five: {what}."
    )
    columns = [
        "figure", *(f"edit {edit}" for edit in kinds), *(f"{yaw:g} degrees" for yaw in pairs.yaws),
        "against metal", "undefined",
    ]  # fmt: skip
    title = "Over scenes, by edit and by yaw"
    return Section(title, [text], [Table(columns, rows)], folded=True)


def _sizes(pairs: Pairs) -> Section:
    graded = [flaw for flaw in FLAWS if len(flaw.sizes) > 1]
    columns = [
        "figure",
        *(f"{f.title}, {f.unit} ({', '.join(f'{s:g}' for s in f.sizes)})" for f in graded),
    ]
    follows = [
        [row.title, *(spread(pairs.follows(row, flaw), pairs.scenes) for flaw in graded)]
        for row in pairs.rows
    ]
    text = (
        f"Spearman's rank correlation of a flaw's size, 0 for the right pair, with a figure's"
        f" disagreement on the same pair, up to {NEAR:g} degrees; in brackets the sizes."
    )
    title = "Does a figure follow the size of a flaw"
    return Section(title, [text], [Table(columns, follows)], folded=True)


def _everything(pairs: Pairs) -> Section:
    heads = ["figure", *(flaw.at(flaw.reference) for flaw in FLAWS)]
    within = [
        [row.title, *(spread(pairs.within(row, flaw), pairs.scenes) for flaw in FLAWS)]
        for row in pairs.rows
    ]
    areas = [
        [flaw.at(size), *(area_text(pairs.area(row, [name], pairs.near)) for row in pairs.rows)]
        for name, (flaw, size) in CONDITIONS.items()
    ]
    floor = [
        [
            f"{row.title}, {metric(row.key).unit}",
            *(spread(interval(pairs.plain(row, RIGHT, yaw)), pairs.scenes) for yaw in pairs.yaws),
        ]
        for row in pairs.rows
    ]
    columns = ["flaw", *(row.title for row in pairs.rows)]
    yaws = ["figure", *(f"{yaw:g} degrees" for yaw in pairs.yaws)]
    tables = [
        Table(heads, within, "Flawed pairs below the right ones of their scene"),
        Table(columns, areas, f"AUROC up to {NEAR:g} degrees"),
        Table(yaws, floor, "Floor: values of right pairs, means over scenes"),
    ]
    return Section("All figures of the audit", [], tables, folded=True)
