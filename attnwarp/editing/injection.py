"""Injection of recorded features, warped along a view's geometry."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

import torch
from torch import Tensor

from attnwarp.editing.layers import Call, Layer, Size, hooked
from attnwarp.editing.recording import Recording
from attnwarp.warp.sampling import work_type


class TokenWarp(Protocol):
    """The warp of one grid, such as :class:`attnwarp.warp.FeatureWarp`."""

    @property
    def weight(self) -> Tensor:
        """(H W, 1) in [0, 1]: M, 1 where the source shows what the target does."""
        ...

    def warp_tokens(self, source: Tensor) -> Tensor:
        """(1, H W, C) of the source's (1, h w, C) tokens."""
        ...


class LayerWarp(Protocol):
    """A warp from a source view to a target view, such as :class:`attnwarp.warp.WarpedView`."""

    def at(self, size: Size, *, source_size: Size | None = None) -> TokenWarp:
        """The warp of an (h, w) grid of the target from a grid of the source."""
        ...


class Identity:
    """The warp of a view onto itself, on any grid."""

    weight = torch.ones(1, 1, dtype=torch.float32)

    def at(self, size: Size, *, source_size: Size | None = None) -> Identity:
        """The identity.

        Raises:
            ValueError: grids of two sizes.
        """
        if source_size not in (None, size):
            raise ValueError(
                f"size: the recording has {source_size} features, the target {size}; give a warp"
                " between views of different sizes"
            )
        return self

    def warp_tokens(self, source: Tensor) -> Tensor:
        """The tokens as they are."""
        return source


Weight = Callable[[int, int], float]
"""a_t by the step's number t, from 0, and the number of steps T."""

Blend = Callable[[TokenWarp, Tensor, Tensor, float], Tensor]
"""(1, H W, C) of a warp, the source's (1, h w, C) tokens, the target's own and the weight a_t."""


def blended(blend: Blend, warp: TokenWarp, source: Tensor, new: Tensor, a: float) -> Tensor:
    """(1, H W, C) tokens of a blend in the type of ``new``: those of half precision are summed in
    float32 and rounded once.
    """
    work = work_type(new.dtype)
    return blend(warp, source.to(work), new.to(work), a).to(new.dtype)


@contextmanager
def inject(
    unet: torch.nn.Module,
    recording: Recording,
    *,
    branches: Sequence[str],
    weight: Weight,
    blend: Blend,
    warps: Sequence[LayerWarp | None] = (None,),
) -> Iterator[None]:
    """Blend recorded features into the UNet's attention while the block runs, at each layer's own
    size. Steps whose features were not chosen stay as they are.

    :func:`attnwarp.methods.attention_warping.inject` is this with the paper's weight and blend.

    Args:
        unet: the UNet that the features came from, or one of its shape.
        recording: features of the source view.
        branches: the guidance branches in the order of the batch; those that were recorded get
            features. One whose share of the guidance is 0 may be missing.
        weight: a_t; where it is 0 features stay as they are.
        blend: blend of a layer's tokens; half precision comes to it as float32.
        warps: warps of the pictures of a batch, one each: :class:`attnwarp.warp.WarpedView` or None
            for the identity.

    Raises:
        ValueError: a timestep, branch or size that does not match the recording, or a run that was
            recorded in fewer steps than planned; the message names it.

    An example is at :func:`attnwarp.methods.attention_warping.a_t`.
    """
    plan, recorded = recording.plan, recording.plan.recorded
    if len(recording.timesteps) < plan.steps:
        raise ValueError(
            f"steps: the recorded run had {len(recording.timesteps)} of {plan.steps} planned steps,"
            " so weights would not fall as they should; plan as many as it has"
        )
    shared = [branch for branch in plan.keep if branch in branches]
    if not shared:
        raise ValueError(
            f"branches: recorded are {', '.join(plan.keep)}, the batch has {', '.join(branches)}"
        )
    step = -1
    last: list[Call] = []
    views = len(warps)
    if plan.views not in (1, views):
        raise ValueError(f"warps: got {views}, expected {plan.views}, one for each recorded view")

    def change(layer: Layer, features: Tensor, call: Call) -> Tensor:
        nonlocal step
        rows = len(branches) * views
        if call.batch != rows:
            raise ValueError(
                f"batch: got {call.batch} rows, expected {rows}: {views} views in"
                f" {len(branches)} branches ({', '.join(branches)})"
            )
        if last != [call]:
            step = recording.step_of(call.timestep, step + 1)
            last[:] = [call]
        if step not in recorded:
            return features
        a = weight(step, plan.steps)
        if not 0 <= a <= 1:
            raise ValueError(f"weight: got {a}, expected a number in [0, 1]")
        if a == 0:
            return features
        size, source_size = layer.size(call.latent_size), layer.size(plan.latent_size)
        result = features.clone()
        for branch in shared:
            source = recording._features_of(step, layer, branch).to(features.device, features.dtype)
            for view, warp in enumerate(warps):
                row = list(branches).index(branch) * views + view
                own = source[view if plan.views > 1 else 0]
                at = (warp or Identity()).at(size, source_size=source_size)
                result[row] = blended(blend, at, own[None], features[row][None], a)[0]
        return result

    with hooked(unet, plan.layers, change):
        yield
