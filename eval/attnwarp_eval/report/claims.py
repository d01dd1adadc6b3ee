"""Claims of claims.yaml, and their measurement from a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from typing import Any, Literal

from attnwarp_eval.report.compared import between
from attnwarp_eval.report.controls import Share, control_share
from attnwarp_eval.scene.yaml import read_yaml
from attnwarp_eval.statistics.contrasts import Contrast, contrast
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
    b: Mapping[str, Any] | None = None
    study: str = ""
    scenes: Mapping[str, int] | None = None
    or_b: Mapping[str, Any] | None = None
    against: float = 0.0
    than: str = ""
    yaw: tuple[float, float] | None = None
    compare_yaw: tuple[tuple[float, float], tuple[float, float]] | None = None
    equal_within: float | str | None = None
    control: Mapping[str, Any] | None = None
    source: str = ""
    editors: tuple[str, ...] = ()
    settings: Literal["complete", "own"] = "complete"
    headline: int = 0
    plain: str = ""

    def of_each_editor(self) -> list[Claim]:
        """The claim for each of its editors; the claim itself without editors."""
        if not self.editors:
            return [self]
        return [self._of_editor(name) for name in self.editors]

    def _of_editor(self, name: str) -> Claim:
        def of(side: Mapping[str, Any]) -> dict[str, Any]:
            return {**side, "editor": {"name": name}}

        control = self.control and {
            key: of(value) if isinstance(value, Mapping) else value
            for key, value in self.control.items()
        }
        return replace(
            self,
            text=f"{self.text} [{name}]",
            a=of(self.a),
            b=None if self.b is None else of(self.b),
            control=control,
            editors=(),
        )

    @property
    def sign(self) -> int:
        """Expected sign of the contrast."""
        return 1 if self.expect == "higher" else -1

    @property
    def bound(self) -> float | None:
        """Bound of equality as :meth:`Contrast.verdict` takes it; None without one.

        Example:
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
        a, b = self._variant(results, self.a), self._variant(results, self.b)
        if b is None and self.or_b is not None:
            b = self._variant(results, self.or_b)
        if a is None or (self.b is not None and b is None):
            return None
        scale = probe(self.probe).metric(metric).scale
        if self.compare_yaw is not None:
            tables = {
                f"yaw {yaw[0]:g} to {yaw[1]:g}": results.views(self.probe, a, metric, yaw)
                for yaw in self.compare_yaw
            }
            # Different views cannot be paired, but their means over each scene can.
            low, high = (
                {s: {"mean": over_scenes({s: v}).mean} for s, v in table.items()}
                for table in tables.values()
            )
            sides = {name: over_scenes(t) for name, t in tables.items()}
            return Measured(metric, sides, low, high, contrast(low, high, scale))
        first = results.views(self.probe, a, metric, self.yaw)
        if b is not None:
            second = results.views(self.probe, b, metric, self.yaw)
            value = between(results, self.probe, a, b, metric, self.yaw)
            names = (a, b)
        elif self.than:
            names = (f"{a}, {self.than}", f"{a}, {metric}")
            first, second = results.views(self.probe, a, self.than, self.yaw), first
            value = contrast(first, second, scale)
        else:
            limit = {s: dict.fromkeys(views, self.against) for s, views in first.items()}
            sides = {a: over_scenes(first)}
            return Measured(metric, sides, limit, first, contrast(limit, first, "plain"))
        # Means over the shared views: only their difference is the claim's.
        sides = dict(zip(names, map(over_scenes, common([first, second])), strict=True))
        control, share = self._control(results, names[1], first, second)
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
        label = self._variant(results, self.control[expected])
        if label is None or direction not in ("higher", "lower"):
            return "not measured", None
        found = between(results, self.probe, reference, label, key, self.yaw).verdict(direction)
        share = None
        if expected == "worse" and "metric" not in self.control:
            table = results.views(self.probe, label, key, self.yaw)
            share = control_share(second, table, first, sign=1 if direction == "higher" else -1)
        return "seen" if found == expected else "not seen", share

    def _variant(self, results: Results, data: Mapping[str, Any] | None) -> str | None:
        if data is None:
            return None
        return variant_like(results, data, self.probe, own=self.settings == "own")


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
        Claim(**_tuples(one), scenes=family["scenes"][one["study"]])
        for entry in family["claims"]
        for one in _of_each_metric(entry)
    )


def _of_each_metric(entry: dict[str, Any]) -> list[dict[str, Any]]:
    """Expand an entry with ``metrics`` to one claim for each; other entries are single claims."""
    common = dict(entry)
    metrics = common.pop("metrics", None)
    if metrics is None:
        return [entry]
    return [
        {
            **common,
            **one,
            "id": f"{entry['id']}-{key}",
            "text": f"{one['text']} {entry['text']}",
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


def variant_like(
    results: Results, data: Mapping[str, Any], name: str, *, own: bool = False
) -> str | None:
    """Name of the first measured variant with the meaning of ``data``.

    Args:
        data: a variant in the format of a study's YAML.
        own: whether the variant may set what ``data`` leaves out.
    """
    asked, study = probe(name), results.study
    if name not in study.probes:
        return None
    wanted = parse_variant(dict(data))
    meaning = None if own else asked.meaning(study, wanted)
    for label, variant in study.variants.items():
        if results.records(name, label) and (
            asked.alike(study, variant, wanted) if own else asked.meaning(study, variant) == meaning
        ):
            return label
    return None
