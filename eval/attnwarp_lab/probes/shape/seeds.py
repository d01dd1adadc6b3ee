"""First splats of surface that an edit adds: where no new colour of the old surface explains it.

Tuning moves splats by little and adds none far from others, so nothing can stand where none was.
A changed pixel whose old surface has one new colour in all views that see it is explained by that
colour. Along the ray of every other one, a splat is put in the first place that the views agree on:
all that look there have changed, and show one colour (space carving, Kutulakos and Seitz 2000).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation

from attnwarp.camera import Camera

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Image = npt.NDArray[np.floating]

CHANGED = 0.05
"""Root mean square change of a pixel's values in [0, 1] from which it counts as changed."""

ALIKE = 0.1
"""Standard deviation of colours, in [0, 1], up to which views show one."""

SAME_DEPTH = 0.02
"""Relative difference of depth within which a view sees a point."""

LEAST_VIEWS = 3
"""Least number of changed views that look at a place: two agree by chance before each camera."""

RANGE = (0.3, 2.0)
"""Depths searched, as multiples of the views' median depth."""

STEPS = 96
"""Number of depths searched."""


@dataclass(frozen=True, eq=False)
class EditedViews:
    """Pictures before and after an edit, with the depth of the splats.

    Args:
        before, after: (V, H, W, 3) sRGB in [0, 1].
        depths: (V, H, W) of the splats; infinite where they have none.
    """

    cameras: Sequence[Camera]
    before: Image
    after: Image
    depths: Array

    @property
    def changed(self) -> Mask:
        """(V, H, W) pixels that the edit changes."""
        return np.asarray(np.sqrt(np.square(self.after - self.before).mean(axis=-1)) > CHANGED)

    def seeds(self) -> tuple[Array, npt.NDArray[np.uint8]]:
        """Compute (S, 3) places of new surface and their colours.

        Example:
            >>> import numpy as np
            >>> from attnwarp.trial import view
            >>> black = np.zeros((3, 8, 8, 3))
            >>> same = EditedViews([view(side=8)] * 3, black, black, np.ones((3, 8, 8)))
            >>> len(same.seeds()[0])  # an edit that changes nothing adds nothing
            0
        """
        changed, places, colors = self.changed, [np.zeros((0, 3))], [np.zeros((0, 3))]
        if not changed.any():
            return places[0], colors[0].astype(np.uint8)
        middle = float(np.median(self.depths[np.isfinite(self.depths)]))
        near, far = (factor * middle for factor in RANGE)
        for view, camera in enumerate(self.cameras):
            explained = binary_dilation(self._recoloured(view, changed), np.ones((3, 3)))
            row, column = np.nonzero(changed[view] & ~explained)
            xy = np.stack([column, row], axis=-1) + 0.5
            end = np.minimum(self.depths[view, row, column] * (1 + SAME_DEPTH), far)
            first = np.full(len(xy), np.nan)
            for depth in np.linspace(far, near, STEPS):
                points = camera.unproject(xy, np.full(len(xy), depth))
                first[self._agreed(points, changed) & (depth < end)] = depth
            there = np.isfinite(first)
            places.append(camera.unproject(xy[there], first[there]))
            colors.append(self.after[view, row[there], column[there]])
        shown = np.concatenate(colors).clip(0, 1)
        return np.concatenate(places), np.round(255 * shown).astype(np.uint8)

    def _recoloured(self, view: int, changed: Mask) -> Mask:
        """(H, W) changed pixels whose old surface has one new colour in the views that see it."""
        explained = np.zeros_like(changed[view])
        row, column = np.nonzero(changed[view] & np.isfinite(self.depths[view]))
        depth = self.depths[view, row, column]
        points = self.cameras[view].unproject(np.stack([column, row], axis=-1) + 0.5, depth)
        pixels, inside, z = self._look(points)
        seen = inside & (np.abs(self.depths[pixels] - z) < SAME_DEPTH * z)
        everywhere = (changed[pixels] | ~seen).all(axis=0)
        alike = _deviation(self.after[pixels], seen) < ALIKE
        explained[row, column] = everywhere & alike & (seen.sum(axis=0) >= 2)
        return explained

    def _agreed(self, points: Array, changed: Mask) -> Mask:
        """(P,) whether views agree that something new is at a point."""
        pixels, inside, z = self._look(points)
        new = inside & changed[pixels]
        hidden = self.depths[pixels] < z * (1 - SAME_DEPTH)
        known = 2 * inside.sum(axis=0) >= len(self.cameras)
        possible = (new | hidden | ~inside).all(axis=0) & known
        alike = _deviation(self.after[pixels], new) < ALIKE
        return np.asarray(possible & alike & (new.sum(axis=0) >= LEAST_VIEWS))

    def _look(self, points: Array) -> tuple[tuple[npt.NDArray[np.int64], ...], Mask, Array]:
        """Index of the pixels (V, P) that show points, whether they are inside, and depths."""
        _, H, W = self.depths.shape
        looks = [camera.project(points) for camera in self.cameras]
        xy, z = (np.stack(parts) for parts in zip(*looks, strict=True))
        column, row = np.floor(np.nan_to_num(xy, nan=-1.0)).astype(np.int64).transpose(2, 0, 1)
        inside = (z > 0) & (row >= 0) & (row < H) & (column >= 0) & (column < W)
        view = np.arange(len(self.cameras))[:, None].repeat(len(points), axis=1)
        return (view, row.clip(0, H - 1), column.clip(0, W - 1)), inside, z


def _deviation(colors: Image, where: Mask) -> Array:
    """(P,) standard deviation over views of colours (V, P, 3), of the views ``where`` says."""
    weight = where[..., None]
    count = np.maximum(weight.sum(axis=0), 1)
    mean = (colors * weight).sum(axis=0) / count
    squares = (np.square(colors - mean) * weight).sum(axis=0) / count
    return np.asarray(np.sqrt(squares).mean(axis=-1))
