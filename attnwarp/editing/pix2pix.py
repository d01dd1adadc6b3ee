"""InstructPix2Pix (Brooks et al. 2023): a picture and an instruction give the edited picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.editing.attention import PIX2PIX_BRANCHES
from attnwarp.editing.editor import Guide, Latent, tensor_of


class InstructPix2Pix(Latent):
    """An :class:`~attnwarp.editing.editor.Editor` over diffusers' own models.

    Args:
        unet, vae, text_encoder, tokenizer: of diffusers and transformers.
        scheduler: a DDIMScheduler.
        text_guidance: s_T of e = e_un + s_T (e_txt - e_img) + s_I (e_img - e_un).
        image_guidance: s_I. Guidance is off, and the batch a third, where s_T is 1 and s_I is 1.
    """

    guide: Guide = "picture"

    def __init__(
        self,
        unet: Any,
        vae: Any,
        text_encoder: Any,
        tokenizer: Any,
        scheduler: Any,
        *,
        text_guidance: float = 7.5,
        image_guidance: float = 1.5,
    ) -> None:
        super().__init__(unet, vae, text_encoder, tokenizer, scheduler)
        self.text_guidance, self.image_guidance = text_guidance, image_guidance

    @classmethod
    def from_folder(cls, folder: Path, **settings: Any) -> InstructPix2Pix:
        """An editor from a local folder in diffusers' format; nothing is downloaded.

        Args:
            folder: with unet, vae, text_encoder, tokenizer and scheduler.
            settings: ``device``, ``dtype``, ``text_guidance``, ``image_guidance``.

        Raises:
            InputError: files that are missing or of another kind, by name.
        """
        from attnwarp.editing.folder import load_parts

        device, dtype = settings.pop("device", "cpu"), settings.pop("dtype", torch.float32)
        return cls(**load_parts(folder, device=device, dtype=dtype), **settings)

    def task(self, guides: Sequence[npt.NDArray[Any]], prompt: str) -> Pix2PixTask:
        """An edit of (H, W, 3) pictures in [0, 1] by one instruction."""
        pictures = tensor_of(guides, "guides", self.factor)
        before = self.raw_latents(pictures)  # not scaled, as the model was trained
        channels = before.shape[1] + self.vae.config.latent_channels
        if self.unet.config.in_channels != channels:
            raise ValueError(
                f"unet: takes {self.unet.config.in_channels} channels, expected {channels}: noisy"
                " latents and the picture's; is it an InstructPix2Pix model?"
            )
        guided = self.text_guidance != 1 or self.image_guidance != 1
        texts = self.embed([prompt, ""] if guided else [prompt])
        views = len(before)
        if guided:
            text = texts[[0, 1, 1]].repeat_interleave(views, dim=0)
            source = torch.cat([before, before, torch.zeros_like(before)])
        else:
            text, source = texts.expand(views, -1, -1), before
        return Pix2PixTask(self, text, source.to(self.unet.dtype), views, guided)


@dataclass(frozen=True, eq=False)
class Pix2PixTask:
    """Embedded instruction and encoded pictures of some views.

    Attributes:
        editor: whose networks run.
        text: (branches x B, L, D).
        before: (branches x B, C, h, w).
        views: B.
        guided: whether there are three branches or one.
    """

    editor: InstructPix2Pix
    text: Tensor
    before: Tensor
    views: int
    guided: bool

    @property
    def branches(self) -> tuple[str, ...]:
        """The guidance branches in the order of the UNet's batch."""
        return PIX2PIX_BRANCHES if self.guided else ("text",)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(B, C, h, w) of the latents."""
        _, c, h, w = self.before.shape
        return self.views, c, h, w

    def predict(self, latents: Tensor, timestep: int) -> Tensor:
        """The guided output for (B, C, h, w) latents at a step."""
        editor = self.editor
        noisy = torch.cat([latents] * len(self.branches))
        step = torch.tensor(timestep, device=latents.device)
        output = editor.unet(
            torch.cat([noisy, self.before], dim=1),
            step,
            encoder_hidden_states=self.text,
            return_dict=False,
        )[0]
        if not self.guided:
            return output
        text, image, uncond = output.chunk(3)
        by_text, by_image = editor.text_guidance, editor.image_guidance
        return uncond + by_text * (text - image) + by_image * (image - uncond)
