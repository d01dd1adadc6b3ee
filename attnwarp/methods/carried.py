"""Extensions beyond the paper, warped along with features: clean estimates, and noise that
sticks to the surface (the preset ``extended``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from attnwarp.editing.editor import shared_noise
from attnwarp.methods.noise import FRESH, carried, own_seed, unmoved
from attnwarp.methods.settings import AttentionWarpingSettings
from attnwarp.methods.sight import Sight, Size, SourceWarp


class Estimates:
    """Sources' estimates of their clean latents, warped to the targets.

    Args:
        editor: the model.
        settings: settings with the weight, its end, and the choice of latents or pictures.

    Attributes:
        sources: estimates of each source, (C, h, w) at each step.
    """

    def __init__(self, editor: Any, settings: AttentionWarpingSettings) -> None:
        self.editor, self.settings = editor, settings
        self.sources: list[list[Tensor]] = []
        self._pictures: dict[tuple[int, int], Tensor] = {}  # decoded once, by source and step

    def change(
        self, sights: Sequence[Sight | None], sources: int, keep: list[Tensor] | None = None
    ) -> Callable[[int, Tensor], Tensor] | None:
        """Return a function of a step and the predicted (B, C, h, w) that returns their
        replacement; None if nothing is replaced.

        Args:
            sights: visibility of each view from the sources.
            sources: number of sources to take estimates from.
            keep: callback that receives the result of a lone view at each step.
        """
        s = self.settings
        if s.estimate == 0:
            return None
        pictures = s.estimate_in == "picture"
        warps = [
            [] if sight is None else [sight.warp(k, picture=True) for k in range(sources)]
            for sight in sights
        ]
        blend = self._carry_picture if pictures else carry

        def change(number: int, x0: Tensor) -> Tensor:
            weight, result = self.weight(number), x0
            if weight > 0 and sources:
                maps = [
                    self._picture(k, number, x0) if pictures else self.sources[k][number].to(x0)
                    for k in range(sources)
                ]
                rows = [blend(own, maps, ws, weight) for own, ws in zip(x0, warps, strict=True)]
                result = torch.stack(rows)
            if keep is not None:
                keep.append(result[0].clone())
            return result

        return change

    def weight(self, number: int) -> float:
        """Weight of a source's estimate at a step, counted from 0; 0 or less means unused."""
        s = self.settings
        return s.estimate * (1 - number / max(1, s.estimate_until * s.steps))

    def memory(self, sizes: Sequence[Size]) -> str | None:
        """Describe the memory of the sources' (h, w) pictures; None if no picture is kept."""
        s = self.settings
        if s.estimate_in != "picture" or s.estimate == 0:
            return None
        kept = sum(self.weight(number) > 0 for number in range(s.steps))
        pixels = sum(h * w for h, w in sizes)
        return (
            f"estimates of {len(sizes)} source{'s' * (len(sizes) > 1)}, as pictures of"
            f" {kept} steps: up to {12 * kept * pixels / 2**20:.1f} MiB in main memory"
        )

    def _picture(self, source: int, number: int, like: Tensor) -> Tensor:
        """Decode a source's estimate at a step, (3, H, W)."""
        key = source, number
        if key not in self._pictures:
            latents = self.sources[source][number].to(like)
            self._pictures[key] = self.editor.pixels(latents[None])[0].cpu()
        return self._pictures[key].to(like.device)

    def _carry_picture(
        self, own: Tensor, pictures: Sequence[Tensor], warps: Sequence[SourceWarp], weight: float
    ) -> Tensor:
        """Encode a target's picture after warping the sources' (3, H, W) into it, (C, h, w)."""
        before = self.editor.pixels(own[None])
        after = carry(before[0], pictures, warps, weight)[None]
        # The autoencoder's loss of detail affects both pictures alike, so pixels without a warped
        # source do not change.
        change = self.editor.latents(after) - self.editor.latents(before)
        return own + change[0].to(own)


def carry(
    own: Tensor, maps: Sequence[Tensor], warps: Sequence[SourceWarp], weight: float
) -> Tensor:
    """Blend the sources' warped (C, h', w') maps into a target's (C, h, w) map.

    Args:
        own: (C, h, w) map of the target.
        maps: maps of the sources.
        warps: warps from the sources.
        weight: weight of the sources' maps, in [0, 1].
    """
    tokens = own.flatten(1).T[None].contiguous()
    for warp, map_ in zip(warps, maps, strict=False):
        h, w = own.shape[1:]
        layer = warp.at((h, w), source_size=(map_.shape[1], map_.shape[2]))
        warped = layer.warp_tokens(map_.flatten(1).T[None].contiguous())
        tokens = torch.lerp(tokens, warped, weight * layer.weight.to(tokens))
    return tokens[0].T.reshape(own.shape)


class Noise:
    """Initial noise of views: shared by all views of a size, fresh for each view, or attached to
    the surface.

    Args:
        settings: settings with the kind of noise and the seed.

    Attributes:
        orders: (h, w) order of each source's noise, if noise sticks to the surface.
    """

    def __init__(self, settings: AttentionWarpingSettings) -> None:
        self.settings = settings
        self.orders: list[Tensor] = []

    def of(
        self, views: Sequence[int], shape: tuple[int, int, int], sights: Sequence[Sight | None]
    ) -> Tensor:
        """Draw (B, C, h, w) noise for views whose latents are (C, h, w)."""
        s = self.settings
        if s.noise == "fresh":
            return torch.cat(
                [shared_noise((1, *shape), own_seed(s.seed, FRESH, view)) for view in views]
            )
        noise = shared_noise((len(views), *shape), s.seed)
        if s.noise == "shared":
            return noise
        rows = []
        for row, sight in zip(noise.flatten(2), sights, strict=True):
            order = self.order(sight, shape[1:])
            rows.append(row[:, order.flatten()].unflatten(1, tuple(order.shape)))
        return torch.stack(rows)

    def order(self, sight: Sight | None, size: tuple[int, ...]) -> Tensor:
        """Compute the (h, w) int64 order of a view's noise; sources of another size are ignored."""
        h, w = size
        if sight is None:
            return unmoved((h, w))
        taken, positions = [], []
        for order, view in zip(self.orders, sight.views, strict=False):
            if tuple(order.shape) != (h, w):
                return unmoved((h, w))
            taken.append(order)
            positions.append(view.at((h, w), source_size=(h, w)).correspondence.xy)
        return carried(taken, positions, sight.choice((h, w)))
