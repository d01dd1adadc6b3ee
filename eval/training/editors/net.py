"""The network of the bundled editors, its noise schedule and its loss: what every stage of the training shares.

A small InstructPix2Pix (Brooks et al. 2023): the picture before the edit is concatenated to the noisy latents. It predicts
the edited picture itself, from betas whose last step is pure noise (Lin et al. 2024, "Common diffusion noise schedules
and sample steps are flawed").
"""

from __future__ import annotations

from typing import Any

import torch

from attnwarp.editing.latents import BLOCK, CHANNELS
from attnwarp.editing.small_unet import EditUNet

Tensor = torch.Tensor

WIDTHS = (64, 128)
LAYERS = 1
HEADS = 4
TEXT_WIDTH = 128
TEXT_LAYERS = 2
VOCABULARY = 1500
TOKENS = 24

T_STEPS = 1000
NOISY_SHARE = 0.6
"""Share of the steps drawn from the noisier ones, where the answer is decided."""
MOST_WEIGHT = 5.0
SD_BETAS = (0.00085, 0.012)
"""Stable Diffusion's, first and last."""
SHIFT = 16.0
"""Factor that multiplies the signal-to-noise amplitude of Stable Diffusion at each step, see
:func:`scheduler`.
"""


def text_encoder(vocabulary: int) -> Any:
    """The text encoder of every editor, before its training."""
    from transformers import CLIPTextConfig, CLIPTextModel

    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=vocabulary, hidden_size=TEXT_WIDTH, intermediate_size=2 * TEXT_WIDTH,
            num_hidden_layers=TEXT_LAYERS, num_attention_heads=4, max_position_embeddings=TOKENS,
            pad_token_id=0, bos_token_id=1, eos_token_id=1,
        )
    )  # fmt: skip


class EditorNet(torch.nn.Module):
    """The UNet and the text encoder, trained together."""

    def __init__(self, vocabulary: int, size: int, *, draws: bool = True) -> None:
        super().__init__()
        self.unet = EditUNet(
            sample_size=size // BLOCK, in_channels=2 * CHANNELS, out_channels=CHANNELS,
            down_block_types=("DownBlock2D",) * len(WIDTHS), mid_block_type="UNetMidBlock2D",
            up_block_types=("CrossAttnUpBlock2D",) * len(WIDTHS), block_out_channels=WIDTHS, layers_per_block=LAYERS,
            cross_attention_dim=TEXT_WIDTH, attention_head_dim=HEADS, norm_num_groups=16,
        )  # fmt: skip
        if not draws:
            self.unet.draw = None
        self.text = text_encoder(vocabulary)
        # The first prediction is the picture before the edit.
        torch.nn.init.zeros_(self.unet.conv_out.weight)
        torch.nn.init.zeros_(self.unet.conv_out.bias)

    def forward(self, noisy: Tensor, before: Tensor, t: Tensor, tokens: Tensor) -> Tensor:
        """(B, 48, h, w) predicted latents of the edited pictures."""
        with halves(noisy.device):
            context = self.text(tokens).last_hidden_state
            both = torch.cat([noisy, before], dim=1)
            return self.unet(both, t, context, return_dict=False)[0].float()


def halves(device: torch.device) -> torch.autocast:
    """Matrices multiplied in bfloat16 where the device is a GPU; pictures, targets and losses stay in float32."""
    on_gpu = device.type == "cuda"
    # A recorded graph cannot use weights that were converted outside it.
    return torch.autocast(device.type, torch.bfloat16, enabled=on_gpu, cache_enabled=False)


def scheduler(shift: float = 1.0) -> Any:
    """The noise schedule and the sampler, as diffusers' pipelines load them.

    Args:
        shift: by which the ratio of signal to noise, in amplitude, is multiplied at every step. A mean
            over a thing is read from as many cells as it has, so the same step of Stable Diffusion hides
            four times as much on 16 x 16 latents as on its 64 x 64 (Hoogeboom et al. 2023, "simple
            diffusion", section 2.3). More of it shows an answer while features still have most of
            their weight.
    """
    from diffusers import DDIMScheduler

    settings: dict[str, Any] = {
        "num_train_timesteps": T_STEPS, "beta_schedule": "scaled_linear", "beta_start": SD_BETAS[0], "beta_end": SD_BETAS[1],
        "rescale_betas_zero_snr": True, "timestep_spacing": "trailing", "prediction_type": "sample", "clip_sample": False,
        "set_alpha_to_one": True, "steps_offset": 0,
    }  # fmt: skip
    plain = DDIMScheduler(**settings)
    if shift == 1:
        return plain
    alphas = plain.alphas_cumprod.double()
    shifted = shift**2 * alphas / (1 + (shift**2 - 1) * alphas)
    before = torch.cat([torch.ones(1, dtype=torch.float64), shifted[:-1]])
    betas = (1 - shifted / before).tolist()
    return DDIMScheduler(**settings | {"rescale_betas_zero_snr": False, "trained_betas": betas})


def draw_steps(count: int, generator: torch.Generator, noisy_from: int) -> Tensor:
    """(count,) steps, more of them noisy, on the generator's device."""
    device = generator.device
    noisy = torch.randint(noisy_from, T_STEPS, (count,), generator=generator, device=device)
    rest = torch.randint(0, noisy_from, (count,), generator=generator, device=device)
    share = torch.rand(count, generator=generator, device=device)
    return torch.where(share < NOISY_SHARE, noisy, rest)


def noised(x: Tensor, noise: Tensor, alphas: Tensor) -> Tensor:
    """sqrt(alpha-bar) x + sqrt(1 - alpha-bar) noise, with (B,) alpha-bar."""
    a = alphas[:, None, None, None]
    return a.sqrt() * x + (1 - a).sqrt() * noise


def loss_of(prediction: Tensor, target: Tensor, weight: Tensor, alphas: Tensor) -> Tensor:
    """Mean squared error of the edited picture's latents, weighted by cell and by min(SNR + 1, 5)."""
    by_step = (alphas / (1 - alphas) + 1).clamp(max=MOST_WEIGHT)
    error = (prediction - target).square().mean(dim=1, keepdim=True)
    return (by_step[:, None, None, None] * weight * error).mean()
