"""A pair of views under one variant: its truth, its warp, and the pictures that colour it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp import Gaussians
from attnwarp.warp import (
    Surface,
    WarpedView,
    WarpSettings,
    render_surface,
    warp_surfaces,
    warp_view,
)
from attnwarp_eval.study import pictures
from attnwarp_eval.twoview import AMBIGUOUS, HIDDEN, NONE, VISIBLE, TwoView
from attnwarp_eval.world import World

Image = npt.NDArray[np.float32]

COLORINGS = ("picture", "mask", "endpoint error", "depth error", "incidence")
"""What the surface that the target sees can be coloured by."""

LABELS = {NONE: "none", VISIBLE: "visible", HIDDEN: "hidden", AMBIGUOUS: "ambiguous"}


@dataclass(frozen=True, eq=False)
class Pair:
    """One target view against the source, under one variant.

    Args:
        world: the scene's truth.
        target: name of the target view.
        settings: the rules of the warp.
        model: the splats that give depth; None takes the truth's own depth.
        spp: samples a pixel of the true pictures.
    """

    world: World
    target: str
    settings: WarpSettings
    model: Gaussians | None
    spp: int = 8

    @cached_property
    def truth(self) -> TwoView:
        """Exact correspondences and visibility."""
        return self.world.pair(self.target, self.world.source.height)

    @cached_property
    def images(self) -> tuple[Image, Image]:
        """(H, W, 3) sRGB truth of the source and of the target."""
        world = self.world
        return world.image(world.source.name, self.spp), world.image(self.target, self.spp)

    @cached_property
    def surfaces(self) -> tuple[Surface, Surface]:
        """What source and target know of the surface, as the warp takes it."""
        source, target = self.world.source, self.world.targets[self.target]
        if self.model is not None:
            return (
                render_surface(self.model, source, self.settings),
                render_surface(self.model, target, self.settings),
            )
        source_hits = self.world.geometry.trace(source)
        target_hits = self.world.geometry.trace(target)
        return (
            Surface(source_hits.depth, source_hits.normal, image=self.images[0]),
            Surface(target_hits.depth, target_hits.normal, image=self.images[1]),
        )

    @cached_property
    def view(self) -> WarpedView:
        """The warp and its mask."""
        source, target = self.world.source, self.world.targets[self.target]
        if self.model is None:
            return warp_surfaces(source, target, self.surfaces[1], self.surfaces[0], self.settings)
        source_image, target_image = self.images
        return warp_view(
            self.model,
            source,
            target,
            self.settings,
            source_surface=self.surfaces[0],
            source_image=source_image,
            target_image=target_image,
        )

    @cached_property
    def depths(self) -> Mapping[str, npt.NDArray[np.float64]]:
        """(H, W) depth of the target by each definition, NaN where undefined."""
        maps = {"truth": self.truth.hits.depth}
        if self.model is not None:
            for depth in ("intersection", "center"):
                for statistic in ("expected", "median"):
                    settings = WarpSettings(depth=depth, depth_statistic=statistic)
                    surface = render_surface(self.model, self.world.targets[self.target], settings)
                    maps[f"{depth}, {statistic}"] = np.asarray(surface.depth, dtype=np.float64)
        return maps

    @cached_property
    def incidence(self) -> npt.NDArray[np.float64]:
        """(H, W) degrees between the true normal and the direction to the source camera."""
        hits = self.truth.hits
        ray = self.world.source.position - hits.point
        cosine = np.einsum("hwi,hwi->hw", hits.normal, ray) / np.linalg.norm(ray, axis=-1)
        return np.degrees(np.arccos(np.clip(cosine, -1, 1)))

    def colors(self, coloring: str) -> Image:
        """(H, W, 3) sRGB colours of the target's pixels.

        Args:
            coloring: one of :data:`COLORINGS`.
        """
        if coloring == "picture":
            return self.images[1]
        if coloring == "mask":
            return pictures.mask_against_truth(self.view.mask.numpy(), self.truth, self.images[1])
        if coloring == "endpoint error":
            return pictures.endpoint_map(self.view.correspondence.xy.numpy(), self.truth)
        if coloring == "depth error":
            depth = np.asarray(self.surfaces[1].depth, dtype=np.float64)
            return pictures.depth_map(depth, self.truth.hits)
        if coloring == "incidence":
            return incidence_map(self.incidence)
        raise ValueError(f"coloring: got {coloring!r}, expected one of {', '.join(COLORINGS)}")

    def insets(self) -> dict[str, Image]:
        """The four pictures beside the 3D view, by title."""
        source, target = self.images
        return {
            "source": source,
            "target": target,
            "source, warped": pictures.warped(source, self.view),
            "mask against truth": self.colors("mask"),
        }


def incidence_map(degrees: npt.NDArray[Any]) -> Image:
    """Angle of incidence at the source, 0 bright to 90 dark; grey where the surface turns away."""
    import matplotlib

    image = matplotlib.colormaps["viridis"](1 - np.nan_to_num(degrees, nan=90) / 90)[..., :3]
    faces = np.isfinite(degrees) & (degrees < 90)
    return np.where(faces[..., None], image, 0.6).astype(np.float32)
