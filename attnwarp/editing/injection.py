"""Injection of recorded features, warped along a view's geometry."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.editing.layers import Call, Layer, Size, hooked
from attnwarp.editing.recording import Recording
from attnwarp.warp import resize_mask
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

    def blend_tokens(self, source: Tensor, new: Tensor, alpha: float) -> Tensor:
        """(1, H W, C) of the source's (1, h w, C) tokens, warped, and the target's own."""
        ...


class LayerWarp(Protocol):
    """A warp from a source view to a target view, such as :class:`attnwarp.warp.WarpedView`."""

    def at(self, size: Size, *, source_size: Size | None = None) -> TokenWarp:
        """The warp of an (h, w) grid of the target from a grid of the source."""
        ...


Blend = Callable[[TokenWarp, Tensor, Tensor, float], Tensor]
"""(1, H W, C) of a warp, the source's (1, h w, C) tokens, the target's own and the weight a_t."""


def decay(a0: float = 0.9) -> Callable[[int, int], float]:
    """The paper's weight, a_t = a0 (T - t) / T with the step's number t of T.

    Args:
        a0: weight of the first step, in [0, 1].

    Raises:
        ValueError: a weight outside [0, 1].

    Example:
        >>> [round(decay()(step, 4), 3) for step in range(4)]
        [0.9, 0.675, 0.45, 0.225]
    """
    _check_share(a0, "a0")
    return lambda step, steps: a0 * (steps - step) / steps


def constant(a: float) -> Callable[[int, int], float]:
    """Constant schedule: one weight at every step.

    Args:
        a: in [0, 1].

    Raises:
        ValueError: a weight outside [0, 1].

    Example:
        >>> [constant(0.5)(step, 4) for step in range(4)]
        [0.5, 0.5, 0.5, 0.5]
    """
    _check_share(a, "a")
    return lambda step, steps: a


@contextmanager
def inject(
    unet: torch.nn.Module,
    recording: Recording,
    *,
    branches: Sequence[str],
    warps: Sequence[LayerWarp | None] = (None,),
    weight: Callable[[int, int], float] | None = None,
    mask: Tensor | None = None,
    layers: Sequence[Layer] | None = None,
    blend: Blend | None = None,
) -> Iterator[None]:
    """Blend recorded features into the UNet's attention while the block runs.

    F = a (M warp(F_src) + (1 - M) F_new) + (1 - a) F_new, at each layer's own size. Steps whose
    features were not chosen stay as they are.

    Args:
        unet: the UNet that the features came from, or one of its shape.
        recording: features of the source view.
        branches: the guidance branches in the order of the batch; those that were recorded get
            features. One whose share of the guidance is 0 may be missing.
        warps: warps of the pictures of a batch, one each: :class:`attnwarp.warp.WarpedView` or None
            for the identity.
        weight: a by (step number, number of steps); :func:`decay` if left out.
        mask: (H, W) bool of the target where features may be injected, at any size with the
            target's proportions; everywhere if left out.
        layers: to inject, all recorded ones if left out.
        blend: blend of tokens along a warp; the formula above if left out. Half precision comes to
            it as float32.

    Raises:
        ValueError: a timestep, layer, branch or size that does not match the recording, or a run
            that was recorded in fewer steps than planned; the message names it.

    Example:
        >>> import numpy as np
        >>> from attnwarp.editing.editor import edit
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.editing.layers import choose_layers
        >>> from attnwarp.editing.recording import RecordingPlan, record
        >>> editor = load_editor("small-plain")
        >>> plan = RecordingPlan(
        ...     choose_layers(editor.unet), (8, 8), editor.branches, editor.branches, steps=1
        ... )
        >>> picture = np.full((32, 32, 3), 0.5, np.float32)
        >>> with record(editor.unet, plan) as recording:
        ...     source = edit(editor, [picture], "make it red", steps=1)
        >>> with inject(editor.unet, recording, branches=editor.branches, weight=constant(1.0)):
        ...     again = edit(editor, [picture], "make it red", steps=1)
        >>> bool((again.images[0] == source.images[0]).all())  # its own features change no bit
        True
    """
    weight = decay() if weight is None else weight
    plan, recorded = recording.plan, recording.plan.recorded
    chosen = plan.layers if layers is None else tuple(layers)
    for layer in chosen:
        if layer not in plan.layers:
            raise ValueError(f"layers: {layer.name} was not recorded")
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
    if mask is not None and (mask.ndim != 2 or mask.dtype != torch.bool):
        raise ValueError(f"mask: got {mask.dtype} {tuple(mask.shape)}, expected bool (H, W)")
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
        if mask is not None:
            h, w = mask.shape
            check.same_aspect((h, w), call.latent_size, "mask", "transpose a mask of (W, H)")
        if last != [call]:
            step = recording.step_of(call.timestep, step + 1)
            last[:] = [call]
        if step not in recorded:
            return features
        alpha = weight(step, plan.steps)
        _check_share(alpha, "weight")
        if alpha == 0:
            return features
        size, source_size = layer.size(call.latent_size), layer.size(plan.latent_size)
        result = features.clone()
        for branch in shared:
            source = recording._features_of(step, layer, branch).to(features.device, features.dtype)
            for view, warp in enumerate(warps):
                row = list(branches).index(branch) * views + view
                own = source[view if plan.views > 1 else 0]
                new = features[row]
                _blend_into(result[row], new, warp, own, alpha, source_size, size, blend)
                if mask is not None:
                    inside = resize_mask(mask.cpu(), size).reshape(-1, 1).to(features.device)
                    result[row] = torch.where(inside, result[row], new)
        return result

    with hooked(unet, chosen, change):
        yield


def _blend_into(
    result: Tensor,  # (H W, C), a copy of new
    new: Tensor,  # (H W, C)
    warp: LayerWarp | None,
    source: Tensor,  # (h w, C)
    alpha: float,
    source_size: Size,
    size: Size,
    blend: Blend | None,
) -> None:
    """Source tokens, warped and blended into the target's own; None is the identity."""
    if warp is None:
        if source_size != size:
            raise ValueError(
                f"size: the recording has {source_size} features, the target {size}; give a warp"
                " between views of different sizes"
            )
        work = work_type(new.dtype)  # half precision is rounded once, as by FeatureWarp
        result.copy_(alpha * source.to(work) + (1 - alpha) * new.to(work))
        return
    layer = warp.at(size, source_size=source_size)
    if blend is not None:
        work = work_type(new.dtype)
        result.copy_(blend(layer, source[None].to(work), new[None].to(work), alpha)[0])
    else:
        result.copy_(layer.blend_tokens(source[None], new[None], alpha)[0])


def _check_share(value: float, name: str) -> None:
    if not 0 <= value <= 1:
        raise ValueError(f"{name}: got {value}, expected a number in [0, 1]")
