"""Masks of a thing in one or a few views, lifted through splats, against exact masks in others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from attnwarp.camera import Camera
from attnwarp.editing.segment import cut_out
from attnwarp.errors import InputError
from attnwarp.warp import lift_masks
from attnwarp_eval import metrics
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Probe, Work, metrics_of, register
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Part, Study, Variant, Whole
from attnwarp_eval.study.shared import pictures
from attnwarp_eval.study.shared.splats import (
    check_splats,
    splats_meaning,
    splats_of,
    surface_spec,
)
from attnwarp_eval.study.shared.things import ThingsPart, thing_of
from attnwarp_eval.truth import appearance
from attnwarp_eval.world import World, turned

Mask = npt.NDArray[np.bool_]


class Lifted(Part):
    """Masks to lift.

    ``masks``: number of masks, from views evenly around the scene, the source first. ``by``: exact
    masks ("truth"), or grabCut's from the bounding box of each ("box").
    """

    masks: Annotated[Whole, Field(ge=1, le=64)] = 1
    by: Literal["truth", "box"] = "truth"


class VariantPart(Part):
    """Keys of a variant that only this probe reads."""

    lifted: Lifted = Lifted()


@register
class Masks(Probe[NoExtra]):
    """Overlap of lifted masks with the exact ones of the targets."""

    name = "masks"
    study_part = ThingsPart
    variant_part = VariantPart
    metrics = metrics_of("masks.")

    def check(self, study: Study) -> None:
        """Refuse variants without splats: masks are lifted through splats."""
        check_splats(study, self.name, "mask to lift")

    def check_scenes(self, study: Study, scenes: Sequence[Scene]) -> None:
        """Refuse things of unknown scenes: they would be unused."""
        study.check_scenes(study.part(ThingsPart).things, "things", scenes)

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each scene, variant and seed."""
        things = {name: thing_of(study, scene) for name, scene in scenes.items()}
        for cell in super().cells(study, names, scenes):
            yield replace(cell, spec={**cell.spec, "thing": things[cell.scene]})

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Splats, and the masks that are lifted."""
        return {
            **surface_spec(study, variant, seed),
            "spp": study.spp,
            "lifted": variant.part(VariantPart).lifted.model_dump(),
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Key of the splats, sampled or fitted, and of the masks."""
        return splats_meaning(study, variant), variant.part(VariantPart).lifted

    def compute(self, work: Work) -> NoExtra:
        """Lift the masks, and render and judge them view by view."""
        spec, world, meter = work.spec, work.world, work.meter
        objects = [world.scene.object_names.index(name) for name in spec["thing"]]
        by, count = spec["lifted"]["by"], spec["lifted"]["masks"]
        around = [turned(world.scene, 360 * k / count) for k in range(1, count)]
        with meter.stage("truth"):
            cameras = [world.source, *around]
            exact = [_thing(world, camera, objects) for camera in cameras]
            given = exact
            if by == "box":
                pairs = zip(cameras, exact, strict=True)
                given = [_by_box(world, camera, true, spec["spp"]) for camera, true in pairs]
        with meter.stage("splats"):
            model = splats_of(work)
        with meter.stage("lift"):
            lifted = lift_masks(model, cameras, given)
        own = {
            "masks.given": metrics.mask_overlap(given[0], exact[0])["masks.iou"],
            "masks.back": lifted.agreement[0],
        }
        shown = int(exact[0].sum())
        for name in spec["views"]:
            camera = world.targets[name]
            with meter.view():
                marked = lifted.render(camera) > 0.5
            with meter.stage("truth"):
                thing = _thing(world, camera, objects)
                pair = world.pair(name, spec["size"])
            with meter.stage("checks"):
                figures = metrics.mask_overlap(marked, thing, pair.visible, pair.unseen)
                if shown < metrics.masks.LEAST_PIXELS:  # nothing to lift
                    figures |= {
                        key: float("nan") for key in figures if not self.metric(key).is_count
                    }
            draw = partial(pictures.of_mask, world, name, marked, thing, spec["spp"])
            work.add(name, figures | own, draw)
        return NoExtra()


def _thing(world: World, camera: Camera, objects: Sequence[int]) -> Mask:
    """(H, W) bool: pixels whose central ray meets an object of the thing first."""
    return np.isin(world.geometry.trace(camera).object_id, objects)


def _by_box(world: World, camera: Camera, thing: Mask, spp: int) -> Mask:
    """(H, W) bool: grabCut's segment in the bounding box of a thing; empty if it finds none."""
    if not thing.any():
        return thing
    rows, columns = np.flatnonzero(thing.any(1)), np.flatnonzero(thing.any(0))
    box = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    image = np.clip(to_srgb(appearance(world.scene, camera, spp=spp, seed=0)), 0, 1)
    try:
        return cut_out(image, box=box)
    except InputError:
        return np.zeros_like(thing)
