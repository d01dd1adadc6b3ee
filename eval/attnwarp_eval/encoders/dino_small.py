"""dino-small: a small encoder of pictures, trained from scratch by eval/training/."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn import functional

from attnwarp.encoders.base import Image
from attnwarp.encoders.bundled import OfSquares, identity_of, read_weights
from attnwarp.encoders.nets import Block, Pool, Stages
from attnwarp.encoders.preprocess import Preprocessing

WEIGHTS = Path(__file__).parent / "weights"

Array = npt.NDArray[np.float64]
Tensor = torch.Tensor


def load(name: str = "dino-small", folder: Path = WEIGHTS) -> BundledDino:
    """Load dino-small."""
    return BundledDino(name, folder)


class DinoSmall(nn.Module):
    """Small network: convolutions to 1/16 of the size, then a transformer with a class token (Caron
    et al. 2021).

    The convolutions replace the patch embedding, since a transformer alone needs far more
    pictures. The class token starts as mean and maximum of their features.
    """

    size = 128
    patch = 16

    def __init__(self, dim: int = 192, depth: int = 3, heads: int = 6) -> None:
        super().__init__()
        self.dim = dim
        self.stages = Stages((32, 64, 128), (1, 2, 2))
        self.embed = nn.Conv2d(128, dim, 1)
        self.cls = Pool(128, dim)
        self.position = nn.Parameter(0.02 * torch.randn(1, dim, 8, 8))
        self.blocks = nn.ModuleList(Block(dim, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map (N, 3, H, W) in [0, 1], sides multiples of 16 -> class token (N, D), patch tokens
        (N, D, H / 16, W / 16).
        """
        x = self.stages(x)[-1]
        y = self.embed(x)
        h, w = y.shape[-2:]
        y = y + functional.interpolate(self.position, (h, w), mode="bicubic", align_corners=False)
        tokens = torch.cat([self.cls(x)[:, None], y.flatten(2).transpose(1, 2)], dim=1)
        for block in self.blocks:
            tokens = block(tokens)
        tokens = self.norm(tokens)
        return tokens[:, 0], tokens[:, 1:].transpose(1, 2).reshape(len(y), self.dim, h, w)


class BundledDino(OfSquares):
    """dino-small: a :class:`~attnwarp_eval.encoders.TokenEncoder`."""

    def __init__(self, name: str, folder: Path) -> None:
        self.net = DinoSmall()
        weights = folder / f"{name}.safetensors"
        read_weights(self.net, weights)
        self.preprocess = Preprocessing(
            resize=DinoSmall.size, crop=(DinoSmall.size, DinoSmall.size)
        )
        self.about = identity_of(
            name, "dino", [weights], str(self.preprocess), DinoSmall.size, self.net.dim
        )

    def images(self, images: Sequence[Image]) -> Array:
        """Compute class tokens, (N, D) float64, not normalised."""
        return self.rows(images, lambda batch: self.net(batch)[0], (self.net.dim,))

    def tokens(self, images: Sequence[Image]) -> Array:
        """Compute patch tokens of the central square, (N, 8, 8, D) float64; a patch has 16 x 16 of
        128 x 128 px."""
        side = DinoSmall.size // DinoSmall.patch
        shape = side, side, self.net.dim
        return self.rows(images, lambda batch: self.net(batch)[1].permute(0, 2, 3, 1), shape)
