"""Injection of recorded features, warped along a view's geometry."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

import torch
from torch import Tensor

from attnwarp.editing.layers import Call, Layer, Network, Steps, check_rows, hooked
from attnwarp.editing.recording import Recording
from attnwarp.editing.schedule import Size
from attnwarp.warp.sampling import work_type


class TokenWarp(Protocol):
    """Warp of one grid, such as :class:`attnwarp.warp.FeatureWarp`."""

    @property
    def weight(self) -> Tensor:
        """Weight M, (H W, 1) in [0, 1]; 1 if source and target show the same surface."""
        ...

    def warp_tokens(self, source: Tensor) -> Tensor:
        """Warp the source's (1, h w, C) tokens to (1, H W, C)."""
        ...


class LayerWarp(Protocol):
    """Warp from a source view to a target view, such as :class:`attnwarp.warp.WarpedView`."""

    def at(self, size: Size, *, source_size: Size | None = None) -> TokenWarp:
        """Build the warp from a grid of the source to an (h, w) grid of the target."""
        ...


class Identity:
    """Warp of a view onto itself, on any grid."""

    weight = torch.ones(1, 1, dtype=torch.float32)

    def at(self, size: Size, *, source_size: Size | None = None) -> Identity:
        """Return the identity.

        Raises:
            ValueError: the grids differ in size.
        """
        if source_size not in (None, size):
            raise ValueError(
                f"size: the recording has {source_size} features, the target {size}; give a warp"
                " between views of different sizes"
            )
        return self

    def warp_tokens(self, source: Tensor) -> Tensor:
        """Return the tokens unchanged."""
        return source


Weight = Callable[[int, int], float]
"""Function of the step t, from 0, and the number of steps T that returns a_t."""

Blend = Callable[[TokenWarp, Tensor, Tensor, float], Tensor]
"""Blend (1, H W, C) from a warp, the source's (1, h w, C) and the target's tokens, and a_t."""


def blended(blend: Blend, warp: TokenWarp, source: Tensor, new: Tensor, a: float) -> Tensor:
    """Blend (1, H W, C) tokens in the dtype of ``new``: half precision is summed in float32 and
    rounded once.
    """
    work = work_type(new.dtype)
    return blend(warp, source.to(work), new.to(work), a).to(new.dtype)


@contextmanager
def inject(
    editor: Network,
    recording: Recording,
    *,
    weight: Weight,
    blend: Blend,
    warps: Sequence[LayerWarp | None] = (None,),
    layers: Sequence[Layer] | None = None,
) -> Iterator[None]:
    """Blend recorded features into an editor's attention, at each layer's size, while the block
    runs. Steps and branches that were not recorded stay unchanged.

    :func:`attnwarp.methods.algorithms.attention_warping.inject` is this function with the paper's
    weight and blend.

    Args:
        editor: editor that the features were recorded from, or an equally shaped one.
        recording: features of the source view.
        weight: function that returns a_t; features stay unchanged if it is 0.
        blend: blend of a layer's tokens; gets half precision as float32.
        warps: warps of the pictures of a batch, one each: :class:`attnwarp.warp.WarpedView`, or
            None for the identity.
        layers: recorded layers to inject into; None for all.

    Raises:
        ValueError: a timestep, branch or size does not match the recording, or the recorded run had
            fewer steps than planned; the message names the mismatch.

    An example is at :func:`attnwarp.methods.algorithms.attention_warping.a_t`.
    """
    plan, recorded, views = recording.plan, recording.plan.recorded, len(warps)
    if len(recording.timesteps) < plan.steps:
        raise ValueError(
            f"steps: the recorded run had {len(recording.timesteps)} of {plan.steps} planned steps,"
            " so weights would not fall as they should; plan as many as it has"
        )
    if not set(plan.keep).intersection(editor.branches):
        raise ValueError(
            f"branches: recorded are {', '.join(plan.keep)}, the editor has"
            f" {', '.join(editor.branches)}"
        )
    if plan.views not in (1, views):
        raise ValueError(f"warps: got {views}, expected {plan.views}, one for each recorded view")
    step, steps = -1, Steps()

    def change(layer: Layer, features: Tensor, call: Call) -> Tensor | None:
        nonlocal step
        check_rows(call, views)
        if steps.begins(call):
            step = recording.step_of(call.timestep, step + 1)
        if step not in recorded:
            return None
        a = weight(step, plan.steps)
        if not 0 <= a <= 1:
            raise ValueError(f"weight: got {a}, expected a number in [0, 1]")
        if a == 0:
            return None
        size, source_size = layer.size(call.latent_size), layer.size(plan.latent_size)
        result = features.clone()
        for number, branch in enumerate(call.branches):
            if branch not in plan.keep:
                continue
            source = recording._features_of(step, layer, branch).to(features.device, features.dtype)
            for view, warp in enumerate(warps):
                row = number * views + view
                own = source[view if plan.views > 1 else 0]
                at = (warp or Identity()).at(size, source_size=source_size)
                result[row] = blended(blend, at, own[None], features[row][None], a)[0]
        return result

    with hooked(editor, plan.layers if layers is None else layers, change):
        yield
