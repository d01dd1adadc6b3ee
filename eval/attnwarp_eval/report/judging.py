"""Verdicts on claims, each from its one judging study, adjusted together; and their section."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Literal

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, number, spread
from attnwarp_eval.metrics.multiview import ABOVE_FLOOR, BELOW_FLOOR
from attnwarp_eval.report.claims import Claim, Measured
from attnwarp_eval.report.compared import difference_text, in_words, no_verdict, scene_texts
from attnwarp_eval.report.controls import HALF, share_text
from attnwarp_eval.statistics.contrasts import EQUAL_LEVEL, Contrast
from attnwarp_eval.statistics.intervals import (
    ROUNDING,
    Interval,
    agreement,
    benjamini_hochberg,
    common,
    paired,
)
from attnwarp_eval.statistics.planning import MOST_SCENES
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.results import Results

Verdict = Literal["holds", "the opposite holds", "equal", "can't tell", "blind"]

Here = Literal["seen", "seen where defined", "mixed", "not seen"]


@dataclass(frozen=True)
class JudgedClaim:
    """A claim, its measurement in a run, and the verdict.

    Attributes:
        agreement: numbers of views with the expected sign, and of all views.
        here: result on the run's scenes.
        below_floor: number of scenes in which both sides disagree less than true views.
        judges: whether the run belongs to the claim's judging study, on a sample.
        p: adjusted p-value; unadjusted before :func:`decided`.
        verdict: verdict; None if another study judges.
    """

    claim: Claim
    measured: Measured
    agreement: tuple[int, int]
    here: Here
    below_floor: tuple[str, ...]
    judges: bool
    p: float
    verdict: Verdict | None = None

    @property
    def contrast(self) -> Contrast:
        """The difference, on the scale of its figure."""
        return self.measured.contrast

    @property
    def metric(self) -> str:
        """Name of the figure."""
        return self.measured.metric

    @property
    def sides(self) -> dict[str, Interval]:
        """Mean of each side."""
        return self.measured.sides

    @property
    def difference(self) -> str:
        """The difference in words, with the interval of the verdict's level."""
        level = EQUAL_LEVEL if self.verdict == "equal" else 0.95
        if self.verdict not in (None, "equal"):
            level = self.contrast.level(self.p)
        return difference_text(
            self.contrast, probe(self.claim.probe).metric(self.metric).unit, level
        )

    @property
    def told(self) -> bool:
        """True if there is a verdict other than "can't tell"."""
        return self.verdict in ("holds", "the opposite holds", "equal")

    @property
    def one_computation(self) -> bool:
        """True if the sides are equal to the last digit everywhere: what parts them had no effect,
        so nothing was tried.
        """
        return not any(self.contrast.by_scene.values())

    @property
    def in_words(self) -> str:
        """The verdict; for "can't tell", also the scenes needed to tell; for fewer than six scenes,
        the number that agree; for a claim of another study, that study's name.
        """
        if self.verdict is None:
            return f"judged by `{self.claim.study}`"
        if self.contrast.scenes < FEWEST_SCENES:
            return no_verdict(self.contrast)
        if self.verdict == "equal":
            return f"equal within {_bound(self.claim)}"
        if self.verdict != "can't tell":
            return self.verdict
        if self.measured.control == "not measured":
            return "can't tell: its control was not measured"
        if self.one_computation:
            return "can't tell: both sides are equal to the last digit"
        needed = self.contrast.needed(self.p, self.claim.bound)
        return f"can't tell: {count_of(needed)} scenes would"

    @property
    def means(self) -> str:
        """Mean of each side in words, in the order of the claim."""
        metric = probe(self.claim.probe).metric(self.metric)
        means = [in_words(side.mean, metric, self.metric) for side in self.sides.values()]
        return " against ".join(reversed(means))

    @property
    def control(self) -> str:
        """Outcome of the control in words, with its share of a gain that was told."""
        share, told = self.measured.share, self.verdict in ("holds", "the opposite holds", "blind")
        if told and share is not None and math.isfinite(share[0]):
            return f"{self.measured.control}: {share_text(share)}"
        return self.measured.control or "none"

    @property
    def row(self) -> tuple[str, ...]:
        """Cells of a table of claims."""
        return (
            self.claim.text,
            self.in_words,
            self.difference,
            self.means,
            str(self.contrast.scenes),
            self.control,
        )


def count_of(scenes: int) -> str:
    """A number of scenes in words.

    Example:
        >>> count_of(40), count_of(5000)
        ('40', 'over 1000')
    """
    return f"over {MOST_SCENES}" if scenes > MOST_SCENES else str(scenes)


def _bound(claim: Claim) -> str:
    metric = probe(claim.probe).metric(claim.metric)
    if isinstance(claim.equal_within, str):
        return (
            claim.equal_within.replace("%", "points")
            if metric.scale == "share"
            else (claim.equal_within)
        )
    return f"{claim.equal_within} {metric.unit}"


def judge(results: Results, claims: Sequence[Claim]) -> list[JudgedClaim]:
    """Every claim that the run has measurements for; claims that its study judges have a verdict,
    adjusted over them.

    """
    return decided(found(results, claims))


def found(results: Results, claims: Sequence[Claim]) -> list[JudgedClaim]:
    """Every claim that the run has measurements for, before a verdict."""
    judged = []
    for claim in claims:
        measured = claim.measure(results)
        if measured is None or not measured.contrast.by_scene:
            continue
        judged.append(
            JudgedClaim(
                claim,
                measured,
                agreement(measured.a, measured.b, claim.sign),
                _here(claim, measured, len(results.study.scenes)),
                _below_floor(measured),
                claim.judged_by(results.study),
                measured.contrast.flips.p,
            )
        )
    return judged


def decided(claims: Iterable[JudgedClaim]) -> list[JudgedClaim]:
    """Claims with their verdicts, p-values adjusted over all judged claims
    (Benjamini-Hochberg).

    Args:
        claims: claims of one run, or of the runs of all judging studies.
    """
    every = list(claims)
    adjusted = benjamini_hochberg([c.p if c.judges else float("nan") for c in every])
    return [
        replace(c, p=p, verdict=_verdict(c, p) if c.judges else None)
        for c, p in zip(every, adjusted, strict=True)
    ]


def _verdict(judged: JudgedClaim, p: float) -> Verdict:
    claim, control = judged.claim, judged.measured.control
    if control == "not measured" or judged.one_computation:
        return "can't tell"
    told = judged.contrast.verdict(claim.expect, adjusted_p=p, bound=claim.bound)
    if control == "not seen":
        # If wrong features do as well, a gain from the right ones and every null result lose their
        # meaning. A loss keeps its meaning.
        lost = told == "worse" and "worse" in (claim.control or {})
        return "the opposite holds" if lost else "blind"
    share = judged.measured.share
    if told in ("better", "worse") and share is not None and share[0] >= HALF:
        return "blind"
    words: dict[str, Verdict] = {"better": "holds", "worse": "the opposite holds", "equal": "equal"}
    return words.get(told, "can't tell")


Comparison = tuple[str, str, frozenset[str]]
"""Key of a comparison: a probe, a metric and two variants."""


def of_comparisons(judged: Iterable[JudgedClaim]) -> dict[Comparison, JudgedClaim]:
    """The claim that judges each comparison of two variants over all views: tables show the claim's
    verdict for such a comparison.
    """
    return {
        (one.claim.probe, one.metric, frozenset(one.sides)): one
        for one in judged
        if one.claim.yaw is None and one.verdict is not None
    }


def _here(claim: Claim, measured: Measured, scenes: int) -> Here:
    """Describe whether the mean difference has the expected sign in every scene.

    ``scenes``: number of the study's scenes. A scene without values cannot show the expected sign.
    """
    shared = common([measured.a, measured.b])
    values = [abs(x) for table in shared for views in table.values() for x in views.values()]
    rounding = ROUNDING * max(values, default=0.0)
    differences = [paired({s: shared[0][s]}, {s: shared[1][s]}) for s in shared[0]]
    signs = [one.mean * claim.sign > rounding for one in differences]
    if not all(signs):
        return "mixed" if any(signs) else "not seen"
    return "seen" if len(signs) == scenes else "seen where defined"


def _below_floor(measured: Measured) -> tuple[str, ...]:
    if not measured.metric.startswith(ABOVE_FLOOR):
        return ()
    a, b = common([measured.a, measured.b])
    return tuple(s for s in a if max(fmean(a[s].values()), fmean(b[s].values())) < 0)


OUTCOMES = {
    "holds": "As expected",
    "the opposite holds": "The opposite of what was expected",
    "equal": "No difference, within a bound",
    "can't tell": "Cannot be told",
    "blind": "No verdict, since the control failed",
}
"""Verdict -> its wording, in the order in which claims are shown."""

COLUMNS = ("claim", "verdict", "difference", "measured", "scenes", "control")
"""Columns of :attr:`JudgedClaim.row`."""


def claims_section(results: Results, judged: Sequence[JudgedClaim]) -> Section | None:
    """The section on the claims that a study judges; None for a run without a verdict."""
    own = [one for one in judged if one.verdict is not None]
    if not own or len(results.study.scenes) < FEWEST_SCENES:
        return None
    kinds = list(OUTCOMES)
    own.sort(key=lambda one: (kinds.index(str(one.verdict)), one.claim.headline or math.inf, one.p))
    counts = Counter(str(one.verdict) for one in own)
    counted = " ".join(f"{OUTCOMES[kind]}: {counts[kind]}." for kind in kinds if counts[kind])
    several = len(own) > 1
    text = [
        f"{len(own)} claim{'s are' if several else ' is'} judged. {counted}",
        f"Of {results.study.sampled}, each test has those in which its difference is defined."
        " Flipped signs of their differences decide"
        + f", adjusted for all {len(own)} claims"
        * several
        + ", and the interval is that of the test. **Control**: what has to do worse, such as"
        " features from a wrong place; in percent the share of the gain that it reaches too, from"
        ' a half on of which the claim is blind. "Can\'t tell" does not mean equal.',
    ]
    rows = [list(one.row) for one in own]
    return Section("Claims", text, [Table(list(COLUMNS), rows)])


HERE = (
    "**Here** speaks of these scenes alone: {here} **Views that agree** have the expected sign."
    " **Measured** are means; those of two variants are over the views that both have. Errors"
    " differ by a ratio, shares by their odds. One study judges each claim, on scenes that were"
    " drawn; others show the same difference without a verdict."
)

MANY = (
    "`seen`: the difference has the expected sign in every scene. `seen where defined`: in every"
    " scene that has values. `not seen`: in no scene."
)
"""Meaning of the column for at least six scenes."""

FEW = "how many have the sign of their mean. So few give no verdict."
"""Meaning of the column for fewer scenes."""


def claims_in_detail(results: Results, findings: Sequence[JudgedClaim]) -> list[Section]:
    """The folded section on every claim that a run has measured; none without any."""
    if not findings:
        return []
    judges = any(finding.judges for finding in findings)
    rows, names = [], results.study.scene_names
    few = len(names) < FEWEST_SCENES
    for finding in findings:
        if few:
            unit = probe(finding.claim.probe).metric(finding.metric).unit
            own = scene_texts(finding.contrast, unit, names)
            below = finding.below_floor
            own = [t + " (below)" * (n in below) for n, t in zip(names, own, strict=True)]
        else:
            own = [f"{finding.contrast.scenes} of {len(names)}", finding.difference]
            if finding.below_floor:
                own[0] += f"; below the floor: {', '.join(finding.below_floor)}"
            if judges:
                own += [number(finding.p), number(finding.contrast.student.p)]
        here = no_verdict(finding.contrast) if few else finding.here
        agree, views = finding.agreement
        sides = "; ".join(f"{name}: {spread(value)}" for name, value in finding.sides.items())
        rows.append([finding.claim.text, here, *own, f"{agree} of {views}", sides, finding.metric])
    text = [HERE.format(here=FEW if few else MANY)]
    if any(finding.metric.startswith(ABOVE_FLOOR) for finding in findings):
        text.append(f"{BELOW_FLOOR} Scenes in which both sides are stand in the table.")
    columns = ["scenes", "difference", *["adjusted p", "p by t"] * judges]
    columns = names if few else columns
    table = Table(["claim", "here", *columns, "views that agree", "measured", "metric"], rows)
    return [Section("Claims in detail", text, [table], folded=True)]
