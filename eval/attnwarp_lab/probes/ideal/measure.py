"""An edit in parts by the ideal editor, against the answers of its source.

Views of a record are named ``parts/view``. Figures end in ``.edit`` for the edited views and in
``.render`` for renders of the edited splats.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Study
from attnwarp_eval.study.shared.drifts import DriftPart
from attnwarp_eval.study.shared.edit_truth import EditTruth
from attnwarp_eval.study.shared.editing_methods import Donor
from attnwarp_eval.study.shared.edits import (
    MethodProbe,
    VariantPart,
    noise_seed,
)
from attnwarp_eval.study.shared.method_run import other_world, own_seconds, run_method
from attnwarp_eval.study.shared.splats import splats_of
from attnwarp_eval.study.shared.things import thing_of
from attnwarp_eval.two_view import HIDDEN
from attnwarp_eval.world import World
from attnwarp_lab.ideal.figures import fill_figures, part_answers, part_figures
from attnwarp_lab.ideal.paint import EDIT
from attnwarp_lab.ideal.recorded import EditorResult, with_ideal_editor
from attnwarp_lab.ideal.share import alone, solve_share
from attnwarp_lab.ideal.thing import Thing, in_front

Image = npt.NDArray[np.float32]

UNABLE = ("dge", "gaussctrl", "fused")
"""Methods that need an editor's attention or guidance, neither of which the ideal editor has."""


@dataclass(frozen=True)
class IdealResult(EditorResult):
    """Those of an edit in parts.

    Attributes:
        part_share: mean share of a view's pixels covered by a part, over views that show it.
        edited: number of edited views.
    """

    entry = "ideal"
    part_share: float
    edited: int


@register
class IdealProbe(MethodProbe[IdealResult]):
    """One edit of a thing in parts by one method and the ideal editor."""

    name = "ideal"
    protocol = 2
    metrics = metrics_of("parts.", "edit.drift")

    def check(self, study: Study) -> None:
        """Require the ideal editor for every variant, and a method that it supports."""
        for name, variant in with_ideal_editor(study, self.name):
            own = variant.part(VariantPart)
            if own.method in UNABLE:
                raise ValueError(
                    f"probes.{self.name}: method {own.method!r} of {name!r} changes attention"
                    " or guidance, which the ideal editor has none of; leave it out"
                )

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each scene, variant and seed."""
        for name, scene in scenes.items():
            thing = thing_of(study, scene)
            for label in names:
                other, files = self.other_scene(study, study.variants[label], name, scenes)
                for seed in study.seeds:
                    spec = {
                        **self.common_spec(study, scene, seed),
                        **self.variant_spec(study, study.variants[label], noise_seed(scene, seed)),
                        **other,
                        "thing": thing,
                    }
                    yield Cell(spec, name, label, self.name, seed, (label,), sources=files)

    def of_other_scene(self, study: Study, scene: Scene) -> Json:
        """Entries for the other scene's thing."""
        return {"thing": thing_of(study, scene)}

    def compute(self, work: Work) -> IdealResult:
        """Solve the share, edit the scene, and measure every target."""
        spec, world, meter = work.spec, work.world, work.meter
        ideal, names = spec["editor"]["ideal"], [world.source.name, *spec["views"]]
        with meter.stage("truth"):
            thing = _thing(
                world, tuple(names), tuple(spec["thing"]), ideal["parts"], ideal["colors"],
                spec["spp"],
            )  # fmt: skip
        with meter.stage("setup"):
            steps = spec["settings"]["steps"]
            # One answer is known from the beginning.
            several = ideal["colors"] > 1
            share = solve_share(thing.grams, ideal["settled"], steps) if several else 1.0
            checked = alone(thing.grams, share, steps)
            shown = thing
            if "drift" in spec:
                drift = DriftPart(**spec["drift"])
                shown = thing.moved(lambda before: drift.motion(before, spec["seed"]))
            editor = shown.editor(share, ideal["cross"])
            donor = self._donor(work, share)
        with meter.stage("splats"):
            before = splats_of(work)
        # They have no effect; the method requires some.
        words = {"instruction": EDIT, "target": EDIT, "source": world.scene.title}
        result = run_method(
            work, _truth(thing), names, before, editor=editor, donor=donor, words=words
        )
        meter.add("whole", own_seconds(result))
        with meter.stage("checks"):
            edited: dict[str, Image] = {
                names[k]: picture.astype(np.float32) / np.float32(255)
                for k, picture in result.edited.items()
            }
            pictures = {"edit": edited}
            if spec["settings"]["iterations"]:  # else the scene is unchanged
                pictures["render"] = _renders(world, names, before, result.gaussians)
            answers = part_answers(edited[names[0]], thing.truth(names[0]), thing.parts)
            answered = {v: part_answers(edited[v], thing.truth(v), thing.parts) for v in names[1:]}
            fill = fill_figures(answered, answers)
            for name in names[1:]:
                row = self._figures(world, thing, name, pictures, answers)
                row |= {f"{key}.edit": value for key, value in fill[name].items()}
                work.add(f"parts/{name}", row | {"edit.drift": result.drift})
        inside = [labels[labels >= 0] for labels in thing.labels.values()]
        counts = [np.unique(own, return_counts=True)[1] for own in inside]
        return IdealResult(
            share, checked.settled, checked.frequencies, checked.agreement, checked.fault(),
            tuple(int(answer) for answer in answers),
            float(np.concatenate(counts).mean()) / spec["size"] ** 2, len(edited),
        )  # fmt: skip

    def _donor(self, work: Work, share: float) -> Donor | None:
        """The other scene's source with an editor of its answers; None without one."""
        other = other_world(work)
        if other is None:
            return None
        spec, name = work.spec, other.source.name
        ideal = spec["editor"]["ideal"]
        thing = _thing(
            other, (name,), tuple(spec["other"]["thing"]), ideal["parts"], ideal["colors"],
            spec["spp"],
        )  # fmt: skip
        return Donor(thing.editor(share, ideal["cross"]), thing.before[name])

    def _figures(
        self,
        world: World,
        thing: Thing,
        name: str,
        pictures: Mapping[str, Mapping[str, Image]],
        answers: npt.NDArray[np.int64],
    ) -> dict[str, float]:
        pair = world.pair(name, world.source.width)
        front = in_front(pair, thing.labels[world.source.name])
        row: dict[str, float] = {}
        for kind, images in pictures.items():
            if name in images:
                figures = part_figures(
                    images[name], thing.truth(name), answers, pair.visible, pair.label == HIDDEN,
                    front,
                )  # fmt: skip
                row |= {f"{key}.{kind}": value for key, value in figures.items()}
        return row

    def read_extra(self, data: Json) -> IdealResult:
        """Read from the record's entry ``ideal``."""
        return IdealResult.from_json(data)


def _thing(
    world: World,
    names: tuple[str, ...],
    objects: tuple[str, ...],
    parts: int,
    colors: int,
    spp: int,
) -> Thing:
    """The thing of a scene, which all variants share; kept as long as its world."""
    key = ("thing", names, objects, parts, colors, spp)
    if key not in world.made:
        cameras = [world.camera(name) for name in names]
        world.made[key] = Thing.of(
            world.scene, world.geometry, cameras, objects, parts=parts, colors=colors, spp=spp
        )
    thing: Thing = world.made[key]
    return thing


def _truth(thing: Thing) -> EditTruth:
    """The thing's true pictures for a method: the whole thing in one answer."""
    masks = {name: labels >= 0 for name, labels in thing.labels.items()}
    count = len(next(iter(thing.after.values())))
    answers = {
        str(k): {name: after[k] for name, after in thing.after.items()} for k in range(count)
    }
    return EditTruth(thing.before, answers, dict.fromkeys(answers, masks), masks)


def _renders(world: World, names: Sequence[str], before: Any, after: Any) -> dict[str, Image]:
    from attnwarp.methods.scene import near_of
    from attnwarp.render import render

    cameras = [world.camera(name) for name in names]
    near = near_of(cameras, before)
    with torch.no_grad():
        return {
            name: np.asarray(render(after, camera, near=near).color.clamp(0, 1).float().numpy())
            for name, camera in zip(names, cameras, strict=True)
        }
