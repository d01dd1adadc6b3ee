"""Expectations tested: the claims of claims.yaml against a run's results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from statistics import fmean
from typing import Any, Literal

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.metrics.multiview import ABOVE_FLOOR, BELOW_FLOOR
from attnwarp_eval.scene.yaml import read_yaml
from attnwarp_eval.statistics.contrasts import Contrast, contrast
from attnwarp_eval.statistics.intervals import (
    ROUNDING,
    ByView,
    Interval,
    agreement,
    benjamini_hochberg,
    common,
    interval,
    paired,
)
from attnwarp_eval.statistics.planning import Parts, parts
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.study import parse_variant

Verdict = Literal["holds", "does not hold", "can't tell", "depends on the editor"]

Here = Literal["seen", "seen where defined", "mixed", "not seen", "depends on the editor"]


@dataclass(frozen=True)
class Claim:
    """One entry of claims.yaml, whose head explains the keys."""

    id: str
    text: str
    probe: str
    metric: str
    a: Mapping[str, Any]
    expect: Literal["higher", "lower"]
    b: Mapping[str, Any] | None = None
    or_b: Mapping[str, Any] | None = None
    against: float = 0.0
    than: str = ""
    yaw: tuple[float, float] | None = None
    compare_yaw: tuple[tuple[float, float], tuple[float, float]] | None = None
    source: str = ""
    editors: tuple[str, ...] = ()
    settings: Literal["complete", "own"] = "complete"

    def of_each_editor(self) -> list[Claim]:
        """The claim for each of its editors; itself where it has none."""
        if not self.editors:
            return [self]
        return [
            replace(
                self,
                text=f"{self.text} [{name}]",
                a={**self.a, "editor": {"name": name}},
                b=None if self.b is None else {**self.b, "editor": {"name": name}},
                editors=(),
            )
            for name in self.editors
        ]

    @property
    def sign(self) -> int:
        """The sign that the contrast is expected to have."""
        return 1 if self.expect == "higher" else -1

    def measure(self, results: Results) -> Measured | None:
        """The sides of the claim; None where the run has no variant of that content."""
        metric = self.metric.replace("{layer}", str(results.layer))
        own = self.settings == "own"
        a = variant_like(results, self.a, self.probe, own=own)
        b = None if self.b is None else variant_like(results, self.b, self.probe, own=own)
        if b is None and self.or_b is not None:
            b = variant_like(results, self.or_b, self.probe, own=own)
        if a is None or (self.b is not None and b is None):
            return None
        if self.compare_yaw is not None:
            tables = {
                f"yaw {low:g} to {high:g}": results.views(self.probe, a, metric, (low, high))
                for low, high in self.compare_yaw
            }
            # Different views cannot be paired; their means can, scene by scene.
            means = [
                {s: {"mean": _interval({s: v}).mean} for s, v in table.items()}
                for table in tables.values()
            ]
            return Measured(
                metric, {name: _interval(t) for name, t in tables.items()}, means[0], means[1]
            )
        first = results.views(self.probe, a, metric, self.yaw)
        if b is None and not self.than:
            limit = {s: dict.fromkeys(views, self.against) for s, views in first.items()}
            return Measured(metric, {a: _interval(first)}, limit, first)
        if b is None:
            names = (f"{a}, {self.than}", f"{a}, {metric}")
            first, second = results.views(self.probe, a, self.than, self.yaw), first
        else:
            names = (a, b)
            second = results.views(self.probe, b, metric, self.yaw)
        # Over the views that both have: only there is the difference of the means the claim's.
        sides = dict(zip(names, map(_interval, common([first, second])), strict=True))
        return Measured(metric, sides, first, second)


@dataclass(frozen=True)
class Measured:
    """The sides of a claim by name, and the two tables whose difference it predicts."""

    metric: str
    sides: dict[str, Interval]
    a: ByView
    b: ByView


def _interval(table: ByView) -> Interval:
    return interval({scene: list(views.values()) for scene, views in table.items()})


@dataclass(frozen=True)
class JudgedClaim:
    """A claim, the measurement, and the verdict."""

    claim: Claim
    metric: str
    sides: dict[str, Interval]
    contrast: Interval
    agreement: tuple[int, int]
    here: Here
    verdict: Verdict
    p: float
    """p-value of the contrast, adjusted over the claims."""
    below_floor: tuple[str, ...] = ()
    """Scenes in which both sides disagree less than true views do."""
    parts: Parts | None = None
    """Parts of the contrast's spread between scenes."""
    flips: Contrast | None = None
    """Sign-flip test on the metric's scale that decides where the scenes are a sample."""


SAMPLED = (
    "**In general** is said of {scenes}, and scenes like these. Flipped signs of the scenes'"
    " differences decide; errors are compared as ratios (×). The interval is the test's, at the"
    " level that the adjustment leaves, so it agrees with the verdict. **p by t** is Student's on"
    " the same scale, not adjusted. Below six scenes there is no verdict."
)
"""Paragraph on a report whose scenes are a sample."""

Comparison = tuple[str, str, frozenset[str]]
"""A probe, a metric and two variants."""


def of_comparisons(judged: Iterable[JudgedClaim]) -> dict[Comparison, float]:
    """The adjusted p-value of each comparison of two variants, over all views, that a claim makes:
    a table that shows such a comparison has the claim's verdict.
    """
    return {
        (one.claim.probe, one.metric, frozenset(one.sides)): one.p
        for one in judged
        if one.claim.yaw is None
    }


@cache
def load_claims() -> tuple[Claim, ...]:
    """The claims that ship with the package."""
    text = (resources.files("attnwarp_eval.report") / "claims.yaml").read_text()
    return tuple(
        Claim(**_tuples(one)) for entry in read_yaml(text)[1] for one in _of_each_metric(entry)
    )


def _of_each_metric(entry: dict[str, Any]) -> list[dict[str, Any]]:
    """An entry with ``metrics`` is a claim for each of them; any other is one itself."""
    common = dict(entry)
    metrics = common.pop("metrics", None)
    if metrics is None:
        return [entry]
    return [
        {
            **common,
            "id": f"{entry['id']}-{key}",
            "text": f"{one['text']} {entry['text']}",
            "metric": one["metric"],
            "expect": one["expect"],
        }
        for key, one in metrics.items()
    ]


def _tuples(entry: dict[str, Any]) -> dict[str, Any]:
    return {
        k: tuple(map(tuple, v))
        if k == "compare_yaw"
        else tuple(v)
        if k in ("yaw", "editors")
        else v
        for k, v in entry.items()
    }


def judge(results: Results, claims: Sequence[Claim]) -> list[JudgedClaim]:
    """Every claim that the run has measurements for, with its verdict.

    Where the scenes are a sample of a population, flipped signs decide, else Student's t. p-values
    are adjusted over the claims (Benjamini-Hochberg). A claim about the editor's working
    is judged for each of its editors; :func:`together` makes one verdict of them.
    """
    each = [one for claim in claims for one in claim.of_each_editor()]
    measurements = [(claim, m) for claim in each if (m := claim.measure(results)) is not None]
    contrasts = [paired(m.a, m.b) for _, m in measurements]
    sampled = bool(results.study.sampled)
    flips = [of_scale(claim, m) if sampled else None for claim, m in measurements]
    adjusted = benjamini_hochberg(
        [
            by_t.p if test is None else test.flips.p
            for by_t, test in zip(contrasts, flips, strict=True)
        ]
    )
    return [
        JudgedClaim(
            claim,
            m.metric,
            m.sides,
            by_t,
            agreement(m.a, m.b, claim.sign),
            _here(claim, m, len(results.study.scenes)),
            _in_general(claim, by_t, p) if test is None else _of_sample(claim, test, p),
            p,
            _below_floor(m),
            parts(m.a, m.b),
            test,
        )
        for (claim, m), by_t, test, p in zip(measurements, contrasts, flips, adjusted, strict=True)
        if by_t.views
    ]


def together(findings: Sequence[JudgedClaim], editors: Sequence[str]) -> tuple[Here, Verdict]:
    """One verdict of the findings of a claim about the editor's working.

    It has one only where all editors were measured and agree; else it depends on the editor, or
    cannot be told from the editors that were measured.
    """
    here, verdicts = {f.here for f in findings}, {f.verdict for f in findings}
    seen: Here = next(iter(here)) if len(here) == 1 else "depends on the editor"
    if here == {"seen", "seen where defined"}:
        seen = "seen where defined"
    if len(findings) < len(editors):
        return seen, "can't tell"
    return seen, next(iter(verdicts)) if len(verdicts) == 1 else "depends on the editor"


def _here(claim: Claim, measured: Measured, scenes: int) -> Here:
    """Tell whether the mean difference has the expected sign in every scene.

    ``scenes``: how many the study has. One without values cannot show what is expected.
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


def _in_general(claim: Claim, contrast: Interval, adjusted_p: float) -> Verdict:
    if not contrast.bounded or not adjusted_p <= 0.05:
        return "can't tell"
    return "holds" if claim.sign * contrast.mean > 0 else "does not hold"


def of_scale(claim: Claim, measured: Measured) -> Contrast:
    """The difference that a claim predicts, on the scale of its metric.

    A side that is compared with a number is compared plainly.
    """
    metric = probe(claim.probe).metric(measured.metric)
    scale = metric.scale if len(measured.sides) > 1 else "plain"
    return contrast(measured.a, measured.b, scale, floor=metric.atol)


def _of_sample(claim: Claim, test: Contrast, adjusted_p: float) -> Verdict:
    found = test.verdict(claim.expect, adjusted_p=adjusted_p)
    told: dict[str, Verdict] = {"better": "holds", "worse": "does not hold"}
    return told.get(found, "can't tell")


def _shown(test: Contrast, adjusted_p: float) -> str:
    """A difference with the interval that agrees with its verdict; ratios as factors."""
    mean, low, high = map(number, test.shown(test.level(adjusted_p)))
    sign = "× " if test.scale == "ratio" else ""
    return f"{sign}{mean} ({low} to {high})"


def variant_like(
    results: Results, data: Mapping[str, Any], name: str, *, own: bool = False
) -> str | None:
    """The name of the first measured variant that means what ``data`` means.

    Args:
        results: of the run.
        data: a variant as a study's YAML has it.
        name: of the probe whose records are needed.
        own: whether settings that ``data`` leaves out may be the variant's own.
    """
    asked, study = probe(name), results.study
    if name not in study.probes:
        return None
    wanted = parse_variant(dict(data))
    for label, variant in study.variants.items():
        if own:
            same = asked.alike(study, variant, wanted)
        else:
            same = asked.meaning(study, variant) == asked.meaning(study, wanted)
        if same and results.records(name, label):
            return label
    return None


def _scenes(finding: JudgedClaim, scenes: int) -> str:
    below = ", ".join(finding.below_floor)
    text = f"{finding.contrast.scenes} of {scenes}"
    return f"{text}; below the floor: {below}" if below else text


def claims(results: Results, findings: Sequence[JudgedClaim]) -> Section:
    """The section of the report.

    Args:
        results: of the run.
        findings: the claims that it has measurements for.
    """
    declared = {claim.id: claim for claim in load_claims()}
    rows, scenes = [], len(results.study.scenes)
    for finding in findings:
        claim = finding.claim
        sides = "; ".join(f"{name}: {spread(value)}" for name, value in finding.sides.items())
        alone = len(finding.sides) == 1
        difference = f"against {number(claim.against)}" if alone else spread(finding.contrast)
        if finding.flips is not None:
            difference = _shown(finding.flips, finding.p)
        student = [] if finding.flips is None else [number(finding.flips.student.p)]
        agree, views = finding.agreement
        rows.append(
            [
                claim.text,
                finding.here,
                finding.verdict,
                _scenes(finding, scenes),
                f"{agree} of {views}",
                difference,
                number(finding.p),
                *student,
                sides,
                finding.metric,
            ]
        )
        editors = declared[claim.id].editors
        own = [other for other in findings if other.claim.id == claim.id]
        if editors and finding is own[-1]:
            here, verdict = together(own, editors)
            text = f"**{declared[claim.id].text}: both editors together**"
            rows.append([text, here, verdict, *["–"] * (5 + len(student)), finding.metric])
    section = Section("What was expected, and what was seen")
    if not rows:
        section.text = ["Nothing that a claim speaks of was measured."]
        return section
    section.text = [
        "A claim that does not hold on these scenes is a result, not an error.",
        (
            "- **Here** speaks of these scenes alone. `seen`: the difference has the expected sign"
            " in every scene of the study. `seen where defined`: in every scene that has values,"
            " and some have none. `not seen`: in no scene.\n"
            "- **In general** speaks of scenes like these, of which a few were drawn. It says"
            " `can't tell` when so few cannot settle it. p-values are adjusted over the claims.\n"
            "- **Scenes**: those in which the difference is defined. **Views that agree** have the"
            " expected sign.\n"
            "- **Measured** are means. Those of two variants are over the views that both have, so"
            " that the difference is theirs."
        ),
    ]
    if results.study.sampled:
        section.text.append(SAMPLED.format(scenes=results.study.sampled))
    if any(finding.metric.startswith(ABOVE_FLOOR) for finding in findings):
        section.text.append(
            f"{BELOW_FLOOR} The column of scenes names those in which both sides are."
        )
    columns = [
        "claim",
        "here",
        "in general",
        "scenes",
        "views that agree",
        "difference",
        "adjusted p",
        *(["p by t"] if results.study.sampled else []),
        "measured",
        "metric",
    ]
    section.tables = [Table(columns, rows)]
    return section
