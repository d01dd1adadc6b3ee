"""Sensitivity of metrics: every metric on right results of an edit and on flawed ones.

A metric that ranks the right result above the flawed one sees that flaw. One that ranks them at
random is blind to it, and one that prefers the flaw moves the wrong way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from attnwarp_eval import metrics
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.cost import in_turn
from attnwarp_eval.metrics.arrays import Array
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.flawed_edits import CONDITIONS, RIGHT, Shot, Task, shots_of, tasks
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.schema import Study, StudyError, check_distinct, did_you_mean
from attnwarp_eval.study.shared.encoders import (
    EncodersPart,
    MetricsProbe,
    Seconds,
    encoder_identities,
    encoder_sources,
    loaded,
)
from attnwarp_eval.two_view import TwoView

FIDELITY = (
    *(
        f"fidelity.{name}{place}"
        for place in ("", ".inside")
        for name in ("mse", "psnr", "ssim", "distance")
    ),
    *(f"fidelity.preserved_{name}" for name in ("mse", "psnr", "ssim", "distance")),
)
"""Figures of :func:`attnwarp_eval.metrics.fidelity` that a record has."""

CONSISTENCY = ("consistency.delta_e", "consistency.rmse_srgb", "consistency.pixels")
"""Figures of :func:`attnwarp_eval.metrics.cross_view` that a record has: of the edited object,
against the source view.
"""


class StudyPart(EncodersPart):
    """Keys of a study that only this probe reads."""

    edits: list[str] = Field(
        default_factory=list, description="edits by name; all of a scene's if empty"
    )

    @model_validator(mode="after")
    def _check_edits(self) -> StudyPart:
        check_distinct(self.edits, "edits")
        return self


@register
class Sensitivity(MetricsProbe):
    """One cell for all metrics of a scene: they judge the same pictures, and run in turn.

    A view of a record is named ``task/target``, a figure ``metric.condition``.
    """

    name = "sensitivity"
    study_part = StudyPart
    metrics = metrics_of("fidelity.", "consistency.", "embedding.")

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene and seed."""
        part = study.part(StudyPart)
        identities = encoder_identities(part)
        available = dict.fromkeys(edit.name for scene in scenes.values() for edit in scene.edits)
        for edit in part.edits:
            if edit not in available:
                raise StudyError(
                    f"edits: no scene has an edit {edit!r}{did_you_mean(edit, available)}"
                )
        for name, scene in scenes.items():
            for seed in study.seeds:
                spec = {
                    **self.common_spec(study, scene, seed),
                    "spp": study.spp,
                    "rounds": study.timing_rounds,
                    "encoders": identities,
                    "tasks": [task.to_dict() for task in _tasks_of(scene, part.edits)],
                }
                yield Cell(
                    spec, name, "metrics", self.name, seed, ("metrics",),
                    sources=encoder_sources(part),
                )  # fmt: skip

    def compute(self, work: Work) -> Seconds:
        """Every metric on every condition of every task; metrics without an encoder are left
        out.
        """
        spec, world, meter = work.spec, work.world, work.meter
        with meter.stage("setup"):
            encoders = loaded(work.cell.sources, spec["encoders"])
        seconds: dict[str, list[float]] = {}
        for index, task in enumerate(map(Task.from_dict, spec["tasks"])):
            with meter.stage("truth"):
                shots = shots_of(world, task, spec)
                source_shot = shots[world.source.name]
                source = {c.name: c.picture(source_shot, spec["seed"]) for c in CONDITIONS}
            prompts = _Prompts(task, source[RIGHT], encoders)
            for name in spec["views"]:
                with meter.stage("truth"):
                    pair = world.pair(name, spec["size"])
                    shot = shots[name]
                    pictures = {c.name: c.picture(shot, spec["seed"]) for c in CONDITIONS}
                    view = _View(pair, shot, source_shot)
                with meter.stage("checks"):
                    measured: dict[str, float] = {}
                    for condition, picture in pictures.items():
                        if picture is not None:
                            values = view.figures(
                                source[condition], picture, encoders.get("perceptual")
                            )
                            measured |= {f"{key}.{condition}": v for key, v in values.items()}
                    measured |= prompts.figures(view.original, pictures)
                    keys = {key.rpartition(".")[0] for key in measured}
                    for condition, picture in pictures.items():
                        if picture is None:  # undefined, and counted as such
                            measured |= {f"{key}.{condition}": math.nan for key in keys}
                meter.count(pictures=len(pictures))
                if index == 0 and name == spec["views"][0]:
                    with meter.stage("rounds"):
                        seconds = _rounds(
                            view, prompts, source["noisy"], pictures["noisy"], encoders, spec
                        )
                work.add(f"{task.name}/{name}", measured)
        return Seconds(seconds)


def _tasks_of(scene: Scene, edits: Sequence[str]) -> list[Task]:
    available = [edit.name for edit in scene.edits]
    if not available:
        raise StudyError(
            f"probes.sensitivity: scene {scene.name!r} names no edits, so there is no right"
            " result; leave it out, or give it some (docs/truth/scenes.md)"
        )
    selected = tasks(scene, edits)
    if not selected:
        raise StudyError(
            f"edits: scene {scene.name!r} has none of {', '.join(edits)}; there are"
            f" {', '.join(available)}"
        )
    return selected


class _View:
    """A view with what metrics need to judge a picture of it."""

    def __init__(self, pair: TwoView, shot: Shot, source: Shot) -> None:
        self.pair = pair
        self.mask = shot.mask
        self.original, self.truth = to_srgb(shot.before), to_srgb(shot.after)
        # What rightly differs between two views, before the edit or after it: highlights and
        # reflections.
        self.exclude = metrics.view_dependent(to_srgb(source.before), self.original, pair)
        self.exclude |= metrics.view_dependent(to_srgb(source.after), self.truth, pair)

    def figures(self, source: Array | None, picture: Array, perceptual: Any) -> dict[str, float]:
        """Fidelity and consistency of a picture."""
        distance = None if perceptual is None else _distance(perceptual)
        against = metrics.fidelity(
            picture, self.truth, self.mask, original_srgb=self.original, distance=distance
        )
        between = self.consistency(source, picture)
        return {
            **{key: against[key] for key in FIDELITY if key in against},
            **{key: between[key] for key in CONSISTENCY},
        }

    def consistency(self, source: Array | None, picture: Array) -> dict[str, float]:
        """Consistency of the edited object in the picture and in the source view of the same
        result.
        """
        return metrics.cross_view(
            source, picture, self.pair, mask=self.mask, exclude=self.exclude
        ).figures()


def _distance(perceptual: Any) -> Callable[[Array, Array], float]:
    return lambda a, b: float(perceptual.distance([a], [b])[0])


class _Prompts:
    """Embeddings of a task's prompts and of its edited source view, computed once."""

    def __init__(self, task: Task, source_edit: Array | None, encoders: Mapping[str, Any]) -> None:
        self.clip, self.dino = encoders.get("clip"), encoders.get("dino")
        if self.clip is not None:
            self.before, self.after = self.clip.texts([task.source, task.target])
            self.clip_source = self.clip.images([source_edit])
        if self.dino is not None:
            self.dino_source = self.dino.images([source_edit])

    def figures(self, original: Array, pictures: Mapping[str, Array | None]) -> dict[str, float]:
        """``embedding.*.condition`` of all conditions that have a picture."""
        available = {
            condition: picture for condition, picture in pictures.items() if picture is not None
        }
        similarities: dict[str, Array] = {}
        if self.clip is not None:
            *images, unedited = self.clip.images([*available.values(), original])
            images = np.stack(images)
            similarities["clip_similarity"] = metrics.clip_similarity(images, self.after).values
            befores = np.broadcast_to(unedited, images.shape)
            similarities["clip_directional"] = metrics.directional_similarity(
                befores, images, self.before, self.after
            ).values
            similarities["clip_image"] = metrics.image_similarity(self.clip_source, images).values
        if self.dino is not None:
            similarities["dino_image"] = metrics.image_similarity(
                self.dino_source, self.dino.images(list(available.values()))
            ).values
        return {
            f"embedding.{name}.{condition}": float(value)
            for name, values in similarities.items()
            for condition, value in zip(available, values, strict=True)
        }


def _rounds(
    view: _View,
    prompts: _Prompts,
    source: Array | None,
    picture: Array | None,
    encoders: Mapping[str, Any],
    spec: Mapping[str, Any],
) -> dict[str, list[float]]:
    """Seconds that one picture costs each metric, in turn in an order drawn anew each round; a
    first round does not count.

    What is made once for all pictures is in none of them: truth, correspondences, and the
    embeddings of the prompts, of the edited source view and of the view before the edit.
    """
    contestants: dict[str, Callable[[], Any]] = {
        "fidelity.mse": lambda: metrics.mse(picture, view.truth),
        "fidelity.ssim": lambda: metrics.ssim(picture, view.truth),
        "consistency.delta_e": lambda: view.consistency(source, picture),  # type: ignore[arg-type]
    }
    if (perceptual := encoders.get("perceptual")) is not None:
        contestants["fidelity.distance"] = lambda: perceptual.distance([picture], [view.truth])
    if (clip := prompts.clip) is not None:
        before = clip.images([view.original])
        contestants["embedding.clip_similarity"] = lambda: metrics.clip_similarity(
            clip.images([picture]), prompts.after
        )
        contestants["embedding.clip_directional"] = lambda: metrics.directional_similarity(
            before, clip.images([picture]), prompts.before, prompts.after
        )
        contestants["embedding.clip_image"] = lambda: metrics.image_similarity(
            prompts.clip_source, clip.images([picture])
        )
    if (dino := prompts.dino) is not None:
        contestants["embedding.dino_image"] = lambda: metrics.image_similarity(
            prompts.dino_source, dino.images([picture])
        )
    works = [lambda _, work=work: work() for work in contestants.values()]
    turns = in_turn(works, spec["rounds"], seed=spec["seed"])
    return dict(zip(contestants, turns.seconds, strict=True))
