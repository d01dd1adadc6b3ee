"""Figures that the audit judges: each entry has its texts for tables, and its function of a pair of
views.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import fundamental
from attnwarp.warp import WarpedView
from attnwarp_eval import metrics
from attnwarp_eval.metrics.arrays import Array, Mask, mean
from attnwarp_eval.metrics.known_geometry import GRID
from attnwarp_eval.two_view import TwoView
from attnwarp_lab.ideal.figures import UNKNOWN, PartTruth, part_answers

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
        warps: functions that make the warp by rendered depth, by the kind of splats.
        before: source and target before the edit.
        partners: the true target of each true source after the edit, first the right edit's.
        labels: true answers of source and target, by parts of the edited object.
        encoders: encoders by kind.
        texts: descriptions of the source and of the edit.
    """

    truth: TwoView
    mask: Mask
    warps: Mapping[str, Callable[[], WarpedView]]
    before: tuple[Shown, Shown]
    partners: Mapping[Shown, Shown]
    labels: tuple[PartTruth, PartTruth]
    encoders: Mapping[str, Any]
    texts: Sequence[str]

    def again(self, warps: Mapping[str, Callable[[], WarpedView]]) -> Pair:
        """Copy of the pair with an empty cache."""
        before = self.before[0].again(), self.before[1].again()
        partners = {source.again(): target.again() for source, target in self.partners.items()}
        return replace(self, warps=warps, before=before, partners=partners)

    @property
    def measures(self) -> dict[str, Measure]:
        """Measures of :data:`FIGURES` that the available encoders and splats allow, by figure."""
        at_hand = (None, *self.encoders)
        return {
            f.key: f.measure
            for f in FIGURES
            if f.measure and f.encoder in at_hand and f.splats in (None, *self.warps)
        }

    @property
    def exact(self) -> Where:
        """True correspondences of surfaces visible in both views."""
        return self.truth.xy, self.truth.visible & ~self.truth.edge

    def rendered(self, splats: str) -> Where:
        """Correspondences by rendered depth."""

        def make() -> Where:
            view = self.warps[splats]()
            return view.correspondence.xy.numpy(), view.mask.numpy()

        found: Where = self.before[1].once(splats, make)
        return found

    @cached_property
    def words(self) -> Array:
        """(2, D) CLIP embeddings of the texts."""
        return np.asarray(self.encoders["clip"].texts(list(self.texts)))

    @cached_property
    def flow(self) -> Where:
        """Optical flow of the pictures before the edit."""
        flow = metrics.optical_flow(self.before[0].picture, self.before[1].picture)
        return flow.xy, flow.accepted


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
        splats: kind of the splats needed, "sampled" or "fitted".
    """

    key: str
    title: str
    needs: str
    measure: Measure | None = None
    encoder: str | None = None
    truth: bool = False
    splats: str | None = None


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


def _nearest(shown: Shown, truth: PartTruth) -> npt.NDArray[np.intp]:
    """(H, W) nearest answer of each pixel of a picture."""
    found: npt.NDArray[np.intp] = shown.once(
        "labels", lambda: truth.errors(shown.picture.astype(np.float32)).argmin(axis=0)
    )
    return found


def _labels(pair: Pair, source: Shown, target: Shown) -> float:
    """Share of the object's pixels, seen by both, whose nearest answers agree.

    Edges count: at small sizes little else of a thing is left.
    """
    there, here = map(_nearest, (source, target), pair.labels)
    seen, xy = pair.truth.visible & pair.mask, pair.truth.xy
    column, row = np.floor(xy[seen]).astype(np.int64).T
    h, w = there.shape
    return mean((there[row.clip(0, h - 1), column.clip(0, w - 1)] == here[seen]).astype(float))


def _parts(pair: Pair, source: Shown, target: Shown) -> float:
    """Share of the object's parts, seen by both, whose nearest answers agree."""
    count = 1 + max(int(truth.pixels.max(initial=0)) for truth in pair.labels)
    there, here = (
        part_answers(one.picture.astype(np.float32), truth, count, among)
        for one, truth, among in zip(
            (source, target), pair.labels, (None, pair.truth.visible), strict=True
        )
    )
    known = (there != UNKNOWN) & (here != UNKNOWN)
    return mean((there == here)[known].astype(float))


def _added(pair: Pair, splats: str, source: Shown, target: Shown) -> float:
    """Colour difference between the views that the edit adds."""
    figures = metrics.edit_agreement(
        (pair.before[0].picture, pair.before[1].picture[GRID]),
        (source.picture, target.picture[GRID]),
        *(part[GRID] for part in pair.rendered(splats)),
    )
    return float(figures["consistency.edit_delta_e"])


def _at_depth(name: str) -> Callable[[Pair, str, Shown, Shown], float]:
    """Difference of the two views along rendered depth."""

    def measure(pair: Pair, splats: str, source: Shown, target: Shown) -> float:
        figures = target.once(
            f"at depth, {splats}",
            lambda: metrics.disagreement_at(
                source.picture, target.picture[GRID], *(p[GRID] for p in pair.rendered(splats))
            ).figures("rendered_"),
        )
        return float(figures[name])

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


def _perceptual(pair: Pair, splats: str, source: Shown, target: Shown) -> float:
    network = pair.encoders["perceptual"]
    return metrics.perceptual_consistency(
        source.picture,
        target.picture,
        *pair.rendered(splats),
        lambda a, b: float(network.distance([a], [b])[0]),
    )


def _along(
    measure: Callable[[Pair, str, Shown, Shown], float], splats: str
) -> Callable[[Pair, Shown, Shown], float]:
    """Measure along the depth of one kind of splats."""
    return lambda pair, source, target: measure(pair, splats, source, target)


_DEPTH: tuple[tuple[str, str, str, Any, str | None], ...] = (
    ("consistency.features", "features (MEt3R's scheme), depth", "splats",
     lambda p, splats, s, t: _features(p, p.rendered(splats), s, t), "dino"),
    ("consistency.perceptual", "perceptual distance, depth", "splats", _perceptual, "perceptual"),
    ("consistency.rendered_mae_srgb", "reprojection loss, depth", "splats",
     _at_depth("consistency.rendered_mae_srgb"), None),
    ("consistency.rendered_delta_e", "colour, depth", "splats",
     _at_depth("consistency.rendered_delta_e"), None),
    ("consistency.edit_delta_e", "colour the edit adds, depth", "splats, originals", _added, None),
)  # fmt: skip

FIGURES = (
    # A pair with too few matches counts as inconsistent.
    Figure(
        "consistency.tsed_2px", "TSED at 2 px", "poses",
        lambda p, s, t: float(_epipolar(p, s, t) < 2),
    ),
    Figure("consistency.tsed_distance", "epipolar distance", "poses", _epipolar),
    Figure(
        "consistency.flow_delta_e", "flow warp error", "originals",
        lambda p, s, t: _colors(p.flow, s, t),
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
        "embedding.clip_neighbours", "CLIP between neighbours", "nothing", _similar("clip"), "clip"
    ),
    Figure(
        "embedding.dino_image", "DINO between neighbours", "nothing", _similar("dino"), "dino"
    ),
    *(
        Figure(f"consistency.{key}{end}", f"{title}{said}", "splats, set of views", splats=splats)
        for splats, end, said in (("sampled", "", ""), ("fitted", ".fitted", ", fitted splats"))
        for key, title in (
            ("fitted_psnr", "Edit PSNR, colours refitted"), ("held_psnr", "held-out PSNR"),
            ("held_distance", "held-out perceptual distance"),
        )
    ),
    *(
        Figure(
            f"{key}{end}", f"{title}{said}", needs,
            _along(measure, splats), encoder, splats=splats,
        )
        for splats, end, said in (("sampled", "", ""), ("fitted", ".fitted", " of fitted splats"))
        for key, title, needs, measure, encoder in _DEPTH
    ),
    Figure("consistency.delta_e", "colour, exact", "truth", _exactly, truth=True),
    Figure(
        "multiview.delta_e_above", "truth: colour above its floor", "truth", _above_floor,
        truth=True,
    ),
    Figure("multiview.labels", "truth: labels that agree", "truth", _labels, truth=True),
    Figure("multiview.parts", "truth: parts that agree", "truth", _parts, truth=True),
)  # fmt: skip
"""Figures; those without truth come first."""

TRUTHS = tuple(figure for figure in FIGURES if figure.key.startswith("multiview."))
"""Figures by whose order real edits are ranked."""
