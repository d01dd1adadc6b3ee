"""A small editor of joint attention, by the pairs, the noise and the loss of the bundled editors.

Its network is diffusers' transformer of FLUX.1 Kontext: text, picture and the picture before the edit in one sequence, with
tokens of 4 x 4 px. It predicts the velocity of a flow. A noisy picture of the diffusion with alpha-bar a, divided by
sqrt(a) + sqrt(1 - a), is the flow's at the share of noise s with s / (1 - s) = sqrt((1 - a) / a).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from attnwarp.editing.joint import grid_ids
from attnwarp.editing.latents import CHANNELS
from training.editors.net import SHIFT, TEXT_WIDTH, halves, scheduler, text_encoder
from training.editors.recipe import Stage

WIDTH, HEADS, DOUBLE, SINGLE = 192, 6, 2, 4
AXES = (8, 12, 12)
"""Channels of a head that the number of a picture, the row and the column turn."""


class JointNet(torch.nn.Module):
    """The transformer and the text encoder, trained together: 5.6 million weights."""

    alphas: Tensor

    def __init__(self, vocabulary: int, shift: float = SHIFT) -> None:
        super().__init__()
        from diffusers import FluxTransformer2DModel

        self.transformer = FluxTransformer2DModel(
            patch_size=1, in_channels=CHANNELS, num_layers=DOUBLE, num_single_layers=SINGLE,
            attention_head_dim=WIDTH // HEADS, num_attention_heads=HEADS, joint_attention_dim=TEXT_WIDTH,
            pooled_projection_dim=TEXT_WIDTH, guidance_embeds=False, axes_dims_rope=AXES,
        )  # fmt: skip
        self.text = text_encoder(vocabulary)
        self.register_buffer("alphas", scheduler(shift).alphas_cumprod.clone(), persistent=False)

    def forward(self, noisy: Tensor, before: Tensor, t: Tensor, tokens: Tensor) -> Tensor:
        """(B, 48, h, w) predicted latents of the edited pictures."""
        a = self.alphas[t]
        both = a.sqrt() + (1 - a).sqrt()
        share = (1 - a).sqrt() / both
        x = noisy / both[:, None, None, None]
        size, device = (x.shape[2], x.shape[3]), x.device
        ids = torch.cat([grid_ids(size, number, 3) for number in (0, 1)]).to(device)
        with halves(device):
            text = self.text(tokens)
            rows = torch.cat([one.flatten(2).transpose(1, 2) for one in (x, before)], dim=1)
            velocity = self.transformer(
                hidden_states=rows, encoder_hidden_states=text.last_hidden_state, pooled_projections=text.pooler_output,
                timestep=share, img_ids=ids, txt_ids=torch.zeros(tokens.shape[1], 3, device=device), return_dict=False,
            )[0][:, : rows.shape[1] // 2].float()  # fmt: skip
        return x - share[:, None, None, None] * velocity.transpose(1, 2).unflatten(2, size)


@dataclass(frozen=True)
class JointStage(Stage):
    """A stage whose network is a :class:`JointNet`."""

    draws: bool = False

    def network(self, vocabulary: int) -> JointNet:
        """The network before its training."""
        return JointNet(vocabulary, self.shift)

    def constants(self) -> dict[str, object]:
        """Constants that the network depends on, by name."""
        return {"WIDTH": WIDTH, "HEADS": HEADS, "DOUBLE": DOUBLE, "SINGLE": SINGLE, "AXES": AXES}


JOINT_STAGES = {
    "joint": JointStage(64, 24_000, 6e-4, 1800, parts=1190, composed=0.7, large=0.2, seed=31)
}
