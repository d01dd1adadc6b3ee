"""Latents of the bundled editors: a fixed, unlearned orthogonal transform of 4 x 4 blocks."""

from __future__ import annotations

import torch
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.models.autoencoders.autoencoder_tiny import AutoencoderTinyOutput
from diffusers.models.autoencoders.vae import DecoderOutput
from diffusers.models.modeling_utils import ModelMixin
from torch import Tensor

BLOCK = 4
"""Side of a block in px: the picture's side over the latents' side."""

CHANNELS = 3 * BLOCK**2

GAINS = (0.5, 1.0, 1.0)
"""Gains of a block's mean, coarse and fine details. A mean over 16 px has a standard deviation near
2, details 0.1 to 0.3; without gains, white noise of unit variance would settle the details before
the colour."""


def haar_basis() -> Tensor:
    """Build (48, 3, 4, 4) orthonormal kernels: a two-level Haar transform of opponent colours.

    Channels 0 to 2 are the mean of a block's luminance, red against blue, green against both; 3 to
    11 the coarse details; 12 to 47 the fine ones.
    """
    color = torch.tensor([[1.0, 1, 1], [1, 0, -1], [1, -2, 1]], dtype=torch.float64)
    color = color / color.norm(dim=1, keepdim=True)
    pair = torch.tensor([[1.0, 1], [1, -1]], dtype=torch.float64) / 2**0.5
    flat = torch.ones(2, dtype=torch.float64) / 2**0.5

    def planes(vertical: Tensor, horizontal: Tensor) -> Tensor:
        return torch.einsum("c k, y, x -> c k y x", color, vertical, horizontal)

    low, high = torch.kron(pair[0], flat), torch.kron(pair[1], flat)
    kernels = [planes(v, h) for v in (low, high) for h in (low, high)]
    for y in range(2):
        for x in range(2):
            place_y, place_x = torch.eye(2, dtype=torch.float64)[[y, x]]
            kernels += [
                planes(torch.kron(place_y, pair[a]), torch.kron(place_x, pair[b]))
                for a, b in ((0, 1), (1, 0), (1, 1))
            ]
    return torch.cat(kernels)


class HaarLatents(ModelMixin, ConfigMixin):
    """Transform between pictures and latents, with the interface of a diffusers autoencoder.

    The transform is orthogonal up to its gains: it is lossless and needs no training.

    Args:
        block_out_channels: tuple of length 3, from which diffusers' pipelines compute the factor
            between picture and latents, 2 ** (3 - 1) = 4.
        latent_channels: number of channels, 48.
        scaling_factor: factor of latents after encoding; here the gains replace it.
    """

    @register_to_config
    def __init__(
        self,
        block_out_channels: tuple[int, ...] = (CHANNELS, CHANNELS, CHANNELS),
        latent_channels: int = CHANNELS,
        scaling_factor: float = 1.0,
    ) -> None:
        super().__init__()
        gains = torch.repeat_interleave(
            torch.tensor(GAINS, dtype=torch.float32), torch.tensor([3, 9, 36])
        )
        basis = haar_basis().float()
        self.register_buffer("encoder", basis * gains[:, None, None, None], persistent=False)
        self.register_buffer("decoder", basis / gains[:, None, None, None], persistent=False)
        # diffusers reads a model's dtype from its parameters, and this model has none to learn.
        self.unit = torch.nn.Parameter(torch.ones(1, dtype=torch.float32), requires_grad=False)

    def encode(self, x: Tensor, return_dict: bool = True) -> AutoencoderTinyOutput | tuple[Tensor]:
        """Encode (B, 3, H, W) in [-1, 1], sides multiples of 4, as (B, 48, H / 4, W / 4)."""
        if x.ndim != 4 or x.shape[1] != 3 or x.shape[2] % BLOCK or x.shape[3] % BLOCK:
            raise ValueError(
                f"x: got shape {tuple(x.shape)}, expected (B, 3, H, W) with sides that are"
                f" multiples of {BLOCK}"
            )
        latents = torch.nn.functional.conv2d(x, self.encoder.to(x.dtype), stride=BLOCK)
        return AutoencoderTinyOutput(latents=latents) if return_dict else (latents,)

    def decode(
        self, x: Tensor, generator: torch.Generator | None = None, return_dict: bool = True
    ) -> DecoderOutput | tuple[Tensor]:
        """Decode (B, 48, h, w) latents to (B, 3, 4 h, 4 w) pictures; ``generator`` is unused."""
        if x.ndim != 4 or x.shape[1] != CHANNELS:
            raise ValueError(f"x: got shape {tuple(x.shape)}, expected (B, {CHANNELS}, h, w)")
        sample = torch.nn.functional.conv_transpose2d(x, self.decoder.to(x.dtype), stride=BLOCK)
        return DecoderOutput(sample=sample) if return_dict else (sample,)
