"""Claims of claims.yaml."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Literal

from attnwarp.errors import InputError
from attnwarp_eval.scene.yaml import read_yaml
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.schema import Study

DECLARED = resources.files("attnwarp_eval.report") / "claims.yaml"
USED = resources.files("attnwarp_eval.report") / "used_seeds.yaml"

FIRST_SEED = 1001
"""Least seed of scenes that claims may draw by."""


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
    scenes: Mapping[str, Any] | None = None
    yaw: tuple[float, float] | None = None
    edit: str = ""
    equal_within: float | str | None = None
    control: Mapping[str, Any] | None = None
    source: str = ""
    headline: int = 0
    plain: str = ""

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

    @property
    def bound_in_words(self) -> str:
        """Bound of equality with its unit: a share's in points."""
        metric = probe(self.probe).metric(self.metric)
        if not isinstance(self.equal_within, str):
            return f"{self.equal_within} {metric.unit}"
        number = self.equal_within.removesuffix(" %")
        points = "point" if number == "1" else "points"
        return f"{number} {points if metric.scale == 'share' else '%'}"

    def planned(self, study: Study) -> bool:
        """Return True if the study has all scenes, the size and the seeds that were planned."""
        drawn = study.population
        if drawn is None or len(study.scenes) < drawn.count:
            return False
        has = {"drawn": drawn.count, "seed": drawn.seed, "size": study.size, "seeds": study.seeds}
        return self.scenes is None or {"seeds": [0], **self.scenes} == has


def check_seeds(family: Mapping[str, Any]) -> None:
    """Check that no claim is made on scenes that were looked at before it.

    Raises:
        InputError: the family draws by a seed that is too small, or that something else than the
            claims' own studies has used.
    """
    used = read_yaml(USED.read_text())[1]
    for study, scenes in family["scenes"].items():
        seed = scenes["seed"]
        own = [name for name, others in family["scenes"].items() if others["seed"] == seed]
        others = [name for name in used.get(str(seed), []) if name not in own]
        if seed < FIRST_SEED or others:
            who = ", ".join(others) or "earlier work"
            raise InputError(
                f"scenes of {study}: got seed {seed}, used by {who};"
                f" take one of {FIRST_SEED} and up that is not in {USED.name}"
            )


@cache
def load_claims() -> tuple[Claim, ...]:
    """Load the bundled claims."""
    family = read_yaml(DECLARED.read_text())[1]
    check_seeds(family)
    return tuple(
        Claim(**entry, scenes=family["scenes"][entry["study"]]) for entry in family["claims"]
    )
