"""GaussCtrl (Wu et al. 2024): edit views by depth, with attention to reference views, from the
inverted noise of their renders.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attnwarp.editing.editor import edit
from attnwarp.editing.editors.controlnet import DepthControlNet
from attnwarp.editing.inversion import inversion_rows, invert_view
from attnwarp.gaussians import Gaussians
from attnwarp.methods.attention import aligned, self_attention
from attnwarp.methods.base import Loop, Method, ViewEdit
from attnwarp.methods.doors import door
from attnwarp.methods.settings import (
    STABLE_DIFFUSION,
    Latents,
    MethodSettings,
)
from attnwarp.methods.work import VIEWS, Guide, Work, chunks
from attnwarp.settings import Count, Share


@dataclass(frozen=True)
class GaussCtrlSettings(MethodSettings):
    """Settings of :func:`attnwarp.methods.gaussctrl`.

    Args:
        views: number of edited views: an equal share of each contiguous part of the views, at
            random; all views if there are fewer.
        references: number of parts of the views; each part gives one reference view.
        self_share: weight of a view's own keys in the UNet's self-attention; the rest is shared
            equally by the reference views.
        control_share: ``self_share`` for the ControlNet; None keeps its attention unchanged.
        latents: initial latents of an edit: DDIM "inversion" of the render, or "random".
        source_prompt: prompt of the inversion; None for the instruction.
        suffix: suffix of the instruction.
        negative_prompt: negative prompt of the unconditional branch; None for the editor's default.
        batch: number of views per network pass, besides the reference views.

    Example:
        >>> from attnwarp.methods import GaussCtrlSettings
        >>> GaussCtrlSettings().self_share
        0.6
    """

    views: Count = 40
    references: Count = 4
    self_share: Share = 0.6
    control_share: Share | None = None
    latents: Latents = "inversion"
    source_prompt: str | None = ""
    suffix: str = ""
    negative_prompt: str | None = None
    batch: Count = 5


class GaussCtrl(Method):
    """Edit views by depth with attention to reference views, then tune the splats on the edits.

    Each edit starts from the DDIM inversion of the view's render, without guidance, or from random
    latents. The reference views go through the network with every batch.

    Args:
        gaussians, cameras, images, options: see :func:`by_view`. ``images`` are used for the
            segments and for the detail that an edit at a smaller size lacks; guides come from the
            splats.
        editor: a :class:`~attnwarp.editing.editors.controlnet.DepthControlNet`. If its network
            predicts the picture, a clean picture's noise is undefined, so inversion begins at the
            lowest timestep, to which all views are noised alike.
        instruction: prompt of the edit.
        settings: :class:`GaussCtrlSettings`; the defaults if omitted.

    Raises:
        ValueError, InputError, RuntimeError: see :func:`by_view`.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.methods import gaussctrl
        >>> from attnwarp.trial import disc, view
        >>> gaussctrl(disc(), [view()], None, load_editor("small-plain"), "red")
        Traceback (most recent call last):
        ValueError: editor: gaussctrl is made for a depth ControlNet, got InstructPix2Pix, which
        takes pictures; choose another editor or method
    """

    def __init__(self, work: Work, settings: GaussCtrlSettings) -> None:
        work.takes("gaussctrl", "depth", DepthControlNet)
        work.one_size("gaussctrl")
        self.work, self.settings = work, settings
        generator = work.generator(VIEWS)
        count = settings.references
        self.views = _spread_draw(range(len(work.sizes)), count, settings.views, generator)
        self.references = [_choice(part, 1, generator)[0] for part in _quarters(self.views, count)]
        self._latents: dict[int, Tensor] = {}

    def run(self, loop: Loop) -> None:
        """Edit all drawn views, batch by batch, then tune."""
        inverted: set[int] = set()
        for batch in chunks(self.views, self.settings.batch):
            together = {*self.references, *batch}
            rows = self._rows(len(batch), len(together - inverted))
            inverted |= together
            loop.edit(0, batch, partial(self.edit, batch), rows=rows)
        loop.tune(0, self.views, self.settings.iterations)

    def _rows(self, views: int, inversions: int) -> int:
        """Rows through the network for a batch whose first ``inversions`` views are inverted."""
        s = self.settings
        edits = (len(self.references) + views) * s.steps * self.work.branches()
        if s.latents == "random":
            return edits
        return edits + inversions * inversion_rows(self.work.editor, s.steps)

    def edit(
        self, group: Sequence[int], model: Gaussians, step: Callable[[], None]
    ) -> list[ViewEdit]:
        """Edit views together with the reference views."""
        work, s = self.work, self.settings
        editor: Any = work.editor
        views = [*self.references, *group]
        guides = {view: work.depth(view, work.frozen) for view in set(views)}
        latents = torch.cat([self.latents(view, guides[view]) for view in views])
        with ExitStack() as stack:
            stack.enter_context(work.guided(s.text_guidance))
            count, branches = len(self.references), len(editor.branches)
            rule = aligned(count, s.self_share, branches)
            stack.enter_context(self_attention(editor.unet, rule))
            if s.control_share is not None:
                rule = aligned(count, s.control_share, branches)
                stack.enter_context(self_attention(editor.controlnet, rule))
            result = edit(
                editor,
                [guides[view] for view in views],
                work.prompt,
                steps=s.steps,
                latents=latents,
                on_step=lambda *_: step(),
            )
        about = {"references": [work.views.cameras[view].name for view in self.references]}
        return [ViewEdit(picture, about) for picture in result.images[count:]]

    def latents(self, view: int, depth: Guide) -> Tensor:
        """Initial latents (1, C, h, w) of a view's edit, computed once per process."""
        work, s = self.work, self.settings
        if s.latents == "random":
            return work.noise(0, [view])
        if view not in self._latents:
            prompt = work.prompt if s.source_prompt is None else s.source_prompt
            self._latents[view] = invert_view(
                work.editor, depth, work.render(view, work.frozen), prompt,
                steps=s.steps, seed=s.seed,
            )  # fmt: skip
        return self._latents[view]


gaussctrl = door(
    GaussCtrl,
    {
        "default": GaussCtrlSettings(),
        "paper": GaussCtrlSettings(**STABLE_DIFFUSION),
        "released": GaussCtrlSettings(control_share=0.0, source_prompt=None, **STABLE_DIFFUSION),
        "random": GaussCtrlSettings(latents="random", **STABLE_DIFFUSION),
    },
)


def _quarters(views: Sequence[int], count: int) -> list[list[int]]:
    """Split views into contiguous, nearly equal parts; fewer parts if there are fewer views."""
    count = min(count, len(views))
    return [list(part) for part in np.array_split(np.asarray(views), count)]


def _choice(views: Sequence[int], count: int, generator: torch.Generator) -> list[int]:
    """Draw ``count`` different views at random and keep their order."""
    order = torch.randperm(len(views), generator=generator)[:count].tolist()
    return [int(views[k]) for k in sorted(order)]


def _spread_draw(
    views: Sequence[int], parts: int, most: int, generator: torch.Generator
) -> list[int]:
    """Draw at most ``count`` views at random: an equal share of each contiguous part."""
    if len(views) <= most:
        return list(views)
    shares = [len(part) for part in np.array_split(np.arange(most), min(parts, len(views)))]
    return [
        view
        for part, share in zip(_quarters(views, parts), shares, strict=True)
        for view in _choice(part, share, generator)
    ]
