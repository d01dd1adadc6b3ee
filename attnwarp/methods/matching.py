"""DGE's attention: key views attend to each other, other views take the output of the key views'
tokens that match their tokens (Chen et al. 2024).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.editing.layers import all_layers
from attnwarp.methods.attention import Attend, joint, self_attention
from attnwarp.methods.epipolar import line_distances
from attnwarp.methods.pictures import Size

MATCHED = "image"
"""Branch whose tokens are matched: the branch of the original picture."""


def matches(tokens: Tensor, key_tokens: Tensor, excluded: Tensor | None = None) -> Tensor:
    """Find the key token with the largest cosine to each token, (L,) indices.

    Args:
        tokens: (L, C).
        key_tokens: (M, C).
        excluded: (L, M) bool of the excluded pairs. A token with all pairs excluded is matched
            among all key tokens.
    """
    cosine = _unit(tokens) @ _unit(key_tokens).T
    if excluded is not None:
        excluded = excluded & ~excluded.all(dim=1, keepdim=True)
        cosine = cosine.masked_fill(excluded, -torch.inf)
    return cosine.argmax(dim=1)


def nearest_keys(view: Camera, keys: Sequence[Camera], count: int) -> list[tuple[int, float]]:
    """Find the nearest key cameras and the weights of their tokens, at most two.

    Of cameras at distances d1 <= d2 the first weighs sigmoid(d2 / (d1 + d2)), the other the rest.

    Example:
        >>> from attnwarp import Camera
        >>> size = dict(width=8, height=8, fov_y=60, up=(0, 1, 0))
        >>> row = [Camera.look_at((x, 0, 3), (x, 0, 0), **size) for x in (0, 1, 4)]
        >>> [(k, round(weight, 3)) for k, weight in nearest_keys(row[1], [row[2], row[0]], 2)]
        [(1, 0.679), (0, 0.321)]
    """
    distances = [float(np.linalg.norm(view.position - key.position)) for key in keys]
    order = sorted(range(len(keys)), key=lambda k: distances[k])[:count]
    if len(order) == 1:
        return [(order[0], 1.0)]
    first, second = (distances[k] for k in order)
    ratio = second / (first + second) if second > 0 else 0.5
    weight = 1 / (1 + float(np.exp(-ratio)))
    return [(order[0], weight), (order[1], 1 - weight)]


@dataclass(eq=False)
class KeyViews:
    """Tokens of the key views at one step, by layer, and their use by other views.

    Args:
        epipolar: distance in cells beyond which a match is excluded; None excludes none.
    """

    branches: tuple[str, ...]
    layers: dict[str, Size]
    epipolar: float | None
    _pass: _KeyPass | _ViewPass | None = None
    _tokens: dict[str, Tensor] = field(default_factory=dict)
    _outputs: dict[str, Tensor] = field(default_factory=dict)

    @contextmanager
    def key_pass(self) -> Iterator[None]:
        """Store the tokens of the key views passed through the network while the block runs."""
        self._tokens.clear()
        self._outputs.clear()
        self._pass = _KeyPass()
        try:
            yield
        finally:
            self._pass = None

    @contextmanager
    def view_pass(
        self, views: Sequence[Camera], keys: Sequence[Camera], nearest: int
    ) -> Iterator[None]:
        """Let views passed through the network use the key views' tokens while the block runs.

        Args:
            nearest: number of key views that each view takes tokens from, 1 or 2.
        """
        self._pass = _ViewPass(
            list(views), list(keys), [nearest_keys(view, keys, nearest) for view in views]
        )
        try:
            yield
        finally:
            self._pass = None

    def rule(self, name: str, tokens: Tensor, attend: Attend) -> Tensor:
        """Compute the output of a layer: see :data:`attnwarp.methods.attention.Rule`."""
        if self._pass is None:
            return attend(tokens, None)
        if isinstance(self._pass, _KeyPass):
            output = attend(tokens, joint(tokens, len(self.branches)))
            self._tokens[name], self._outputs[name] = tokens, output
            return output
        return self._matched(name, tokens, self._pass)

    def _matched(self, name: str, tokens: Tensor, now: _ViewPass) -> Tensor:
        count = len(self.branches)
        branch = self.branches.index(MATCHED) if MATCHED in self.branches else 0
        own, key_tokens, outputs = (
            values.reshape(count, -1, *values.shape[1:])
            for values in (tokens, self._tokens[name], self._outputs[name])
        )
        result = torch.zeros_like(own)
        for k in range(len(now.views)):
            for key, weight in now.nearest[k]:
                excluded = self._excluded(now, k, key, self.layers[name], tokens.device)
                index = matches(own[branch, k], key_tokens[branch, key], excluded)
                result[:, k] += weight * outputs[:, key, index]
        return result.reshape(tokens.shape)

    def _excluded(
        self, now: _ViewPass, view: int, key: int, size: Size, device: torch.device
    ) -> Tensor | None:
        if self.epipolar is None:
            return None
        place = view, key, size
        if place not in now.excluded:
            distances = line_distances(now.views[view], now.keys[key], size)
            far = None if distances is None else (distances > self.epipolar).to(device)
            now.excluded[place] = far
        return now.excluded[place]


@dataclass(frozen=True)
class _KeyPass:
    pass


@dataclass(frozen=True)
class _ViewPass:
    views: list[Camera]
    keys: list[Camera]
    nearest: list[list[tuple[int, float]]]
    # By view, key and size: layers of one size share data as large as their attention. Kept for one
    # pass, since the data of all views at once would fill the memory.
    excluded: dict[tuple[int, int, Size], Tensor | None] = field(default_factory=dict)


@contextmanager
def key_views(
    unet: Any, branches: tuple[str, ...], latent_size: Size, epipolar: float | None
) -> Iterator[KeyViews]:
    """Replace a UNet's self-attention while the block runs; outside of key passes and view passes
    it is unchanged."""
    layers = {layer.name: layer.size(latent_size) for layer in all_layers(unet)}
    keys = KeyViews(branches, layers, epipolar)
    with self_attention(unet, keys.rule):
        yield keys


def _unit(tokens: Tensor) -> Tensor:
    # Rounding in half precision would decide between close matches.
    tokens = tokens.to(torch.promote_types(tokens.dtype, torch.float32))
    return tokens / tokens.norm(dim=-1, keepdim=True).clamp_min(1e-12)
