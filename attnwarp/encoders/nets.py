"""Networks of the bundled encoders, small enough for a CPU; eval/training/README.md says
what trained them.

Inputs are pictures (N, 3, H, W) sRGB in [0, 1]; each network centres its input.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn
from torch.nn import functional

Tensor = torch.Tensor


class Residual(nn.Module):
    """Two 3 x 3 convolutions with batch normalisation about an identity (He et al. 2016, figure
    2)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.first_norm = nn.BatchNorm2d(channels)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.second_norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, C, h, w) -> (N, C, h, w)."""
        y = functional.relu(self.first_norm(self.first(x)))
        return functional.relu(x + self.second_norm(self.second(y)))


class Stages(nn.Module):
    """Convolutional stages: the first at a quarter of the size, each further one at half of the
    previous size."""

    def __init__(self, widths: Sequence[int], depths: Sequence[int]) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(3, widths[0] // 2, 3, stride=2, padding=1, bias=False),
            nn.BatchNorm2d(widths[0] // 2),
            nn.ReLU(),
            nn.Conv2d(widths[0] // 2, widths[0], 2, stride=2),
        )
        self.stages = nn.ModuleList()
        for k, (width, depth) in enumerate(zip(widths, depths, strict=True)):
            down = [nn.Conv2d(widths[k - 1], width, 2, stride=2)] if k else []
            self.stages.append(nn.Sequential(*down, *(Residual(width) for _ in range(depth))))

    def forward(self, x: Tensor) -> list[Tensor]:
        """Map (N, 3, H, W) in [0, 1] -> the output of every stage, (N, C_k, H / 2^(k + 2),
        W / 2^(k + 2)).
        """
        x = self.stem(4 * x - 2)
        out = []
        for stage in self.stages:
            x = stage(x)
            out.append(x)
        return out


class Pool(nn.Module):
    """Mean and maximum over all positions, projected: the mean captures ground and light, the
    maximum local objects.
    """

    def __init__(self, channels: int, dim: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(2 * channels)
        self.project = nn.Linear(2 * channels, dim)

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, C, h, w) -> (N, dim)."""
        return self.project(self.features(x))

    def features(self, x: Tensor) -> Tensor:
        """Map (N, C, h, w) -> (N, 2 C), the features before the projection."""
        return self.norm(torch.cat([x.mean((2, 3)), x.amax((2, 3))], dim=1))


class Patches(nn.Module):
    """Vectors of regions, from all stages but the first, in the space of texts.

    Args:
        widths: channels of the stages, each of half the size of the previous one.
    """

    def __init__(self, widths: Sequence[int], dim: int, hidden: int = 128) -> None:
        super().__init__()
        self.inputs = nn.ModuleList(nn.Conv2d(width, hidden, 1) for width in widths)
        self.norm = nn.BatchNorm2d(hidden)
        self.mix = nn.Conv2d(hidden, hidden, 3, padding=1)
        self.project = nn.Conv2d(hidden, dim, 1)
        # A text describes a region with probability sigmoid(exp(scale) cosine + bias).
        self.scale = nn.Parameter(torch.tensor(2.3))
        self.bias = nn.Parameter(torch.tensor(-4.0))

    def forward(self, stages: Sequence[Tensor]) -> Tensor:
        """Map the stages' outputs, (N, C_k, h / 2^k, w / 2^k) -> (N, dim, h, w)."""
        size = stages[0].shape[-2:]
        total = self.inputs[0](stages[0])
        for layer, x in zip(list(self.inputs)[1:], stages[1:], strict=True):
            total = total + functional.interpolate(
                layer(x), size, mode="bilinear", align_corners=False
            )
        return self.project(functional.relu(self.mix(functional.relu(self.norm(total)))))


class Block(nn.Module):
    """Transformer block with normalisation first."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.attend_norm = nn.LayerNorm(dim)
        self.qkv = nn.Linear(dim, 3 * dim)
        self.out = nn.Linear(dim, dim)
        self.think_norm = nn.LayerNorm(dim)
        self.think = nn.Sequential(nn.Linear(dim, 2 * dim), nn.GELU(), nn.Linear(2 * dim, dim))

    def forward(self, x: Tensor, absent: Tensor | None = None) -> Tensor:
        """Map (N, L, D) -> (N, L, D); no token attends to ``absent`` ones, (N, L) bool."""
        n, length, dim = x.shape
        q, k, v = (
            self.qkv(self.attend_norm(x))
            .view(n, length, 3, self.heads, dim // self.heads)
            .permute(2, 0, 3, 1, 4)
        )
        # Written out: for a few hundred tokens on a CPU, two matrix products are several times
        # faster than the fused kernel.
        scores = q @ k.transpose(-1, -2) * (dim // self.heads) ** -0.5
        if absent is not None:
            scores = scores.masked_fill(absent[:, None, None], -torch.inf)
        weights = scores.softmax(dim=-1)
        y = (weights @ v).transpose(1, 2).reshape(n, length, dim)
        x = x + self.out(y)
        return x + self.think(self.think_norm(x))


class TextTower(nn.Module):
    """Small transformer over byte-pair tokens; the embedding is read at the last token.

    Args:
        vocabulary: number of tokens; token 0 is padding.
        length: longest text in tokens; longer texts are cut, keeping their end token.
    """

    def __init__(
        self, vocabulary: int, width: int, depth: int, heads: int, length: int, dim: int
    ) -> None:
        super().__init__()
        self.length = length
        self.words = nn.Embedding(vocabulary, width, padding_idx=0)
        self.position = nn.Parameter(0.01 * torch.randn(length, width))
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(width)
        self.project = nn.Linear(width, dim)

    def forward(self, tokens: Tensor) -> Tensor:
        """Map (N, L) int64, padded with 0 at the end -> (N, dim)."""
        x = self.words(tokens) + self.position[: tokens.shape[1]]
        for block in self.blocks:
            x = block(x, tokens == 0)
        last = (tokens != 0).sum(dim=1).clamp(min=1) - 1
        return self.project(self.norm(x[torch.arange(len(x)), last]))


class ClipSmall(nn.Module):
    """Small encoder of pictures and texts in one space (Radford et al. 2021)."""

    size = 112
    length = 40

    def __init__(self, vocabulary: int, dim: int = 192) -> None:
        super().__init__()
        self.vision = Stages((32, 64, 128, 224), (1, 1, 2, 2))
        self.pool = Pool(224, dim)
        self.text = TextTower(vocabulary, 128, 3, 4, self.length, dim)
        # exp(scale) multiplies the cosine, as in the paper, which starts at 1 / 0.07.
        self.scale = nn.Parameter(torch.tensor(2.66))

    def images(self, x: Tensor) -> Tensor:
        """Map (N, 3, 112, 112) in [0, 1] -> (N, dim)."""
        return self.pool(self.vision(x)[-1])

    def texts(self, tokens: Tensor) -> Tensor:
        """Map (N, L) tokens -> (N, dim)."""
        return self.text(tokens)


class ClipParts(ClipSmall):
    """:class:`ClipSmall` with a vector for each region of 8 x 8 px in the space of texts."""

    def __init__(self, vocabulary: int, dim: int = 192) -> None:
        super().__init__(vocabulary, dim)
        self.patches = Patches((64, 128, 224), dim)

    def places(self, x: Tensor) -> Tensor:
        """Map (N, 3, H, W) in [0, 1], sides multiples of 32 -> (N, dim, H / 8, W / 8)."""
        return self.patches(self.vision(x)[1:])


class PerceptualSmall(nn.Module):
    """Small network: differences of features, weighted by channel and averaged over positions and
    stages (Zhang et al. 2018, eq. 1).

    Features are normalised at each position; weights are kept positive by their exponential. The
    slightly blurred picture is an additional first stage, so that differences too faint for the
    features still count.
    """

    def __init__(self) -> None:
        super().__init__()
        self.widths = (32, 48, 64, 96)
        self.layers = nn.ModuleList()
        before = 3
        for k, width in enumerate(self.widths):
            self.layers.append(
                nn.Conv2d(before, width, 5 if k == 0 else 3, padding=2 if k == 0 else 1)
            )
            before = width
        self.log_weights = nn.ParameterList(
            nn.Parameter(torch.zeros(width)) for width in self.widths
        )
        self.color_log_weight = nn.Parameter(torch.zeros(3))

    def features(self, x: Tensor) -> list[Tensor]:
        """Map (N, 3, H, W) in [0, 1] -> (N, C_k, h_k, w_k): full size, then half the previous size
        at each stage.
        """
        x = 4 * x - 2
        out = []
        for k, layer in enumerate(self.layers):
            if k:
                x = functional.avg_pool2d(x, 2, ceil_mode=True)
            x = functional.relu(layer(x)) if k < len(self.layers) - 1 else layer(x)
            out.append(x)
        return out

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Map two (N, 3, H, W) -> (N,) symmetric distances, 0 for equal pictures."""
        return self.between(self.stack(a), self.stack(b))

    def stack(self, x: Tensor) -> list[Tensor]:
        """Stack the compared features of pictures: the pictures averaged over 4 x 4 px, then their
        unit features.
        """
        size = 4 if min(x.shape[-2:]) >= 4 else 1
        return [functional.avg_pool2d(x, size), *(_Unit.apply(y) for y in self.features(x))]

    def between(self, a: list[Tensor], b: list[Tensor]) -> Tensor:
        """Compute distances, (N,), from the results of :meth:`stack`."""
        weights = [self.color_log_weight, *self.log_weights]
        parts = [
            functional.mse_loss(x, y, reduction="none").mean((2, 3)) @ w.exp()
            for x, y, w in zip(a, b, weights, strict=True)
        ]
        return torch.stack(parts).sum(dim=0)


class _Unit(torch.autograd.Function):
    """Normalise each position's feature vector to length 1; nearly zero vectors stay so. This
    gradient passes over the features half as often as autograd's."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        scale = (x.square().sum(dim=1, keepdim=True) + 1e-2).rsqrt()
        unit = x * scale
        ctx.save_for_backward(unit, scale)
        return unit

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (gradient,), (unit, scale) = gradients, ctx.saved_tensors
        along = (unit * gradient).sum(dim=1, keepdim=True)
        return torch.addcmul(gradient, unit, along, value=-1).mul_(scale)
