"""Verdicts of a run against a baseline. Pure: two snapshots in, one comparison out.

Two cells of one definition and one seed are the same computation, so their figures are compared
view by view. A change within the margin is tested over scenes, with the p-values of all tests
adjusted together.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from attnwarp_eval.compare.snapshot import NOT_MEASURED, Measured, Snapshot
from attnwarp_eval.metrics.gates import GATES, Margin, margin, same_count
from attnwarp_eval.metrics.registry import METRICS, Metric
from attnwarp_eval.statistics.contrasts import paired
from attnwarp_eval.statistics.intervals import (
    ByView,
    Interval,
    benjamini_hochberg,
    verdict,
)
from attnwarp_eval.study.probe import probe as probe_of

Verdict = Literal["worse", "better", "equal", "can't tell"]

FEWEST_SCENES = 6
"""Fewest pairs of scenes with which a test can flag a difference."""

NOT_IN_STUDY = "not in the run's study"

FaultKind = Literal["missing", "unmeasured", "redefined", "counter"]


@dataclass(frozen=True)
class Fault:
    """A failure that is not a metric regression.

    Attributes:
        kind: ``missing``: present in the baseline, absent in the run; ``unmeasured``: scenes,
            variants, probes or seeds without any cell in the run; ``redefined``: the cell
            computes something else; ``counter``: its work differs.
        name: name of the cell, metric or view.
        detail: expected and actual value.
    """

    kind: FaultKind
    name: str
    detail: str


@dataclass(frozen=True)
class FigureVerdict:
    """The verdict on one metric of one variant over all scenes and views.

    Attributes:
        verdict: verdict; "equal" only if shown within the margin.
        baseline, run: means over scenes of the means over the views defined on both sides.
        difference: run - baseline, paired on scene and view; of absolute values for a figure that
            is best at 0.
        adjusted_p: p-value of the difference, adjusted for all tests of the comparison; NaN without
            a test.
        worst: the view with the largest worsening (``scene/view/seed``), with its two values.
        undefined: views whose value was defined in the baseline only.
        beyond_margin: views that got worse by more than the metric's margin; one is enough for
            "worse", regardless of the mean.
    """

    probe: str
    variant: str
    metric: str
    verdict: Verdict
    baseline: float
    run: float
    difference: Interval
    adjusted_p: float
    worst: tuple[str, float, float] | None
    undefined: int
    beyond_margin: int = 0


@dataclass(frozen=True)
class Comparison:
    """The outcome of a comparison.

    Attributes:
        study: name of the run's study.
        rows: one for each (probe, variant, metric) on both sides.
        faults: failures without a figure.
        added: figures and counters that only the run has; they pass until ``--update`` adds them to
            the baseline.
        unread: probes with cells on both sides and figures, none of which was compared.
        left_out: figures of one side only, which a comparison of common figures omits.
    """

    study: str
    rows: tuple[FigureVerdict, ...]
    faults: tuple[Fault, ...]
    added: tuple[str, ...] = field(default=())
    unread: tuple[str, ...] = field(default=())
    left_out: tuple[str, ...] = field(default=())

    @property
    def incomplete(self) -> bool:
        """True if the run measured less than the baseline, and nothing else is wrong."""
        worse = any(row.verdict == "worse" for row in self.rows)
        return bool(self.faults) and not worse and {f.kind for f in self.faults} == {"unmeasured"}

    @property
    def regressed(self) -> bool:
        """True if anything got worse, is missing, or is no longer the same."""
        return bool(self.faults) or any(row.verdict == "worse" for row in self.rows)

    @property
    def too_little(self) -> str:
        """Reason why there is no verdict; empty if there is one."""
        if not self.rows:
            return "both sides share no gated figure"
        if self.unread:
            return (
                f"both sides share no gated figure of {', '.join(map(repr, self.unread))}; gate on"
                " a study without it"
            )
        return ""


Key = tuple[str, str, str, str]
"""(scene, probe, variant, seed)."""


def compare(baseline: Snapshot, run: Snapshot, common: bool = False) -> Comparison:
    """Compare a run with a baseline over the union of their cells, metrics and views.

    With ``common`` only common cells of one definition, seeds included, are compared. The rest is
    then no fault, and is listed in ``left_out``.
    """
    left_out: list[str] = []
    left, right = _by_key(baseline.cells), _by_key(run.cells)
    faults, added = _missing_cells(left, right, run)
    for key in sorted(left.keys() & right.keys()):
        first, second = left[key], right[key]
        name = _name(key)
        if {c.definition for c in first} != {c.definition for c in second}:
            detail = "another scene, setting, encoder or protocol than the baseline's"
            if common:
                left_out.append(f"{name} ({detail})")
                del left[key], right[key]
                continue
            faults.append(Fault("redefined", name, detail))
        before, now = _counted(first), _counted(second)
        faults += _counters(name, before, now)
        added += [f"{name} / {counter}" for counter in sorted(now.keys() - before.keys())]
        first, second = left[key], right[key] = _without_psnr(first, second)
        missing, new = _missing_figures(name, first, second)
        faults += missing
        added += new
    rows = _rows(left, right)
    both = {probe for _, probe, *_ in left.keys() & right.keys()}
    # A plugin's probe has figures without gates: none of them was dropped.
    unread = sorted(name for name in both - {r.probe for r in rows} if _has_gates(name))
    if common:
        lacking = [fault for fault in faults if fault.kind in ("missing", "unmeasured")]
        faults = [fault for fault in faults if fault not in lacking]
        left_out += [f"{fault.name} ({fault.detail})" for fault in lacking]
        left_out += [f"{name} (only in the run)" for name in added]
        added = []
    return Comparison(run.study, rows, tuple(faults), tuple(added), tuple(unread), tuple(left_out))


def _has_gates(name: str) -> bool:
    """Return True if any figure of a probe is gated."""
    return not GATES.keys().isdisjoint(m.name for m in probe_of(name).metrics.values())


def _by_key(cells: Iterable[Measured]) -> dict[Key, list[Measured]]:
    """The cells of every key, one for each edit; shared ones are repeated, since variants may
    diverge.
    """
    table: dict[Key, list[Measured]] = {}
    for cell in cells:
        for variant in cell.variants:
            key = (cell.scene, cell.probe, variant, str(cell.seed))
            table.setdefault(key, []).append(cell)
    return table


def _without_psnr(
    first: list[Measured], second: list[Measured]
) -> tuple[list[Measured], list[Measured]]:
    """Both sides without PSNRs whose mean squared errors both have: the PSNR of equal pictures is
    infinite, so undefined here, and would fail when an error falls to 0.
    """
    shared = _metrics(first) & _metrics(second)
    left_out = {key for key in shared if "psnr" in key and key.replace("psnr", "mse") in shared}
    if not left_out:
        return first, second

    def kept(cells: list[Measured]) -> list[Measured]:
        return [
            replace(cell, figures={k: f for k, f in cell.figures.items() if k not in left_out})
            for cell in cells
        ]

    return kept(first), kept(second)


def _name(key: Key) -> str:
    return " / ".join((*key[:3], f"seed {key[3]}"))


def _missing_cells(
    left: Mapping[Key, object], right: Mapping[Key, object], run: Snapshot
) -> tuple[list[Fault], list[str]]:
    reasons: dict[Key, str] = dict.fromkeys(left.keys() - right.keys(), NOT_IN_STUDY)
    # A run that lacks one of its expected cells is incomplete, regardless of the baseline.
    for (scene, probe, variant, seed), reason in run.missing.items():
        reasons[scene, probe, variant, str(seed)] = reason
    only_here = dict.fromkeys(right.keys() - left.keys(), "")
    return _lacking(reasons, right), [fault.name for fault in _lacking(only_here, left)]


_WHOLE = ("scene", "probe", "variant", "seed")
"""Parts of a key; all missing values of a part are reported in one line."""

_NOT_FAILED = ("", NOT_IN_STUDY, NOT_MEASURED)


def _lacking(lacking: Mapping[Key, str], there: Mapping[Key, object]) -> list[Fault]:
    """Faults for missing keys: first scenes, probes, variants and seeds without any cell, then
    single cells. A failed cell has a separate line with its error.
    """
    rest, faults = dict(lacking), []
    for place, what in enumerate(_WHOLE):
        has = {key[place] for key in there}
        for reason in _NOT_FAILED:
            keys = [key for key, why in rest.items() if key[place] not in has and why == reason]
            names = sorted({key[place] for key in keys})
            if keys:
                cells = f"{len(keys)} {_plural('cell', keys)}"
                detail = f"{cells} {reason}" if reason else cells
                name = f"{_plural(what, names)} {', '.join(names)}"
                faults.append(Fault("unmeasured", name, detail))
                rest = {key: why for key, why in rest.items() if key not in keys}
    return faults + [Fault("missing", _name(key), why) for key, why in sorted(rest.items())]


def _plural(word: str, counted: Collection[object]) -> str:
    return word if len(counted) == 1 else f"{word}s"


def _counted(cells: Iterable[Measured]) -> dict[str, int]:
    """Counts of work over cells."""
    counts: dict[str, int] = {}
    for cell in cells:
        for name, count in cell.counters.items():
            counts[name] = counts.get(name, 0) + count
    return counts


def _counters(name: str, first: Mapping[str, int], second: Mapping[str, int]) -> list[Fault]:
    faults = []
    for counter, before in sorted(first.items()):
        now = second.get(counter)
        if now is None or not same_count(counter, before, now):
            detail = f"{before} in the baseline, {'none' if now is None else now} in the run"
            if now is not None and before:
                word = "rose" if now > before else "fell"
                detail += f": {word} by {100 * abs(now - before) / before:.3g} %"
            faults.append(Fault("counter", f"{name} / {counter}", detail))
    return faults


def _missing_figures(
    name: str, first: list[Measured], second: list[Measured]
) -> tuple[list[Fault], list[str]]:
    faults, added = [], []
    before, now = _figures(first), _figures(second)
    for metric in sorted(before.keys() | now.keys()):
        if metric not in now:
            faults.append(Fault("missing", f"{name} / {metric}", "the run has no such figure"))
        elif metric not in before:
            added.append(f"{name} / {metric}")
        else:
            versions, views = before[metric]
            if versions != now[metric][0]:
                detail = "the metric's version is another than the baseline's"
                faults.append(Fault("redefined", f"{name} / {metric}", detail))
            for view in sorted(views - now[metric][1]):
                faults.append(
                    Fault("missing", f"{name} / {metric} / {view}", "the run has no such view")
                )
            added += [f"{name} / {metric} / {view}" for view in sorted(now[metric][1] - views)]
    return faults, added


def _figures(cells: list[Measured]) -> dict[str, tuple[set[int], set[str]]]:
    """Versions and views of every metric of the cells."""
    table: dict[str, tuple[set[int], set[str]]] = {}
    for cell in cells:
        for key, figure in cell.figures.items():
            versions, views = table.setdefault(key, (set(), set()))
            versions.add(figure.version)
            views.update(figure.values)
    return table


def _metrics(cells: list[Measured]) -> set[str]:
    return {key for cell in cells for key in cell.figures}


def _rows(
    left: Mapping[Key, list[Measured]], right: Mapping[Key, list[Measured]]
) -> tuple[FigureVerdict, ...]:
    shared: dict[tuple[str, str], list[Key]] = {}
    for key in sorted(left.keys() & right.keys()):
        shared.setdefault((key[1], key[2]), []).append(key)
    names = sorted(
        {
            (*variant, metric)
            for variant, keys in shared.items()
            for key in keys
            for metric in _metrics(left[key]) & _metrics(right[key])
        }
    )
    groups = [
        _Group.of(probe, variant, metric, shared[probe, variant], left, right)
        for probe, variant, metric in names
    ]
    # Exclude tests with too few scenes, which would reduce the power of the others.
    adjusted = benjamini_hochberg(
        [g.difference.p if g.difference.scenes >= FEWEST_SCENES else math.nan for g in groups]
    )
    return tuple(g.row(p) for g, p in zip(groups, adjusted, strict=True))


@dataclass(frozen=True)
class _Group:
    """The values of one metric of one variant on both sides, by scene, view and seed.

    Attributes:
        before, now: measured values.
        worsening: scene/view -> worsening of the run, in the metric's unit.
    """

    probe: str
    variant: str
    metric: Metric
    key: str
    before: ByView
    now: ByView
    difference: Interval
    worsening: Mapping[str, float]

    @classmethod
    def of(
        cls,
        probe: str,
        variant: str,
        key: str,
        shared: list[Key],
        left: Mapping[Key, list[Measured]],
        right: Mapping[Key, list[Measured]],
    ) -> _Group:
        metric = METRICS[key]
        before, now = (_values(side, shared, key) for side in (left, right))
        size = abs if metric.direction == "zero" else float
        first, second = (
            {s: {v: float(size(x)) for v, x in views.items()} for s, views in side.items()}
            for side in (before, now)
        )
        sign = -1.0 if metric.direction == "higher" else 1.0
        worsening = {
            f"{scene}/{view}": sign * (second[scene][view] - value)
            for scene, views in first.items()
            for view, value in views.items()
            if view in second.get(scene, {})
        }
        return cls(probe, variant, metric, key, before, now, paired(first, second), worsening)

    def row(self, adjusted_p: float) -> FigureVerdict:
        """The group's verdict."""
        flat_before, flat_now = _flat(self.before), _flat(self.now)
        undefined = sum(
            math.isfinite(value) and math.isnan(flat_now.get(name, 0.0))
            for name, value in flat_before.items()
        )
        defined = {name: w for name, w in self.worsening.items() if math.isfinite(w)}
        worst = max(defined, key=lambda name: defined[name], default=None)
        return FigureVerdict(
            self.probe,
            self.variant,
            self.key,
            self._by_views(flat_before, undefined) or self._by_scenes(flat_before, adjusted_p),
            *_means_of_shared(self.before, self.now),
            self.difference,
            adjusted_p,
            (worst, flat_before[worst], flat_now[worst]) if worst else None,
            undefined,
            self._beyond_margin(flat_before),
        )

    def _beyond_margin(self, before: Mapping[str, float]) -> int:
        limit = margin(self.key)
        return sum(w > limit.around(before[name]) for name, w in self.worsening.items())

    def _by_views(self, before: Mapping[str, float], undefined: int) -> Verdict | None:
        """The verdict view by view; None if only a test can decide."""
        allowed = Margin(self.metric.atol, self.metric.rtol)
        limit = margin(self.key)
        if undefined or self._beyond_margin(before):
            return "worse"
        now = _flat(self.now)
        if any(math.isnan(before[name]) and math.isfinite(now[name]) for name in self.worsening):
            return "can't tell"  # defined in the run only: neither better nor worse
        changes = [
            (w, allowed.around(before[name]), limit.around(before[name]))
            for name, w in self.worsening.items()
            if math.isfinite(w)
        ]
        if all(abs(w) <= tolerance for w, tolerance, _ in changes):
            return "equal"
        gained = any(w < -most for w, _, most in changes)
        lost = any(w > tolerance for w, tolerance, _ in changes)
        return "better" if gained and not lost else None

    def _by_scenes(self, before: Mapping[str, float], adjusted_p: float) -> Verdict:
        """The verdict of a test over scenes."""
        difference = self.difference
        if difference.scenes < FEWEST_SCENES:
            return "can't tell"
        values = [value for value in before.values() if math.isfinite(value)]
        allowed = Margin(self.metric.atol, self.metric.rtol)
        outcome = verdict(
            difference,
            "higher" if self.metric.direction == "higher" else "lower",
            atol=float(np.mean([allowed.around(value) for value in values])),
            adjusted_p=adjusted_p,
        )
        reach = float(np.mean([margin(self.key).around(value) for value in values]))
        within = max(abs(difference.low), abs(difference.high)) < reach
        if outcome == "can't tell" and within and not difference.undefined:
            return "equal"
        return outcome


def _values(
    side: Mapping[Key, list[Measured]], keys: list[Key], metric: str
) -> dict[str, dict[str, float]]:
    """Scene -> view and seed -> value."""
    table: dict[str, dict[str, float]] = {}
    for key in keys:
        for cell in side[key]:
            figure = cell.figures.get(metric)
            for view, value in figure.values.items() if figure else ():
                table.setdefault(key[0], {})[f"{view}/{cell.seed}"] = value
    return table


def _flat(table: ByView) -> dict[str, float]:
    return {
        f"{scene}/{view}": value for scene, views in table.items() for view, value in views.items()
    }


def _means_of_shared(before: ByView, now: ByView) -> tuple[float, float]:
    """Means over scenes of the means over the views defined on both sides; without such views, over
    each side's defined views, and NaN without any.
    """
    names = _flat(before).keys() & _flat(now).keys()
    one, other = _flat(before), _flat(now)
    shared = {n for n in names if math.isfinite(one[n]) and math.isfinite(other[n])}

    def mean(table: ByView) -> float:
        return _mean_of_defined(
            _mean_of_defined(
                x for view, x in views.items() if not shared or f"{scene}/{view}" in shared
            )
            for scene, views in table.items()
        )

    return mean(before), mean(now)


def _mean_of_defined(values: Iterable[float]) -> float:
    defined = [value for value in values if math.isfinite(value)]
    return float(np.mean(defined)) if defined else math.nan
