"""Flaws of known size in a true edit: in the target view only, or equally in all views.

Sizes refer to the flawed picture: pixels, shares, degrees. A flaw is drawn on the true picture by
exact geometry, so its size is known and nothing else differs. If all views share a flaw, they
agree, and a figure that rates it above a right edit can be gamed by it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.metrics.arrays import Array, Mask
from attnwarp_eval.metrics.consistency import has_taps, sampled
from attnwarp_eval.study.shared.drifts import Motion, moved
from attnwarp_eval.two_view import HIDDEN, TwoView

STEP = 1e-4
"""Length in scene units of a point's step for the direction of its surface in the picture."""


@dataclass(frozen=True, eq=False)
class Edited:
    """A true edit in one view, and the inputs of flaws.

    Attributes:
        pair: pair of the source and this view.
        source: (h, w, 3) sRGB in [0, 1], the true source after the edit.
        before, after, another: (H, W, 3) the view before the edit, after it, and with another right
            answer.
        mask: (H, W) bool, the edited object in the view.
        elsewhere: (H, W, 3) a view of another scene, or None.
        misdirected: (H, W, 3) the view after an edit of other objects, or None.
        seed: seed of the flaws' random draws.
        place: number of the view, 0 for the source; each view has separate noise.
    """

    pair: TwoView
    source: Array
    before: Array
    after: Array
    another: Array
    mask: Mask
    elsewhere: Array | None = None
    misdirected: Array | None = None
    seed: int = 0
    place: int = 0
    _kept: dict[str, Array] = field(default_factory=dict)

    def grown(self) -> Array:
        """(H, W, 3) linear light: the object's paint, outside it that of its nearest pixel."""
        if "grown" not in self._kept:
            self._kept["grown"] = to_linear(self.after)
            if self.mask.any():
                nearest = distance_transform_edt(
                    ~self.mask, return_distances=False, return_indices=True
                )
                self._kept["grown"] = self._kept["grown"][tuple(nearest)]
        return self._kept["grown"]

    def along(self) -> Array:
        """(H, W, 2) unit direction of the surface in the picture, for one world direction at all
        pixels; 0 where the surface runs along the ray.
        """
        if "along" not in self._kept:
            hits, camera = self.pair.hits, self.pair.target
            direction = np.random.default_rng([self.seed, 1]).normal(size=3)
            tangent = direction - (hits.normal @ direction)[..., None] * hits.normal
            with np.errstate(invalid="ignore"):
                here, there = (
                    camera.project(point.reshape(-1, 3))[0].reshape(*self.mask.shape, 2)
                    for point in (hits.point, hits.point + STEP * tangent)
                )
                moved = there - here
                length = np.linalg.norm(moved, axis=-1, keepdims=True)
                self._kept["along"] = np.nan_to_num(
                    np.divide(moved, length, out=np.zeros_like(moved), where=length > 1e-9)
                )
        return self._kept["along"]


Make = Callable[[Edited, float], Array | None]


@dataclass(frozen=True)
class Flaw:
    """A kind of flaw.

    Attributes:
        name: the first part of a condition's key.
        title: short title for display.
        unit: unit of its sizes.
        sizes: sizes in rising order.
        reference: the size shown in tables of all flaws.
        make: (H, W, 3) sRGB of the flawed view at a size; None if impossible.
        counts: whether the flaw is one of the most important.
        alike: whether the source also has the flaw.
    """

    name: str
    title: str
    unit: str
    sizes: tuple[float, ...]
    reference: float
    make: Make
    counts: bool = False
    alike: bool = False

    def key(self, size: float) -> str:
        """Name of the condition at a size.

        Example:
            >>> FLAWS[0].key(0.3)
            'answer=0.3'
        """
        return f"{self.name}={size:g}"

    def at(self, size: float) -> str:
        """Title with a size, for display.

        Example:
            >>> FLAWS[0].at(0.3), FLAWS[3].at(45)
            ('another answer, 30 % of the object', 'hue shift, 45 degrees')
        """
        if self.unit.startswith("of the"):
            return f"{self.title}, {100 * size:g} % {self.unit}"
        return f"{self.title}, {size:g} {self.unit}" if self.unit else self.title


def _answer(edited: Edited, size: float) -> Array:
    """Another answer in a spot of the object's surface, ``size`` of its pixels."""
    if size >= 1:
        return edited.another
    inside = np.argwhere(edited.mask)
    if not len(inside):
        return edited.after
    points = edited.pair.hits.point[edited.mask]
    center = points[np.random.default_rng([edited.seed, 2]).integers(len(points))]
    near = np.argsort(((points - center) ** 2).sum(axis=1), kind="stable")
    rows, columns = inside[near[: max(1, round(size * len(points)))]].T
    result = edited.after.copy()
    result[rows, columns] = edited.another[rows, columns]
    return result


def _hue(edited: Edited, size: float) -> Array:
    """The object's hue turned by ``size`` degrees in CIELAB, its lightness and chroma kept."""
    from skimage.color import lab2rgb, rgb2lab

    lab = rgb2lab(edited.after)
    turn = np.radians(size)
    a, b = lab[..., 1], lab[..., 2]
    turned = np.stack(
        [lab[..., 0], a * np.cos(turn) - b * np.sin(turn), a * np.sin(turn) + b * np.cos(turn)], -1
    )
    return np.where(edited.mask[..., None], np.clip(lab2rgb(turned), 0, 1), edited.after)


def _slid(edited: Edited, size: float) -> Array:
    """The object's texture shifted by ``size`` px along its surface."""
    row, column = np.indices(edited.mask.shape)
    at = [row + size * edited.along()[..., 1], column + size * edited.along()[..., 0]]
    moved = np.stack(
        [map_coordinates(edited.grown()[..., c], at, order=1, mode="nearest") for c in range(3)], -1
    )
    return np.where(edited.mask[..., None], to_srgb(np.clip(moved, 0, 1)), edited.after)


def _doubled(edited: Edited, size: float) -> Array:
    """Hidden pixels show the occluder in the source, as under a mask of image bounds only."""
    pair = edited.pair
    hidden = (pair.label == HIDDEN) & has_taps(pair.xy, edited.source.shape)
    result = edited.after.copy()
    result[hidden] = to_srgb(np.clip(sampled(to_linear(edited.source), pair.xy[hidden]), 0, 1))
    return result


def _blurred(edited: Edited, size: float) -> Array:
    blurred = gaussian_filter(to_linear(edited.after), (size, size, 0), mode="nearest")
    return to_srgb(np.clip(blurred, 0, 1))


def _mixed(picture: Array, other: Array, weight: float) -> Array:
    """Sum of two pictures in linear light, the other's with a weight."""
    light = (1 - weight) * to_linear(picture) + weight * to_linear(other)
    return to_srgb(np.clip(light, 0, 1))


def _flat(edited: Edited, size: float) -> Array:
    """Texture removed by a share: each object is mixed with its mean light."""
    light, ids = to_linear(edited.after), edited.pair.hits.object_id
    for one in np.unique(ids):
        here = ids == one
        light[here] += size * (light[here].mean(axis=0) - light[here])
    return to_srgb(np.clip(light, 0, 1))


def _moved(edited: Edited, motion: Motion) -> Array:
    """The picture after a motion about its middle; the border is repeated."""
    return moved(edited.after, motion)


def _bled(edited: Edited, size: float) -> Array:
    """The object's paint ``size`` px beyond its outline."""
    around = ~edited.mask & (distance_transform_edt(~edited.mask) <= size)
    if not edited.mask.any():
        return edited.after
    return np.where(around[..., None], to_srgb(np.clip(edited.grown(), 0, 1)), edited.after)


def _noisy(edited: Edited, size: float) -> Array:
    noise = np.random.default_rng([edited.seed, 3, edited.place]).normal(
        0, size, edited.after.shape
    )
    return np.clip(edited.after + noise, 0, 1)


FLAWS = (
    Flaw("answer", "another answer", "of the object", (0.3, 1.0), 1.0, _answer, counts=True),
    Flaw("unedited", "view left unedited", "", (1.0,), 1.0, lambda e, _: e.before, counts=True),
    Flaw(
        "ghost", "two answers at once", "of the light", (0.25, 0.5), 0.5,
        lambda e, size: _mixed(e.after, e.another, size), counts=True,
    ),
    Flaw("hue", "hue shift", "degrees", (15.0, 45.0), 45.0, _hue, counts=True),
    Flaw("slid", "texture slid", "px", (1.0, 2.0, 4.0, 8.0), 4.0, _slid, counts=True),
    Flaw("doubled", "doubled behind an edge", "", (1.0,), 1.0, _doubled),
    Flaw("bled", "paint bled outside", "px", (4.0, 8.0), 4.0, _bled),
    Flaw("blur", "blur", "px", (0.5, 1.0, 2.0, 4.0), 2.0, _blurred),
    Flaw("flat", "texture removed", "of the contrast", (0.5, 1.0), 1.0, _flat),
    Flaw("noise", "noise", "of white", (0.03, 0.1), 0.03, _noisy),
    Flaw(
        "moved", "picture shifted", "px", (2.0, 8.0), 2.0,
        lambda e, size: _moved(e, (size, 0, 0, 0)),
    ),
    Flaw(
        "zoomed", "picture zoomed", "%", (0.5, 1.0, 2.0), 2.0,
        lambda e, size: _moved(e, (0, 0, size, 0)),
    ),
    Flaw(
        "turned", "picture turned", "degrees", (0.5,), 0.5,
        lambda e, size: _moved(e, (0, 0, 0, size)),
    ),
    Flaw("elsewhere", "another scene", "", (1.0,), 1.0, lambda e, _: e.elsewhere),
    Flaw(
        "weak_all", "all views: edit left out", "of the light", (0.5, 1.0), 0.5,
        lambda e, size: _mixed(e.after, e.before, size), alike=True,
    ),
    Flaw("hue_all", "all views: hue shift", "degrees", (180.0,), 180.0, _hue, alike=True),
    Flaw(
        "misdirected_all", "all views: another thing edited", "", (1.0,), 1.0,
        lambda e, _: e.misdirected, alike=True,
    ),
    Flaw("blur_all", "all views: blur", "px", (0.5, 1.0, 2.0, 4.0), 2.0, _blurred, alike=True),
    Flaw(
        "flat_all", "all views: texture removed", "of the contrast", (0.5, 1.0), 1.0, _flat,
        alike=True,
    ),
    Flaw("noise_all", "all views: noise", "of white", (0.03,), 0.03, _noisy, alike=True),
)  # fmt: skip
"""Every flaw: first of the target, the most important first, then of all views."""

COUNTED = tuple(flaw for flaw in FLAWS if flaw.counts)
"""The most important flaws."""

CONDITIONS = {flaw.key(size): (flaw, size) for flaw in FLAWS for size in flaw.sizes}
"""Flaws with their sizes by name."""
