"""Budgets of methods: a study's YAML, limits from another variant's seconds, and their outcome.

A budget in seconds makes a cell's result depend on the machine and its load. Records of such cells
say so, and comparisons of runs skip their figures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import Field, model_validator

from attnwarp_eval.canonical_json import digest
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Part


class BudgetPart(Part):
    """Limits of a variant's method: no edit or tuning iteration begins beyond them.

    ``seconds_of`` names a variant whose seconds in the same process are the limit;
    ``network_rows`` counts rows through the editor's network, and does not depend on the machine.
    """

    seconds: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    seconds_of: str | None = None
    network_rows: int | None = Field(default=None, gt=0)

    @model_validator(mode="after")
    def _one_limit_of_time(self) -> BudgetPart:
        if self.seconds is not None and self.seconds_of is not None:
            raise ValueError("budget: got seconds and seconds_of, expected one of them")
        if self.seconds is None and self.seconds_of is None and self.network_rows is None:
            raise ValueError("budget: got no limit, expected seconds, seconds_of or network_rows")
        return self


@dataclass(frozen=True)
class Spent:
    """Outcome of a budget.

    Attributes:
        seconds: limit in seconds; None for no limit.
        seconds_of: variant that gave the limit; None if the study states a number.
        network_rows: limit in rows; None for no limit.
        cut: limit that ended the method; None if it finished.
    """

    seconds: float | None
    seconds_of: str | None
    network_rows: int | None
    cut: str | None


def timed(spec: Mapping[str, Any]) -> bool:
    """Return True if a cell's result depends on the machine's speed.

    >>> timed({}), timed({"budget": {"network_rows": 9}}), timed({"budget": {"seconds": 2.0}})
    (False, False, True)
    """
    return bool({"seconds", "seconds_of"} & set(spec.get("budget") or ()))


class Stopwatch:
    """Seconds of methods in this process, by spec.

    A method's first run in a process pays for compilation; it is skipped.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._warm: set[str] = set()

    def note(self, spec: Json, seconds: float) -> None:
        """Record the seconds of a run."""
        kind = digest([spec["method"], spec["editor"], spec["size"]])
        if kind in self._warm:
            self._seconds.setdefault(digest(spec), seconds)
        self._warm.add(kind)

    def seconds(self, spec: Json, run: Callable[[], float]) -> float:
        """Recorded seconds of a run; ``run`` is called if there are none."""
        while (taken := self._seconds.get(digest(spec))) is None:
            self.note(spec, run())
        return taken
