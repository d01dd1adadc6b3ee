"""Controls of a study of edits: detection of wrong features by its figures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from statistics import fmean
from typing import Literal

import numpy as np

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, number
from attnwarp_eval.report.compared import Yaw, between
from attnwarp_eval.statistics.contrasts import Verdict
from attnwarp_eval.statistics.intervals import ByView, common
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import report_of
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.edits import VariantPart

HALF = 0.5
"""Share of a gain that features from a wrong place reach, above which it is no evidence."""

DRAWS, TAIL = 1000, 0.025
"""Number of resamples of scenes for the interval of a control's share, and their part beyond each
of its ends."""

Share = tuple[float, float, float]
"""Share of a gain that a control reaches, and the ends of its 95 % interval."""


KEPT = {"worse": ("worse",), "better": (), "": ("better", "worse")}
"""Expectation of a control that is not seen -> tests that keep their meaning: a loss, but no gain
of a method whose wrong features do as well; beside the controls of a study, both."""


@dataclass(frozen=True)
class Control:
    """Outcome of a comparison's control; "none" without one.

    Attributes:
        expected: expectation of it, against the comparison's last side; empty for the controls of a
            study, which say what its null results are worth.
        share: share of the gain that it reaches, if it has to be worse in the same figure.
    """

    seen: Literal["none", "seen", "not seen", "not measured"] = "none"
    expected: Literal["worse", "better", ""] = ""
    share: Share | None = None


UNCONTROLLED = Control()


def word_of(test: Verdict, control: Control) -> Literal[Verdict, "blind"]:
    """Verdict of a test beside its control.

    Example:
        >>> word_of("better", Control("not seen", "worse")), word_of("equal", Control("not seen"))
        ('blind', 'blind')
        >>> word_of("better", Control("seen", "worse", share=(0.6, 0.4, 0.8)))
        'blind'
    """
    if control.seen == "not measured":
        return "can't tell"
    if control.seen == "not seen":
        return test if test in KEPT[control.expected] else "blind"
    share = 0.0 if control.share is None else control.share[0]
    return "blind" if test in ("better", "worse") and share >= HALF else test


def control_share(method: ByView, control: ByView, alone: ByView, *, sign: int = 1) -> Share:
    """Share of a method's gain that a control reaches, with its 95 % interval.

    Scenes are drawn with replacement. A draw without a gain bounds the share on neither side, so it
    lies beyond both ends; if these are 2.5 % of the draws, there are no ends. NaN without a gain.

    Args:
        method, control, alone: figures of the method, of its control, and without either.
        sign: -1 if lower is better.

    Example:
        >>> tables = [{f"s{k}": {"v": value} for k in range(6)} for value in (0.9, 0.4, 0.3)]
        >>> [round(value, 3) for value in control_share(*tables)]
        [0.167, 0.167, 0.167]
    """
    tables = common([method, control, alone])
    means = np.array([[fmean(views.values()) for views in table.values()] for table in tables])
    if not means.size:
        return np.nan, np.nan, np.nan
    count = means.shape[1]
    drawn = np.random.default_rng(0).integers(count, size=(DRAWS, count))
    gain, reached = sign * (means[0] - means[2]), sign * (means[1] - means[2])
    gains, shares = gain[drawn].mean(axis=1), reached[drawn].mean(axis=1)
    shares /= np.where(gains > 0, gains, 1)
    lost = np.count_nonzero(gains <= 0)
    mean = float(reached.mean() / gain.mean()) if gain.mean() > 0 else np.nan
    if lost >= TAIL * DRAWS:
        return mean, -np.inf, np.inf
    low, high = (
        np.quantile(np.where(gains > 0, shares, beyond), at)
        for beyond, at in ((-np.inf, TAIL), (np.inf, 1 - TAIL))
    )
    return mean, float(low), float(high)


def share_text(share: Share) -> str:
    """A control's share in percent, with its interval; in words if it falls below both sides, as
    features from a wrong place do beside features from a right one.

    Example:
        >>> share_text((0.08, 0.05, 0.12)), share_text((float("nan"),) * 3)
        ('8.0 % (5.0 to 12 %)', 'no gain')
        >>> share_text((-35.1, -59.1, -22.5))
        'worse than both sides'
    """
    if not np.isfinite(share[0]):
        return "no gain"
    if share[2] < 0:
        return "worse than both sides"
    mean, low, high = (number(100 * value, 2) for value in share)
    return f"{mean} % ({low} to {high} %)" if np.isfinite(share[2]) else f"{mean} % (no bounds)"


def controls_of(results: Results, name: str, baseline: str) -> dict[str, str]:
    """Measured controls of a variant, by label.

    A control differs from its variant in ``control`` alone.
    """
    study, own = results.study, probe(name)
    meaning = own.meaning(study, study.variants[baseline])
    return {
        label: str(variant.control)
        for label, variant in study.variants.items()
        if isinstance(variant, VariantPart)
        and variant.control is not None
        and own.meaning(study, variant.model_copy(update={"control": None})) == meaning
        and results.records(name, label)
    }


def seen(
    results: Results,
    name: str,
    metric: str,
    variant: str,
    control: str,
    *,
    expected: Literal["worse", "better"] = "worse",
    yaw: Yaw | None = None,
) -> bool:
    """Return True if a figure tells a control from its variant, as ``expected``; False for a
    figure without a better direction.
    """
    direction = probe(name).metric(metric).direction
    if direction not in ("higher", "lower"):
        return False
    return between(results, name, variant, control, metric, yaw).verdict(direction) == expected


def seen_by(results: Results, name: str, baseline: str) -> dict[str, dict[str, bool]]:
    """Metric -> control of a variant -> whether the metric sees it; empty without controls."""
    labels = controls_of(results, name, baseline) if probe(name).edits else {}
    metrics = report_of(name).contrasts_at(results.layer) if labels else []
    return {m: {one: seen(results, name, m, baseline, one) for one in labels} for m in metrics}


def outcomes_of(results: Results, name: str, baseline: str) -> dict[str, Control]:
    """Metric -> outcome of a variant's controls: seen if it separates any of them from it.

    Features from the wrong place must do worse. Otherwise the figure does not depend on the
    source of features, so "can't tell" about two warps says nothing.
    """
    told = seen_by(results, name, baseline)
    return {m: Control("seen" if any(of.values()) else "not seen") for m, of in told.items()}


def controls(results: Results) -> list[Section]:
    """The section on controls, a table for each baseline with controls; none for fewer than six
    scenes, on which no test can detect a difference.
    """
    if len(results.study.scenes) < FEWEST_SCENES:
        return []
    pairs = {(one.probe, one.baseline): None for one in results.study.ablations}
    tables = [table for pair in pairs for table in _tables(results, *pair)]
    if not tables:
        return []
    text = (
        "A control takes features from the wrong place, so it has to do worse: then a figure has"
        " seen it. A figure that sees none of them is blind to where features come from."
    )
    return [Section("Controls", [text], tables, folded=True)]


def _tables(results: Results, name: str, baseline: str) -> Iterator[Table]:
    told = {
        metric: of
        for metric, of in seen_by(results, name, baseline).items()
        if probe(name).metric(metric).direction in ("higher", "lower")
    }
    if not told:
        return
    rows = [
        [label, "seen", *("seen" if of[label] else "not seen" for of in told.values())]
        for label in next(iter(told.values()))
    ]
    answers = ["sees" if any(of.values()) else "blind" for of in told.values()]
    rows.append(["this figure is", "", *answers])
    yield Table(["control", "expected", *told], rows, f"Controls of {baseline!r}")
