"""The key ``edges`` of a study, and the tokens counted together by distance to a depth edge."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field

from attnwarp_eval.study.schema import Part, Study, Whole
from attnwarp_lab.ideal.labels import edge_distance

FAR = 4
"""Distance to a depth edge, in tokens, from which tokens are counted together."""

AWAY = 2
"""Distance from which a token is away from edges: small things have few tokens beyond it."""

PLACES = [f"edge{d}" for d in range(FAR + 1)]
AT, OFF = PLACES[0], "away"
"""Places of :func:`among`; the judged two."""


class Edges(Part):
    """Variants whose errors at depth edges are judged.

    ``exact``: exact geometry and mask. ``control``: features from a wrong place. ``methods``: the
    judged ones. ``parts``: by default the first number of the study; small ones, as a part as large
    as several tokens hides errors of one.
    """

    exact: str
    control: str = ""
    methods: list[str] = Field(min_length=1)
    parts: Annotated[Whole | None, Field(ge=2, le=10_000)] = None

    @property
    def named(self) -> list[str]:
        """All variants, the methods first."""
        return [*self.methods, *(name for name in (self.exact, self.control) if name)]


class EdgesPart(Part):
    """The key ``edges`` of a study, by probe."""

    edges: dict[str, Edges] = Field(default_factory=dict)


def edges_of(study: Study, probe: str) -> Edges | None:
    """Find the judged variants of a probe, None without any.

    Raises:
        ValueError: a variant that the probe does not measure.
    """
    found = study.part(EdgesPart).edges.get(probe)
    if found is not None:
        study.check_variants(found.named, f"edges.{probe}", probe)
    return found


def among(
    depth: npt.NDArray[np.floating], size: tuple[int, int]
) -> dict[str, npt.NDArray[np.bool_]]:
    """(h, w) tokens counted together, by the end of their figures' names: at each distance to a
    depth edge in whole tokens, away from edges, and all.

    Args:
        depth: (H, W) true depth.
        size: (h, w) of the grid of tokens.

    Example:
        >>> step = np.where(np.arange(16) < 4, 2.0, 4.0) * np.ones((4, 1))
        >>> {key: of[0].tolist() for key, of in among(step, (1, 4)).items() if key in (AT, OFF)}
        {'edge0': [True, True, False, False], 'away': [False, False, False, True]}
    """
    away = edge_distance(depth, size)
    whole = np.minimum(away, FAR).astype(np.int64)
    at = {place: whole == d for d, place in enumerate(PLACES)}
    return {**at, OFF: whole >= AWAY, "all": whole >= 0}
