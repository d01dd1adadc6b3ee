"""Part labels that a variant's warp carries, against exact truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from attnwarp.warp import WarpedView
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Part, Study, Variant, Whole
from attnwarp_eval.study.shared.things import thing_of
from attnwarp_eval.study.shared.warps import WarpProbe, warped_views
from attnwarp_eval.two_view import TwoView
from attnwarp_eval.world import World
from attnwarp_lab.ideal.editor import FACTOR
from attnwarp_lab.ideal.labels import Labels as LabelMap
from attnwarp_lab.ideal.labels import carried_labels, edge_distance, label_transport
from attnwarp_lab.ideal.parts import token_parts
from attnwarp_lab.ideal.thing import labels_of
from attnwarp_lab.probes.labels.inspected import Parts

FAR = 4
"""Distance to a depth edge, in tokens, from which tokens are counted together."""

GRIDS = (8, 16, 32, 64)
"""Default sides of the token grids."""


class Labels(Part):
    """Tokens and parts.

    ``grids``: tokens along a side, divisors of the image size; by default those of 8, 16, 32 and 64
    that are. ``parts``: numbers of parts; a figure without a grid in its name is for the first, on
    tokens of 4 px, as in the ideal editor.
    """

    grids: list[Annotated[Whole, Field(ge=1)]] = Field(default_factory=list)
    parts: Annotated[list[Annotated[Whole, Field(ge=2, le=10_000)]], Field(min_length=1)] = Field(
        default_factory=lambda: [12, 48]
    )


class StudyPart(Part):
    """Keys of a study that only this probe reads."""

    labels: Labels = Labels()


def grids_of(study: Study, size: int) -> list[int]:
    """Sides of the token grids that a study measures.

    Args:
        study: study, with or without the probe.
    """
    grids = study.part(StudyPart).labels.grids
    return grids or [grid for grid in GRIDS if size % grid == 0]


@register
class LabelTransport(WarpProbe):
    """Labels of a thing's parts, carried along the tokens of a warp."""

    name = "labels"
    study_part = StudyPart
    metrics = metrics_of("labels.")

    def check(self, study: Study) -> None:
        """Require grids that divide the pictures."""
        for grid in study.part(StudyPart).labels.grids:
            if study.size % grid:
                raise ValueError(
                    f"labels.grids: got {grid}, expected divisors of the image size, {study.size}"
                )

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each scene, variant and seed."""
        things = {name: thing_of(study, scene) for name, scene in scenes.items()}
        for cell in super().cells(study, names, scenes):
            yield replace(cell, spec={**cell.spec, "thing": things[cell.scene]}, pictures=())

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Depth, rules, grids and parts."""
        return {
            **super().variant_spec(study, variant, seed),
            "grids": grids_of(study, study.size),
            "parts": study.part(StudyPart).labels.parts,
        }

    def token_labels(self, study: Study, world: World, targets: Sequence[str]) -> Parts:
        """Labels for the first number of parts."""
        size = world.source.width
        return Parts(
            world,
            (world.source.name, *targets),
            tuple(thing_of(study, world.scene)),
            study.part(StudyPart).labels.parts[0],
            tuple(grid for grid in grids_of(study, size) if size % grid == 0),
        )

    def compute(self, work: Work) -> NoExtra:
        """Warp, carry and count, view by view."""
        spec, world, meter = work.spec, work.world, work.meter
        names = [world.source.name, *spec["views"]]
        with meter.stage("truth"):
            cameras = [world.camera(name) for name in names]
            labels = {
                count: labels_of(world.scene, world.geometry, cameras, spec["thing"], count)
                for count in spec["parts"]
            }
        grids: list[int] = spec["grids"]
        near = min(grids, key=lambda grid: abs(grid - spec["size"] / FACTOR))
        for name, truth, view in warped_views(work, grids):
            figures: dict[str, float] = {}
            for count in spec["parts"]:
                for grid in grids:
                    pair = labels[count][names[0]], labels[count][name]
                    first = (count, grid) == (spec["parts"][0], near)
                    one, by_distance = _figures(work, truth, view, pair, grid, first)
                    if first:
                        figures |= one | by_distance
                    figures |= {f"{key}.{grid}.{count}": value for key, value in one.items()}
            work.add(name, figures)
        return NoExtra()


def _figures(
    work: Work,
    truth: TwoView,
    view: WarpedView,
    labels: tuple[LabelMap, LabelMap],
    grid: int,
    distances: bool,
) -> tuple[dict[str, float], dict[str, float]]:
    """Figures of the part labels carried by a warp, of all tokens and by distance to depth edges.

    Args:
        truth: truth of the pair, (H, W).
        labels: (H, W) part of each pixel of the source and of the target.
        grid: side of the token grid, a divisor of the image's.
        distances: False leaves the figures by distance out.
    """
    source, target = (token_parts(of, (grid, grid)) for of in labels)
    with work.meter.stage("carry"):
        carried = carried_labels(view.at((grid, grid)), source)
    with work.meter.stage("checks"):
        of = carried, target, labels[1], truth.visible, truth.unseen
        by_distance: dict[str, float] = {}
        if distances:
            far = np.minimum(edge_distance(truth.hits.depth, (grid, grid)), FAR).astype(int)
            for tokens in range(FAR + 1):
                one = label_transport(*of, among=far == tokens)
                by_distance |= {f"{key}.edge{tokens}": value for key, value in one.items()}
        return label_transport(*of), by_distance
