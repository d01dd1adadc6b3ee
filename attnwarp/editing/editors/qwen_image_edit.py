"""Qwen-Image-Edit and -Plus (Alibaba 2025): edits by an instruction that a vision model reads with
the picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attnwarp.editing.editors import reads
from attnwarp.editing.joint import Joint, Stack
from attnwarp.editing.schedule import Size


@reads("QwenImageEditPipeline")
class QwenImageEdit(Joint):
    """Editor of Qwen-Image-Edit.

    Args:
        text_guidance: s of v = v_un + s (v_txt - v_un), rescaled to the length of v_txt.
        negative_prompt: words of the second pass.
        parts: networks, tokenizer, processor and scheduler, by their names in diffusers.
    """

    pipeline = "QwenImageEditPipeline"
    networks = {  # noqa: RUF012
        "transformer": "QwenImageTransformer2DModel",
        "vae": "AutoencoderKLQwenImage",
        "text_encoder": "Qwen2_5_VLForConditionalGeneration",
    }
    stacks = (Stack("transformer_blocks", "num_layers"),)
    words = ("tokenizer", 512)
    own_steps = 50
    read_area = 1024**2
    """Area in px of the picture that the vision model reads; the edited one keeps its size."""

    def __init__(
        self, *, text_guidance: float = 4.0, negative_prompt: str = " ", **parts: Any
    ) -> None:
        super().__init__(text_guidance=text_guidance, negative_prompt=negative_prompt, **parts)

    def raw_latents(self, pictures: Tensor) -> Tensor:
        """Encode pictures as one frame each."""
        return super().raw_latents(pictures[:, :, None])[:, :, 0]

    def pixels(self, latents: Tensor) -> Tensor:
        """Decode one frame each."""
        return super().pixels(latents)[:, :, 0]

    def scaled(self, latents: Tensor) -> Tensor:
        """Scale latents by the statistics of each channel."""
        mean, deviation = self._statistics(latents)
        return (latents - mean) / deviation

    def unscaled(self, latents: Tensor) -> Tensor:
        """Undo :meth:`scaled`, as frames."""
        latents = latents.to(self.vae.dtype)
        mean, deviation = self._statistics(latents)
        return (latents * deviation + mean)[:, :, None]

    def _statistics(self, like: Tensor) -> tuple[Tensor, ...]:
        c = self.vae.config
        return tuple(
            torch.tensor(v).view(1, -1, 1, 1).to(like) for v in (c.latents_mean, c.latents_std)
        )

    def embed(self, words: str, pictures: Sequence[Tensor]) -> dict[str, Any]:
        """Encode an instruction together with each view's pictures."""
        rows = [
            self._read(words, [one[view] for one in pictures]) for view in range(len(pictures[0]))
        ]
        # The views' pictures have one size, so their texts have one length.
        return {"encoder_hidden_states": torch.cat(rows)}

    def _read(self, words: str, pictures: Sequence[Tensor]) -> Tensor:
        from PIL import Image

        read = []
        for picture in pictures:
            _, h, w = picture.shape
            width = math.sqrt(self.read_area * w / h)
            size = [round(side / 32) * 32 for side in (width * h / w, width)]
            pixels = np.rint(255 * picture.permute(1, 2, 0).numpy()).astype(np.uint8)
            read.append(self.pipe.image_processor.resize(Image.fromarray(pixels), *size))
        with torch.no_grad():
            text: Tensor = self.pipe.encode_prompt(words, image=read, device=self.network.device)[0]
        return text

    def places(self, size: Size, pictures: int, text: Mapping[str, Any]) -> dict[str, Any]:
        """List the frames of each view's sequence."""
        frames = [(1, *size)] * (pictures + 1)
        return {
            "img_shapes": [frames] * len(text["encoder_hidden_states"]),
            "encoder_hidden_states_mask": None,
        }

    def combined(self, text: Tensor, uncond: Tensor) -> Tensor:
        """Combine the branches' velocities, each token with the length of the text's."""
        guided = super().combined(text, uncond)
        return guided * (text.norm(dim=-1, keepdim=True) / guided.norm(dim=-1, keepdim=True))


@reads("QwenImageEditPlusPipeline")
class QwenImageEditPlus(QwenImageEdit):
    """Editor of Qwen-Image-Edit-Plus (releases 2509 and later), which sees several pictures."""

    pipeline = "QwenImageEditPlusPipeline"
    references = 2
    read_area = 384**2
