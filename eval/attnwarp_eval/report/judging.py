"""The one path from two variants of a run to a word, for claims and for tables of variants."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, number
from attnwarp_eval.metrics.registry import Metric
from attnwarp_eval.report.claims import Claim
from attnwarp_eval.report.compared import between, difference_text, in_words, no_verdict
from attnwarp_eval.report.controls import (
    UNCONTROLLED,
    Control,
    control_share,
    seen,
    share_text,
    word_of,
)
from attnwarp_eval.statistics.contrasts import EQUAL_LEVEL, Contrast, Verdict
from attnwarp_eval.statistics.intervals import benjamini_hochberg, common, over_scenes
from attnwarp_eval.statistics.planning import MOST_SCENES
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.study import parse_variant

Word = Literal[Verdict, "blind", "not finished", ""]


@dataclass(frozen=True)
class Comparison:
    """Two variants of a run in one figure.

    Attributes:
        metric: name of the figure in records.
        a, b: labels of the variants; the difference is that of b from a.
        direction: values that are better, or that the claim expects; None judges nothing.
        control: outcome of the comparison's control.
        claim: claim that makes this comparison, if any.
        means: means of a and of b over the views that both have, for a claim.
        p: p-value adjusted over the family; NaN before :func:`judged`.
        word: verdict; empty before :func:`judged`, and without a direction.
    """

    probe: str
    metric: str
    a: str
    b: str
    contrast: Contrast
    direction: Literal["higher", "lower"] | None
    control: Control = UNCONTROLLED
    claim: Claim | None = None
    means: tuple[float, float] = (math.nan, math.nan)
    p: float = math.nan
    word: Word = ""

    @property
    def specification(self) -> Metric:
        """Specification of the figure."""
        return probe(self.probe).metric(self.metric)

    @property
    def bound(self) -> float | None:
        """Bound of equality, of a claim."""
        return None if self.claim is None else self.claim.bound

    @property
    def difference(self) -> str:
        """The difference in words, with the interval of the verdict's level."""
        bounded = self.word in ("equal", "within")
        level = EQUAL_LEVEL if bounded else self.contrast.level(self.p)
        return difference_text(self.contrast, self.specification.unit, level)

    @property
    def verdict(self) -> str:
        """The word, with the bound that it speaks of; for fewer than six scenes the number that
        agree.
        """
        if self.word and self.contrast.scenes < FEWEST_SCENES:
            return no_verdict(self.contrast)
        if self.claim is None or self.word not in ("equal", "within"):
            return self.word
        if self.word == "equal":
            return f"equal within {self.claim.bound_in_words}"
        more = "more" if self.contrast.flips.mean > 0 else "less"
        return f"{more}, by less than {self.claim.bound_in_words}"

    @property
    def hangs_on(self) -> int:
        """Number of scenes without any one of which the word would be another."""
        assert self.direction is not None
        others = 0
        for scene in self.contrast.by_scene:
            left = self.contrast.without(scene)
            p = min(1.0, left.flips.p * self.p / self.contrast.flips.p)
            test = left.verdict(self.direction, adjusted_p=p, bound=self.bound)
            others += word_of(test, self.control) != self.word
        return others

    @property
    def reason(self) -> str:
        """Reason of "can't tell": what lacks, or the scenes that would tell; else empty."""
        if self.word != "can't tell" or self.contrast.scenes < FEWEST_SCENES:
            return ""
        if self.control.seen == "not measured":
            return "its control was not measured"
        if not any(self.contrast.by_scene.values()):
            return "both sides are equal to the last digit"
        return f"{count_of(self.contrast.needed(self.p, self.bound))} scenes would"


def judged(family: Iterable[Comparison]) -> list[Comparison]:
    """Comparisons with words, p-values adjusted over those without one (Benjamini-Hochberg).

    Args:
        family: rows of a table, or claims of one run or of the runs of all judging studies.
    """
    every = list(family)
    adjusted = benjamini_hochberg([math.nan if c.word else c.contrast.flips.p for c in every])
    return [c if c.word else _judged(c, p) for c, p in zip(every, adjusted, strict=True)]


def _judged(one: Comparison, p: float) -> Comparison:
    if one.direction is None:
        return replace(one, p=p)
    test = one.contrast.verdict(one.direction, adjusted_p=p, bound=one.bound)
    return replace(one, p=p, word=word_of(test, one.control))


def count_of(scenes: int) -> str:
    """A number of scenes in words.

    Example:
        >>> count_of(40), count_of(5000)
        ('40', 'over 1000')
    """
    return f"over {MOST_SCENES}" if scenes > MOST_SCENES else str(scenes)


def variant_like(results: Results, data: Mapping[str, Any], name: str) -> str | None:
    """Name of the first measured variant with the meaning of ``data``, as in a study's YAML."""
    own, study = probe(name), results.study
    if name not in study.probes:
        return None
    meaning = own.meaning(study, parse_variant(dict(data)))
    for label, variant in study.variants.items():
        if results.records(name, label) and own.meaning(study, variant) == meaning:
            return label
    return None


def measured(results: Results, claims: Iterable[Claim]) -> list[Comparison]:
    """The comparison of every claim that the run has measurements for; "not finished" if not all
    of it was measured as planned.
    """
    comparisons = (_measured(results, claim) for claim in claims)
    return [one for one in comparisons if one is not None and one.contrast.by_scene]


def _measured(results: Results, claim: Claim) -> Comparison | None:
    """None if the run lacks a variant of that content."""
    name, layer = claim.probe, str(results.layer)
    if claim.edit:
        results = results.by_edit(name).get(claim.edit, replace(results, cells=[]))
    metric = claim.metric.replace("{layer}", layer)
    a, b = (variant_like(results, side, name) for side in (claim.a, claim.b))
    if a is None or b is None:
        return None
    names, control = {a, b}, UNCONTROLLED
    tables = [results.views(name, who, metric, claim.yaw) for who in (a, b)]
    if claim.control is not None:
        key = str(claim.control.get("metric", claim.metric)).replace("{layer}", layer)
        direction = probe(name).metric(key).direction
        expected: Literal["worse", "better"] = "worse" if "worse" in claim.control else "better"
        label = variant_like(results, claim.control[expected], name)
        control = Control("not measured", expected)
        if label is not None and direction in ("higher", "lower"):
            names.add(label)
            share = None
            if expected == "worse" and "metric" not in claim.control:
                table = results.views(name, label, key, claim.yaw)
                sign = 1 if direction == "higher" else -1
                share = control_share(tables[1], table, tables[0], sign=sign)
            told = seen(results, name, key, b, label, expected=expected, yaw=claim.yaw)
            control = Control("seen" if told else "not seen", expected, share)
    finished = claim.planned(results.study) and all(
        cell.record is not None
        for cell in results.cells
        if cell.probe == name and names.intersection(cell.variants)
    )
    first, second = (over_scenes(table).mean for table in common(tables))
    return Comparison(
        name, metric, a, b, between(results, name, a, b, metric, claim.yaw), claim.expect,
        control, claim, (first, second), word="" if finished else "not finished",
    )  # fmt: skip


def judge(results: Results, claims: Iterable[Claim]) -> list[Comparison]:
    """Claims that the run's study judges with their verdicts, adjusted over them."""
    return judged(measured(results, (c for c in claims if c.study == results.study.name)))


OUTCOMES = {
    "holds": "As expected",
    "the opposite holds": "The opposite of what was expected",
    "within": "A difference within a bound",
    "equal": "No difference, within a bound",
    "can't tell": "Cannot be told",
    "blind": "No verdict, since the control failed",
    "not finished": "Not finished as planned",
}
"""Outcome of a claim -> its wording, in the order in which claims are shown."""

COLUMNS = (
    "claim", "verdict", "difference", "measured", "spread over scenes, seeds", "scenes × seeds",
    "hangs on", "control",
)  # fmt: skip
"""Columns of :func:`claim_row`."""


def outcome(one: Comparison) -> str:
    """Word for a claim, where "better" is what it expects."""
    return {"better": "holds", "worse": "the opposite holds"}.get(one.word, one.word)


def claim_verdict(one: Comparison) -> str:
    """Verdict on a claim, without the reason."""
    return outcome(one) if one.word in ("better", "worse") else one.verdict


def means_in_words(one: Comparison) -> str:
    """Means of both sides of a claim, that of b first."""
    first, second = (in_words(mean, one.specification, one.metric) for mean in one.means)
    return f"{second} against {first}"


def claim_row(one: Comparison, seeds: int = 1) -> list[str]:
    """Cells of a table of claims; the control comes with its share of a gain.

    Args:
        seeds: number of seeds of the run.
    """
    assert one.claim is not None
    control, share = str(one.control.seen), one.control.share
    if one.word in ("better", "worse", "blind") and share is not None and math.isfinite(share[0]):
        control += f": {share_text(share)}"
    verdict = ": ".join(filter(None, (claim_verdict(one), one.reason)))
    spread = f"{number(one.contrast.deviation, 2)}, {number(one.contrast.over_seeds, 2)}"
    scenes, told = f"{one.contrast.scenes} × {seeds}", one.word != "not finished"
    hangs = f"{one.hangs_on} of {one.contrast.scenes}" if told else "–"
    return [
        one.claim.text, verdict, one.difference, means_in_words(one), spread, scenes, hangs,
        control,
    ]  # fmt: skip


def claims_section(results: Results, claims: Sequence[Comparison]) -> Section | None:
    """The section on the claims that a study judges; None for a run without any."""
    if not claims or len(results.study.scenes) < FEWEST_SCENES:
        return None
    kinds, several = list(OUTCOMES), len(claims) > 1

    def order(one: Comparison) -> tuple[float, ...]:
        return kinds.index(outcome(one)), (one.claim and one.claim.headline) or math.inf, one.p

    counts = Counter(map(outcome, claims))
    counted = " ".join(f"{OUTCOMES[kind]}: {counts[kind]}." for kind in kinds if counts[kind])
    text = [
        f"{len(claims)} claim{'s are' if several else ' is'} judged. {counted}",
        f"Of {results.study.scenes_in_words}, each test has those in which its difference is"
        " defined. Flipped signs of their differences decide"
        + f", adjusted for all {len(claims)} claims"
        * several
        + ", and the interval is that of the test. **Control**: what has to do worse, such as"
        " features from a wrong place; in percent the share of the gain that it reaches too, from"
        ' a half on of which the claim is blind. "Can\'t tell" does not mean equal. **Spread**:'
        " standard deviation of the difference over scenes, and over the seeds of a scene, on the"
        " scale of the test. **Hangs on**: scenes without any one of which the verdict would be"
        " another.",
    ]
    seeds = len(results.study.seeds)
    rows = [claim_row(one, seeds) for one in sorted(claims, key=order)]
    return Section("Claims", text, [Table(list(COLUMNS), rows)])
