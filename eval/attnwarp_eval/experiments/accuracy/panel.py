"""Errors and times of the contestants for one question on one scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from attnwarp_eval.statistics.intervals import Ratio, time_ratio
from attnwarp_eval.study.record import Json, with_nan

PROTOCOL = 1
"""Version; raised when a panel's figures change."""


@dataclass(frozen=True)
class Contestant:
    """Error and time of one method of computing the truth.

    Attributes:
        name: name for display.
        error: error in the panel's unit, with a 95 % interval if rounds differ (bootstrap over
            rounds), else the same value three times.
        more: further figures by name.
    """

    name: str
    error: tuple[float, float, float]
    seconds: tuple[float, ...]
    more: dict[str, float]


@dataclass(frozen=True)
class Panel:
    """The contestants of one question on one scene; the first is the baseline of the ratios.

    Attributes:
        question: "pictures", "depth" or "visibility".
        contestants: the baseline first; none if the scene has nothing to measure.
        again: seconds of the baseline's second run of each round.
        squares: squared error of each round, by contestant ("pictures" only).
    """

    question: str
    scene: str
    unit: str
    contestants: tuple[Contestant, ...]
    again: tuple[float, ...]
    squares: tuple[tuple[float, ...], ...] = ()

    def ratio(self, index: int | None) -> Ratio:
        """Seconds of a contestant over the baseline's by round; None: the baseline's second run."""
        seconds = self.again if index is None else self.contestants[index].seconds
        return time_ratio([seconds], [self.contestants[0].seconds])

    def at_equal_error(self, index: int) -> Ratio:
        """Time for the same noise over the baseline's: variance x seconds, paired by round."""
        products = [
            np.array(self.squares[k]) * np.array(self.contestants[k].seconds) for k in (index, 0)
        ]
        return time_ratio([products[0].tolist()], [products[1].tolist()])

    @classmethod
    def from_record(cls, record: Json) -> Panel:
        """Read the panel of a cell.

        Raises:
            LookupError, TypeError, ValueError: the record is of another kind.
        """
        fields = record["panel"]
        contestants = []
        for c in fields["contestants"]:
            error, low, high = (np.nan if value is None else value for value in c["error"])
            contestants.append(
                Contestant(c["name"], (error, low, high), tuple(c["seconds"]), with_nan(c["more"]))
            )
        return cls(
            fields["question"],
            fields["scene"],
            fields["unit"],
            tuple(contestants),
            tuple(fields["again"]),
            tuple(map(tuple, fields["squares"])),
        )


def panel_spec(question: str, name: str, content: str, rounds: int) -> Json:
    """Spec of a panel: all inputs that decide its figures.

    Args:
        question: "pictures", "depth" or "visibility".
        content: content hash of the scene.
    """
    spec: Json = {
        "probe": "accuracy",
        "protocol": PROTOCOL,
        "question": question,
        "scene": content,
        "name": name,
        "rounds": rounds,
    }
    if question == "pictures":
        import mitsuba

        from attnwarp_eval.truth.llvm import variant
        from attnwarp_eval.truth.mitsuba import APPEARANCE_PROTOCOL

        spec |= {"mitsuba": mitsuba.__version__, "variant": variant()}
        return spec | {"appearance": APPEARANCE_PROTOCOL}
    from attnwarp_eval._open3d import open3d

    return spec | {"open3d": open3d().__version__}
