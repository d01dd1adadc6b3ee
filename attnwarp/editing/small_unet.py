"""Network of the bundled editors: diffusers' UNet, predicting the change of a picture.

It is a separate class so that diffusers' pipelines can load it from a folder unchanged.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from diffusers import UNet2DConditionModel

# diffusers' pipelines identify a component by the base class of this name in its module.
from diffusers.models.modeling_utils import ModelMixin  # noqa: F401
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from torch import Tensor

ANSWERS = 64
"""Number of answers that the noise can select."""


SETTLED, OPEN = 850, 920
"""Time steps (of 1000): below SETTLED the noise selects nothing, above OPEN it has full influence.

In between the noisy picture itself comes to show the answer.
"""


class EditUNet(UNet2DConditionModel):
    """Conditional UNet whose output is added to the source picture's latents.

    Half of the input channels are the noisy latents, the other half the latents of the picture
    before the edit (InstructPix2Pix). The network predicts the edited picture ("sample" in
    diffusers), most of which equals the picture before.

    If the text leaves the answer open, the noise selects it: a term computed from the text and the
    mean of the noisy latents over a region is added to the text's tokens. So the first step settles
    the answer, as low frequencies of the noise do in large models, and the answer acts through
    cross-attention.

    Attributes:
        draw: network from the mean, at unit variance for pure noise, and the text's last token to
            the term added to all tokens; None adds nothing.
        region: (V, h, w) weights in [0, 1] of the edited region over which the noise is pooled,
            for each view of a batch of V views times branches. None is the full picture, as in
            training. The sum is divided by the root of the summed squares, so that white noise
            keeps its variance for any region. An empty region counts as the full picture.
    """

    draw: torch.nn.Module | None
    region: Tensor | None = None

    # diffusers reads the configuration's names from this untyped signature.
    @functools.wraps(UNet2DConditionModel.__init__)  # type: ignore[misc]
    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        text = self.config.cross_attention_dim
        self.draw = torch.nn.Sequential(
            torch.nn.Linear(self.config.out_channels + text, ANSWERS),
            torch.nn.Softmax(dim=-1),
            torch.nn.Linear(ANSWERS, text),
        )

    def forward(
        self, sample: Tensor, timestep: Any, encoder_hidden_states: Tensor, *args: Any,
        return_dict: bool = True, **more: Any,
    ) -> Any:  # fmt: skip
        """Run the base class with the source's latents (the second half of ``sample``) added."""
        noisy, before = sample.split(self.config.out_channels, dim=1)
        if self.draw is not None:
            mean = self._pooled(noisy)
            drawn = self.draw(torch.cat([mean, encoder_hidden_states[:, -1]], dim=1))
            time = torch.as_tensor(timestep, dtype=sample.dtype, device=sample.device)
            share = ((time - SETTLED) / (OPEN - SETTLED)).clamp(0, 1)
            drawn = share.reshape(-1, 1) * drawn
            encoder_hidden_states = encoder_hidden_states + drawn[:, None]
        change = super().forward(
            sample, timestep, encoder_hidden_states, *args, return_dict=False, **more
        )[0]
        result = before + change
        return UNet2DConditionOutput(sample=result) if return_dict else (result,)

    def _pooled(self, noisy: Tensor) -> Tensor:
        """Average over the region, (B, C), scaled to unit variance for white noise."""
        if self.region is None:
            cells = noisy.shape[2] * noisy.shape[3]
            return noisy.mean(dim=(2, 3)) * cells**0.5
        weights = self.region.to(noisy)
        empty = weights.flatten(1).sum(1) == 0
        weights = torch.where(empty[:, None, None], torch.ones_like(weights), weights)
        weights = weights / weights.square().sum(dim=(1, 2), keepdim=True).sqrt()
        tiled = weights.repeat(len(noisy) // len(weights), 1, 1)
        return torch.einsum("bchw,bhw->bc", noisy, tiled)
