"""Section of a report on what is right by distance to a depth edge.

A paper of 2026 (RL3DEdit, 2603.03143 v2) says of methods that carry features between views that
they "accumulate alignment errors in geometrically discontinuous regions".
"""

from __future__ import annotations

from collections.abc import Mapping

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import spread
from attnwarp_eval.report.compared import difference_text
from attnwarp_eval.statistics.contrasts import contrast
from attnwarp_eval.statistics.intervals import ByView, over_scenes
from attnwarp_eval.study.probe_report import Layout
from attnwarp_eval.study.results import Results
from attnwarp_lab.ideal.edges import AT, AWAY, FAR, OFF, PLACES

Figures = tuple[str, str, str]
"""Variant of a row, its metrics of what is right and of what hidden tokens take; {} is a place."""


def edge_tables(results: Results, probe: str, metrics: Mapping[str, Figures]) -> list[Table]:
    """Shares that are right at an edge and away from it, and by distance.

    Args:
        metrics: figures by row.
    """

    def views(title: str, figure: int, place: str) -> ByView:
        own = metrics[title]
        return results.views(probe, own[0], own[figure].format(place))

    def shown(title: str, figure: int, *places: str) -> list[str]:
        scenes = len(results.study.scenes)
        return [spread(over_scenes(views(title, figure, p)), scenes) for p in places]

    rows = []
    for title in metrics:
        found = contrast(views(title, 1, OFF), views(title, 1, AT), "plain")
        beyond = [difference_text(found, "share"), *shown(title, 2, AT, OFF)]
        rows.append([title, *shown(title, 1, AT, OFF), *beyond])
    heads = ["variant", "right, edge", "right, away", "difference", "hidden, edge", "hidden, away"]
    near = ["variant", *map(str, range(FAR)), f"{FAR} and more"]
    return [
        Table(heads, rows),
        Table(
            near,
            [[title, *shown(title, 1, *PLACES)] for title in metrics],
            "Right tokens by distance to a depth edge",
            folded=True,
        ),
    ]


TEXT = (
    "Shares that are right of what the source truly shows, at a true depth edge (tokens that touch"
    f" one) and {AWAY} whole tokens and more **away**. **Hidden** is the share of what the source"
    " does not show that takes something of it all the same. The difference is over views that"
    " have both, with the 95 % interval over scenes; it is described, not judged. A token at an"
    " edge shows two surfaces, so exact geometry and mask lose there too: hold each row's"
    " difference against theirs."
)


def edge_section(
    results: Results,
    layout: Layout,
    probe: str,
    metrics: Mapping[str, Figures],
) -> Section:
    """Section on depth edges: one figure and one table.

    Args:
        results, layout: run and layout of the report.
        probe: name of the probe.
        metrics: figures by row.
    """
    path, distances = layout.figure(f"edges-{probe}.svg"), range(FAR + 1)
    near = [
        charts.Line(
            title,
            distances,
            [over_scenes(results.views(probe, name, right.format(p))) for p in PLACES],
        )
        for title, (name, right, _) in metrics.items()
    ]
    with charts.drawing(path) as (axes,):
        charts.lines(
            axes, near, x="tokens to the nearest depth edge", y="share that is right", title="",
            share=True, apart=0.05,
        )  # fmt: skip
    picture = Picture(f"figures/{path.name}", "Right tokens by distance to a depth edge")
    title = "Do carried features err at depth edges?"
    return Section(title, [TEXT], edge_tables(results, probe, metrics), [picture], leads=True)
