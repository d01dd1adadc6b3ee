"""Stable Diffusion 3 and 3.5 (Esser et al. 2024), picture to picture: the picture is noised in
part, and denoised to a description.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.editing.editor import Begin
from attnwarp.editing.editors import reads
from attnwarp.editing.joint import Joint, Pass, Stack, linear_shift
from attnwarp.editing.layers import CONTROLNET_BRANCHES
from attnwarp.editing.schedule import Flow, Size, Time

MOST_SHIFT = 1.16


@reads("StableDiffusion3Pipeline", "StableDiffusion3Img2ImgPipeline")
class StableDiffusion3(Joint):
    """Editor of Stable Diffusion 3. Its text describes the edited picture.

    Keys are taken before their norm, which sees them by heads. There are no references.

    Args:
        text_guidance: s of v = v_un + s (v_txt - v_un), in one batch.
        strength: share of the schedule that an edit runs, from its end: more changes more.
        parts: networks, tokenizers and scheduler, by their names in diffusers.
    """

    pipeline = "StableDiffusion3Img2ImgPipeline"
    networks = {  # noqa: RUF012
        "transformer": "SD3Transformer2DModel",
        "vae": "AutoencoderKL",
        "text_encoder": "CLIPTextModelWithProjection",
        "text_encoder_2": "CLIPTextModelWithProjection",
        "text_encoder_3": "T5EncoderModel",
    }
    optional = ("text_encoder_3",)
    stacks = (
        Stack("transformer_blocks", "num_layers", rows="image", keys="attn.to_k"),
        Stack(
            "transformer_blocks", "dual_attention_layers", "attn2.to_out.0", "image",
            "attn2.to_k", "attn2.to_v",
        ),
    )  # fmt: skip
    words = ("tokenizer", 77)
    begins: Begin = "picture"
    own_steps = 30
    options = ("text_guidance", "strength", "negative_prompt")

    def __init__(self, *, text_guidance: float = 7.0, strength: float = 0.6, **parts: Any) -> None:
        self.strength = check.number(strength, 0.001, 1, "strength")
        super().__init__(text_guidance=text_guidance, **parts)

    @classmethod
    def token_of(cls, config: Mapping[str, Any]) -> int:
        """Return the side of a patch, which the network itself cuts."""
        return int(config["patch_size"])

    def flow(self, scheduler: Any) -> Flow:
        """Take the last steps of a longer schedule, so many that those asked for are run."""
        whole = Flow.of(scheduler, self.mu, self.token, even=False)

        def spacing(steps: int, size: Size) -> Sequence[float]:
            count = int(steps / self.strength + 1e-9)  # 3 / 0.6 is below 5 in floats
            return whole.spacing(count, size)[-steps:]

        return Flow(spacing)

    def mu(self, scheduler: Any, tokens: int, steps: int) -> float:
        """Compute the shift, of a scheduler that has one by size."""
        return linear_shift(scheduler.config, tokens, MOST_SHIFT)

    @property
    def channels(self) -> int:
        """Number of channels of the latents."""
        return int(self.network.config.in_channels)

    @property
    def branches(self) -> tuple[str, ...]:
        """Guidance branches in the order of the batch."""
        return CONTROLNET_BRANCHES if self.scale != 1 else ("text",)

    def embed(self, words: str, pictures: Sequence[Tensor]) -> dict[str, Any]:
        """Encode a description by all text encoders."""
        with torch.no_grad():
            text, _, pooled, _ = self.pipe.encode_prompt(
                words, None, None, device=self.network.device, do_classifier_free_guidance=False
            )
        views = len(pictures[0])
        return {
            "encoder_hidden_states": text.expand(views, -1, -1),
            "pooled_projections": pooled.expand(views, -1),
        }

    def passes(self, inputs: dict[str, Any]) -> Sequence[Pass]:
        """Join the branches in one batch."""
        rows = list(inputs.values())
        joined = {name: torch.cat([row[name] for row in rows]) for name in rows[0]}
        return [(tuple(inputs), joined)]

    def seen(self, pictures: Sequence[Tensor]) -> None:
        """Return no tokens: the network sees no reference."""

    def packed(self, latents: Tensor) -> Tensor:
        """Return the latents, which the network cuts itself."""
        return latents

    def unpacked(self, tokens: Tensor, size: Size) -> Tensor:
        """Return the network's output."""
        return tokens

    def clock(self, timestep: Time, like: Tensor) -> Tensor:
        """Convert a share of noise to thousandths."""
        return (1000 * torch.tensor(timestep, dtype=torch.float32, device=like.device)).expand(
            len(like)
        )
