"""CoreEditor (Zhu et al. 2025): edit views together, each token a mix of what all views show of its
point (correspondence-constrained attention).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from attnwarp.editing.editor import Latent
from attnwarp.editing.layers import Call, Layer, Network, all_layers, check_rows, hooked
from attnwarp.editing.schedule import Size
from attnwarp.gaussians import Gaussians
from attnwarp.methods.attention import aligned, self_attention
from attnwarp.methods.base import Loop, ViewEdit
from attnwarp.methods.by_warps import ByWarps, SourceSettings, checked_source
from attnwarp.methods.doors import door
from attnwarp.methods.geometry import Warps
from attnwarp.methods.work import Work, chunks
from attnwarp.settings import Count, Share
from attnwarp.warp import FeatureWarp
from attnwarp.warp.sampling import work_type


@dataclass(frozen=True)
class CorrespondingSettings(SourceSettings):
    """Settings of :func:`attnwarp.methods.corresponding`.

    Args:
        self_share: weight of a view's own keys in its self-attention; the rest is attention to the
            source view, which then is in every batch. Below 1 the editor must be Stable
            Diffusion's.
        batch: number of views per network pass, whose tokens are mixed.

    Example:
        >>> from attnwarp.methods import preset
        >>> preset("corresponding", "released").self_share
        0.7
    """

    batch: Count = 40
    self_share: Share = 1.0


class Corresponding(ByWarps):
    """Edit views together, mixing the tokens that show one point, then tune the splats.

    The output of each self-attention becomes sum_l w_l h_l(W_l p): p is the token's point, l are
    the views of the batch that see it, and w is their softmax of <h(p), h_l(W_l p)> / sqrt(d).

    The authors' code mixes by heads before their projection, tests visibility by reprojection in
    place of :class:`attnwarp.warp.WarpSettings`, adds matches by similarity of features, takes the
    source's keys from an edit that the user chose among several, and edits the renders again while
    the splats are tuned.

    Args:
        gaussians, cameras, images, instruction, options: see :func:`by_view`. All views' edits have
            one size.
        editor: any editor. Those of Stable Diffusion mix in every self-attention of the UNet,
            others in the layers that they offer.
        settings: :class:`CorrespondingSettings`; the defaults if omitted.
        source: number of the view that others attend to if ``self_share`` is below 1.
        warps: see :func:`attention_warping`.

    Raises:
        ValueError, InputError, RuntimeError: see :func:`by_view`.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.methods import CorrespondingSettings, corresponding
        >>> from attnwarp.trial import disc, view
        >>> quick = CorrespondingSettings(steps=1, iterations=1)
        >>> views, editor = [view(0), view(1)], load_editor("small-plain")
        >>> result = corresponding(disc(), views, None, editor, "red", quick)
        >>> result.counters["network_rows"]  # two views, two branches each
        4
    """

    def __init__(
        self,
        work: Work,
        settings: CorrespondingSettings,
        source: int = 0,
        warps: Warps | None = None,
    ) -> None:
        work.one_size("corresponding")
        if settings.start is not None:
            work.starts_at(settings.start[0], "start")
        if settings.self_share < 1 and not isinstance(work.editor, Latent):
            raise ValueError(
                f"self_share: got {settings.self_share:g}, for which"
                f" {type(work.editor).__name__} has no keys; set it to 1"
            )
        self.settings, self.source = settings, checked_source(source, work)
        super().__init__(work, settings, warps)

    def run(self, loop: Loop) -> None:
        """Edit all views, batch by batch, then tune."""
        work, s = self.work, self.settings
        views = range(len(work.sizes))
        for batch in chunks(views, s.batch):
            rows = len(self._together(batch)) * s.steps * work.branches()
            loop.edit(0, batch, partial(self.edit, batch), rows=rows)
        loop.tune(0, views, s.iterations)

    def _together(self, batch: Sequence[int]) -> list[int]:
        """Views of a network pass: the batch, after the source if others attend to it."""
        if self.settings.self_share == 1:
            return list(batch)
        return [self.source, *(view for view in batch if view != self.source)]

    def edit(
        self, batch: Sequence[int], model: Gaussians, step: Callable[[], None]
    ) -> list[ViewEdit]:
        """Edit views with their tokens mixed."""
        work, s, views = self.work, self.settings, self._together(batch)
        editor: Any = work.editor
        start = None if s.start is None else work.timestep(0, views[0], s.start)
        latent_size = editor.noise_shape(work.sizes[0])[1:]
        with work.guided(s.text_guidance), ExitStack() as stack:
            if s.self_share < 1:
                rule = aligned(1, s.self_share, len(editor.branches))
                stack.enter_context(self_attention(editor.unet, rule))
            offered = all_layers(editor.unet) if isinstance(editor, Latent) else editor.layers()
            layers = [layer for layer in offered if layer.kind in ("self", "joint")]

            def warp(source: int, target: int) -> Any:
                return self.warp(views[source], views[target])

            stack.enter_context(mixing(editor, layers, len(views), latent_size, warp))
            result = work.edit(views, step, start=start)
        edits = dict(zip(views, result.images, strict=True))
        return [ViewEdit(edits[view], {"start": start}) for view in batch]


corresponding = door(
    Corresponding,
    {
        "default": CorrespondingSettings(),
        "released": CorrespondingSettings(self_share=0.7, text_guidance=6.0, iterations=1000),
    },
)


@contextmanager
def mixing(
    editor: Network, layers: Sequence[Layer], views: int, latent_size: Size, warps: Warps
) -> Iterator[None]:
    """Mix the tokens that show one point in all views of a batch while the block runs.

    Args:
        views: number of views of a batch, in each branch.
        warps: function of a source's and a target's place in the batch that returns their warp.
    """
    sizes = {layer.size(latent_size) for layer in layers}
    # A warp at the pictures' size takes megabytes, so of each pair only the layers' warps are kept.
    pairs: dict[tuple[int, int], dict[Size, FeatureWarp]] = {}
    for target in range(views):
        for source in range(views):
            if source != target:
                view = warps(source, target)
                pairs[source, target] = {size: view.at(size, source_size=size) for size in sizes}

    def mix(layer: Layer, features: Tensor, call: Call) -> Tensor:
        check_rows(call, views)
        size = layer.size(call.latent_size)
        by_branch = features.to(work_type(features.dtype)).unflatten(0, (-1, views))
        mixed = torch.empty_like(by_branch)
        for target in range(views):
            own = by_branch[:, target]
            shown, seen = [own], [torch.ones(own.shape[1], dtype=torch.bool, device=own.device)]
            for source in range(views):
                if source != target:
                    warp = pairs[source, target][size]
                    shown.append(warp.warp_tokens(by_branch[:, source].contiguous()))
                    seen.append(warp.mask.flatten().to(own.device))
            tokens = torch.stack(shown)  # (views, branches, n, C), the view's first
            scores = (own * tokens).sum(dim=-1) / own.shape[-1] ** 0.5
            hidden = ~torch.stack(seen)[:, None]
            shares = torch.softmax(scores.masked_fill(hidden, -torch.inf), dim=0)
            mixed[:, target] = (shares[..., None] * tokens).sum(dim=0)
        return mixed.flatten(0, 1).to(features.dtype)

    with hooked(editor, layers, mix):
        yield
