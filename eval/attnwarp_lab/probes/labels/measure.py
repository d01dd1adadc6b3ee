"""Part labels that a variant's warp carries, against exact truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from attnwarp.warp import WarpedView
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Part, Study, Variant, Whole
from attnwarp_eval.study.shared.controls import MovedView
from attnwarp_eval.study.shared.edits import VariantPart
from attnwarp_eval.study.shared.things import thing_of
from attnwarp_eval.study.shared.warps import WarpProbe, warped_views
from attnwarp_eval.two_view import TwoView
from attnwarp_lab.ideal.edges import PLACES, EdgesPart, among, edges_of
from attnwarp_lab.ideal.editor import FACTOR
from attnwarp_lab.ideal.labels import Labels as LabelMap
from attnwarp_lab.ideal.labels import Mask, carried_labels, label_transport
from attnwarp_lab.ideal.parts import token_parts
from attnwarp_lab.ideal.thing import labels_of

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


class StudyPart(EdgesPart):
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
        """Require grids that divide the pictures, and known variants."""
        edges_of(study, self.name)
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
        """Depth, rules, grids and parts; an exact mask, a control, and the parts at edges."""
        edges, own = edges_of(study, self.name), variant.part(VariantPart)
        parts, further = study.part(StudyPart).labels.parts, dict[str, Any]()
        if own.mask == "truth":
            further["mask"] = own.mask
        if own.control is not None:
            further["control"] = own.control
        if edges is not None and any(study.variants[name] == variant for name in edges.named):
            further["edges"] = {"parts": edges.parts or parts[0]}
        return {
            **super().variant_spec(study, variant, seed),
            "grids": grids_of(study, study.size),
            "parts": parts,
            **further,
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Key of the depth, the rules, the mask and the control."""
        own = variant.part(VariantPart)
        return *super().meaning(study, variant), own.mask, own.control

    def compute(self, work: Work) -> NoExtra:
        """Warp, carry and count, view by view."""
        spec, world, meter = work.spec, work.world, work.meter
        names = [world.source.name, *spec["views"]]
        edges = spec.get("edges", {"parts": spec["parts"][0]})
        with meter.stage("truth"):
            cameras = [world.camera(name) for name in names]
            labels = {
                count: labels_of(world.scene, world.geometry, cameras, spec["thing"], count)
                for count in {*spec["parts"], edges["parts"]}
            }
        grids: list[int] = spec["grids"]
        near = min(grids, key=lambda grid: abs(grid - spec["size"] / FACTOR))
        fine = labels[edges["parts"]]
        source = token_parts(fine[names[0]], (near, near))
        for name, truth, view in warped_views(work, grids):
            if "mask" in spec:
                view = view.with_mask(torch.from_numpy(np.ascontiguousarray(truth.visible)))
            if "control" in spec:
                view = MovedView.of(view, spec["control"])
            layer, figures = view.at((near, near)), dict[str, float]()
            for count in spec["parts"]:
                pair = labels[count][names[0]], labels[count][name]
                for grid in grids:
                    one = _figures(work, truth, view, pair, grid)
                    if (count, grid) == (spec["parts"][0], near):
                        figures |= one
                    figures |= {f"{key}.{grid}.{count}": value for key, value in one.items()}
            places = among(truth.hits.depth, (near, near))
            if "edges" not in spec:
                places = {place: places[place] for place in PLACES}
            figures |= _by_place(carried_labels(layer, source), truth, fine[name], places)
            work.add(name, figures)
        return NoExtra()


def _figures(
    work: Work, truth: TwoView, view: WarpedView, labels: tuple[LabelMap, LabelMap], grid: int
) -> dict[str, float]:
    """Figures of the part labels carried by a warp.

    Args:
        truth: truth of the pair, (H, W).
        labels: (H, W) part of each pixel of the source and of the target.
        grid: side of the token grid, a divisor of the image's.
    """
    source, target = (token_parts(of, (grid, grid)) for of in labels)
    with work.meter.stage("carry"):
        carried = carried_labels(view.at((grid, grid)), source)
    with work.meter.stage("checks"):
        return label_transport(carried, target, labels[1], truth.visible, truth.unseen)


def _by_place(
    carried: LabelMap, truth: TwoView, pixels: LabelMap, places: Mapping[str, Mask]
) -> dict[str, float]:
    """Figures of carried labels by the end of their names."""
    tokens = token_parts(pixels, (carried.shape[0], carried.shape[1]))
    return {
        f"{key}.{place}": value
        for place, counted in places.items()
        for key, value in label_transport(
            carried, tokens, pixels, truth.visible, truth.unseen, counted
        ).items()
    }
