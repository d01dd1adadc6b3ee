"""Report of edits that change shapes by the ideal editor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import spread
from attnwarp_eval.report.controls import control_share, share_text
from attnwarp_eval.statistics.intervals import over_scenes
from attnwarp_eval.study.probe_report import (
    Layout,
    in_degrees,
    mean_values,
    register_report,
    views_of,
)
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.edits import VariantPart
from attnwarp_lab.ideal.report import EditorReport
from attnwarp_lab.probes.shape.measure import KINDS

BY_KIND = {
    "same": "shape.same.{}",
    "new, seen": "shape.new.{}",
    "uncovered": "shape.uncovered.{}",
    "overlap": "shape.overlap.{}",
    "new stands": "shape.stands.new.{}",
    "gone stands": "shape.stands.gone.{}",
}
"""Columns of a kind."""

TOLD = (
    "Places with several right answers: those that are added, replaced and moved. With one, removed"
    " and grown, each view alone is the truth, so they show harm alone. Same, new, uncovered and"
    " overlap are of the edited pictures; what stands is the depth of the tuned splats, within 2 %"
    " of the true scene after."
)

TOLD_ANGLE = (
    "Overlap of the silhouettes of what is new, of places with several right answers, by the angle"
    " between a view and the source. And the share of a variant's gain over views edited alone that"
    " its features reach from a wrong place, with the 95 % interval over scenes: above a half the"
    " gain is no evidence that the place makes it."
)

PROBE, OVERLAP = "shape", "shape.overlap.several"
GAINS = {"shape.same.several": "same", "shape.new.several": "new, seen", OVERLAP: "overlap"}


@register_report
class ShapeReport(EditorReport):
    """New, uncovered and untouched surface by variant; by kind and number of answers."""

    name = PROBE
    measures = "edits that change shapes by the ideal editor"
    columns: ClassVar[Mapping[str, str]] = {
        "same": "shape.same.several",
        "new, seen": "shape.new.several",
        "uncovered": "shape.uncovered.several",
        "overlap": "shape.overlap.several",
        "one answer: new, seen": "shape.new.one",
        "one answer: uncovered": "shape.uncovered.one",
        "lost, dE00": "shape.lost",
        "new stands": "shape.stands.new.several",
        "gone stands": "shape.stands.gone.several",
        "untouched stands": "shape.stands.untouched",
    }
    contrasts = (
        "shape.same.several",
        "shape.new.several",
        "shape.overlap.several",
        "shape.new.one",
        "shape.lost",
        "shape.stands.new.several",
        "shape.stands.untouched",
    )

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Figures of each kind, by variant."""
        measured = dict.fromkeys(v for c, _ in results.finished(self.name) for v in c.variants)
        names = [name for name in results.study.variants if name in measured]
        if not names:
            return
        tables = []
        for kind in KINDS:
            columns = {title: metric.format(kind) for title, metric in BY_KIND.items()}
            rows = [[n, *mean_values(results, self.name, n, columns.values())] for n in names]
            tables.append(Table([kind, *columns], rows, folded=True))
        shares = Table(["share of the gain", *GAINS.values()], [*_shares(results)])
        first = results.study.ablations[:1]
        shown = [name for table in first for name in (table.baseline, *table.variants)] or names
        angles = _by_yaw(results, [name for name in shown if name in measured])
        yield Section("By angle, and wrong features", [TOLD_ANGLE], [angles, shares])
        yield Section("Kinds of edits", [TOLD], tables)


def _by_yaw(results: Results, names: Sequence[str]) -> Table:
    """Overlap of each variant by view."""
    tables = {name: results.views(PROBE, name, OVERLAP) for name in names}
    keys = dict.fromkeys(key for table in tables.values() for of in table.values() for key in of)
    records = (record for _, record in results.finished(PROBE))
    heads = in_degrees([key.partition("/")[0] for key in keys], views_of(records))
    rows, scenes = [], len(results.study.scenes)
    for name, table in tables.items():
        own = [over_scenes({s: {k: of[k]} for s, of in table.items() if k in of}) for k in keys]
        rows.append([name, *(spread(value, scenes) for value in own)])
    return Table(["overlap", *heads], rows)


def _shares(results: Results) -> Iterator[list[str]]:
    """Rows of the share of a baseline's gain that features from a wrong place reach."""
    parts = {name: own.part(VariantPart) for name, own in results.study.variants.items()}
    for table in results.study.ablations:
        alone = [name for name in table.variants if parts[name].options.get("a0") == 0]
        for name in table.variants if alone else []:
            if parts[name].control is not None:
                of = (table.baseline, name, alone[0])
                shares = [control_share(*(results.views(PROBE, n, m) for n in of)) for m in GAINS]
                yield [f"{name}, of {table.baseline}", *map(share_text, shares)]
