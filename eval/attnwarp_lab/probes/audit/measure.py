"""Figures of right edits, and of the same edits with one flaw of known size.

A pair is the source and a target turned by some yaw. Figures are named ``metric.condition``: the
conditions are :data:`~attnwarp_lab.probes.audit.flaws.CONDITIONS`, the right pairs of
:data:`~attnwarp_lab.probes.audit.views.PAIRS`, and ``arm=NAME``, real edits by the study's
variants. A figure of a whole set of views, in which every second target has the flaw, is repeated
under each view. Figures that need the truth are recorded next to those that do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from time import perf_counter
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.warp import Surface, WarpedView, render_surface, warp_view
from attnwarp_eval.cost import Meter, in_turn
from attnwarp_eval.metrics.arrays import Array
from attnwarp_eval.metrics.refit import refit
from attnwarp_eval.scene.edits import pick
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Part, Splats, Study, check_distinct
from attnwarp_eval.study.shared.edit_figures import full_size
from attnwarp_eval.study.shared.edit_truth import EditTruth
from attnwarp_eval.study.shared.edits import MethodProbe, editor_of, scene_seed
from attnwarp_eval.study.shared.encoders import (
    EncodersPart,
    encoder_identities,
    encoder_sources,
    loaded,
)
from attnwarp_eval.study.shared.fits import fit_of, fit_spec
from attnwarp_eval.study.shared.method_run import run_method
from attnwarp_eval.world import splats
from attnwarp_lab.ideal.figures import PartTruth
from attnwarp_lab.ideal.share import solve_share
from attnwarp_lab.ideal.thing import Thing
from attnwarp_lab.probes.audit.figures import Measure, Pair, Shown
from attnwarp_lab.probes.audit.flaws import CONDITIONS
from attnwarp_lab.probes.audit.scores import digest_of, keep, scores_of
from attnwarp_lab.probes.audit.views import (
    PAIRS,
    Pictures,
    answered_thing,
    edit_of_others,
    edited_view,
    ideal_thing,
    some_answers,
    true_pictures,
)

ARM = "arm="
"""Begin of a condition of a real edit."""

REFIT_SIZE = 128
"""Side in px of the pictures to which splats' colours are fitted."""


class Audit(Part):
    """Edits and views.

    ``edits``: edits with at least two answers. ``yaws``: degrees of the targets from the source.
    ``splats``: the scene before the edit, with rendered depth; with ``fitted``, splats fitted to
    its true pictures stand beside it. ``scores``: file of scores, and ``pictures``: whether the run
    keeps the pictures that they are of (:mod:`attnwarp_lab.probes.audit.scores`).
    """

    edits: Annotated[list[str], Field(min_length=1)] = Field(default_factory=lambda: ["parts"])
    yaws: Annotated[list[Annotated[float, Field(ge=-180, le=180)]], Field(min_length=1)] = Field(
        default_factory=lambda: [2.0, 10.0, 30.0, 60.0, 120.0]
    )
    splats: Splats = Splats(kind="2d", count=16_000, position_noise=0.1, normal_noise=3.0)
    fitted: bool = False
    scores: str | None = None
    pictures: bool = False

    @model_validator(mode="after")
    def _check_yaws(self) -> Audit:
        check_distinct(self.yaws, "audit.yaws")
        if 0 in self.yaws:
            raise ValueError("audit.yaws: got 0, which the source has; leave it out")
        return self


class StudyPart(EncodersPart):
    """Keys of a study for this probe."""

    audit: Audit = Audit()


@dataclass(frozen=True)
class Seconds:
    """Seconds of one judgement, by metric and round, taken in turn."""

    seconds: Mapping[str, list[float]]

    def to_json(self) -> Json:
        """The entry ``rounds`` of the record's cost."""
        return {"cost": {"rounds": dict(self.seconds)}} if self.seconds else {}


@register
class AuditProbe(MethodProbe[Seconds]):
    """Audit with one cell per scene, edit and seed: all metrics judge the same pictures.

    The study's variants are real edits, ranked within a scene.
    """

    name = "audit"
    protocol = 4
    whole = True
    study_part = StudyPart
    metrics = metrics_of("consistency.", "embedding.", "multiview.")
    judges_variants = False

    def read_extra(self, data: Json) -> Seconds:
        """Read from the record's cost."""
        rounds = data["cost"].get("rounds", {})
        return Seconds({key: [float(v) for v in values] for key, values in rounds.items()})

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each scene, edit and seed, with the next scene as the other scene."""
        part = study.part(StudyPart)
        identities = encoder_identities(part)
        files = dict(zip(study.scene_names, study.scenes, strict=True))
        order = list(scenes)
        settings = part.audit.model_dump(exclude={"edits", "scores", "fitted"})
        scored = {} if part.audit.scores is None else {"scores": digest_of(part.audit.scores)}
        arms = {name: study.variants[name] for name in study.probes.get(self.name, ())}
        for (place, (name, scene)), edit in product(enumerate(scenes.items()), part.audit.edits):
            neighbour = order[(place + 1) % len(order)]
            for seed in study.seeds:
                own = scene_seed(study, name, seed)
                fit = fit_spec(study, None, seed) if part.audit.fitted else None
                spec = {
                    "probe": self.name,
                    "protocol": self.protocol,
                    "scene": scene.content_hash,
                    "other": scenes[neighbour].content_hash if neighbour != name else None,
                    "size": study.size,
                    "seed": seed,
                    "spp": study.spp,
                    "rounds": study.timing_rounds,
                    "encoders": identities,
                    **settings,
                    **scored,
                    "edit": edit,
                    "answers": some_answers(scene, edit),
                    "other_edit": edit_of_others(scene, edit),
                    "fit": fit,
                    "arms": {a: self.variant_spec(study, v, own) for a, v in arms.items()},
                }
                editors = {f"editor of {a}": editor_of(study, v).name for a, v in arms.items()}
                sources = {**encoder_sources(part), **editors, "other": files[neighbour]}
                sources |= {"scores": part.audit.scores} if part.audit.scores else {}
                yield Cell(spec, name, edit, self.name, seed, (edit,), sources=sources)

    def compute(self, work: Work) -> Seconds:
        """Compute every metric on every condition at every yaw."""
        spec, world, meter = work.spec, work.world, work.meter
        with meter.stage("setup"):
            encoders = loaded(work.cell.sources, spec["encoders"])
        with meter.stage("truth"):
            cameras, pictures = true_pictures(work)
            views = [world.source, *cameras]
            edited = [edited_view(world, spec, pictures, c, place) for place, c in enumerate(views)]
            thing = answered_thing(world, spec, pictures, views)
        with meter.stage("splats"):
            settings = spec["splats"]
            models = {
                "sampled": splats(work.cell.scene_file, spec["size"], spec["seed"], **settings)
            }
            if spec["fit"] is not None:
                models["fitted"] = fit_of(work).gaussians
        # By condition, the pictures of all views.
        with meter.stage("truth"):
            judged: dict[str, list[Array]] = {
                state: [pictures[state][camera.name] for camera in views] for state in PAIRS
            }
            for name, (flaw, size) in CONDITIONS.items():
                made = [flaw.make(view, size) for view in edited]
                if not flaw.alike:
                    made[0] = judged["right"][0]
                if all(picture is not None for picture in made):
                    judged[name] = [picture for picture in made if picture is not None]
        things = dict.fromkeys(judged, thing)
        with meter.stage("arms"):
            ideal_of = cache(partial(ideal_thing, world, spec["edit"], spec["spp"], tuple(views)))
            for name, arm in spec["arms"].items():
                ideal = arm["editor"].get("ideal")
                own = thing if ideal is None else ideal_of(ideal["parts"], ideal["colors"])
                things[f"{ARM}{name}"] = own
                judged[f"{ARM}{name}"] = _edits(work, name, own, models["sampled"], pictures)
        if spec["pictures"]:
            keep(work.root, work.cell, judged, [camera.name for camera in views])
        of_sets, seconds = self._of_sets(work, judged, views, models, encoders)
        scores = scores_of(work.cell)
        shown = {
            state: {name: Shown(picture, encoders) for name, picture in of_views.items()}
            for state, of_views in pictures.items()
        }
        sources: dict[int, Shown] = {id(judged[s][0]): shown[s][world.source.name] for s in PAIRS}
        source_of = {
            name: sources.setdefault(id(of[0]), Shown(of[0], encoders))
            for name, of in judged.items()
        }
        surfaces = {kind: render_surface(model, world.source) for kind, model in models.items()}
        for place, (camera, view) in enumerate(zip(cameras, edited[1:], strict=True)):
            warps = {
                kind: partial(_warp, model, world.source, camera, surfaces[kind])
                for kind, model in models.items()
            }
            before, *right = (
                (shown[state][world.source.name], shown[state][camera.name])
                for state in ("before", *PAIRS)
            )
            names = (world.source.name, camera.name)
            pair = Pair(
                view.pair, view.mask, warps, before, dict(right),
                (_answered(thing, names[0]), _answered(thing, names[1])), encoders, texts(work),
            )  # fmt: skip
            pairs = {
                one: replace(pair, labels=(_answered(one, names[0]), _answered(one, names[1])))
                for one in set(things.values())
            }
            targets = {state: target for state, (_, target) in zip(PAIRS, right, strict=True)}
            with meter.stage("checks"):
                figures = dict(of_sets)
                for name, of in judged.items():
                    target = targets.get(name) or Shown(of[place + 1], encoders)
                    for key, measure in pair.measures.items():
                        figures[f"{key}.{name}"] = measure(
                            pairs[things[name]], source_of[name], target
                        )
                    for key, of_score in scores.items():
                        value = of_score.get((name, *names), math.nan)
                        figures[f"{key}.{name}"] = value
            meter.count(pictures=len(judged))
            if place == len(cameras) // 2:
                fresh = {
                    kind: partial(_warp, model, world.source, camera)
                    for kind, model in models.items()
                }
                with meter.stage("rounds"):
                    seconds |= _rounds(pair, fresh, spec)
            work.add(camera.name, figures)
        return Seconds(seconds)

    def _of_sets(
        self,
        work: Work,
        judged: Mapping[str, Sequence[Array]],
        views: Sequence[Camera],
        models: Mapping[str, Gaussians],
        encoders: Mapping[str, Any],
    ) -> tuple[dict[str, float], dict[str, list[float]]]:
        """Figures of all views together, by figure and condition, and the seconds of a set.

        In a set with a flaw of one view, every second target has it; so those held out have none.
        """
        sets = {
            name: [
                judged["right"][k] if is_alone(name) and k % 2 == 0 else picture
                for k, picture in enumerate(of)
            ]
            for name, of in judged.items()
        }
        figures: dict[str, float] = {}
        seconds: dict[str, list[float]] = {}
        with work.meter.stage("sets"):
            for kind, model in models.items():
                end = "" if kind == "sampled" else f".{kind}"
                found, taken = _refitted(model, views, sets, encoders)
                figures |= {f"{key}{end}.{name}": value for (key, name), value in found.items()}
                seconds |= {f"{key}{end}": [taken] for key in {key for key, _ in found}}
        return figures, seconds


def is_alone(condition: str) -> bool:
    """Return True for a flaw of the target view alone."""
    return condition in CONDITIONS and not CONDITIONS[condition][0].alike


def texts(work: Work) -> tuple[str, str]:
    """Descriptions of the source and of the first answer."""
    edit = work.world.scene.edit(work.spec["edit"])
    answer = pick(edit, work.spec["answers"][0][0])
    return edit.source, edit.target if answer is None else answer.target


def _answered(thing: Thing, view: str) -> PartTruth:
    """True answers of a view; the first is the picture before the edit."""
    before, after = thing.before[view], thing.after[view]
    labels = thing.labels[view]
    return PartTruth(before, np.concatenate([before[None], after]), labels, labels < 0)


def _edits(work: Work, arm: str, thing: Thing, model: Gaussians, pictures: Pictures) -> list[Array]:
    """All views, edited by an arm; a view that it leaves out stays as it was."""
    spec = work.spec["arms"][arm]
    names = list(thing.before)
    edit = work.world.scene.edit(work.spec["edit"])
    words = {"instruction": edit.instruction, "source": edit.source, "target": texts(work)[1]}
    shared = {key: work.spec[key] for key in ("scene", "size", "seed")}
    cell = replace(
        work.cell, spec={**shared, **spec, "edit": words},
        sources={**work.cell.sources, "editor": work.cell.sources[f"editor of {arm}"]},
    )  # fmt: skip
    editor = None
    if (ideal := spec["editor"].get("ideal")) is not None:
        share = solve_share(thing.grams, ideal["settled"], spec["settings"]["steps"])
        editor = thing.editor(share, ideal["cross"])
    masks = {name: labels >= 0 for name, labels in thing.labels.items()}
    answers = {
        str(k): {name: after[k] for name, after in thing.after.items()}
        for k in range(len(work.spec["answers"]))
    }
    truth = EditTruth(thing.before, answers, dict.fromkeys(answers, masks), masks)
    other = Work(cell, work.root, work.scene_world, Meter())
    result = run_method(other, truth, names, model, editor=editor)
    return [
        full_size(thing.before[name], result.edited[k]).astype(np.float64)
        if k in result.edited
        else pictures["before"][name]
        for k, name in enumerate(names)
    ]


def _refitted(
    model: Gaussians,
    cameras: Sequence[Camera],
    sets: Mapping[str, Sequence[Array]],
    encoders: Mapping[str, Any],
) -> tuple[dict[tuple[str, str], float], float]:
    """Figures of splats whose colours are fitted to each set, and seconds of a set.

    Every second target is held out, from the second on.
    """
    import cv2

    size = tuple(min(REFIT_SIZE, side) for side in (cameras[0].width, cameras[0].height))
    small = {
        name: [cv2.resize(one, size, interpolation=cv2.INTER_AREA).clip(0, 1) for one in of]
        for name, of in sets.items()
    }
    held = range(2, len(cameras), 2)
    start = perf_counter()
    results = refit(model, [c.resize(*size) for c in cameras], list(small.values()), held)
    figures: dict[tuple[str, str], float] = {}
    for (name, of), found in zip(small.items(), results, strict=True):
        figures["consistency.fitted_psnr", name] = found.fitted
        figures["consistency.held_psnr", name] = found.held_out
        if "perceptual" in encoders and held:
            distances = encoders["perceptual"].distance(
                [of[view].astype(np.float32) for view in held], [found.renders[v] for v in held]
            )
            figures["consistency.held_distance", name] = float(np.mean(distances))
    return figures, (perf_counter() - start) / len(sets)


def _warp(
    model: Gaussians, source: Camera, target: Camera, surface: Surface | None = None
) -> WarpedView:
    """The warp by rendered depth; ``surface`` is the source's, by default rendered."""
    return warp_view(model, source, target, source_surface=surface, warn_empty=False)


def _rounds(
    pair: Pair, warps: Mapping[str, Callable[[], WarpedView]], spec: Json
) -> dict[str, list[float]]:
    """Seconds of each metric for one pair, in turn, in a random order each round.

    All inputs of a metric from the four pictures are recomputed: keypoints, embeddings, flow,
    the depth of both views. Truth is not timed.
    """

    def work(measure: Measure) -> Callable[[int], float]:
        def run(turn: int) -> float:
            new = pair.again(warps)
            return measure(new, *next(iter(new.partners.items())))

        return run

    works = [work(measure) for measure in pair.measures.values()]
    turns = in_turn(works, spec["rounds"], seed=spec["seed"])
    return dict(zip(pair.measures, turns.seconds, strict=True))
