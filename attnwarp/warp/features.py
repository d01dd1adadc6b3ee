"""The warp of one feature size: feature maps and attention tokens."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.warp import tokens
from attnwarp.warp.correspondence import Correspondence, positions_in
from attnwarp.warp.sampling import sample
from attnwarp.warp.taps import Taps, taps_of


@dataclass(frozen=True, eq=False)
class FeatureWarp:
    """The warp at one feature size.

    Taps and weights are made once for a device and a type, so a layer's warp copies nothing to or
    from the host.

    Args:
        correspondence: on the target's feature grid, into the source's.
        mask: (H, W) bool, where the warped features count.
    """

    correspondence: Correspondence
    mask: Tensor
    _taps: dict[tuple[torch.device, torch.dtype], Taps] = field(default_factory=dict, repr=False)
    _masks: dict[torch.device, Tensor] = field(default_factory=dict, repr=False)

    def warp(self, features: Tensor) -> Tensor:
        """Target features (..., H, W) from (C, h, w) or (B, C, h, w) source ones;
        :func:`attnwarp.warp.sample`.
        """
        return sample(features, self.correspondence)[0]

    def warp_tokens(self, source: Tensor) -> Tensor:
        """The source's tokens, warped to the target's grid.

        Args:
            source: (B, h*w, C) floating, row by row of the source's feature grid. The gradient
                flows back through the result.

        Returns:
            (B, H*W, C) in the source's type, 0 where a pixel has no position in the source.

        Raises:
            ValueError: another shape than the source grid's, or a type that cannot be blended.
        """
        taps = self._taps_for(source)
        return tokens.sample_rows(source, taps).to(source.dtype)

    def blend_tokens(
        self, source: Tensor, new: Tensor, alpha: float, *, in_place: bool = False
    ) -> Tensor:
        """Warp, mask and blend: a (M warp(source) + (1 - M) new) + (1 - a) new, M = ``mask``.

        Args:
            source: (B, h*w, C) or (1, h*w, C) recorded tokens of the source's grid, converted to
                the type of ``new``.
            new: (B, H*W, C) the target's own tokens.
            alpha: a, in [0, 1].
            in_place: write the result to ``new``. Not where a gradient is recorded.

        Returns:
            (B, H*W, C) in the type of ``new``, with its bits where the mask is False; sums are in
            float32 for half precision and rounded once. ``new`` itself if ``in_place``.

        Raises:
            ValueError: shapes that do not fit, a type that cannot be blended, ``alpha`` out of
                range, ``in_place`` with a gradient.
        """
        self._check_blend(source, new, alpha, in_place)
        source = source.to(new.dtype)
        warped = tokens.sample_rows(source, self._taps_for(source))
        result = tokens.blend_rows(warped, new, self._mask_on(new.device), alpha)
        return new.copy_(result) if in_place else result

    def _check_blend(self, source: Tensor, new: Tensor, alpha: float, in_place: bool) -> None:
        target = self.correspondence.target
        check.shape(new, ("B", target.height * target.width, "C"), "new")
        self._check_tokens(source, "source")
        if source.shape[0] not in (1, new.shape[0]) or source.shape[2] != new.shape[2]:
            raise ValueError(
                f"source: got shape {tuple(source.shape)}, expected ({new.shape[0]} or 1,"
                f" {source.shape[1]}, {new.shape[2]}) for new tokens {tuple(new.shape)}"
            )
        if not new.dtype.is_floating_point:
            raise ValueError(f"new: got {new.dtype}, expected a floating type")
        if source.device != new.device:
            raise ValueError(f"source: lies on {source.device}, new on {new.device}")
        if not 0 <= alpha <= 1:
            raise ValueError(f"alpha: got {alpha}, expected a number in [0, 1]")
        if in_place and torch.is_grad_enabled() and (source.requires_grad or new.requires_grad):
            raise ValueError(
                "in_place: got True where a gradient is recorded; use torch.no_grad() or"
                " in_place=False"
            )

    def _check_tokens(self, source: Tensor, name: str) -> None:
        camera = self.correspondence.source
        check.shape(source, ("B", camera.height * camera.width, "C"), name)
        if not source.dtype.is_floating_point:
            raise ValueError(f"{name}: got {source.dtype}, expected a floating type")

    def _taps_for(self, source: Tensor) -> Taps:
        self._check_tokens(source, "source")
        key = (source.device, tokens.work_type(source.dtype))
        if key not in self._taps:
            camera = self.correspondence.source
            xy = positions_in(self.correspondence, camera.width, camera.height)
            self._taps[key] = taps_of(xy, camera.height, camera.width).to(*key)
        return self._taps[key]

    def _mask_on(self, device: torch.device) -> Tensor:
        if device not in self._masks:
            self._masks[device] = self.mask.reshape(-1).to(device)
        return self._masks[device]
