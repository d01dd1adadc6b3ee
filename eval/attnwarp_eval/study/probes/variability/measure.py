"""Does a method make another thing with another seed, and one thing in all views of a seed?

A cell is one edit of one scene by one method with every seed of the study: pictures of different
seeds are compared with each other. Splats and true pictures are those of the first seed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.methods.pictures import enlarged_change
from attnwarp_eval import metrics
from attnwarp_eval.colors import color_difference
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study import pictures
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.edit_truth import EditTruth, neighbours, planned_truth
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Study
from attnwarp_eval.study.shared.edits import (
    MethodProbe,
    VariantPart,
    editor_of,
    edits_of,
    scene_seed,
)
from attnwarp_eval.study.shared.method_run import run_method
from attnwarp_eval.study.shared.splats import splats_of

Image = npt.NDArray[np.float32]

WITHIN, FLOOR, BETWEEN, CHANGE = (
    f"variability.{name}" for name in ("within", "within_floor", "between", "change")
)


@dataclass(frozen=True)
class Varied:
    """Entries of a cell's record beside the figures of its views.

    Attributes:
        name, instruction: of the edit.
        seeds: in order.
        answers: by seed in that order, the right answer that all edited views together are nearest
            to; None where nothing of the object shows.
    """

    name: str
    instruction: str
    seeds: tuple[int, ...]
    answers: tuple[str | None, ...]

    def to_json(self) -> Json:
        """The record's entry ``varied``."""
        data = asdict(self)
        return {"varied": {**data, "seeds": list(self.seeds), "answers": list(self.answers)}}

    @classmethod
    def from_json(cls, data: Json) -> Varied:
        """Rebuild from :meth:`to_json`."""
        return cls(**{**data, "seeds": tuple(data["seeds"]), "answers": tuple(data["answers"])})


@register
class VariabilityProbe(MethodProbe[Varied]):
    """One edit of one scene by one method, with several seeds."""

    name = "variability"
    protocol = 2
    metrics = metrics_of("variability.")

    def check(self, study: Study) -> None:
        """One seed varies from no other, and a method that was cut short varies with the clock."""
        if self.name not in study.probes:
            return
        if len(study.seeds) < 2:
            raise ValueError(
                f"seeds: got {study.seeds}, expected at least 2 for probes.{self.name}"
            )
        for name in study.probes[self.name]:
            if study.variants[name].part(VariantPart).budget is not None:
                raise ValueError(
                    f"probes.{self.name}: {name!r} has a budget; name a variant without one"
                )

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene, edit and variant."""
        first = study.seeds[0]
        for name, scene in scenes.items():
            for label, edit in itertools.product(names, list(edits_of(study, scene))):
                variant = study.variants[label]
                spec = {
                    **self.common_spec(study, scene, first),
                    **self.variant_spec(study, variant, scene_seed(study, name, first)),
                    "seeds": list(study.seeds),
                    "edit": edit,
                }
                views = study.pictures_of(spec["views"], label)
                yield Cell(
                    spec, name, label, self.name, first, (label,),
                    tuple(f"{edit['name']}/{view}" for view in views),
                    {"editor": editor_of(study, variant).name},
                )  # fmt: skip

    def compute(self, work: Work) -> Varied:
        """Edit the scene with every seed, then compare the views of a seed and of all seeds."""
        spec, world, meter = work.spec, work.world, work.meter
        names = [world.source.name, *spec["views"]]
        edit = spec["edit"]
        with meter.stage("truth"):
            truth = planned_truth(work.cell, names)
        with meter.stage("splats"):
            before = splats_of(work)
        edited: dict[int, dict[str, Image]] = {}
        for seed in spec["seeds"]:
            drawn = spec["settings"]["seed"] + seed - spec["seeds"][0]
            own = {**spec, "settings": {**spec["settings"], "seed": drawn}}
            result = run_method(
                replace(work, cell=replace(work.cell, spec=own)), truth, names, before
            )
            edited[seed] = {
                names[k]: enlarged_change(
                    truth.originals[names[k]], pixels.astype(np.float32) / np.float32(255)
                )
                for k, pixels in result.edited.items()
            }
            meter.count(network_rows=int(result.counters.get("network_rows", 0)))
        with meter.stage("checks"):
            other = neighbours(world, spec["views"])
            for view in spec["views"]:
                row = self._figures(work, truth, edited, view, other[view])
                draw = partial(self._draw, truth, edited, view)
                work.add(f"{edit['name']}/{view}", row, draw)
            answers = tuple(truth.judge(views).answer for views in edited.values())
        return Varied(edit["name"], edit["instruction"], tuple(spec["seeds"]), answers)

    def _figures(
        self,
        work: Work,
        truth: EditTruth,
        edited: Mapping[int, Mapping[str, Image]],
        view: str,
        other: str,
    ) -> dict[str, float]:
        """Figures of one view, means over the seeds; NaN where a method did not edit the views."""
        mask = truth.union[view]
        pair = work.world.between(other, view)
        both = [views for views in edited.values() if view in views and other in views]
        own = [views[view] for views in edited.values() if view in views]
        same = [
            metrics.cross_view(views[other], views[view], pair, mask=mask).delta_e for views in both
        ]
        originals = truth.originals
        floor = metrics.cross_view(originals[other], originals[view], pair, mask=mask).delta_e
        return {
            WITHIN: _mean(np.nanmean(values) for values in same if np.isfinite(values).any()),
            FLOOR: float(np.nanmean(floor)) if np.isfinite(floor).any() else math.nan,
            BETWEEN: _mean(color_difference(a, b, mask) for a, b in itertools.combinations(own, 2)),
            CHANGE: _mean(color_difference(image, originals[view], mask) for image in own),
        }

    def _draw(
        self, truth: EditTruth, edited: Mapping[int, Mapping[str, Image]], view: str
    ) -> dict[str, bytes]:
        """JPEG files of a view before the edit, and with each seed."""
        images = {"before": truth.originals[view]}
        images |= {f"seed-{seed}": views[view] for seed, views in edited.items() if view in views}
        return {
            content: pictures.jpeg(pictures.enlarged(image)) for content, image in images.items()
        }

    def read_extra(self, data: Json) -> Varied:
        """Read from the record's entry ``varied``."""
        return Varied.from_json(data["varied"])


def _mean(values: Iterable[Any]) -> float:
    defined = [float(value) for value in values if math.isfinite(value)]
    return sum(defined) / len(defined) if defined else math.nan
