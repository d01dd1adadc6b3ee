"""Section of a report on errors by distance to a depth edge.

A paper of 2026 (RL3DEdit, 2603.03143 v2) says of methods that carry features between views that
they "accumulate alignment errors in geometrically discontinuous regions". A method does so where
its errors beyond those of exact geometry are more at a depth edge than away from any.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, spread
from attnwarp_eval.report.compared import difference_text, no_verdict
from attnwarp_eval.report.controls import HALF, control_share, share_text
from attnwarp_eval.statistics.contrasts import Contrast, contrast
from attnwarp_eval.statistics.intervals import ByView, benjamini_hochberg, over_scenes
from attnwarp_eval.study.probe_report import Layout
from attnwarp_eval.study.results import Results
from attnwarp_lab.ideal.edges import AT, AWAY, FAR, OFF, PLACES, Edges, edges_of

EQUAL_WITHIN = 0.05
"""Difference of shares up to which a method errs equally at an edge and away from it."""


def minus(a: ByView, b: ByView) -> dict[str, dict[str, float]]:
    """Subtract tables, over the views that both have.

    Example:
        >>> minus({"bear": {"left": 3.0, "right": 1.0}}, {"bear": {"left": 1.0}})
        {'bear': {'left': 2.0}}
    """
    return {
        scene: {
            view: value - b[scene][view] for view, value in a[scene].items() if view in b[scene]
        }
        for scene in a.keys() & b.keys()
    }


Figures = tuple[str, str, str, str]
"""Variant of a row, its metrics of what is right, of what is wrong and of what hidden tokens take;
{} is a place. All that is not right is wrong if the second is empty."""


class EdgeTable:
    """Shares of right tokens by variant and distance, and the verdict on each.

    Args:
        results: a run.
        probe: name of the probe.
        edges: its variants.
        metrics: figures by row.
    """

    def __init__(
        self,
        results: Results,
        probe: str,
        edges: Edges,
        metrics: Mapping[str, Figures],
    ) -> None:
        self.results, self.probe, self.edges, self.metrics = results, probe, edges, metrics
        self.judged = {title: self._at_edges(title) for title in self.rows}
        adjusted = benjamini_hochberg([one.flips.p for one in self.judged.values()])
        self.p = dict(zip(self.judged, adjusted, strict=True))

    @property
    def rows(self) -> list[str]:
        """Titles of the judged rows."""
        return [t for t, (variant, *_) in self.metrics.items() if variant in self.edges.methods]

    def right(self, title: str, place: str) -> ByView:
        """Shares of a row that are right at a place of :func:`among`, by view."""
        return self._views(title, 1, place)

    def errors(self, title: str, place: str) -> ByView:
        """Errors of a row beyond those of exact geometry at a place, by view."""
        exact = self.edges.exact
        if self.metrics[title][2]:
            return minus(self._views(title, 2, place), self._views(exact, 2, place))
        return minus(self.right(exact, place), self.right(title, place))

    def _views(self, title: str, figure: int, place: str) -> ByView:
        own = self.metrics[title]
        return self.results.views(self.probe, own[0], own[figure].format(place))

    def _at_edges(self, title: str) -> Contrast:
        return contrast(self.errors(title, OFF), self.errors(title, AT), "plain")

    def share_of_control(self, title: str) -> tuple[float, float, float] | None:
        """:func:`control_share` of a row at an edge; None without a control."""
        if not self.edges.control:
            return None
        own = self.right(title, AT)
        nothing = {scene: dict.fromkeys(views, 0.0) for scene, views in own.items()}
        alone = self.right(self.edges.alone, AT) if self.edges.alone else nothing
        return control_share(own, self.right(self.edges.control, AT), alone)

    def verdict(self, title: str) -> str:
        """One verdict on the printed criticism of a row."""
        found, share = self.judged[title], self.share_of_control(title)
        if found.scenes < FEWEST_SCENES:
            return no_verdict(found) if found.scenes else "not measured"
        if share is not None and share[0] > HALF:
            return "blind"
        told = found.verdict("lower", adjusted_p=self.p[title], bound=EQUAL_WITHIN)
        words = {"worse": "holds", "better": "the opposite holds", "equal": "does not hold: equal"}
        return words.get(told, told)

    def tables(self) -> list[Table]:
        """Errors at an edge and away from it with the verdict; right shares by distance."""
        scenes = len(self.results.study.scenes)
        rows, places = [], []
        for title in self.metrics:
            shown = [spread(over_scenes(self.right(title, p)), scenes) for p in PLACES]
            shown += [spread(over_scenes(self._views(title, 3, p)), scenes) for p in (AT, OFF)]
            places.append([title, *shown])
            if title not in self.judged:
                continue
            share = self.share_of_control(title)
            rows.append([
                title,
                spread(over_scenes(self.errors(title, AT)), scenes),
                spread(over_scenes(self.errors(title, OFF)), scenes),
                difference_text(self.judged[title], "share"),
                "none" if share is None else share_text(share),
                self.verdict(title),
            ])  # fmt: skip
        heads = ["variant", "errors, edge", "errors, away", "difference"]
        heads += ["the control's share", "errs more at depth edges"]
        by_distance = [*map(str, range(FAR)), f"{FAR} and more", "hidden, edge", "hidden, away"]
        caption = "Right tokens by distance to a depth edge, and hidden ones that take something"
        return [
            Table(heads, rows),
            Table(["variant", *by_distance], places, caption, folded=True),
        ]


TEXT = (
    "Shares that are right of what the source truly shows, by whole tokens to the nearest true"
    " depth edge. **Hidden** is the share of what the source does not show that takes something of"
    " it all the same. **Errors** are what is wrong beyond exact geometry and mask at the same"
    " distance. **Errs more at depth edges** is the printed criticism of carried features"
    f" (2603.03143 v2): `holds` where errors at an edge are more than those {AWAY} tokens and more"
    " away, by flipped signs of the scenes' differences, adjusted over the rows; equal within"
    f" {100 * EQUAL_WITHIN:.0f} points. `blind`: at an edge, features from a wrong place bring more"
    " than half of what the row brings beyond views alone."
)


def edge_section(
    results: Results,
    layout: Layout,
    probe: str,
    metrics: Mapping[str, Figures],
    beside: Mapping[str, Sequence[tuple[float, ByView]]],
    axis: str,
) -> Section | None:
    """Section on depth edges: one figure, one table, one verdict a row; None if not asked for.

    Args:
        results, layout: run and layout of the report.
        probe: name of the probe.
        metrics: figures by row.
        beside: line -> (x, shares), of the figure's second panel.
        axis: title of that panel's x axis.
    """
    edges = edges_of(results.study, probe)
    if edges is None or not results.finished(probe):
        return None
    found = EdgeTable(results, probe, edges, metrics)
    path, away = layout.figure(f"edges-{probe}.svg"), range(FAR + 1)
    near = [charts.Line(t, away, [over_scenes(found.right(t, p)) for p in PLACES]) for t in metrics]
    further = [
        charts.Line(name, [x for x, _ in line], [over_scenes(table) for _, table in line])
        for name, line in beside.items()
    ]
    further = [line for line in further if sum(np.isfinite(y.mean) for y in line.y) > 1]
    panels = [(near, "tokens to the nearest depth edge"), *[(further, axis)] * bool(further)]
    with charts.drawing(path, columns=len(panels)) as axes:
        for place, (series, x) in zip(axes, panels, strict=True):
            charts.lines(
                place, series, x=x, y="share that is right", title="", share=True, apart=0.05
            )
    picture = Picture(f"figures/{path.name}", "Right tokens by distance to a depth edge")
    title = "Do carried features err at depth edges?"
    return Section(title, [TEXT], found.tables(), [picture], leads=True)
