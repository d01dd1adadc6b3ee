"""Report of whole edits taken in turn: seconds, their spread, and ratios to the first."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number, ratio_text
from attnwarp_eval.statistics.intervals import RATIO_INTERVAL
from attnwarp_eval.study.probe_report import Layout, ProbeReport, register_report
from attnwarp_eval.study.probes.timing.measure import COUNTERS
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.method_run import PARTS, WHOLE
from attnwarp_eval.study.turns import Timed, timed_in_turn


@register_report
class TimingReport(ProbeReport):
    """Seconds of whole edits by variant; seconds of warps are shown with the fronts."""

    name = "timing"

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Seconds of each contestant, their spread, and ratios to the first."""
        timed = timed_in_turn(results, WHOLE)
        if layout.timings and timed is not None:
            yield self._section(results, timed)

    def _section(self, results: Results, timed: Timed) -> Section:
        counted = next(record for _, record in results.finished(self.name) if record.extra.work)
        columns = [
            "variant", "s, median", "lowest to highest", f"ratio to {timed.baseline!r}", "verdict",
            *(f"{part}, s" for part in PARTS), *(counter.replace("_", " ") for counter in COUNTERS),
        ]  # fmt: skip
        rows = []
        for name, work in zip(timed.turns[0].names, counted.extra.work, strict=True):
            ratio = timed.ratio(name)
            base = name == timed.baseline
            rows.append(
                [
                    name,
                    *_spread(timed.rounds(name)),
                    "1" if base else ratio_text(ratio),
                    "baseline" if base else timed.judge(ratio),
                    *(_spread(timed.of(part).rounds(name))[0] for part in PARTS),
                    *(str(work[counter]) for counter in COUNTERS),
                ]
            )
        rest = ["–"] * (len(PARTS) + len(COUNTERS))
        rows.append(["again", *_spread(timed.rounds(None)), ratio_text(timed.noise), "–", *rest])
        text = [
            (
                f"Seconds of one whole edit, {timed.turns[0].rounds} rounds of each variant in one"
                f" process, in turn: {', '.join(turn.of for turn in timed.turns)}. Ratios are"
                f" medians over rounds of the ratio within a round; {RATIO_INTERVAL} The row"
                " `again` is the first variant against itself: inside that band, or its mirror"
                " image about 1, nothing is called faster or slower."
            ),
        ]
        title = "Seconds of an edit, taken in turn"
        return Section(title, text, [Table(columns, rows)], folded=True)


def _spread(rounds: Sequence[Sequence[float]]) -> tuple[str, str]:
    """Median over cells and rounds; the lowest and the highest."""
    taken = [value for row in rounds for value in row]
    return number(statistics.median(taken)), f"{number(min(taken))} to {number(max(taken))}"
