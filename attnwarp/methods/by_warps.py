"""Methods that carry edits along the warps between views of the splats before the edit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from attnwarp import check
from attnwarp.editing.schedule import Grid, Time
from attnwarp.io.names import file_stems
from attnwarp.methods.algorithms.by_view import ByViewSettings
from attnwarp.methods.base import Method, edit_file
from attnwarp.methods.geometry import Geometry, Warps
from attnwarp.methods.pictures import Image, Size
from attnwarp.methods.work import Work
from attnwarp.warp import PRESETS as WARPS
from attnwarp.warp import FeatureWarp, WarpedView, WarpSettings


@dataclass(frozen=True)
class CarriedSettings(ByViewSettings):
    """Settings shared by the methods that carry edits along warps of their own.

    Args:
        warp: correspondences and masks, :class:`attnwarp.warp.WarpSettings`.
    """

    warp: WarpSettings = WARPS["corrected"]


@dataclass(frozen=True)
class SourceSettings(CarriedSettings):
    """Settings shared by those of them that give one view, the source, a part of its own."""


class ByWarps(Method):
    """Method with warps between its views.

    Args:
        warps: external warps, such as from exact depth; None uses the splats' depth.
        sources, targets: numbers of the views that external warps lead from and to; None for all.
    """

    def __init__(
        self,
        work: Work,
        settings: CarriedSettings,
        warps: Warps | None,
        sources: Sequence[int] | None = None,
        targets: Sequence[int] | None = None,
    ) -> None:
        self.work, self.names = work, file_stems(work.views.cameras)
        self.geometry = Geometry(work, settings.warp, warps)
        if warps is not None:
            views = range(len(self.names))
            digest = self.geometry.digest(sources or views, targets or views)
            self.inputs = {"warps": digest}

    def warp(self, source: int, target: int) -> WarpedView:
        """Compute the warp from one view to another."""
        with self.work.folder.seconds.part("warp"):
            return self.geometry.warp(source, target, self.work.frozen)

    def of_edits(self, source: int, target: int) -> FeatureWarp:
        """Compute the warp from one view's edit to another's, at the sizes of the edits."""
        sizes: list[Size] = self.work.sizes
        return self.warp(source, target).at(sizes[target], source_size=sizes[source])

    def kept(self, number: int, view: int) -> Image:
        """Read a view's edit of a round, (h, w, 3) in [0, 1], as rounded in its file: a resumed run
        reads the same.
        """
        pixels = self.work.folder.read_picture(edit_file(number, self.names[view]))
        return pixels.astype(np.float32) / np.float32(255)

    def begin(
        self, number: int, view: int, start: int | None, grid: Grid
    ) -> tuple[Tensor, Sequence[Time]]:
        """Return the latents (1, C, h, w) that a view's edit begins at, and its timesteps: of its
        noised picture, or without a start of what the editor begins at.
        """
        editor, s = self.work.editor, self.work.settings
        network = editor.network
        noise = self.work.noise(number, (view,)).to(network.device, network.dtype)
        schedule = editor.schedule
        size = noise.shape[2], noise.shape[3]
        if start is not None:
            (noised,) = schedule.published(start, 1)
            timesteps = schedule.published(start, s.steps, grid)
        else:
            timesteps = schedule.timesteps(s.steps, size)
            if editor.begins == "noise":
                return noise, timesteps
            noised = timesteps[0]
        before = editor.encode([self.work.picture(view)])
        return schedule.add_noise(before, noise, noised), timesteps


def checked_source(source: int, work: Work) -> int:
    """Return the number of a source view."""
    return int(check.number(source, 0, len(work.sizes) - 1, "source", whole=True))
