"""Self-attention over tokens of other views, for any diffusers network and processor."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor

Attend = Callable[[Tensor, Tensor | None], Tensor]
"""Original attention of a layer: (B, L, C) tokens attend to (B, M, C), to themselves for None."""

Rule = Callable[[str, Tensor, Attend], Tensor]
"""(B, L, C) output of a layer, from the layer's name, input tokens and original attention."""


@contextmanager
def self_attention(network: Any, rule: Rule) -> Iterator[None]:
    """Compute every self-attention of a network by a rule while the block runs."""
    before = dict(network.attn_processors)
    replaced = {
        name: _Ruled(name.removesuffix(".processor"), processor, rule)
        if name.endswith(".attn1.processor")
        else processor
        for name, processor in before.items()
    }
    network.set_attn_processor(replaced)
    try:
        yield
    finally:
        network.set_attn_processor(before)


class _Ruled:
    """Attention processor that delegates projections and softmax to the processor it replaces."""

    def __init__(self, name: str, processor: Any, rule: Rule) -> None:
        self.name, self.processor, self.rule = name, processor, rule

    def __call__(
        self,
        attn: Any,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor | None = None,
        attention_mask: Tensor | None = None,
        **more: Any,
    ) -> Tensor:
        def attend(tokens: Tensor, others: Tensor | None) -> Tensor:
            output: Tensor = self.processor(
                attn,
                tokens,
                encoder_hidden_states=others,
                attention_mask=attention_mask,
                **more,
            )
            return output

        return self.rule(self.name, hidden_states, attend)


def joint(tokens: Tensor, branches: int) -> Tensor:
    """Return (branches V, V L, C): for each picture the tokens of all pictures of its branch.

    Example:
        >>> import torch
        >>> joint(torch.arange(6.0).reshape(6, 1, 1), branches=2)[[0, 2, 3], :, 0].int().tolist()
        [[0, 1, 2], [0, 1, 2], [3, 4, 5]]
    """
    rows, length, channels = tokens.shape
    views = rows // branches
    all_views = tokens.reshape(branches, 1, views * length, channels)
    return all_views.expand(-1, views, -1, -1).reshape(rows, views * length, channels)


def aligned(references: int, self_share: float, branches: int) -> Rule:
    """GaussCtrl's attention: self-attention of the view blended with attention to references.

    The output is s attn(q, k, v) + (1 - s) / R sum_r attn(q, k_r, v_r). The first R pictures of
    each branch in the batch are the references.

    Args:
        references: R, the number of reference views.
        self_share: s in [0, 1], the weight of the view's self-attention.
    """

    def rule(name: str, tokens: Tensor, attend: Attend) -> Tensor:
        rows, length, channels = tokens.shape
        by_branch = tokens.reshape(branches, rows // branches, length, channels)
        total = self_share * attend(tokens, None) if self_share else 0.0
        for reference in range(references):
            others = by_branch[:, reference : reference + 1].expand_as(by_branch)
            # The projection after the attention is affine and the shares add to 1, so averaging
            # outputs equals averaging heads.
            output = attend(tokens, others.reshape(tokens.shape))
            total = total + (1 - self_share) / references * output
        return total  # type: ignore[return-value]

    return rule
