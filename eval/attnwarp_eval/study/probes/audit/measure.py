"""Consistency metrics of view pairs whose edit is right, and of pairs with one flaw of known size.

A pair is the source and a target turned by some yaw. Figures are named ``metric.condition``: the
conditions are :data:`~attnwarp_eval.study.flaws.CONDITIONS`, in the target alone, and the right
pairs of :data:`~attnwarp_eval.study.shared.right_views.PAIRS`. A metric that needs the truth stands
beside those that a person has.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from attnwarp.camera import Camera, fundamental
from attnwarp.gaussians import Gaussians
from attnwarp.warp import Surface, WarpedView, render_surface, warp_view
from attnwarp_eval import metrics
from attnwarp_eval.cost import in_turn
from attnwarp_eval.metrics.arrays import Array, Mask, mean
from attnwarp_eval.metrics.consistency import FlowMethod
from attnwarp_eval.metrics.known_geometry import GRID
from attnwarp_eval.scene.edits import pick
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.flaws import CONDITIONS
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Part, Splats, Study, check_distinct
from attnwarp_eval.study.shared.encoders import (
    EncodersPart,
    MetricsProbe,
    Seconds,
    encoder_identities,
    encoder_sources,
    loaded,
)
from attnwarp_eval.study.shared.right_views import (
    PAIRS,
    cells_of_edit,
    edited_target,
    true_pictures,
)
from attnwarp_eval.two_view import TwoView
from attnwarp_eval.world import splats

REFIT_SIZE = 128
"""Side in px of the pictures that splats' colours are fitted to."""

Where = tuple[Array, Mask]
"""(H, W, 2) px of the source for each target pixel, and (H, W) bool where they are trusted."""


class Audit(Part):
    """Edit and view pairs.

    ``edit``: one with at least two answers. ``yaws``: degrees between the views of a pair.
    ``splats``: the scene before the edit, whose depth is rendered.
    """

    edit: str = "parts"
    yaws: Annotated[list[Annotated[float, Field(gt=0, le=180)]], Field(min_length=1)] = Field(
        default_factory=lambda: [2.0, 10.0, 30.0, 60.0, 120.0]
    )
    splats: Splats = Splats(kind="2d", count=16_000, position_noise=0.1, normal_noise=3.0)

    @model_validator(mode="after")
    def _check_yaws(self) -> Audit:
        check_distinct(self.yaws, "audit.yaws")
        return self


class StudyPart(EncodersPart):
    """Keys of a study that this probe reads."""

    audit: Audit = Audit()


@register
class AuditProbe(MetricsProbe):
    """One cell a scene and seed: all metrics judge the same pictures."""

    name = "audit"
    protocol = 2
    study_part = StudyPart
    metrics = metrics_of("consistency.", "embedding.", "multiview.")

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene and seed."""
        part = study.part(StudyPart)
        own = {
            "rounds": study.timing_rounds,
            "splats": part.audit.splats.model_dump(),
            "encoders": encoder_identities(part),
            "yaws": part.audit.yaws,
        }
        yield from cells_of_edit(self, study, scenes, part.audit.edit, own, encoder_sources(part))

    def compute(self, work: Work) -> Seconds:
        """Every metric on every condition at every yaw."""
        spec, world, meter = work.spec, work.world, work.meter
        with meter.stage("setup"):
            encoders = loaded(work.cell.sources, spec["encoders"])
        with meter.stage("truth"):
            cameras, pictures = true_pictures(work)
        with meter.stage("splats"):
            model = splats(work.cell.scene_file, spec["size"], spec["seed"], **spec["splats"])
            surface = render_surface(model, world.source)
        edit = world.scene.edit(spec["edit"])
        answer = pick(edit, spec["answers"][0][0])
        texts = (edit.source, edit.target if answer is None else answer.target)
        shown = {
            state: {name: _Shown(picture, encoders) for name, picture in views.items()}
            for state, views in pictures.items()
        }
        seconds: dict[str, list[float]] = {}
        for place, camera in enumerate(cameras):
            with meter.stage("truth"):
                truth = world.pair(camera.name, spec["size"])
                edited = edited_target(world, spec, pictures, camera, truth)
                flawed = {
                    name: flaw.make(edited, size) for name, (flaw, size) in CONDITIONS.items()
                }

            warp = partial(_warp, model, world.source, camera, surface)

            def views(state: str, camera: Camera = camera) -> tuple[_Shown, _Shown]:
                return shown[state][world.source.name], shown[state][camera.name]

            refit = partial(_refit, model, (world.source, camera))
            pair = _Pair(
                truth, warp, refit, views("before"), dict(map(views, PAIRS)), encoders, texts
            )
            judged = {name: views(name) for name in PAIRS} | {
                name: (views("right")[0], _Shown(picture, encoders))
                for name, picture in flawed.items()
                if picture is not None
            }
            figures: dict[str, float] = {}
            with meter.stage("checks"):
                pair.refit_all(list(judged.values()))
                for name in (*PAIRS, *flawed):
                    values = (
                        pair.figures(*judged[name])
                        if name in judged
                        else dict.fromkeys(pair.contestants, math.nan)
                    )
                    figures |= _named(values, name)
            meter.count(pictures=len(PAIRS) + len(flawed))
            if place == len(cameras) // 2:
                with meter.stage("rounds"):
                    whole = partial(_warp, model, world.source, camera)
                    seconds = _rounds(pair, whole, spec)
            work.add(camera.name, figures)
        return Seconds(seconds)


def _named(values: Mapping[str, float], condition: str) -> dict[str, float]:
    return {f"{key}.{condition}": value for key, value in values.items()}


def _warp(
    model: Gaussians, source: Camera, target: Camera, surface: Surface | None = None
) -> WarpedView:
    """The warp by rendered depth; ``surface`` is the source's, rendered if left out."""
    return warp_view(model, source, target, source_surface=surface, warn_empty=False)


def _refit(
    model: Gaussians, cameras: Sequence[Camera], pairs: Sequence[tuple[_Shown, _Shown]]
) -> list[float]:
    """Edit PSNR of splats whose colours are fitted to each pair."""
    import cv2

    size = tuple(min(REFIT_SIZE, side) for side in (cameras[0].width, cameras[0].height))
    return metrics.refit_psnr(
        model,
        [camera.resize(*size) for camera in cameras],
        [
            [cv2.resize(one.picture, size, interpolation=cv2.INTER_AREA) for one in views]
            for views in pairs
        ],
    )


def _rounds(pair: _Pair, warp: Callable[[], WarpedView], spec: Json) -> dict[str, list[float]]:
    """Seconds that one pair costs each metric, in turn in an order drawn anew each round.

    Everything that a metric needs of the four pictures is made anew: keypoints, embeddings, flow,
    the depth of both views. Truth costs nothing.
    """

    def work(name: str) -> Callable[[int], float]:
        def run(turn: int) -> float:
            new = pair.again(warp)
            return new.contestants[name](*next(iter(new.partners.items())))

        return run

    turns = in_turn([work(name) for name in pair.contestants], spec["rounds"], seed=spec["seed"])
    return dict(zip(pair.contestants, turns.seconds, strict=True))


class _Shown:
    """A picture, and what several metrics need of it or of its pair, made once.

    A target belongs to one pair and one source.

    Attributes:
        picture: (H, W, 3) sRGB in [0, 1].
    """

    def __init__(self, picture: Array, encoders: Mapping[str, Any]) -> None:
        self.picture, self._encoders = picture, encoders
        self._kept: dict[str, Any] = {}

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """Result of ``make``, of the first call with that name."""
        if name not in self._kept:
            self._kept[name] = make()
        return self._kept[name]

    def part(self, kind: str) -> Any:
        """Keypoints ("sift"), (1, D) embedding ("clip", "dino") or (h, w, D) "tokens"."""
        if kind == "sift":
            return self.once(kind, lambda: metrics.sift_features(self.picture))
        if kind == "tokens":
            return self.once(kind, lambda: self._encoders["dino"].tokens([self.picture])[0])
        return self.once(kind, lambda: self._encoders[kind].images([self.picture]))

    def again(self) -> _Shown:
        """Copy of the picture with nothing made yet."""
        return _Shown(self.picture, self._encoders)


Measure = Callable[[_Shown, _Shown], float]


class _Pair:
    """All metrics of a pair of views.

    Args:
        truth: exact relation of the two.
        warp: makes the warp by rendered depth.
        refit: Edit PSNR of each of several pairs.
        before: source and target before the edit.
        partners: the true target of each true source after the edit, the right edit's first.
        texts: descriptions of the source and of the edit.

    Attributes:
        contestants: metric -> what computes it of source and target after the edit.
    """

    def __init__(
        self,
        truth: TwoView,
        warp: Callable[[], WarpedView],
        refit: Callable[[Sequence[tuple[_Shown, _Shown]]], list[float]],
        before: tuple[_Shown, _Shown],
        partners: Mapping[_Shown, _Shown],
        encoders: Mapping[str, Any],
        texts: Sequence[str],
    ) -> None:
        self.truth, self.before, self.partners = truth, before, partners
        self.encoders, self.texts = encoders, texts
        self._warp, self._refit = warp, refit
        self.exact = truth.xy, truth.visible & ~truth.edge
        self.contestants = self._contestants()

    def again(self, warp: Callable[[], WarpedView]) -> _Pair:
        """Copy of the pair with nothing made yet."""
        before = self.before[0].again(), self.before[1].again()
        partners = {source.again(): target.again() for source, target in self.partners.items()}
        return _Pair(self.truth, warp, self._refit, before, partners, self.encoders, self.texts)

    def refit_all(self, pairs: Sequence[tuple[_Shown, _Shown]]) -> None:
        """Fit splats' colours to all pairs at once, which costs little more than to one."""
        for (_, target), value in zip(pairs, self._refit(pairs), strict=True):
            target.once("refit", partial(float, value))

    def figures(self, source: _Shown, target: _Shown) -> dict[str, float]:
        """Every metric of two pictures."""
        return {key: measure(source, target) for key, measure in self.contestants.items()}

    def _contestants(self) -> dict[str, Measure]:
        found: dict[str, Measure] = {
            # A pair with too few matches counts against.
            "consistency.tsed_2px": lambda s, t: float(self._distance(s, t) < 2),
            "consistency.tsed_distance": self._distance,
            "consistency.flow_delta_e.dis": lambda s, t: _colors(self._dis, s, t),
            "consistency.flow_delta_e.farneback": lambda s, t: _colors(self._farneback, s, t),
            "consistency.rendered_delta_e": lambda s, t: _colors(self._rendered, s, t),
            "consistency.edit_psnr": lambda s, t: t.once("refit", lambda: self._refit([(s, t)])[0]),
            "consistency.edit_delta_e": lambda s, t: self._added("", s, t),
            "consistency.edit_delta_e_p90": lambda s, t: self._added("_p90", s, t),
            "consistency.delta_e": self._exactly,
            # The floor is of the true views of what the source shows.
            "multiview.delta_e_above": lambda s, t: (
                self._exactly(s, t) - self._exactly(s, self.partners[s])
            ),
        }
        if "clip" in self.encoders:
            found |= {
                "embedding.direction_consistency": self._direction,
                "embedding.clip_image": lambda s, t: _similar("clip", s, t),
                "embedding.clip_similarity": lambda _, t: float(
                    metrics.clip_similarity(t.part("clip"), self._words[1]).mean
                ),
                "embedding.clip_directional": lambda _, t: float(
                    metrics.directional_similarity(
                        self.before[1].part("clip"), t.part("clip"), *self._words
                    ).mean
                ),
            }
        if "dino" in self.encoders:
            found |= {
                "embedding.dino_image": lambda s, t: _similar("dino", s, t),
                "embedding.match_similarity": self._matched,
                "consistency.features.rendered": lambda s, t: self._features(self._rendered, s, t),
                "consistency.features.exact": lambda s, t: self._features(self.exact, s, t),
            }
        if "perceptual" in self.encoders:
            network = self.encoders["perceptual"]
            found["consistency.perceptual"] = lambda s, t: metrics.perceptual_consistency(
                s.picture, t.picture, *self._rendered,
                lambda a, b: float(network.distance([a], [b])[0]),
            )  # fmt: skip
        return found

    @cached_property
    def _rendered(self) -> Where:
        view = self._warp()
        return view.correspondence.xy.numpy(), view.mask.numpy()

    @cached_property
    def _dis(self) -> Where:
        return self._flow("dis")

    @cached_property
    def _farneback(self) -> Where:
        return self._flow("farneback")

    def _flow(self, method: FlowMethod) -> Where:
        flow = metrics.optical_flow(self.before[0].picture, self.before[1].picture, method)
        return flow.xy, flow.accepted

    def _distance(self, source: _Shown, target: _Shown) -> float:
        F = fundamental(self.truth.source, self.truth.target)
        if F is None:
            return math.nan

        def median() -> float:
            matches = metrics.match_features(source.part("sift"), target.part("sift"))
            return float(metrics.tsed([metrics.epipolar_distance(*matches, F)]).medians[0])

        return float(target.once("median", median))

    def _exactly(self, source: _Shown, target: _Shown) -> float:
        return float(target.once("exact", lambda: _colors(self.exact, source, target)))

    def _added(self, suffix: str, source: _Shown, target: _Shown) -> float:
        figures = target.once(
            "edit",
            lambda: metrics.edit_agreement(
                (self.before[0].picture, self.before[1].picture[GRID]),
                (source.picture, target.picture[GRID]),
                *(part[GRID] for part in self._rendered),
            ),
        )
        return float(figures[f"consistency.edit_delta_e{suffix}"])

    def _direction(self, source: _Shown, target: _Shown) -> float:
        before, after = (
            np.concatenate([one.part("clip") for one in views])
            for views in (self.before, (source, target))
        )
        return metrics.direction_consistency(before, after).mean

    def _matched(self, source: _Shown, target: _Shown) -> float:
        tokens = [one.part("tokens") for one in (*self.before, source, target)]
        return metrics.match_similarity(*(rows.reshape(-1, rows.shape[-1]) for rows in tokens)).mean

    def _features(self, where: Where, source: _Shown, target: _Shown) -> float:
        similarity = metrics.feature_consistency(
            source.part("tokens"), target.part("tokens"), *where, source.picture.shape[:2],
            seen=self.encoders["dino"].preprocess.seen,
        )  # fmt: skip
        return 1 - similarity.mean

    @cached_property
    def _words(self) -> Array:
        return np.asarray(self.encoders["clip"].texts(list(self.texts)))


def _colors(where: Where, source: _Shown, target: _Shown) -> float:
    result = metrics.disagreement_at(
        source.picture, target.picture[GRID], *(part[GRID] for part in where)
    )
    return mean(result.delta_e[result.counted])


def _similar(kind: str, source: _Shown, target: _Shown) -> float:
    return metrics.image_similarity(source.part(kind), target.part(kind)).mean
