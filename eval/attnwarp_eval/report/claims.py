"""Claims of claims.yaml, and their measurement from a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Literal

from attnwarp_eval.report.compared import between
from attnwarp_eval.report.controls import Share, control_share
from attnwarp_eval.scene.yaml import read_yaml
from attnwarp_eval.statistics.contrasts import Contrast
from attnwarp_eval.statistics.intervals import ByView, Interval, common, over_scenes
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Study
from attnwarp_eval.study.study import parse_variant

DECLARED = resources.files("attnwarp_eval.report") / "claims.yaml"

Seen = Literal["", "seen", "not seen", "not measured"]
"""Outcome of a claim's control; empty without a control."""


@dataclass(frozen=True)
class Claim:
    """Entry of claims.yaml; the head of that file explains the keys."""

    id: str
    text: str
    probe: str
    metric: str
    a: Mapping[str, Any]
    expect: Literal["higher", "lower"]
    b: Mapping[str, Any]
    study: str = ""
    scenes: Mapping[str, int] | None = None
    yaw: tuple[float, float] | None = None
    equal_within: float | str | None = None
    control: Mapping[str, Any] | None = None
    source: str = ""
    headline: int = 0
    plain: str = ""
    context: str = ""

    @property
    def sign(self) -> int:
        """Expected sign of the contrast."""
        return 1 if self.expect == "higher" else -1

    @property
    def bound(self) -> float | None:
        """Bound of equality as :meth:`Contrast.verdict` takes it; None without one.

        Example:
            >>> from dataclasses import replace
            >>> side = {"preset": "corrected"}
            >>> claim = Claim("c", "", "warp", "warp.epe_median", side, "lower", b=side)
            >>> round(replace(claim, equal_within="10 %").bound, 4)  # of a ratio: log(1.1)
            0.0953
            >>> replace(claim, metric="occlusion.recall", equal_within="2 %").bound
            0.02
        """
        if self.equal_within is None or not isinstance(self.equal_within, str):
            return self.equal_within
        share = float(self.equal_within.removesuffix("%")) / 100
        ratio = probe(self.probe).metric(self.metric).scale == "ratio"
        return math.log1p(share) if ratio else share

    def judged_by(self, study: Study) -> bool:
        """Return True for the study that judges the claim, with the scenes planned for it."""
        drawn = study.population
        return study.name == self.study and (
            drawn is not None and self.scenes in (None, {"drawn": drawn.count, "seed": drawn.seed})
        )

    def measure(self, results: Results) -> Measured | None:
        """Measure the sides of the claim; None if the run lacks a variant of that content."""
        metric = self.metric.replace("{layer}", str(results.layer))
        a, b = (variant_like(results, side, self.probe) for side in (self.a, self.b))
        if a is None or b is None:
            return None
        first, second = (results.views(self.probe, who, metric, self.yaw) for who in (a, b))
        value = between(results, self.probe, a, b, metric, self.yaw)
        # Means over the shared views: only their difference is the claim's.
        sides = dict(zip((a, b), map(over_scenes, common([first, second])), strict=True))
        control, share = self._control(results, b, first, second)
        return Measured(metric, sides, first, second, value, control, share)

    def _control(
        self, results: Results, reference: str, first: ByView, second: ByView
    ) -> tuple[Seen, Share | None]:
        """Test at 5 % whether the run detects the claim's control; the control's share of a gain
        from the first table to the second, if it has to be worse in the claim's own metric.
        """
        if self.control is None:
            return "", None
        key = str(self.control.get("metric", self.metric)).replace("{layer}", str(results.layer))
        direction = probe(self.probe).metric(key).direction
        expected = "worse" if "worse" in self.control else "better"
        label = variant_like(results, self.control[expected], self.probe)
        if label is None or direction not in ("higher", "lower"):
            return "not measured", None
        found = between(results, self.probe, reference, label, key, self.yaw).verdict(direction)
        share = None
        if expected == "worse" and "metric" not in self.control:
            table = results.views(self.probe, label, key, self.yaw)
            share = control_share(second, table, first, sign=1 if direction == "higher" else -1)
        return "seen" if found == expected else "not seen", share


@dataclass(frozen=True)
class Measured:
    """Sides of a claim by name, the two tables whose difference it predicts, that difference on the
    scale of the figure, whether the claim's control was detected, and its share of a gain.
    """

    metric: str
    sides: dict[str, Interval]
    a: ByView
    b: ByView
    contrast: Contrast
    control: Seen = ""
    share: Share | None = None


@cache
def load_claims() -> tuple[Claim, ...]:
    """Load the bundled claims."""
    family = read_yaml(DECLARED.read_text())[1]
    return tuple(
        Claim(**entry, scenes=family["scenes"][entry["study"]]) for entry in family["claims"]
    )


def variant_like(results: Results, data: Mapping[str, Any], name: str) -> str | None:
    """Name of the first measured variant with the meaning of ``data``, as in a study's YAML."""
    asked, study = probe(name), results.study
    if name not in study.probes:
        return None
    meaning = asked.meaning(study, parse_variant(dict(data)))
    for label, variant in study.variants.items():
        if results.records(name, label) and asked.meaning(study, variant) == meaning:
            return label
    return None
