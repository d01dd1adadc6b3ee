"""Definition of a hard case, and its outcome at one level of hardness."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from attnwarp_eval.scene.yaml import read_yaml

if TYPE_CHECKING:
    import torch

Direction = Literal["forward", "backward"]
Verdict = Literal["holds", "breaks", "refused"]

DECADES = 3.0
"""Margins are clipped here: a factor of 1000 on either side of a tolerance is enough, and rounding
errors far below a tolerance differ between processors."""


@dataclass(frozen=True)
class Way:
    """One implementation under test in a case.

    Attributes:
        backend: ``reference``, ``cpu`` or ``gpu`` for computations with several backends;
            else the module under test, such as ``raycast`` or ``metrics``.
        precision: type of the input: ``float64``, ``float32``, ``float16`` or ``bfloat16``.
        direction: the values, or their gradient.
    """

    backend: str
    precision: str = "float64"
    direction: Direction = "forward"

    @property
    def name(self) -> str:
        """Backend, precision and direction."""
        return f"{self.backend} {self.precision} {self.direction}"

    @property
    def dtype(self) -> torch.dtype:
        """The precision as torch's type."""
        import torch

        dtype: torch.dtype = getattr(torch, self.precision)
        return dtype

    @property
    def numpy(self) -> np.dtype[Any]:
        """The precision as numpy's type."""
        return np.dtype(self.precision)


def ways(*backends: str, precisions: tuple[str, ...] = ("float64", "float32")) -> tuple[Way, ...]:
    """Every backend in every precision, forward.

    Example:
        >>> [way.name for way in ways("cpu")]
        ['cpu float64 forward', 'cpu float32 forward']
    """
    return tuple(Way(backend, precision) for backend in backends for precision in precisions)


@dataclass(frozen=True)
class Bound:
    """Largest allowed error.

    Attributes:
        tolerance: tolerance in that unit, or a function of the level.
    """

    unit: str
    tolerance: float | Callable[[float], float]
    reason: str

    def at(self, level: float) -> float:
        """The tolerance at a level."""
        return self.tolerance(level) if callable(self.tolerance) else self.tolerance


def exact(unit: str, reason: str = "a label, a mask or a bit is right or wrong") -> Bound:
    """A bound on a count of wrong things: none may be wrong, so the limit is 0.5."""
    return Bound(unit, 0.5, reason)


@dataclass(frozen=True)
class Case:
    """A numerically hard input, swept over its hardness until the computation breaks.

    Attributes:
        number: number in the report of reports/stability; several cases may share one.
        name: name in commands and records.
        oracle: description of the reference result, computed without code under test.
        hardness: swept quantity, with its unit.
        levels: levels of hardness, the easiest first.
        required: the last level whose values must hold; later levels are meant to break.
        quick: the levels of a short sweep.
        ways: the implementations under test.
        measure: error of a way at a level, in the bound's unit; raises ValueError if the
            input is refused.
        must_refuse: whether a way must refuse a level.
        required_backward: the last level whose gradients must hold, by default ``required``.
        limit: reason for the limit of hardness; empty if every level holds.
        version: version, raised when the errors change meaning.

    Example:
        >>> import numpy as np
        >>> sums = Case(
        ...     99,
        ...     "sum",
        ...     "A small number beside a large one",
        ...     input="1 beside a power of two",
        ...     oracle="integers",
        ...     hardness="log2 of the large one",
        ...     levels=(10, 20, 30),
        ...     required=20,
        ...     quick=(20,),
        ...     bounds={"forward": Bound("of 1", 1e-3, "the small number counts")},
        ...     ways=(Way("numpy", "float32"),),
        ...     measure=lambda level, way: abs(float(np.float32(2**level + 1)) - 2**level - 1),
        ... )
        >>> [sums.outcome(level, sums.ways[0]).verdict for level in sums.levels]
        ['holds', 'holds', 'breaks']
    """

    number: int
    name: str
    title: str
    input: str
    oracle: str
    hardness: str
    levels: tuple[float, ...]
    required: float
    quick: tuple[float, ...]
    bounds: Mapping[Direction, Bound]
    ways: tuple[Way, ...]
    measure: Callable[[float, Way], float] = field(repr=False)
    must_refuse: Callable[[float, Way], bool] = field(default=lambda level, way: False, repr=False)
    required_backward: float | None = None
    limit: str = ""
    version: int = 1

    def is_required(self, level: float, direction: Direction = "forward") -> bool:
        """Return True if this level must hold."""
        last = self.required
        if direction == "backward" and self.required_backward is not None:
            last = self.required_backward
        return self.levels.index(level) <= self.levels.index(last)

    def outcome(self, level: float, way: Way) -> Outcome:
        """Evaluate one way at one level."""
        error, refusal = math.nan, ""
        try:
            with np.errstate(all="ignore"):
                error = float(self.measure(level, way))
        except ValueError as problem:  # attnwarp.errors.InputError is one
            refusal = str(problem)
        return self.judge(level, way, error, refusal)

    def judge(self, level: float, way: Way, error: float, refusal: str) -> Outcome:
        """Judge an error by this case's bound.

        Args:
            error: in the bound's unit; NaN if the result is not finite, or refused.
            refusal: message of the refusal, else empty.
        """
        return Outcome(
            level,
            self.is_required(level, way.direction),
            math.inf if math.isnan(error) and not refusal else error,
            self.bounds[way.direction].at(level),
            refusal,
            self.must_refuse(level, way),
        )


@dataclass(frozen=True)
class Outcome:
    """Outcome of one way at one level.

    Attributes:
        required: whether the level must hold.
        error: error in the bound's unit; infinite if the result is not finite, NaN if refused.
        refusal: message of the refusal, else empty.
        must_refuse: whether the input had to be refused.
    """

    level: float
    required: bool
    error: float
    tolerance: float
    refusal: str
    must_refuse: bool

    @property
    def must_hold(self) -> bool:
        """True if the level is required, as a result or as a refusal."""
        return self.required or self.must_refuse

    @property
    def margin(self) -> float:
        """Decades between the error and its tolerance, clipped at :data:`DECADES`; negative if the
        tolerance is exceeded, NaN where a level that need not hold is refused.
        """
        if self.refusal or self.must_refuse:
            if bool(self.refusal) == self.must_refuse:
                return DECADES
            return -DECADES if self.must_hold else math.nan
        if not math.isfinite(self.error):
            return -DECADES
        if self.error == 0:
            return DECADES
        return min(max(math.log10(self.tolerance / self.error), -DECADES), DECADES)

    @property
    def verdict(self) -> Verdict:
        """Verdict in one word; a required refusal counts as "holds"."""
        margin = self.margin
        return "refused" if math.isnan(margin) else "holds" if margin >= 0 else "breaks"


@cache
def _rows(package: str) -> dict[str, dict[str, Any]]:
    """The rows of a package's cases.yaml by the case's name."""
    text = (resources.files(package) / "cases.yaml").read_text("utf-8")
    return {
        name: {key: tuple(v) if isinstance(v, list) else v for key, v in row.items()}
        for name, row in read_yaml(text)[1].items()
    }


def hard(
    name: str,
    measure: Callable[[float, Way], float],
    ways: tuple[Way, ...],
    *,
    bounds: Bound | Mapping[Direction, Bound],
    must_refuse: Callable[[float, Way], bool] = lambda level, way: False,
    package: str = "attnwarp_eval.stability",
) -> Case:
    """Case with the texts and levels of a row of cases.yaml.

    Args:
        name: row of the table.
        measure, ways, must_refuse: as in :class:`Case`.
        bounds: as in :class:`Case`, or one for every direction.
        package: package whose cases.yaml has the row.

    Example:
        >>> from attnwarp_eval.stability.case import exact, hard, ways
        >>> bound = exact("hidden pixels accepted")
        >>> hard("opposed_views", lambda level, way: 0.0, ways("cpu"), bounds=bound).required
        180
    """
    if isinstance(bounds, Bound):
        bounds = dict.fromkeys([way.direction for way in ways], bounds)
    return Case(
        name=name, measure=measure, ways=ways, bounds=bounds, must_refuse=must_refuse,
        **_rows(package)[name],
    )  # fmt: skip


def level_name(level: float) -> str:
    """Name of a level in records and tables.

    Example:
        >>> level_name(89.9999), level_name(1e6)
        ('89.9999', '1e+06')
    """
    return f"{level:g}" if abs(level) >= 1e6 else f"{level:.10g}"
