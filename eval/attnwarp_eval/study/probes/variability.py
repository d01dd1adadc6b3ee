"""Does a method make another thing with another seed, and one thing in all views of a seed?

A cell is one edit of one scene by one method with every seed of the study: pictures of different
seeds are compared with each other. Splats and true pictures are those of the first seed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.methods.pictures import enlarged_change
from attnwarp_eval import metrics
from attnwarp_eval.document.model import Gallery, Picture, Section, Table
from attnwarp_eval.document.numbers import spread
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.statistics.intervals import ByView, Interval, interval
from attnwarp_eval.study import pictures
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.edit_truth import EditTruth, neighbours, planned_truth
from attnwarp_eval.study.probes import editing, register
from attnwarp_eval.study.probes.base import Layout, Place, Probe, Work, metrics_of
from attnwarp_eval.study.probes.variant_splats import splats_of
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Study, Variant

Image = npt.NDArray[np.float32]

NOTICED = 1.0
"""CIEDE2000 that is just noticed; below it two pictures are the same to a person."""

AGREES = 0.5
"""Disagreement within a seed, as a part of the variety between seeds, below which views agree."""

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
class VariabilityProbe(Probe[Varied]):
    """One edit of one scene by one method, with several seeds."""

    name = "variability"
    metrics = metrics_of("variability.")
    edits = True
    study_keys = frozenset({"size", "views", "seeds", "spp", "editing"})
    shared = editing.EditingProbe.shared

    def check(self, study: Study) -> None:
        """One seed varies from no other, and a method that was cut short varies with the clock."""
        if self.name not in study.probes:
            return
        if len(study.seeds) < 2:
            raise ValueError(
                f"seeds: got {study.seeds}, expected at least 2 for probes.{self.name}"
            )
        for name in study.probes[self.name]:
            if study.variants[name].part(editing.VariantPart).budget is not None:
                raise ValueError(
                    f"probes.{self.name}: {name!r} has a budget; name a variant without one"
                )

    def reads(self, study: Study, variant: Variant) -> Set[str]:
        """A method of editing."""
        return editing.EditingProbe().reads(study, variant)

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene, edit and variant."""
        first = study.seeds[0]
        edit_probe = editing.EditingProbe()
        for name, scene in scenes.items():
            for label, edit in itertools.product(names, list(editing.edits_of(study, scene))):
                variant = study.variants[label]
                spec = {
                    **self.common_spec(study, scene, first),
                    **edit_probe.variant_spec(study, variant, first),
                    "seeds": list(study.seeds),
                    "edit": edit,
                }
                views = study.pictures_of(spec["views"], label)
                yield Cell(
                    spec, name, label, self.name, first, (label,),
                    tuple(f"{edit['name']}/{view}" for view in views),
                    {"editor": editing.editor_of(study, variant).name},
                )  # fmt: skip

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Those of a method of editing."""
        return editing.EditingProbe().meaning(study, variant)

    def alike(self, study: Study, variant: Variant, wanted: Variant) -> bool:
        """Compare as the editing probe does: a claim may leave a method's own settings out."""
        return editing.EditingProbe().alike(study, variant, wanted)

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
            own = {**spec, "settings": {**spec["settings"], "seed": seed}}
            result = editing.run_method(
                replace(work, cell=replace(work.cell, spec=own)), truth, names, before
            )
            edited[seed] = {
                names[k]: enlarged_change(
                    truth.originals[names[k]], pixels.astype(np.float32) / np.float32(255)
                )
                for k, pixels in result.edited.items()
            }
            for part, seconds in result.seconds.items():
                meter.add(f"method: {part}", seconds)
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
            BETWEEN: _mean(_difference(a, b, mask) for a, b in itertools.combinations(own, 2)),
            CHANGE: _mean(_difference(image, originals[view], mask) for image in own),
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
            figures = [interval(_lists(table)) for table in (change, between, disagreement, excess)]
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


def _difference(a: Image, b: Image, mask: npt.NDArray[np.bool_]) -> float:
    """Mean CIEDE2000 of two (H, W, 3) sRGB pictures inside a mask; NaN where it is empty."""
    from skimage.color import deltaE_ciede2000, rgb2lab

    if not mask.any():
        return math.nan
    return float(deltaE_ciede2000(rgb2lab(a[mask]), rgb2lab(b[mask])).mean())


def _mean(values: Iterable[Any]) -> float:
    defined = [float(value) for value in values if math.isfinite(value)]
    return sum(defined) / len(defined) if defined else math.nan


def _lists(table: Mapping[str, Mapping[str, float]]) -> dict[str, list[float]]:
    return {scene: list(values.values()) for scene, values in table.items()}
