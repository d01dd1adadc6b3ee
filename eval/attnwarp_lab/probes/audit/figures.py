"""Figures that the audit judges: each entry has its texts for tables, and its function of a pair of
views.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

from attnwarp.camera import fundamental
from attnwarp.warp import WarpedView
from attnwarp_eval import metrics
from attnwarp_eval.metrics.arrays import Array, Mask, mean
from attnwarp_eval.metrics.consistency import FlowMethod
from attnwarp_eval.metrics.known_geometry import GRID
from attnwarp_eval.two_view import TwoView

Where = tuple[Array, Mask]
"""(H, W, 2) source position in px for each target pixel, and (H, W) bool of trusted ones."""


class Shown:
    """A picture, with cached intermediate results of the picture or its pair for the figures.

    A target belongs to one pair and one source.

    Attributes:
        picture: (H, W, 3) sRGB in [0, 1].
    """

    def __init__(self, picture: Array, encoders: Mapping[str, Any]) -> None:
        self.picture, self._encoders = picture, encoders
        self._kept: dict[str, Any] = {}

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """Result of ``make``, cached by name."""
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

    def again(self) -> Shown:
        """Copy of the picture with an empty cache."""
        return Shown(self.picture, self._encoders)


@dataclass(eq=False)
class Pair:
    """A pair of views, and the figures' inputs besides the pictures after the edit.

    Attributes:
        truth: exact relation of the two.
        mask: (H, W) bool, the edited object in the target.
        warp: function that makes the warp by rendered depth.
        refit: function that gives the Edit PSNR of several pairs.
        before: source and target before the edit.
        partners: the true target of each true source after the edit, first the right edit's.
        encoders: encoders by kind.
        texts: descriptions of the source and of the edit.
    """

    truth: TwoView
    mask: Mask
    warp: Callable[[], WarpedView]
    refit: Callable[[Sequence[tuple[Shown, Shown]]], list[float]]
    before: tuple[Shown, Shown]
    partners: Mapping[Shown, Shown]
    encoders: Mapping[str, Any]
    texts: Sequence[str]

    def again(self, warp: Callable[[], WarpedView]) -> Pair:
        """Copy of the pair with an empty cache."""
        before = self.before[0].again(), self.before[1].again()
        partners = {source.again(): target.again() for source, target in self.partners.items()}
        return Pair(
            self.truth, self.mask, warp, self.refit, before, partners, self.encoders, self.texts
        )

    def refit_all(self, pairs: Sequence[tuple[Shown, Shown]]) -> None:
        """Fit splats' colours to all pairs at once, at little more than the cost of one."""
        for (_, target), value in zip(pairs, self.refit(pairs), strict=True):
            target.once("refit", partial(float, value))

    @property
    def measures(self) -> dict[str, Measure]:
        """Measures of :data:`FIGURES` that the available encoders allow, by figure."""
        at_hand = (None, *self.encoders)
        return {f.key: f.measure for f in FIGURES if f.measure and f.encoder in at_hand}

    @property
    def exact(self) -> Where:
        """True correspondences of surfaces visible in both views."""
        return self.truth.xy, self.truth.visible & ~self.truth.edge

    @cached_property
    def rendered(self) -> Where:
        """Correspondences by rendered depth."""
        view = self.warp()
        return view.correspondence.xy.numpy(), view.mask.numpy()

    @cached_property
    def outside(self) -> Mask:
        """(H, W) bool: pixels of neither the object nor its neighbourhood."""
        grown: Mask = binary_dilation(self.mask, np.ones((3, 3), dtype=bool))
        return ~grown

    @cached_property
    def words(self) -> Array:
        """(2, D) CLIP embeddings of the texts."""
        return np.asarray(self.encoders["clip"].texts(list(self.texts)))

    def flow(self, method: FlowMethod) -> Where:
        """Optical flow of the pictures before the edit."""

        def make() -> Where:
            flow = metrics.optical_flow(self.before[0].picture, self.before[1].picture, method)
            return flow.xy, flow.accepted

        found: Where = self.before[1].once(method, make)
        return found


Measure = Callable[[Pair, Shown, Shown], float]


@dataclass(frozen=True)
class Figure:
    """Definition of a figure: its texts for tables, and its function of a pair.

    Attributes:
        key, title: key and title of the metric.
        needs: inputs besides the edited pictures.
        measure: function of a pair and its edited source and target; None for figures of sets.
        encoder: kind of the encoder needed.
        truth: whether the truth is needed.
    """

    key: str
    title: str
    needs: str
    measure: Measure | None = None
    encoder: str | None = None
    truth: bool = False


def _epipolar(pair: Pair, source: Shown, target: Shown) -> float:
    F = fundamental(pair.truth.source, pair.truth.target)
    if F is None:
        return math.nan

    def median() -> float:
        matches = metrics.match_features(source.part("sift"), target.part("sift"))
        return float(metrics.tsed([metrics.epipolar_distance(*matches, F)]).medians[0])

    return float(target.once("median", median))


def _colors(where: Where, source: Shown, target: Shown) -> float:
    result = metrics.disagreement_at(
        source.picture, target.picture[GRID], *(part[GRID] for part in where)
    )
    return mean(result.delta_e[result.counted])


def _exactly(pair: Pair, source: Shown, target: Shown) -> float:
    return float(target.once("exact", lambda: _colors(pair.exact, source, target)))


def _above_floor(pair: Pair, source: Shown, target: Shown) -> float:
    """Disagreement above the floor of the true views; for a flawed source, the floor is the right
    edit's.
    """
    true = source if source in pair.partners else next(iter(pair.partners))
    return _exactly(pair, source, target) - _exactly(pair, true, pair.partners[true])


def _added(suffix: str) -> Measure:
    """Measure of the colour difference between the views that the edit adds."""

    def measure(pair: Pair, source: Shown, target: Shown) -> float:
        figures = target.once(
            "edit",
            lambda: metrics.edit_agreement(
                (pair.before[0].picture, pair.before[1].picture[GRID]),
                (source.picture, target.picture[GRID]),
                *(part[GRID] for part in pair.rendered),
            ),
        )
        return float(figures[f"consistency.edit_delta_e{suffix}"])

    return measure


def _direction(pair: Pair, source: Shown, target: Shown) -> float:
    before, after = (
        np.concatenate([one.part("clip") for one in views])
        for views in (pair.before, (source, target))
    )
    return metrics.direction_consistency(before, after).mean


def _matched(pair: Pair, source: Shown, target: Shown) -> float:
    tokens = [one.part("tokens") for one in (*pair.before, source, target)]
    return metrics.match_similarity(*(rows.reshape(-1, rows.shape[-1]) for rows in tokens)).mean


def _features(pair: Pair, where: Where, source: Shown, target: Shown) -> float:
    similarity = metrics.feature_consistency(
        source.part("tokens"), target.part("tokens"), *where, source.picture.shape[:2],
        seen=pair.encoders["dino"].preprocess.seen,
    )  # fmt: skip
    return 1 - similarity.mean


def _words(pair: Pair, source: Shown, target: Shown) -> float:
    return float(metrics.clip_similarity(target.part("clip"), pair.words[1]).mean)


def _direction_of_words(pair: Pair, source: Shown, target: Shown) -> float:
    before = pair.before[1].part("clip")
    return float(metrics.directional_similarity(before, target.part("clip"), *pair.words).mean)


def _similar(kind: str) -> Measure:
    return lambda _, s, t: metrics.image_similarity(s.part(kind), t.part(kind)).mean


def _perceptual(pair: Pair, source: Shown, target: Shown) -> float:
    network = pair.encoders["perceptual"]
    return metrics.perceptual_consistency(
        source.picture,
        target.picture,
        *pair.rendered,
        lambda a, b: float(network.distance([a], [b])[0]),
    )


def _preserved(compare: Callable[[Array, Array, Mask], float]) -> Measure:
    """Measure of the target outside the object against the picture before the edit."""
    return lambda p, _, t: compare(t.picture, p.before[1].picture, p.outside)


FIGURES = (
    # A pair with too few matches counts as inconsistent.
    Figure(
        "consistency.tsed_2px", "TSED at 2 px", "poses",
        lambda p, s, t: float(_epipolar(p, s, t) < 2),
    ),
    Figure("consistency.tsed_distance", "epipolar distance", "poses", _epipolar),
    Figure(
        "consistency.flow_delta_e.dis", "flow warp error, DIS", "originals",
        lambda p, s, t: _colors(p.flow("dis"), s, t),
    ),
    Figure(
        "consistency.flow_delta_e.farneback", "flow warp error, Farneback", "originals",
        lambda p, s, t: _colors(p.flow("farneback"), s, t),
    ),
    Figure("embedding.match_similarity", "DINO match similarity", "originals", _matched, "dino"),
    Figure(
        "embedding.direction_consistency", "CLIP direction consistency", "originals", _direction,
        "clip",
    ),
    Figure(
        "embedding.clip_directional", "CLIP directional similarity", "originals, prompts",
        _direction_of_words, "clip",
    ),
    Figure("embedding.clip_similarity", "CLIP similarity", "prompt", _words, "clip"),
    Figure(
        "embedding.clip_image", "CLIP image similarity", "nothing", _similar("clip"), "clip"
    ),
    Figure(
        "embedding.dino_image", "DINO image similarity", "nothing", _similar("dino"), "dino"
    ),
    Figure("consistency.colmap_registered", "COLMAP, registered views", "set of views"),
    Figure("consistency.colmap_points", "COLMAP, points", "set of views"),
    Figure("consistency.colmap_track_length", "COLMAP, track length", "set of views"),
    Figure("consistency.colmap_error", "COLMAP, reprojection error", "set of views"),
    Figure(
        "fidelity.preserved_mse", "rest unchanged, PSNR", "originals, mask",
        _preserved(metrics.mse),
    ),
    Figure(
        "fidelity.preserved_ssim", "rest unchanged, SSIM", "originals, mask",
        _preserved(metrics.ssim),
    ),
    Figure(
        "consistency.edit_psnr", "Edit PSNR, colours refitted", "splats",
        lambda p, s, t: t.once("refit", lambda: p.refit([(s, t)])[0]),
    ),
    Figure(
        "consistency.features.rendered", "features, rendered depth", "splats",
        lambda p, s, t: _features(p, p.rendered, s, t), "dino",
    ),
    Figure(
        "consistency.perceptual", "perceptual, rendered depth", "splats", _perceptual, "perceptual"
    ),
    Figure(
        "consistency.rendered_delta_e", "colour, rendered depth", "splats",
        lambda p, s, t: _colors(p.rendered, s, t),
    ),
    Figure(
        "consistency.edit_delta_e", "colour the edit adds", "splats, originals", _added("")
    ),
    Figure(
        "consistency.edit_delta_e_p90", "colour the edit adds, p90", "splats, originals",
        _added("_p90"),
    ),
    Figure(
        "consistency.features.exact", "features, exact", "truth",
        lambda p, s, t: _features(p, p.exact, s, t), "dino", truth=True,
    ),
    Figure("consistency.delta_e", "colour, exact", "truth", _exactly, truth=True),
    Figure(
        "multiview.delta_e_above", "colour above its floor, exact", "truth", _above_floor,
        truth=True,
    ),
)  # fmt: skip
"""Figures; those without truth come first."""
