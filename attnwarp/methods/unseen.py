"""Attention to the source's edit where no warp reaches the marked thing.

A back that the source does not see gets no features, so the editor chooses its look anew in each
view. There a view can attend to the keys and values of the source's edit at the same step, as
GaussCtrl's alignment does everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.editing.layers import Layer
from attnwarp.editing.schedule import Size
from attnwarp.methods.attention import Attend, self_attention
from attnwarp.warp import WarpedView
from attnwarp.warp.masks import axis_weights

Unseen = Callable[[Size], Tensor]
"""Function of a grid's (h, w) that returns the share of each token that attends to the source."""


def unseen_of(warp: WarpedView, segment: npt.NDArray[Any]) -> Unseen:
    """Mark the tokens of a target that no warp reaches, inside its segment."""

    def share(size: Size) -> Tensor:
        # The mask does not depend on the size of the source's grid.
        reached = warp.at(size, source_size=size).mask
        return _averaged(torch.as_tensor(segment), size) * ~reached

    return share


@dataclass(eq=False)
class SourceTokens:
    """Inputs of self-attention during a source's edit.

    Attributes:
        by_pass: (branches, L, C) tokens by the layer's name, then by the number of the pass.
    """

    by_pass: dict[str, dict[int, Tensor]] = field(default_factory=dict)


@contextmanager
def kept_tokens(
    network: Any, layers: Sequence[Layer], dtype: torch.dtype, passes: range
) -> Iterator[SourceTokens]:
    """Keep the inputs of a network's self-attention while the block runs; outputs are unchanged."""
    names = {layer.name for layer in layers}
    kept, done = SourceTokens(), dict.fromkeys(names, 0)

    def rule(name: str, tokens: Tensor, attend: Attend) -> Tensor:
        if name in names:
            if done[name] in passes:
                own = kept.by_pass.setdefault(name, {})
                own[done[name]] = tokens.detach().to("cpu", dtype, copy=True)
            done[name] += 1
        return attend(tokens, None)

    with self_attention(network, rule):
        yield kept


@contextmanager
def attending(
    network: Any,
    layers: Sequence[Layer],
    latent_size: Size,
    kept: SourceTokens,
    unseen: Sequence[Unseen],
    passes: range,
) -> Iterator[None]:
    """Let unseen tokens of views attend to the source's tokens while the block runs.

    A token's output is (1 - u) attn(q, k, v) + u attn(q, k_source, v_source), with its share u.
    """
    sizes = {layer.name: layer.size(latent_size) for layer in layers if layer.name in kept.by_pass}
    shares = {
        size: torch.stack([of(size).reshape(-1, 1) for of in unseen]) for size in {*sizes.values()}
    }
    done = dict.fromkeys(sizes, 0)

    def rule(name: str, tokens: Tensor, attend: Attend) -> Tensor:
        own = attend(tokens, None)
        if name not in sizes:
            return own
        number, done[name] = done[name], done[name] + 1
        share = shares[sizes[name]].to(own)
        if number not in passes or not share.any():
            return own
        source = kept.by_pass[name][number].to(tokens)
        branches, views = len(source), len(unseen)
        others = source[:, None].expand(-1, views, -1, -1).flatten(0, 1)
        # Tokens attend one by one, so those that are seen in every view are left out.
        asked = share.any(dim=0)[:, 0].nonzero()[:, 0]
        attended = attend(tokens[:, asked], others)
        result = own.clone()
        result[:, asked] = torch.lerp(
            own[:, asked], attended, share[:, asked].repeat(branches, 1, 1)
        )
        return result

    with self_attention(network, rule):
        yield


def has_self_attention(network: Any) -> bool:
    """Return True if a network has self-attention of diffusers."""
    names = getattr(network, "attn_processors", {})
    return any(name.endswith(".attn1.processor") for name in names)


def _averaged(values: Tensor, size: Size) -> Tensor:
    """Average (H, W) values over the pixels of an (h, w) grid, float64."""
    rows = axis_weights(size[0], values.shape[0], "area")
    columns = axis_weights(size[1], values.shape[1], "area")
    return rows @ values.double() @ columns.T
