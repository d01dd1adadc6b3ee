"""What one expects to see, tested: the claims of claims.yaml against a run's results."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal

import yaml

from attnwarp_eval.report.results import Results
from attnwarp_eval.statistics import Interval, benjamini_hochberg, interval, paired

Verdict = Literal["holds", "does not hold", "can't tell", "not measured"]


@dataclass(frozen=True)
class Claim:
    """One entry of claims.yaml; see there for what the keys mean."""

    id: str
    text: str
    probe: str
    metric: str
    a: str
    expect: Literal["higher", "lower"]
    b: str | None = None
    yaw: tuple[float, float] | None = None
    compare_yaw: tuple[tuple[float, float], tuple[float, float]] | None = None
    source: str = ""

    def measure(self, results: Results) -> tuple[dict[str, Interval], Interval]:
        """The sides that are compared, by name, and the interval of the contrast that ``expect`` speaks of."""
        if self.compare_yaw is not None:
            sides = {}
            means = []
            for low, high in self.compare_yaw:
                table = results.views(self.probe, self.a, self.metric, (low, high))
                sides[f"yaw {low:g} to {high:g}"] = interval({s: list(v.values()) for s, v in table.items()})
                # Different views cannot be paired; their means can, scene by scene.
                means.append({s: {"mean": interval({s: list(v.values())}).mean} for s, v in table.items()})
            return sides, paired(means[0], means[1])
        a = results.views(self.probe, self.a, self.metric, self.yaw)
        first = interval({s: list(v.values()) for s, v in a.items()})
        if self.b is None:
            return {self.a: first}, first
        b = results.views(self.probe, self.b, self.metric, self.yaw)
        return {self.a: first, self.b: interval({s: list(v.values()) for s, v in b.items()})}, paired(a, b)


@dataclass(frozen=True)
class Finding:
    """A claim, what was measured, and what follows."""

    claim: Claim
    sides: dict[str, Interval]
    contrast: Interval
    verdict: Verdict


def load_claims() -> list[Claim]:
    """The claims that ship with the package."""
    text = (resources.files("attnwarp_eval") / "claims.yaml").read_text()
    return [Claim(**_tuples(entry)) for entry in yaml.safe_load(text)]


def _tuples(entry: dict[str, Any]) -> dict[str, Any]:
    return {k: tuple(map(tuple, v)) if k == "compare_yaw" else tuple(v) if k == "yaw" else v for k, v in entry.items()}


def judge(results: Results, claims: list[Claim]) -> list[Finding]:
    """Every claim with its verdict; p-values are adjusted over the claims (Benjamini-Hochberg)."""
    measured = [claim.measure(results) for claim in claims]
    adjusted = benjamini_hochberg([contrast.p for _, contrast in measured])
    found = []
    for claim, (sides, contrast), p in zip(claims, measured, adjusted, strict=True):
        found.append(Finding(claim, sides, contrast, _verdict(claim, contrast, p)))
    return found


def _verdict(claim: Claim, contrast: Interval, adjusted_p: float) -> Verdict:
    if contrast.views == 0:
        return "not measured"
    if not contrast.known or not adjusted_p <= 0.05:
        return "can't tell"
    sign = 1 if claim.expect == "higher" else -1
    return "holds" if sign * contrast.mean > 0 else "does not hold"
