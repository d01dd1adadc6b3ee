"""The network of the bundled editors: diffusers' own UNet, which predicts the change of a picture.

It is a class of its own so that diffusers' pipelines load it from a folder as it is.
"""

from __future__ import annotations

from typing import Any

from diffusers import UNet2DConditionModel

# diffusers' pipelines know a component's kind by the base class of that name in its module.
from diffusers.models.modeling_utils import ModelMixin  # noqa: F401
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from torch import Tensor


class EditUNet(UNet2DConditionModel):
    """A conditional UNet whose output is added to the source picture's latents.

    Half of the input channels are the noisy latents, the other half the latents of the picture
    before the edit (InstructPix2Pix). Its prediction is the edited picture ("sample" in diffusers),
    and most of that is the picture before.
    """

    def forward(self, sample: Tensor, *args: Any, return_dict: bool = True, **more: Any) -> Any:
        """As the base class, with the source's latents (the second half of ``sample``) added."""
        before = sample[:, sample.shape[1] - self.config.out_channels :]
        change = super().forward(sample, *args, return_dict=False, **more)[0]
        result = before + change
        return UNet2DConditionOutput(sample=result) if return_dict else (result,)
