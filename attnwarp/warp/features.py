"""Warp of one feature size: feature maps and attention tokens."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.warp import sampling
from attnwarp.warp.correspondence import Correspondence
from attnwarp.warp.taps import Taps

Backend: TypeAlias = Literal["auto", "reference"]
"""Backend that computes a warp: "reference" is the definition in torch, on any device. "auto" uses
the kernels (:mod:`attnwarp.warp.cpu`) for CPU tensors, and torch elsewhere.
"""


@dataclass(frozen=True, eq=False)
class FeatureWarp:
    """Warp at one feature size.

    Taps and weights are built once per size, device and dtype, so the warp of a layer copies
    nothing to or from the host.

    Args:
        correspondence: map from the target's H x W feature grid into the source's h x w grid.
        mask: (H, W) bool, True where the warped features count.
        backend: "auto" or "reference"; both give the same bits.

    Example:
        >>> import torch
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import FeatureWarp, correspond
        >>> _, camera, seen = wall()
        >>> c = correspond(camera, camera, seen.depth)  # a view onto itself
        >>> warp, features = FeatureWarp(c, c.defined), torch.rand(4, 8, 8)
        >>> torch.equal(warp.warp(features), features)
        True
    """

    correspondence: Correspondence
    mask: Tensor
    backend: Backend = "auto"
    _taps: dict[tuple[Any, ...], Taps] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def weight(self) -> Tensor:
        """Weight (H W, 1) float32: 1 inside the mask, 0 elsewhere."""
        return self.mask.reshape(-1, 1).float()

    def warp(self, features: Tensor | np.ndarray[Any, Any]) -> Tensor:
        """Warp source features to the target, (C, H, W) or (B, C, H, W).

        Args:
            features: (C, h, w) or (B, C, h, w) floating, of any size with the aspect ratio of the
                source's grid: :func:`attnwarp.warp.sample`.

        Returns:
            Features in the dtype of ``features``; 0 for a pixel without a source position, NaN for
            a pixel that reads a NaN: NaN means undefined and is never filled.

        Raises:
            ValueError: the number of axes or the aspect ratio is wrong, or the dtype cannot be
                blended.
        """
        if isinstance(features, np.ndarray):
            features = torch.from_numpy(np.ascontiguousarray(features))
        check.instance(features, Tensor, "features", "torch.Tensor")
        if features.ndim not in (3, 4) or not features.dtype.is_floating_point:
            return sampling.sample(features, self.correspondence)[0]  # raises the error
        self._check_size(features)
        taps = self._taps_for(features, *features.shape[-2:])
        warped = self._engine(features).sample_maps(features.flatten(-2), taps)
        return warped.unflatten(-1, tuple(self.mask.shape))

    def warp_tokens(self, source: check.Array) -> Tensor:
        """Warp the source's tokens to the target's grid.

        Args:
            source: (B, h*w, C) floating tokens, row by row of the source's grid. The gradient
                flows back through the result.

        Returns:
            (B, H*W, C) in the source's dtype, 0 for a pixel without a source position. An edit
            blends them into the target's tokens:
            :func:`attnwarp.methods.algorithms.attention_warping.blend`.

        Raises:
            ValueError: the shape differs from the source grid, or the dtype cannot be blended.

        Example:
            >>> import torch
            >>> from attnwarp.trial import wall
            >>> from attnwarp.warp import warp_surfaces
            >>> source, target, seen = wall()  # 2 px apart
            >>> layer = warp_surfaces(source, target, seen, seen).at((4, 4))
            >>> column = torch.arange(4.0).repeat(4).reshape(1, 16, 1)
            >>> layer.warp_tokens(column)[0, :4, 0].tolist()
            [1.0, 2.0, 3.0, 3.0]
        """
        source = check.tensor(source, "source")
        self._check_tokens(source)
        taps = self._tokens_taps(source)
        return self._engine(source).sample_tokens(source, taps).to(source.dtype)

    def _check_size(self, features: Tensor) -> None:
        h, w = features.shape[-2:]
        if h < 1 or w < 1:
            raise ValueError(f"features: got {h} x {w} (height x width), expected at least 1 x 1")
        camera = self.correspondence.source
        remedy = (
            "transpose a map of (w, h); for features of a stretched picture make the layer with"
            f" at(..., source_size=({h}, {w}))"
        )
        check.same_aspect((h, w), (camera.height, camera.width), "features", remedy)

    def _engine(self, features: Tensor) -> Any:
        """Choose the sampling module: kernels or torch."""
        if self.backend == "reference" or features.device.type != "cpu":
            return sampling
        # numba is slow to import.
        from attnwarp.warp import cpu

        return cpu

    def _check_tokens(self, source: Tensor) -> None:
        camera = self.correspondence.source
        check.instance(source, Tensor, "source", "torch.Tensor")
        check.shape(source, ("B", camera.height * camera.width, "C"), "source")
        if not source.dtype.is_floating_point:
            raise ValueError(f"source: got {source.dtype}, expected a floating type")

    def _tokens_taps(self, source: Tensor) -> Taps:
        camera = self.correspondence.source
        return self._taps_for(source, camera.height, camera.width)

    def _taps_for(self, features: Tensor, h: int, w: int) -> Taps:
        dtype = sampling.work_type(features.dtype)
        key = (h, w, features.device, dtype)
        if key not in self._taps:
            engine = self._engine(features)
            self._taps[key] = engine.taps_at(self.correspondence, (h, w), dtype, features.device)
        return self._taps[key]
