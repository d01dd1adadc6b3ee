"""FLUX.1 Kontext [dev] (Black Forest Labs 2025): edits by an instruction, guided in one pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.editing.editor import MOST_GUIDANCE
from attnwarp.editing.editors import reads
from attnwarp.editing.joint import Joint, Stack, grid_ids
from attnwarp.editing.schedule import Size


@reads("FluxKontextPipeline")
class FluxKontext(Joint):
    """Editor of FLUX.1 Kontext [dev].

    Args:
        text_guidance: guidance that the network takes as a number.
        true_guidance: s of v = v_un + s (v_txt - v_un), in a second pass; 1 runs one pass.
        parts: networks, tokenizers and scheduler, by their names in diffusers.
    """

    pipeline = "FluxKontextPipeline"
    networks = {  # noqa: RUF012
        "transformer": "FluxTransformer2DModel",
        "vae": "AutoencoderKL",
        "text_encoder": "CLIPTextModel",
        "text_encoder_2": "T5EncoderModel",
    }
    stacks = (
        Stack("transformer_blocks", "num_layers"),
        Stack(
            "single_transformer_blocks", "num_single_layers", "proj_out", "after text",
            after="num_layers",
        ),
    )  # fmt: skip
    more_sets = {  # noqa: RUF012
        # Blocks where an edit keeps what it should (Avrahami et al. 2025, Stable Flow).
        "stable-flow": (0, 1, 17, 18, 25, 28, 53, 54, 56),
        # Blocks whose attention follows positions (Wei et al. 2025, FreeFlux).
        "freeflux": (0, 7, 8, 9, 10, 18, 25, 28, 37, 42, 45, 50, 56),
    }
    words = ("tokenizer_2", 512)
    own_steps = 28
    options = ("text_guidance", "true_guidance", "negative_prompt")

    def __init__(
        self, *, text_guidance: float = 3.5, true_guidance: float = 1.0, **parts: Any
    ) -> None:
        super().__init__(text_guidance=text_guidance, **parts)
        most = MOST_GUIDANCE
        self.true_guidance = check.number(true_guidance, -most, most, "true_guidance")

    @property
    def scale(self) -> float:
        """Weight of the instruction against the negative prompt."""
        return self.true_guidance

    def embed(self, words: str, pictures: Sequence[Tensor]) -> dict[str, Any]:
        """Encode an instruction by both text encoders."""
        with torch.no_grad():
            text, pooled, _ = self.pipe.encode_prompt(words, device=self.network.device)
        views = len(pictures[0])
        return {
            "encoder_hidden_states": text.expand(views, -1, -1),
            "pooled_projections": pooled.expand(views, -1),
        }

    def places(self, size: Size, pictures: int, text: Mapping[str, Any]) -> dict[str, Any]:
        """Compute positions (picture, row, column), 0 for text, and the guidance's number."""
        views, count = text["encoder_hidden_states"].shape[:2]
        device = self.network.device
        ids = torch.cat([grid_ids(size, number, 3) for number in range(pictures + 1)])
        guidance = torch.full((views,), self.text_guidance, dtype=torch.float32, device=device)
        return {
            "txt_ids": torch.zeros(count, 3, dtype=torch.float32, device=device),
            "img_ids": ids.to(device),
            "guidance": guidance if self.network.config.guidance_embeds else None,
        }
