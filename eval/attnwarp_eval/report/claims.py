"""What one expects to see, tested: the claims of claims.yaml against a run's results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal

import yaml

from attnwarp_eval.report.results import Results
from attnwarp_eval.statistics.intervals import (
    ByView,
    Interval,
    agreement,
    benjamini_hochberg,
    interval,
    paired,
)

Verdict = Literal["holds", "does not hold", "can't tell"]


@dataclass(frozen=True)
class Claim:
    """One entry of claims.yaml; see there for what the keys mean."""

    id: str
    text: str
    probe: str
    metric: str
    a: Mapping[str, Any]
    expect: Literal["higher", "lower"]
    b: Mapping[str, Any] | None = None
    yaw: tuple[float, float] | None = None
    compare_yaw: tuple[tuple[float, float], tuple[float, float]] | None = None
    source: str = ""

    @property
    def sign(self) -> int:
        """The sign that the contrast is expected to have."""
        return 1 if self.expect == "higher" else -1

    def measure(self, results: Results) -> Measured | None:
        """What the claim speaks of; None where the run has no variant of that content."""
        metric = self.metric.replace("{layer}", str(results.layer))
        a = results.variant_like(self.a, self.probe)
        b = None if self.b is None else results.variant_like(self.b, self.probe)
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
        if b is None:
            zero = {scene: dict.fromkeys(views, 0.0) for scene, views in first.items()}
            return Measured(metric, {a: _interval(first)}, zero, first)
        second = results.views(self.probe, b, metric, self.yaw)
        return Measured(metric, {a: _interval(first), b: _interval(second)}, first, second)


@dataclass(frozen=True)
class Measured:
    """The sides of a claim by name, and the two tables whose difference it speaks of."""

    metric: str
    sides: dict[str, Interval]
    a: ByView
    b: ByView


def _interval(table: ByView) -> Interval:
    return interval({scene: list(views.values()) for scene, views in table.items()})


@dataclass(frozen=True)
class Finding:
    """A claim, what was measured, and what follows."""

    claim: Claim
    metric: str
    sides: dict[str, Interval]
    contrast: Interval
    agreement: tuple[int, int]
    here: Literal["seen", "mixed", "not seen"]
    verdict: Verdict


def load_claims() -> list[Claim]:
    """The claims that ship with the package."""
    text = (resources.files("attnwarp_eval.report") / "claims.yaml").read_text()
    return [Claim(**_tuples(entry)) for entry in yaml.safe_load(text)]


def _tuples(entry: dict[str, Any]) -> dict[str, Any]:
    return {
        k: tuple(map(tuple, v)) if k == "compare_yaw" else tuple(v) if k == "yaw" else v
        for k, v in entry.items()
    }


def judge(results: Results, claims: list[Claim]) -> list[Finding]:
    """Every claim that something was measured for, with its verdict.

    p-values are adjusted over the claims (Benjamini-Hochberg).
    """
    measured = [(claim, m) for claim in claims if (m := claim.measure(results)) is not None]
    contrasts = [paired(m.a, m.b) for _, m in measured]
    adjusted = benjamini_hochberg([contrast.p for contrast in contrasts])
    return [
        Finding(
            claim,
            m.metric,
            m.sides,
            contrast,
            agreement(m.a, m.b, claim.sign),
            _here(claim, m),
            _in_general(claim, contrast, p),
        )
        for (claim, m), contrast, p in zip(measured, contrasts, adjusted, strict=True)
        if contrast.views
    ]


def _here(claim: Claim, measured: Measured) -> Literal["seen", "mixed", "not seen"]:
    """Whether the mean difference has the expected sign in every scene that has one."""
    scenes = [paired({s: measured.a[s]}, {s: measured.b[s]}) for s in measured.a if s in measured.b]
    signs = [difference.mean * claim.sign > 0 for difference in scenes if difference.views]
    return "seen" if all(signs) else "mixed" if any(signs) else "not seen"


def _in_general(claim: Claim, contrast: Interval, adjusted_p: float) -> Verdict:
    if not contrast.known or not adjusted_p <= 0.05:
        return "can't tell"
    return "holds" if claim.sign * contrast.mean > 0 else "does not hold"
