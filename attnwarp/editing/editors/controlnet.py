"""Depth ControlNet (Zhang et al. 2023): a picture from a depth map and a prompt."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.editing.editor import (
    LATENT_CHANNELS,
    MOST_GUIDANCE,
    Guide,
    Image,
    Latent,
    check_networks,
    tensor_of,
)
from attnwarp.editing.editors import reads
from attnwarp.editing.layers import CONTROLNET_BRANCHES
from attnwarp.editing.schedule import Time


def control_image(depth: npt.NDArray[Any]) -> Image:
    """Convert a depth map to an (H, W, 3) float32 control picture: 1 / (d + 1e-5) over its maximum.

    Args:
        depth: (H, W) depth along the optical axis; NaN gives 0, the value of infinite depth. A view
            without surface has a black picture.

    Example:
        >>> control_image(np.array([[1.0, 2.0, np.nan]]))[0, :, 0].round(3).tolist()
        [1.0, 0.5, 0.0]
    """
    check.shape(depth, ("H", "W"), "depth")
    defined = np.isfinite(depth)
    if not defined.any():
        return np.zeros((*depth.shape, 3), np.float32)
    if depth[defined].min() <= 0:
        raise ValueError(f"depth: got {depth[defined].min():g}, expected positive numbers")
    near = np.where(defined, 1 / (np.where(defined, depth, 1) + 1e-5), 0)
    return np.repeat((near / near.max())[..., None], 3, axis=2).astype(np.float32)


def check_base(
    unet: Mapping[str, Any], text_encoder: Mapping[str, Any], vae: Mapping[str, Any]
) -> None:
    """Refuse configurations that do not form a plain Stable Diffusion model."""
    hint = (
        "; a ControlNet goes with a plain model, which takes no picture, mask or depth map besides"
    )
    channels = vae.get("latent_channels", LATENT_CHANNELS)
    check_networks(unet, text_encoder, channels, "unet", hint)


def check_controlnet(
    controlnet: Mapping[str, Any], text_encoder: Mapping[str, Any], vae: Mapping[str, Any]
) -> None:
    """Refuse a ControlNet's configuration that does not fit the base model's."""
    channels = vae.get("latent_channels", LATENT_CHANNELS)
    check_networks(controlnet, text_encoder, channels, "controlnet")


@reads("StableDiffusionControlNetPipeline")
class DepthControlNet(Latent):
    """Depth-guided :class:`~attnwarp.editing.editor.Editor` of diffusers models.

    Args:
        unet, vae, text_encoder, tokenizer: networks and tokenizer of diffusers and
            transformers.
        scheduler: a DDIMScheduler.
        controlnet: ControlNet of diffusers, for depth.
        text_guidance: s of e = e_un + s (e_txt - e_un); 1 turns guidance off and halves the batch.
        control_scale: factor of the ControlNet's residuals.
        negative_prompt: negative prompt of the unconditional branch.
    """

    guide: Guide = "depth"
    options = ("text_guidance", "control_scale", "negative_prompt")
    carries = CONTROLNET_BRANCHES

    def __init__(
        self,
        unet: Any,
        vae: Any,
        text_encoder: Any,
        tokenizer: Any,
        scheduler: Any,
        controlnet: Any,
        *,
        text_guidance: float = 5.0,
        control_scale: float = 1.0,
        negative_prompt: str = "",
    ) -> None:
        super().__init__(unet, vae, text_encoder, tokenizer, scheduler)
        words = text_encoder.config.to_dict()
        check_base(unet.config, words, vae.config)
        check_controlnet(controlnet.config, words, vae.config)
        most = MOST_GUIDANCE
        self.text_guidance = check.number(text_guidance, -most, most, "text_guidance")
        self.controlnet = controlnet.eval().requires_grad_(False)
        self.control_scale = control_scale
        self.negative_prompt = negative_prompt

    @classmethod
    def from_folder(
        cls, folder: str | Path, controlnet: str | Path | None = None, **settings: Any
    ) -> DepthControlNet:
        """Load an editor from local folders in diffusers' format; nothing is downloaded.

        Args:
            folder: folder with unet, vae, text_encoder, tokenizer and scheduler.
            controlnet: folder of the ControlNet, ``folder``/controlnet if omitted.
            settings: ``device``, ``dtype`` and the settings of this class.

        Raises:
            InputError: files are missing or of another kind; the message names them.
        """
        from attnwarp.editing.folder import config_of, load_controlnet, load_parts, named

        device, dtype = settings.pop("device", "cpu"), settings.pop("dtype", torch.float32)
        place = Path(folder) / "controlnet" if controlnet is None else Path(controlnet)
        # Checked before loading weights, since a large model might not fit the memory.
        words, vae = config_of(folder, "text_encoder"), config_of(folder, "vae")
        with named(folder):
            check_base(config_of(folder, "unet"), words, vae)
        with named(place):
            check_controlnet(config_of(place.parent, place.name), words, vae)
        parts = load_parts(folder, device=device, dtype=dtype)
        control = load_controlnet(place, device=device, dtype=dtype)
        return cls(**parts, controlnet=control, **settings)

    @property
    def branches(self) -> tuple[str, ...]:
        """Guidance branches in the order of the UNet's batch."""
        return CONTROLNET_BRANCHES if self.text_guidance != 1 else ("text",)

    @property
    def parts(self) -> dict[str, Any]:
        """Networks and tokenizer."""
        return {**super().parts, "controlnet": self.controlnet}

    def task(
        self,
        guides: Sequence[npt.NDArray[Any]],
        prompt: str,
        regions: Sequence[npt.NDArray[Any]] | None = None,
    ) -> ControlTask:
        """Prepare one picture per (H, W) depth map, from one prompt; regions are ignored."""
        control = tensor_of([control_image(depth) for depth in guides], "guides", self.factor)
        control = control.to(self.unet.device, self.controlnet.dtype)
        views = len(control)
        prompts = {"uncond": self.negative_prompt, "text": prompt}
        texts = self.embed([prompts[name] for name in self.branches])
        return ControlTask(
            self,
            texts.repeat_interleave(views, dim=0),
            torch.cat([control] * len(texts)),
            (views, *self.noise_shape((control.shape[2], control.shape[3]))),
        )


@dataclass(frozen=True, eq=False)
class ControlTask:
    """Embedded prompt and control pictures of some views.

    Attributes:
        text: (branches x B, L, D) embeddings.
        control: (branches x B, 3, H, W) control pictures.
        shape: (B, C, h, w) of the latents.
    """

    editor: DepthControlNet
    text: Tensor
    control: Tensor
    shape: tuple[int, int, int, int]

    @property
    def branches(self) -> tuple[str, ...]:
        """Guidance branches in the order of the UNet's batch."""
        return self.editor.branches

    def predict(self, latents: Tensor, timestep: Time) -> Tensor:
        """Compute the guided output for (B, C, h, w) latents at a step."""
        editor = self.editor
        noisy = torch.cat([latents] * len(self.branches))
        step = torch.tensor(int(timestep), device=latents.device)
        down, middle = editor.controlnet(
            noisy,
            step,
            encoder_hidden_states=self.text,
            controlnet_cond=self.control,
            conditioning_scale=editor.control_scale,
            return_dict=False,
        )
        output = editor.unet(
            noisy,
            step,
            encoder_hidden_states=self.text,
            down_block_additional_residuals=down,
            mid_block_additional_residual=middle,
            return_dict=False,
        )[0]
        if len(self.branches) == 1:
            return output
        uncond, text = output.chunk(2)
        return uncond + editor.text_guidance * (text - uncond)
