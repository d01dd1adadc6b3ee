"""Geometry of an edit: the warps between its views, and the choice of source views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.digest import digest_each
from attnwarp.gaussians import Gaussians
from attnwarp.methods.pictures import Mask
from attnwarp.methods.settings import AttentionWarpingSettings
from attnwarp.methods.sight import Sight
from attnwarp.methods.work import Work
from attnwarp.warp import Surface, WarpedView, parts_read, render_surface, warp_view

CHAIN_COVERAGE = 0.5
"""Share of the next source's surface that the sources so far must see."""

Warps = Callable[[int, int], WarpedView]
"""Function that returns the warp from a source view to a target view, by their numbers."""


class Geometry:
    """Warps along the scene's geometry."""

    def __init__(self, work: Work, settings: AttentionWarpingSettings, warps: Warps | None) -> None:
        self.work, self.settings, self.outside = work, settings, warps
        self._frozen: dict[int, Surface] = {}

    def sight(self, sources: Sequence[int], view: int, model: Gaussians) -> Sight:
        """Compute the visibility of a view: the sources' warps and the source of each pixel."""
        s = self.settings
        warps = [self.warp(source, view, model) for source in sources]
        scales = [self._edit_share(source) / self._edit_share(view) for source in sources]
        zeros = not s.mask and s.outside == "zeros"
        return Sight(warps, scales, zeros)

    def warp(self, source: int, target: int, model: Gaussians) -> WarpedView:
        """Compute the warp from one view to another by depth of the original or current model."""
        s, scene = self.settings, self.work.scene
        if self.outside is not None:
            return self._masked(self.outside(source, target))
        before = self.work.frozen if s.depth_from == "frozen" else model
        reads: dict[str, Any] = {}
        wanted = parts_read(s.warp)
        if "source_image" in wanted:
            reads["source_image"] = scene.picture(source)
        if "target_image" in wanted:
            reads["target_image"] = scene.picture(target)
        if "target_segment" in wanted and scene.segments is not None:
            reads["target_segment"] = scene.segments[target] > 0.5
        warp = warp_view(
            before,
            scene.cameras[source],
            scene.cameras[target],
            s.warp,
            **reads,
            source_surface=self._surface(source, before),
            near=self.work.near,
            backend=self.work.backend,
            warn_empty=False,
        )
        return self._masked(warp)

    def _masked(self, warp: WarpedView) -> WarpedView:
        return warp if self.settings.mask else warp.with_mask(warp.rules["defined"])

    def _surface(self, view: int, model: Gaussians) -> Surface:
        if model is self.work.frozen and view in self._frozen:
            return self._frozen[view]
        surface = render_surface(
            model, self.work.scene.cameras[view], self.settings.warp,
            near=self.work.near, backend=self.work.backend,
        )  # fmt: skip
        if model is self.work.frozen:
            self._frozen[view] = surface
        return surface

    def _edit_share(self, view: int) -> float:
        """Pixels of a view's edit per pixel of its picture."""
        camera, (h, w) = self.work.scene.cameras[view], self.work.sizes[view]
        return h * w / (camera.height * camera.width)

    def digest(self, sources: Sequence[int], targets: Sequence[int]) -> str:
        """Hash the external warps between views (SHA-256): a function has no other identity."""
        outside, cameras = self.outside, self.work.scene.cameras
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

    def chain(self, source: int) -> tuple[int, ...]:
        """Choose further sources, as many as the settings ask; see :func:`choose_chain`."""
        s, scene = self.settings, self.work.scene

        def seen(first: int, target: int) -> tuple[Mask, Mask]:
            warp = self.warp(first, target, self.work.frozen)
            surface = warp.rules["defined"].numpy()
            if scene.segments is not None:
                surface = surface & (scene.segments[target] > 0.5)
            return warp.mask.numpy(), surface

        return choose_chain(len(scene.cameras), source, s.sources, CHAIN_COVERAGE, seen)


def choose_chain(
    views: int,
    source: int,
    count: int,
    coverage: float,
    seen: Callable[[int, int], tuple[Mask, Mask]],
) -> tuple[int, ...]:
    """Choose further sources, outward from the first.

    A view's share is the part of its surface that the sources so far see. The next source is the
    view of the smallest share among those with a share of at least ``coverage``. If no view has
    that share, the view of the largest share is next. The first of equal views is chosen.

    Args:
        count: number of sources, the first included; fewer if there are fewer views.
        seen: function of a source and a target that returns two (H, W) bool masks: target pixels
            that the source sees, and target pixels that show surface.
    """
    chain: list[int] = []
    seen_by_some: dict[int, Mask] = {}
    last = source
    while len(chain) < min(count, views) - 1:
        shares = {}
        for view in range(views):
            if view in (source, *chain):
                continue
            pixels, surface = seen(last, view)
            seen_by_some[view] = seen_by_some.get(view, np.zeros_like(pixels)) | (pixels & surface)
            shares[view] = float(seen_by_some[view].sum() / max(1, surface.sum()))
        enough = {view: share for view, share in shares.items() if share >= coverage}
        last = (
            min(enough, key=enough.__getitem__) if enough else max(shares, key=shares.__getitem__)
        )
        chain.append(last)
    return tuple(chain)
