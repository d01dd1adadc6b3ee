"""Report of edits in parts by the ideal editor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import spread
from attnwarp_eval.statistics.intervals import interval
from attnwarp_eval.study.probe_report import Layout, register_report
from attnwarp_eval.study.results import Results
from attnwarp_lab.ideal.report import EditorReport


@register_report
class IdealReport(EditorReport):
    """Seen, through, bleed and dE by variant, to be read together."""

    name = "ideal"
    measures = "edits in parts by the ideal editor"
    columns: ClassVar[Mapping[str, str]] = {
        "seen": "parts.seen.edit",
        "through": "parts.through.edit",
        "unseen, between targets": "parts.fill.edit",
        "bleed, dE00": "parts.bleed.edit",
        "dE00 where seen": "parts.delta_e.edit",
        "seen, renders": "parts.seen.render",
        "through, renders": "parts.through.render",
        "dE00 where seen, renders": "parts.delta_e.render",
    }
    contrasts = (
        "parts.seen.edit",
        "parts.through.edit",
        "parts.fill.edit",
        "parts.bleed.edit",
        "parts.delta_e.edit",
        "parts.seen.render",
        "parts.delta_e.render",
    )

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """The editor by scene: share of signal, settling of answers, statistics alone."""
        found: dict[tuple[object, ...], dict[str, dict[str, list[float]]]] = {}
        for cell, record in results.finished(self.name):
            ideal, extra, steps = (
                record.spec["editor"]["ideal"], record.extra, record.spec["settings"]["steps"],
            )  # fmt: skip
            values = found.setdefault((*ideal.values(), steps), {})
            for name, value in (
                ("size of a part, %", 100 * extra.part_share),
                ("settled at step", extra.settled * steps),
                ("share of signal", extra.share),
                ("alone: agreement, %", 100 * extra.agreement),
            ):
                values.setdefault(name, {}).setdefault(cell.scene, []).append(value)
        if not found:
            return
        names = [*results.finished(self.name)[0][1].spec["editor"]["ideal"], "steps"]
        rows = [
            [
                *map(str, key),
                *(spread(interval(of), len(results.study.scenes)) for of in own.values()),
            ]
            for key, own in found.items()
        ]
        columns = [*names, *next(iter(found.values()))]
        text = [
            (
                "An editor that repairs whatever it can tell to be wrong; a real one may repair"
                " less. No difference means: below a part's size."
                " Alone, with fresh noise, answers come alike often and agree by chance."
            ),
            *self.problems(results),
        ]
        yield Section("The ideal editor", text, [Table(columns, rows)], folded=True)
