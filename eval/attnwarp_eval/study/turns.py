"""Seconds of contestants that ran in turn, over the cells of a run, for a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from attnwarp_eval.statistics.intervals import Interval, Ratio, time_ratio
from attnwarp_eval.study.probe import InTurn, probe
from attnwarp_eval.study.results import Results


@dataclass(frozen=True)
class Timed:
    """Seconds of one stage of contestants that ran in turn, by the cells that timed it."""

    turns: Sequence[InTurn]
    stage: str

    @property
    def baseline(self) -> str:
        """The contestant that is the denominator of all ratios."""
        return self.turns[0].names[0]

    def rounds(self, name: str | None) -> list[list[float]]:
        """Seconds of a contestant, cell by round; None gives the baseline's second run."""
        return [
            turn.seconds[self.stage][-1 if name is None else turn.names.index(name)]
            for turn in self.turns
            if name is None or name in turn.names
        ]

    def of(self, stage: str) -> Timed:
        """Timings of another stage."""
        return Timed(self.turns, stage)

    @property
    def names(self) -> list[str]:
        """Every contestant, the baseline first."""
        return list(dict.fromkeys(name for turn in self.turns for name in turn.names))

    @property
    def scenes(self) -> int:
        """Number of scenes that were timed."""
        return len({turn.scene for turn in self.turns})

    @property
    def base(self) -> float:
        """Median seconds of the baseline over cells and rounds."""
        return float(np.median(np.concatenate(self.rounds(self.baseline))))

    @property
    def noise(self) -> Ratio:
        """Ratio of the baseline to itself: the machine's noise."""
        return time_ratio(self.rounds(None), self.rounds(self.baseline))

    def ratio(self, name: str) -> Ratio:
        """Ratio of a contestant's time to the baseline's within a round."""
        both = [turn for turn in self.turns if name in turn.names]
        return time_ratio(self.rounds(name), Timed(both, self.stage).rounds(self.baseline))

    def seconds(self, name: str) -> Interval:
        """The baseline's seconds times the ratio, which cancels slow moments of the machine."""
        ratio, base, nan = self.ratio(name), self.base, float("nan")
        low, high = base * ratio.low, base * ratio.high
        return Interval(base * ratio.ratio, low, high, 1, 1, 0, nan, nan)

    def judge(self, ratio: Ratio) -> str:
        """Verdict "faster" or "slower", outside the band of the baseline against itself."""
        noise = self.noise
        if not (noise.bounded and ratio.bounded):
            return f"can't tell ({min(turn.rounds for turn in self.turns)} rounds)"
        band = max(noise.high, 1 / noise.low, 1.0)
        if ratio.low > band:
            return "slower"
        if ratio.high < 1 / band:
            return "faster"
        return "can't tell"


def timed_in_turn(results: Results, stage: str) -> Timed | None:
    """The seconds of a stage that cells of a run took in turn; None if none did."""
    turns = [
        replace(turn, scene=cell.scene)
        for cell in results.cells
        if cell.record is not None
        and (turn := probe(cell.probe).in_turn(cell, cell.record)) is not None
        and stage in turn.seconds
    ]
    return Timed(turns, stage) if turns else None
