"""FLUX.2 [klein] (Black Forest Labs 2026): edits by an instruction, in four steps if distilled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from attnwarp.editing.editors import reads
from attnwarp.editing.joint import TOKEN, Joint, Stack, grid_ids
from attnwarp.editing.schedule import Size

REFERENCE_GAP = 10
"""Distance between the numbers of pictures in the positions: 0, 10, 20, ..."""


@reads("Flux2KleinPipeline")
class Flux2Klein(Joint):
    """Editor of FLUX.2 [klein].

    Args:
        text_guidance: s of v = v_un + s (v_txt - v_un); a distilled model takes none. 4 if omitted.
        is_distilled: True for a model made for four steps without guidance.
        parts: networks, tokenizer and scheduler, by their names in diffusers.
    """

    pipeline = "Flux2KleinPipeline"
    networks = {  # noqa: RUF012
        "transformer": "Flux2Transformer2DModel",
        "vae": "AutoencoderKLFlux2",
        "text_encoder": "Qwen3ForCausalLM",
    }
    stacks = (
        Stack("transformer_blocks", "num_layers"),
        Stack(
            "single_transformer_blocks", "num_single_layers", "attn.to_out", "after text",
            values="attn.to_qkv_mlp_proj", fused=2, after="num_layers",
        ),
    )  # fmt: skip
    words = ("tokenizer", 480)
    references = 3

    def __init__(
        self, *, text_guidance: float | None = None, is_distilled: bool = False, **parts: Any
    ) -> None:
        if is_distilled and text_guidance not in (None, 1):
            raise ValueError("text_guidance: this model is distilled and takes none; leave it out")
        own = 1.0 if is_distilled else 4.0
        super().__init__(text_guidance=own if text_guidance is None else text_guidance, **parts)
        self.own_steps = self.steps_of({"is_distilled": is_distilled})
        self.options = () if is_distilled else type(self).options

    @classmethod
    def told(cls, index: Mapping[str, Any]) -> dict[str, Any]:
        """Read whether a folder's model is distilled."""
        return {"is_distilled": bool(index.get("is_distilled"))}

    @classmethod
    def steps_of(cls, index: Mapping[str, Any]) -> int:
        """Find the number of steps: few of a distilled model."""
        return 4 if index.get("is_distilled") else 50

    def mu(self, scheduler: Any, tokens: int, steps: int) -> float:
        """Compute the shift fitted for FLUX.2 at 10 and at 200 steps, linear between them."""
        many = 0.00016927 * tokens + 0.45666666
        if tokens > 4300:
            return many
        few = 8.73809524e-05 * tokens + 1.89833333
        return few + (many - few) * (steps - 10) / 190

    def scaled(self, latents: Tensor) -> Tensor:
        """Scale latents by the statistics of each of a token's channels."""
        mean, deviation = self._statistics(latents)
        return pixel_shuffle((pixel_unshuffle(latents, TOKEN) - mean) / deviation, TOKEN)

    def unscaled(self, latents: Tensor) -> Tensor:
        """Undo :meth:`scaled`."""
        mean, deviation = self._statistics(latents)
        plain = pixel_shuffle(pixel_unshuffle(latents, TOKEN) * deviation + mean, TOKEN)
        return plain.to(self.vae.dtype)

    def _statistics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        norm = self.vae.bn
        variance = norm.running_var + self.vae.config.batch_norm_eps
        mean, deviation = (
            value.view(1, -1, 1, 1).to(like) for value in (norm.running_mean, variance.sqrt())
        )
        return mean, deviation

    def embed(self, words: str, pictures: Sequence[Tensor]) -> dict[str, Any]:
        """Encode an instruction in the chat's form."""
        with torch.no_grad():
            text = self.pipe.encode_prompt(words, device=self.network.device)[0]
        return {"encoder_hidden_states": text.expand(len(pictures[0]), -1, -1)}

    def places(self, size: Size, pictures: int, text: Mapping[str, Any]) -> dict[str, Any]:
        """Compute positions (picture, row, column, word) of pictures 0, 10, ... and of text."""
        count, device = text["encoder_hidden_states"].shape[1], self.network.device
        words = torch.zeros(count, 4, dtype=torch.float32)
        words[:, 3] = torch.arange(count)
        ids = [grid_ids(size, REFERENCE_GAP * number, 4) for number in range(pictures + 1)]
        return {"txt_ids": words.to(device), "img_ids": torch.cat(ids).to(device), "guidance": None}
