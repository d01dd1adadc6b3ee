"""Warped reference: the source's edit, warped into each view, is the picture that the view's edit
starts from. In small the projection and refinement of GeM-NR (Bengtson et al. 2026).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np
import torch

from attnwarp.gaussians import Gaussians
from attnwarp.methods.base import Loop, ViewEdit
from attnwarp.methods.by_warps import ByWarps, SourceSettings, checked_source
from attnwarp.methods.doors import door
from attnwarp.methods.geometry import Warps
from attnwarp.methods.pictures import Image
from attnwarp.methods.settings import (
    needs_start,
)
from attnwarp.methods.work import Work, chunks


@dataclass(frozen=True)
class WarpedReferenceSettings(SourceSettings):
    """Settings of :func:`attnwarp.methods.warped_reference`.

    Args:
        start: (lowest, highest) range of the timestep to which start pictures are noised; one is
            drawn for all views. The source starts from pure noise.

    Example:
        >>> from attnwarp.methods import WarpedReferenceSettings
        >>> WarpedReferenceSettings(start=None)
        Traceback (most recent call last):
        ValueError: start: got None, but views begin at pictures; give [lowest, highest]
    """

    start: tuple[int, int] | None = (700, 700)

    def __post_init__(self) -> None:
        super().__post_init__()
        needs_start(self.start)


class WarpedReference(ByWarps):
    """Edit a source view, then each other view from the source's warped edit, and tune the splats.

    A view starts from M S_warp + (1 - M) I: S_warp is the source's edit warped along the splats'
    depth, M the warp's mask, I the view's picture, which also guides the edit. The start is noised
    to a timestep T and denoised.

    The paper also aligns the depth of edits that change the geometry, and refines by an editor that
    takes two pictures.

    Args:
        gaussians, cameras, images, editor, instruction, options: see :func:`by_view`.
        settings: :class:`WarpedReferenceSettings`; the defaults if omitted.
        source, warps: see :func:`attention_warping`.

    Raises:
        ValueError, InputError, RuntimeError: see :func:`by_view`.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.methods import WarpedReferenceSettings, warped_reference
        >>> from attnwarp.trial import disc, view
        >>> quick = WarpedReferenceSettings(steps=1, iterations=1)
        >>> views, editor = [view(0), view(1)], load_editor("small-plain")
        >>> result = warped_reference(disc(), views, None, editor, "red", quick)
        >>> list(result.edited)  # the source, then the other view
        [0, 1]
    """

    def __init__(
        self,
        work: Work,
        settings: WarpedReferenceSettings,
        source: int = 0,
        warps: Warps | None = None,
    ) -> None:
        assert settings.start is not None
        work.starts_at(settings.start[0], "start")
        self.settings, self.source = settings, checked_source(source, work)
        self.others = [view for view in range(len(work.sizes)) if view != self.source]
        super().__init__(work, settings, warps, [self.source], self.others)
        self.about = {"source": self.names[self.source]}

    def run(self, loop: Loop) -> None:
        """Edit the source, then the other views batch by batch, then tune."""
        work, s = self.work, self.settings
        rows = s.steps * work.branches()
        loop.edit(0, [self.source], partial(self.edit, [self.source]), rows=rows)
        for _, same in groupby(self.others, key=lambda view: work.sizes[view]):
            for batch in chunks(list(same), s.batch):
                loop.edit(0, batch, partial(self.edit, batch), rows=len(batch) * rows)
        loop.tune(0, range(len(work.sizes)), s.iterations)

    def edit(
        self, batch: Sequence[int], model: Gaussians, step: Callable[[], None]
    ) -> list[ViewEdit]:
        """Edit the source from pure noise, or other views from its edit."""
        work, s = self.work, self.settings
        pictures: list[Image] | None = None
        start, shares = None, [0.0]
        if self.source not in batch:
            assert s.start is not None
            start = work.timestep(0, self.source, s.start)
            pictures, shares = map(list, zip(*map(self.starts, batch), strict=True))
        result = work.edit(batch, step, start=start, pictures=pictures)
        return [
            ViewEdit(picture, {"start": start, "warped": share})
            for picture, share in zip(result.images, shares, strict=True)
        ]

    def starts(self, view: int) -> tuple[Image, float]:
        """Compose the picture (h, w, 3) that a view starts from, and the warped share of it."""
        warp, before = self.of_edits(self.source, view), self.work.picture(view)
        edited = torch.from_numpy(self.kept(0, self.source)).permute(2, 0, 1)
        # Weights that add up to more than 1 by rounding must not leave [0, 1].
        warped = warp.warp(edited).clamp(0, 1).permute(1, 2, 0).numpy()
        mask = warp.mask.numpy()
        picture = np.where(mask[..., None], warped, before).astype(np.float32)
        return picture, float(mask.mean())


warped_reference = door(WarpedReference, {"default": WarpedReferenceSettings()})
