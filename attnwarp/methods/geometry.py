"""Geometry of an edit: the warps between its views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.digest import digest_each
from attnwarp.gaussians import Gaussians
from attnwarp.methods.work import Work
from attnwarp.warp import (
    Surface,
    WarpedView,
    WarpSettings,
    parts_read,
    render_surface,
    sample_at,
    warp_view,
)

Warps = Callable[[int, int], WarpedView]
"""Function that returns the warp from a source view to a target view, by their numbers."""


class Geometry:
    """Warps along the scene's geometry.

    Args:
        warps: external warps; None uses the splats' depth.
        mask: True keeps a warp's mask, False every pixel with a depth.
        depth_from: model of the depth: "frozen" is that before the edit, "current" the tuned one.
    """

    def __init__(
        self,
        work: Work,
        settings: WarpSettings,
        warps: Warps | None,
        *,
        mask: bool = True,
        depth_from: str = "frozen",
    ) -> None:
        self.work, self.settings, self.outside = work, settings, warps
        self.mask, self.depth_from = mask, depth_from
        self._frozen: dict[int, Surface] = {}

    def warp(self, source: int, target: int, model: Gaussians) -> WarpedView:
        """Compute the warp from one view to another by depth of the original or current model."""
        s, views, segments = self.settings, self.work.views, self.work.segments
        if self.outside is not None:
            return self._masked(source, self.outside(source, target))
        before = self.work.frozen if self.depth_from == "frozen" else model
        reads: dict[str, Any] = {}
        wanted = parts_read(s)
        if "source_image" in wanted:
            reads["source_image"] = views.picture(source)
        if "target_image" in wanted:
            reads["target_image"] = views.picture(target)
        if "target_segment" in wanted and segments is not None:
            reads["target_segment"] = segments[target] > 0.5
        warp = warp_view(
            before,
            views.cameras[source],
            views.cameras[target],
            s,
            **reads,
            source_surface=self._surface(source, before),
            near=self.work.near,
            backend=self.work.backend,
            warn_empty=False,
        )
        return self._masked(source, warp)

    def _masked(self, source: int, warp: WarpedView) -> WarpedView:
        if not self.mask:
            warp = warp.with_mask(warp.rules["defined"])
        kept = self.work.views.masks[source]
        if kept is None:
            return warp
        # What the source's mask ignores, such as a passer-by, is not on the surface behind it.
        share = sample_at(torch.from_numpy(kept)[None].double(), warp.correspondence.xy)[0]
        return warp.with_mask(warp.mask & (share > 0.5))

    def _surface(self, view: int, model: Gaussians) -> Surface:
        if model is self.work.frozen and view in self._frozen:
            return self._frozen[view]
        surface = render_surface(
            model, self.work.views.cameras[view], self.settings,
            near=self.work.near, backend=self.work.backend,
        )  # fmt: skip
        if model is self.work.frozen:
            self._frozen[view] = surface
        return surface

    def digest(self, sources: Sequence[int], targets: Sequence[int]) -> str:
        """Hash the external warps between views (SHA-256): a function has no other identity."""
        outside, cameras = self.outside, self.work.views.cameras
        assert outside is not None

        def parts() -> Iterator[npt.NDArray[Any]]:
            # Warps are large, so none is kept; a mask is a hundredth of a warp.
            masks = []
            for source in sources:
                for target in targets:
                    if target == source:
                        continue
                    warp, camera = outside(source, target), cameras[target]
                    name = f"warps({source}, {target}).mask"
                    check.shape(warp.mask, (camera.height, camera.width), name)
                    masks.append(warp.mask.numpy())
                    yield warp.correspondence.xy.numpy()
            yield from masks

        return digest_each(parts())
