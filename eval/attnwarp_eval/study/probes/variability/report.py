"""Report of variability: does a method vary between seeds, and agree within one?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from attnwarp_eval.document.model import Gallery, Picture, Section, Table
from attnwarp_eval.document.numbers import spread
from attnwarp_eval.statistics.intervals import ByView, Interval, interval, over_scenes
from attnwarp_eval.study.probe_report import Layout, Place, ProbeReport, register_report
from attnwarp_eval.study.probes.variability.measure import BETWEEN, CHANGE, FLOOR, WITHIN
from attnwarp_eval.study.results import Results

NOTICED = 1.0
"""CIEDE2000 that is just noticed; below it two pictures are the same to a person."""

AGREES = 0.5
"""Disagreement within a seed, as a part of the variety between seeds, below which views agree."""


@register_report
class VariabilityReport(ProbeReport):
    """Variety between seeds, and agreement within one, by variant."""

    name = "variability"
    measures = "edits by several seeds"
    tabulates_all = True

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """The table of methods."""
        if results.finished(self.name):
            yield Place.RESULT, self._table(results)

    def _table(self, results: Results) -> Section:
        seeds, scenes = len(results.study.seeds), len(results.study.scenes)
        columns = [
            "variant",
            "change",
            "variety between seeds",
            "disagreement within a seed",
            f"the same less {AGREES:g} of the variety",
            f"answers, of {seeds} seeds",
            "so",
        ]
        rows = []
        for name in results.study.variants:
            records = results.records(self.name, name)
            if not records:
                continue
            change, between, within, floor = (
                results.views(self.name, name, metric)
                for metric in (CHANGE, BETWEEN, WITHIN, FLOOR)
            )
            disagreement = _less(within, floor)
            excess = _less(disagreement, between, AGREES)
            figures = [over_scenes(table) for table in (change, between, disagreement, excess)]
            answers: dict[str, list[float]] = {}
            for scene, _, record in records:
                answers.setdefault(scene, []).append(len(set(record.extra.answers) - {None}))
            shown = [spread(value, scenes) for value in (*figures, interval(answers))]
            rows.append([name, *shown, described(figures[0], figures[1], figures[3])])
        text = [
            (
                f"Mean CIEDE2000 inside the edited object, {seeds} seeds, edited views. **Change**:"
                " against the view before the edit. **Variety between seeds**: the same view in two"
                " seeds. **Disagreement within a seed**: neighbouring views at the same points of"
                " the surface, above that of the views before the edit. Answers: how many right"
                " answers an edit got over the seeds, by all views together."
            ),
            (
                f"A variety below {NOTICED:g} is not noticed: the method always makes the same. A"
                " method is to vary between seeds and to agree within one. Where the disagreement"
                f" within a seed is above {AGREES:g} of the variety, it varies within a seed"
                " too; views drawn one by one have a ratio of about 1. Each word needs a 95 %"
                " interval over scenes that lies on one side of its limit, so of one scene nothing"
                " is told."
            ),
        ]
        return Section("Variety between seeds, agreement within one", text, [Table(columns, rows)])

    def gallery(self, results: Results) -> Section | None:
        """A row of seeds for each variant and view."""
        rows: list[tuple[str, Sequence[Picture]]] = []
        for cell, record in results.finished(self.name):
            by_view: dict[str, list[Picture]] = {}
            for picture in record.pictures:
                caption = picture.content.replace("-", " ")
                by_view.setdefault(picture.view, []).append(Picture(picture.path, caption))
            for view, row in by_view.items():
                rows.append((f"**{cell.scene}, {view}** {cell.variants[0]}", row))
        if not rows:
            return None
        text = ["A view before the edit, and after it with each seed."]
        return Section("Seeds side by side", text, gallery=Gallery(rows))


def described(change: Interval, between: Interval, excess: Interval) -> str:
    """Describe in words what a method does, as far as the intervals tell.

    Args:
        change: CIEDE2000 of the views before and after the edit.
        between: of the same view in two seeds.
        excess: of neighbouring views of a seed, above that before the edit, less
            :data:`AGREES` of ``between``.

    >>> several = interval({"bear": [12.0], "face": [14.0]})  # 13 ± 13
    >>> of_one = interval({"bear": [12.0]})
    >>> described(several, several, several), described(of_one, of_one, of_one)
    ("can't tell", "can't tell")
    """
    if (changes := _above(change, NOTICED)) is None:
        return "can't tell"
    if not changes:
        return "changes nothing"
    if (varies := _above(between, NOTICED)) is None:
        return "can't tell whether it varies"
    if not varies:
        return "always the same"
    if (disagrees := _above(excess, 0.0)) is None:
        return "varies, can't tell whether within a seed too"
    return "varies, within a seed too" if disagrees else "varies, and agrees within a seed"


def _above(value: Interval, limit: float) -> bool | None:
    """Return True if an interval lies above a limit, False if below; None if on both, or without
    bounds.
    """
    if not value.bounded or value.low <= limit <= value.high:
        return None
    return value.low > limit


def _less(a: ByView, b: ByView, factor: float = 1.0) -> dict[str, dict[str, float]]:
    """a - factor * b by scene and view, for two figures of the same cells."""
    return {
        scene: {view: x - factor * b[scene][view] for view, x in views.items()}
        for scene, views in a.items()
    }
