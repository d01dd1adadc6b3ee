"""A thing in parts: its labels and true answers in every view, and the editor with them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from cv2 import INTER_NEAREST

from attnwarp.camera import Camera
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.shared.drifts import Motion, moved
from attnwarp_eval.truth import Geometry, appearance
from attnwarp_eval.two_view import TwoView
from attnwarp_lab.ideal.editor import FACTOR, Answers, Cross, IdealEditor
from attnwarp_lab.ideal.figures import PartTruth
from attnwarp_lab.ideal.paint import answer_colors, painted
from attnwarp_lab.ideal.parts import Labels, part_labels, token_parts
from attnwarp_lab.ideal.share import Grams


def labels_of(
    scene: Scene, geometry: Geometry, cameras: Sequence[Camera], objects: Sequence[str], parts: int
) -> dict[str, Labels]:
    """(H, W) part of each pixel by the view's name, -1 outside the thing.

    Args:
        cameras: cameras of the views, whose surface points are pooled.
        objects: names of the thing's objects.

    Raises:
        ValueError: no such object, or no view shows one.
    """
    there = scene.object_names
    for name in objects:
        if name not in there:
            raise ValueError(f"objects: got {name!r}, expected some of {', '.join(there)}")
    ids = [there.index(name) for name in objects]
    points = {}
    for camera in cameras:
        hits = geometry.trace(camera)
        inside = np.isin(hits.object_id, ids)
        points[camera.name] = np.where(inside[..., None], hits.point, np.nan)
    return part_labels(points, parts)


@dataclass(frozen=True, eq=False)
class Thing:
    """A thing in parts, each with the same answers.

    Attributes:
        labels: (H, W) part of each pixel, by view.
        before: (H, W, 3) sRGB in [0, 1] before the edit, by view.
        after: (K, H, W, 3) after the edit, the whole thing in one answer, by view.
        parts: number of parts.
    """

    labels: Mapping[str, Labels]
    before: Mapping[str, np.ndarray]
    after: Mapping[str, np.ndarray]
    parts: int

    @classmethod
    def of(
        cls,
        scene: Scene,
        geometry: Geometry,
        cameras: Sequence[Camera],
        objects: Sequence[str],
        *,
        parts: int,
        colors: int,
        spp: int,
    ) -> Thing:
        """A scene's objects, painted in colours.

        Args:
            scene, geometry, cameras, objects, parts: see :func:`labels_of`. The source comes first.
            colors: answers of each part.

        Example:
            >>> from attnwarp_eval.scene.file import load_scene
            >>> from attnwarp_eval.truth import Geometry
            >>> scene = load_scene("spheres").with_size(16, 16)
            >>> thing = Thing.of(scene, Geometry(scene), scene.cameras[:2], ["melon"],
            ...                  parts=2, colors=3, spp=1)
            >>> thing.after["source"].shape
            (3, 16, 16, 3)
        """
        labels = labels_of(scene, geometry, cameras, objects, parts)

        def pictures(of: Scene) -> dict[str, np.ndarray]:
            return {c.name: to_srgb(appearance(of, c, spp=spp, seed=0)) for c in cameras}

        before = pictures(scene)
        after = [pictures(painted(scene, objects, color)) for color in answer_colors(colors)]
        return cls(
            labels, before, {name: np.stack([one[name] for one in after]) for name in before}, parts
        )

    def moved(self, motion: Callable[[np.ndarray], Motion]) -> Thing:
        """The thing in pictures that an editor moves.

        Args:
            motion: function of a view's picture before.
        """
        motions = {name: motion(before) for name, before in self.before.items()}
        return Thing(
            {n: moved(labels, motions[n], INTER_NEAREST) for n, labels in self.labels.items()},
            {n: moved(before, motions[n]) for n, before in self.before.items()},
            {n: np.stack([moved(one, motions[n]) for one in a]) for n, a in self.after.items()},
            self.parts,
        )

    def tokens(self, view: str) -> Labels:
        """(h, w) part of each token of a view."""
        H, W = self.labels[view].shape
        return token_parts(self.labels[view], (H // FACTOR, W // FACTOR))

    @cached_property
    def views(self) -> list[Answers]:
        """Views as inputs of the editor."""
        return [
            Answers(before, self.after[name], self.tokens(name))
            for name, before in self.before.items()
        ]

    @cached_property
    def grams(self) -> Grams:
        """Gram matrices of the parts, which decide the share of signal."""
        return Grams.of(self.views)

    def editor(self, share: float, cross: Cross = "paint") -> IdealEditor:
        """The editor of these views."""
        return IdealEditor(self.views, share, cross)

    def truth(self, view: str) -> PartTruth:
        """True pictures of a view, for figures."""
        return PartTruth.of(
            self.before[view], self.after[view], self.labels[view], self.tokens(view)
        )


def in_front(pair: TwoView, source: Labels) -> Labels:
    """(H, W) part of the surface that the source shows at the position of a target's point; -1 for
    no part, and for a point outside the source image.

    Args:
        source: (H, W) part of each pixel of the source.
    """
    result = np.full(pair.label.shape, -1, dtype=np.int16)
    inside = pair.in_source_image
    column, row = np.floor(pair.xy[inside]).astype(np.int64).T
    h, w = source.shape
    result[inside] = source[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
    return result
