"""Report of edits in parts by the ideal editor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import spread
from attnwarp_eval.statistics.contrasts import paired
from attnwarp_eval.statistics.intervals import interval, over_scenes
from attnwarp_eval.study.probe_report import Layout, register_report
from attnwarp_eval.study.results import Results
from attnwarp_lab.ideal.edge_report import edge_section
from attnwarp_lab.ideal.edges import edges_of
from attnwarp_lab.ideal.report import EditorReport

MOST_STAGES = 3
"""Stages of an edit that the figure on depth edges shows."""

DRIFTING = {
    "ideal": ("ideal editor", "parts with the source's answer", "parts.seen.edit"),
    "editing": (
        "bundled editor",
        "dE00 between views above the floor",
        "multiview.delta_e_above.edit_inside",
    ),
}
"""Probes of methods whose editor drifts: the editor, what is shown, and its metric."""


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
        """The editor by scene: share of signal, settling of answers, statistics alone; figures by
        planted drift; errors at depth edges.
        """
        edges = edges_of(results.study, self.name)
        if edges is not None:
            own = "parts.right.{}.edit", "parts.through.{}.edit"
            metrics = {name: (name, *own) for name in edges.named}
            stages = {
                name: [
                    (stage, results.views(self.name, name, f"parts.right.stage{stage}.edit"))
                    for stage in range(1, MOST_STAGES + 1)
                ]
                for name in edges.named
            }
            section = edge_section(results, layout, self.name, metrics, stages, "stage of the edit")
            if section is not None:
                yield section
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
        if any("drift" in record.spec for _, record in results.finished(self.name)):
            yield _drift(results, layout)


def _drift(results: Results, layout: Layout) -> Section:
    """Figures of each method by the shift of its editor; a variant's method is its name up to the
    first comma.
    """
    path, tables = layout.figure("drift.svg"), []
    shown = {probe: said for probe, said in DRIFTING.items() if results.finished(probe)}
    with charts.drawing(path, columns=len(shown), height=4.2, width=6.5 * len(shown)) as all_axes:
        for axes, (probe, (editor, what, key)) in zip(all_axes, shown.items(), strict=True):
            found: dict[str, dict[float, dict[str, dict[str, float]]]] = {}
            for cell, record in results.finished(probe):
                shift = record.spec.get("drift", {"shift": 0.0})["shift"]
                by_shift = found.setdefault(cell.variants[0].partition(",")[0], {})
                values = {f"{cell.seed}/{view.name}": view.metrics[key] for view in record.views}
                by_shift.setdefault(shift, {}).setdefault(cell.scene, {}).update(values)
            means = {
                name: {shift: over_scenes(by[shift]) for shift in sorted(by)}
                for name, by in found.items()
            }
            shifts = sorted({shift for by in means.values() for shift in by})
            alone = next(iter(found.values()))
            gains = {
                name: {shift: paired(alone.get(shift, {}), by[shift]) for shift in sorted(by)}
                for name, by in found.items()
            }
            series = [charts.Line(name, list(by), list(by.values())) for name, by in gains.items()]
            charts.lines(axes, series, x="planted shift, px", y=f"gain: {what}", title=editor)
            count = len(results.study.scenes)
            rows = [
                [
                    name,
                    *(
                        spread(of[name][shift], count) if shift in of[name] else ""
                        for of in (means, gains)
                        for shift in shifts
                    ),
                ]
                for name in found
            ]
            columns = ["method", *(f"{w}{s:g} px" for w in ("", "gain, ") for s in shifts)]
            tables.append(Table(columns, rows, f"{editor}: {what}"))
    text = (
        "An editor that moves every picture it edits by this shift, each view in a direction of its"
        f" own; pictures are of {results.study.size} px. Warps assume that it stays. **Gain**: the"
        " difference from the first row at the same shift, paired by scene; less is better of dE00."
        " A shifted picture shows background and other parts at a part's place, so views alone"
        " agree more by chance too. Only edits whose source shows a right answer count, so rows"
        " stand on different scenes. Of fewer than six a bracket holds the least and the most."
    )
    picture = Picture("figures/drift.svg", "Gain over views alone, by the drift of the editor.")
    title = "How much drift does each method stand?"
    return Section(title, [text], tables, [picture], leads=True)
