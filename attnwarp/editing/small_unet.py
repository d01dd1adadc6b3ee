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
from torch.nn import functional

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


HUES = 8
"""Number of answers that :class:`PartsUNet` has for a part."""

NEAR = 0.6
"""Distance in the latents' means within which a part has the colour of an answer."""

KIN = 32
"""Number of channels that tell which cells belong to one part."""


class PartsUNet(EditUNet):
    """Editing UNet whose noise selects an answer for each part of a picture.

    The noise is averaged over the cells that look as if they belonged to the same part. What the
    mean selects is added to the text at that place alone: adding a vector to all text tokens adds
    its projection to the output of a cross-attention, so a place's own vector is added there.

    Attributes:
        kin: network from the picture before and each cell's place to features that are near each
            other in cells of one part.
        pick: network from the mean noise, the nearness to each answer and the text's last token
            to the vector of the answer.
        hues: (8, 3) means of the answers' colours in the latents; an answer that a part has
            already is not selected.
    """

    drawn: Tensor | None = None
    hues: Tensor

    # diffusers reads the configuration's names from this untyped signature.
    @functools.wraps(EditUNet.__init__)  # type: ignore[misc]
    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.draw = None
        latents, text = self.config.out_channels, self.config.cross_attention_dim
        self.kin = torch.nn.Sequential(
            torch.nn.Conv2d(latents + 2, 64, 3, padding=1), torch.nn.SiLU(),
            torch.nn.Conv2d(64, 64, 3, padding=1), torch.nn.SiLU(), torch.nn.Conv2d(64, KIN, 1),
        )  # fmt: skip
        self.pick = torch.nn.Sequential(
            torch.nn.Linear(latents + HUES + text, ANSWERS),
            torch.nn.Softmax(dim=-1),
            torch.nn.Linear(ANSWERS, text),
        )
        self.register_buffer("hues", torch.zeros(HUES, 3, dtype=torch.float32))
        for name, module in self.named_modules():
            if name.endswith("attn2"):
                module.register_forward_hook(self._add)

    def alike(self, before: Tensor) -> Tensor:
        """(B, N, N) logarithms of the weights by which a cell averages over all cells."""
        side = 16  # cells of a picture of 64 px, by which places are told
        y, x = (
            torch.arange(n, device=before.device, dtype=before.dtype) / side - 0.5
            for n in before.shape[2:]
        )
        place = torch.stack(torch.meshgrid(y, x, indexing="ij")).expand(len(before), -1, -1, -1)
        features = self.kin(torch.cat([before, place], dim=1)).flatten(2)
        # Softmax of minus the squared distance; what depends on the first cell alone drops out.
        products = features.transpose(1, 2) @ features
        return torch.log_softmax(2 * products - features.square().sum(dim=1)[:, None], dim=2)

    def evidence(self, noise: Tensor, before: Tensor) -> Tensor:
        """(B, N, 56) noise averaged over each cell's part, at unit variance, and how near the part
        is to each answer.
        """
        weights = self.alike(before).exp()
        scale = weights.square().sum(dim=2, keepdim=True).sqrt()
        mean = weights @ noise.flatten(2).transpose(1, 2) / scale
        hue = weights @ before[:, :3].flatten(2).transpose(1, 2)
        near = (-(hue[:, :, None] - self.hues).square().sum(dim=3) / (2 * NEAR**2)).exp()
        return torch.cat([mean, near], dim=2)

    def forward(
        self, sample: Tensor, timestep: Any, encoder_hidden_states: Tensor, *args: Any, **more: Any
    ) -> Any:
        """Run the base class with what the noise selects at each place."""
        noisy, before = sample.split(self.config.out_channels, dim=1)
        time = torch.as_tensor(timestep, dtype=sample.dtype, device=sample.device)
        share = ((time - SETTLED) / (OPEN - SETTLED)).clamp(0, 1).reshape(-1, 1, 1)
        if share.any():
            evidence = self.evidence(noisy, before)
            text = encoder_hidden_states[:, -1:].expand(-1, evidence.shape[1], -1)
            drawn = share * self.pick(torch.cat([evidence, text], dim=2))
            self.drawn = drawn.transpose(1, 2).unflatten(2, noisy.shape[2:])
        try:
            return super().forward(sample, timestep, encoder_hidden_states, *args, **more)
        finally:
            self.drawn = None

    def _add(self, attention: Any, _: Any, output: Tensor) -> Tensor | None:
        if self.drawn is None:
            return None
        stride = round((self.drawn.shape[2] * self.drawn.shape[3] / output.shape[1]) ** 0.5)
        drawn = functional.avg_pool2d(self.drawn, stride, ceil_mode=True).flatten(2).transpose(1, 2)
        return output + functional.linear(attention.to_v(drawn), attention.to_out[0].weight)
