"""Figures of right edits, and of the same edits with one flaw of known size.

A pair is the source and a target turned by some yaw. Figures are named ``metric.condition``: the
conditions are :data:`~attnwarp_lab.probes.audit.flaws.CONDITIONS`, and the right pairs of
:data:`~attnwarp_lab.probes.audit.views.PAIRS`. A figure of a whole set of views, in which
every second target has the flaw, is repeated under each view. Figures that need the truth are
recorded next to those that do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Annotated

from pydantic import Field, model_validator

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.warp import Surface, WarpedView, render_surface, warp_view
from attnwarp_eval import metrics
from attnwarp_eval.cost import in_turn
from attnwarp_eval.metrics.arrays import Array
from attnwarp_eval.scene.edits import pick
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Probe, Work, metrics_of, register
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Part, Splats, Study, check_distinct
from attnwarp_eval.study.shared.encoders import (
    EncodersPart,
    encoder_identities,
    encoder_sources,
    loaded,
)
from attnwarp_eval.world import splats
from attnwarp_lab.probes.audit.figures import Measure, Pair, Shown
from attnwarp_lab.probes.audit.flaws import CONDITIONS, COUNTED, ELSEWHERE, Edited
from attnwarp_lab.probes.audit.refit import refit_psnr
from attnwarp_lab.probes.audit.views import (
    PAIRS,
    Pictures,
    edit_of_others,
    edited_view,
    true_pictures,
    two_answers,
)

REFIT_SIZE = 128
"""Side in px of the pictures to which splats' colours are fitted."""

IN_SETS = {flaw.key(flaw.reference): flaw for flaw in (*COUNTED, ELSEWHERE)}
"""Flaws of sets of views: a reconstruction takes too long for all of them."""


class Audit(Part):
    """Edit and views.

    ``edit``: an edit with at least two answers. ``yaws``: degrees of the targets from the source.
    ``splats``: the scene before the edit, with rendered depth. ``colmap``: whether COLMAP
    reconstructs all views, too; needs pycolmap.
    """

    edit: str = "parts"
    yaws: Annotated[list[Annotated[float, Field(ge=-180, le=180)]], Field(min_length=1)] = Field(
        default_factory=lambda: [2.0, 10.0, 30.0, 60.0, 120.0]
    )
    splats: Splats = Splats(kind="2d", count=16_000, position_noise=0.1, normal_noise=3.0)
    colmap: bool = False

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
class AuditProbe(Probe[Seconds]):
    """Audit with one cell per scene and seed: all metrics judge the same pictures."""

    name = "audit"
    protocol = 3
    study_part = StudyPart
    metrics = metrics_of("consistency.", "embedding.", "multiview.", "fidelity.preserved_")
    judges_variants = False

    def check(self, study: Study) -> None:
        """Refuse variants, which would change no metric."""
        if study.probes.get(self.name):
            raise ValueError(
                "probes.audit: got variants, expected []; it judges metrics, which no variant"
                " changes"
            )

    def read_extra(self, data: Json) -> Seconds:
        """Read from the record's cost."""
        rounds = data["cost"].get("rounds", {})
        return Seconds({key: [float(v) for v in values] for key, values in rounds.items()})

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each scene and seed, with the next scene as the other scene."""
        part = study.part(StudyPart)
        identities = encoder_identities(part)
        files = dict(zip(study.scene_names, study.scenes, strict=True))
        order = list(scenes)
        for place, (name, scene) in enumerate(scenes.items()):
            neighbour = order[(place + 1) % len(order)]
            for seed in study.seeds:
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
                    **part.audit.model_dump(),
                    "answers": two_answers(scene, part.audit.edit),
                    "other_edit": edit_of_others(scene, part.audit.edit),
                }
                sources = {**encoder_sources(part), "other": files[neighbour]}
                yield Cell(spec, name, "metrics", self.name, seed, ("metrics",), sources=sources)

    def compute(self, work: Work) -> Seconds:
        """Compute every metric on every condition at every yaw."""
        spec, world, meter = work.spec, work.world, work.meter
        with meter.stage("setup"):
            encoders = loaded(work.cell.sources, spec["encoders"])
        with meter.stage("truth"):
            cameras, pictures = true_pictures(work)
            views = [
                edited_view(world, spec, pictures, camera, place)
                for place, camera in enumerate((world.source, *cameras))
            ]
        with meter.stage("splats"):
            model = splats(work.cell.scene_file, spec["size"], spec["seed"], **spec["splats"])
            surface = render_surface(model, world.source)
        edit = world.scene.edit(spec["edit"])
        answer = pick(edit, spec["answers"][0][0])
        texts = (edit.source, edit.target if answer is None else answer.target)
        shown = {
            state: {name: Shown(picture, encoders) for name, picture in of_views.items()}
            for state, of_views in pictures.items()
        }
        sources = {
            name: Shown(picture, encoders)
            for name, (flaw, size) in CONDITIONS.items()
            if flaw.alike and (picture := flaw.make(views[0], size)) is not None
        }
        seconds: dict[str, list[float]] = {}
        of_sets: dict[str, float] = {}
        if spec["colmap"]:
            with meter.stage("sets"):
                of_sets, seconds = _reconstructed([world.source, *cameras], pictures, views)
        for place, (camera, edited) in enumerate(zip(cameras, views[1:], strict=True)):

            def of(state: str, camera: Camera = camera) -> tuple[Shown, Shown]:
                return shown[state][world.source.name], shown[state][camera.name]

            with meter.stage("truth"):
                flawed = {n: flaw.make(edited, size) for n, (flaw, size) in CONDITIONS.items()}
            pair = Pair(
                edited.pair, edited.mask, partial(_warp, model, world.source, camera, surface),
                partial(_refit, model, (world.source, camera)), of("before"),
                dict(map(of, PAIRS)), encoders, texts,
            )  # fmt: skip
            judged = {name: of(name) for name in PAIRS} | {
                name: (sources.get(name, of("right")[0]), Shown(picture, encoders))
                for name, picture in flawed.items()
                if picture is not None
            }
            with meter.stage("checks"):
                pair.refit_all(list(judged.values()))
                figures = {
                    f"{key}.{name}": measure(pair, *judged[name]) if name in judged else math.nan
                    for name in (*PAIRS, *flawed)
                    for key, measure in pair.measures.items()
                }
            meter.count(pictures=len(PAIRS) + len(flawed))
            if place == len(cameras) // 2:
                with meter.stage("rounds"):
                    seconds |= _rounds(pair, partial(_warp, model, world.source, camera), spec)
            work.add(camera.name, figures | of_sets)
        return Seconds(seconds)


def _reconstructed(
    cameras: Sequence[Camera], pictures: Pictures, views: Sequence[Edited]
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """COLMAP's figures of all views, by figure and condition, and the seconds of each set."""
    figures: dict[str, float] = {}
    seconds: list[float] = []
    keys = list(metrics.Reconstruction(len(cameras)).figures())
    for name in (*PAIRS, *IN_SETS):
        images: list[Array | None] = [
            pictures[name if name in PAIRS else "right"][camera.name] for camera in cameras
        ]
        if name in IN_SETS:
            flaw = IN_SETS[name]
            images[1::2] = [flaw.make(view, flaw.reference) for view in views[1::2]]
        if any(image is None for image in images):
            figures |= {f"{key}.{name}": math.nan for key in keys}
            continue
        start = perf_counter()
        found = metrics.reconstruct(images, cameras).figures()
        seconds.append(perf_counter() - start)
        figures |= {f"{key}.{name}": value for key, value in found.items()}
    return figures, dict.fromkeys(keys, seconds)


def _warp(
    model: Gaussians, source: Camera, target: Camera, surface: Surface | None = None
) -> WarpedView:
    """The warp by rendered depth; ``surface`` is the source's, by default rendered."""
    return warp_view(model, source, target, source_surface=surface, warn_empty=False)


def _refit(
    model: Gaussians, cameras: Sequence[Camera], pairs: Sequence[tuple[Shown, Shown]]
) -> list[float]:
    """Edit PSNR of splats whose colours are fitted to each pair."""
    import cv2

    size = tuple(min(REFIT_SIZE, side) for side in (cameras[0].width, cameras[0].height))
    return refit_psnr(
        model,
        [camera.resize(*size) for camera in cameras],
        [
            [cv2.resize(one.picture, size, interpolation=cv2.INTER_AREA) for one in views]
            for views in pairs
        ],
    )


def _rounds(pair: Pair, warp: Callable[[], WarpedView], spec: Json) -> dict[str, list[float]]:
    """Seconds of each metric for one pair, in turn, in a random order each round.

    All inputs of a metric from the four pictures are recomputed: keypoints, embeddings, flow,
    the depth of both views. Truth is not timed.
    """

    def work(measure: Measure) -> Callable[[int], float]:
        def run(turn: int) -> float:
            new = pair.again(warp)
            return measure(new, *next(iter(new.partners.items())))

        return run

    works = [work(measure) for measure in pair.measures.values()]
    turns = in_turn(works, spec["rounds"], seed=spec["seed"])
    return dict(zip(pair.measures, turns.seconds, strict=True))
