"""InstructPix2Pix (Brooks et al. 2023): an edited picture from a picture and an instruction."""

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
    Latent,
    check_networks,
    tensor_of,
)
from attnwarp.editing.editors import reads
from attnwarp.editing.layers import PIX2PIX_BRANCHES
from attnwarp.editing.schedule import Time


def check_pix2pix(
    unet: Mapping[str, Any], text_encoder: Mapping[str, Any], vae: Mapping[str, Any]
) -> None:
    """Refuse configurations that do not form an InstructPix2Pix model.

    Raises:
        ValueError: see :func:`attnwarp.editing.editor.check_networks`; or the autoencoder is tiny:
            its latents are always scaled, while the network needs a picture's unscaled ones.
    """
    if vae.get("_class_name") == "AutoencoderTiny":
        raise ValueError(
            "vae: is an AutoencoderTiny, whose latents of a picture are not those that"
            " InstructPix2Pix was trained on; expected its own AutoencoderKL"
        )
    hint = ": noisy latents and the picture's; is it an InstructPix2Pix model?"
    channels = 2 * vae.get("latent_channels", LATENT_CHANNELS)
    check_networks(unet, text_encoder, channels, "unet", hint)


@reads("StableDiffusionInstructPix2PixPipeline")
class InstructPix2Pix(Latent):
    """Picture-guided :class:`~attnwarp.editing.editor.Editor` of diffusers models.

    Args:
        unet, vae, text_encoder, tokenizer: networks and tokenizer of diffusers and
            transformers.
        scheduler: a DDIMScheduler.
        text_guidance: s_T of e = e_un + s_T (e_txt - e_img) + s_I (e_img - e_un).
        image_guidance: s_I. With s_T = s_I = 1 guidance is off and the batch is a third.
    """

    guide: Guide = "picture"
    options = ("text_guidance", "image_guidance")
    carries = ("text", "image")

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
        self.draws = getattr(unet, "draw", None) is not None
        check_pix2pix(unet.config, text_encoder.config.to_dict(), vae.config)
        most = MOST_GUIDANCE
        self.text_guidance = check.number(text_guidance, -most, most, "text_guidance")
        self.image_guidance = check.number(image_guidance, -most, most, "image_guidance")

    @classmethod
    def from_folder(cls, folder: str | Path, **settings: Any) -> InstructPix2Pix:
        """Load an editor from a local folder in diffusers' format; nothing is downloaded.

        Args:
            folder: folder with unet, vae, text_encoder, tokenizer and scheduler.
            settings: ``device``, ``dtype``, ``text_guidance``, ``image_guidance``.

        Raises:
            InputError: files are missing or of another kind; the message names them.
        """
        from attnwarp.editing.folder import config_of, load_parts, named

        device, dtype = settings.pop("device", "cpu"), settings.pop("dtype", torch.float32)
        # Checked before loading weights, since a large model might not fit the memory.
        with named(folder):
            check_pix2pix(*(config_of(folder, name) for name in ("unet", "text_encoder", "vae")))
        return cls(**load_parts(folder, device=device, dtype=dtype), **settings)

    @property
    def branches(self) -> tuple[str, ...]:
        """Active guidance branches, in the order of the UNet's batch."""
        return tuple(branch_shares(self.text_guidance, self.image_guidance))

    def task(
        self,
        guides: Sequence[npt.NDArray[Any]],
        prompt: str,
        regions: Sequence[npt.NDArray[Any]] | None = None,
    ) -> Pix2PixTask:
        """Prepare an edit of (H, W, 3) pictures in [0, 1] by one instruction."""
        pictures = tensor_of(guides, "guides", self.factor)
        before = self.raw_latents(pictures)  # not scaled, as the model was trained
        shares = branch_shares(self.text_guidance, self.image_guidance)
        views = len(before)
        texts = self.embed([prompt, ""])
        text = {"text": texts[0], "image": texts[1], "uncond": texts[1]}
        nothing = torch.zeros_like(before)
        source = {"text": before, "image": before, "uncond": nothing}
        return Pix2PixTask(
            self,
            torch.stack([text[name] for name in shares]).repeat_interleave(views, dim=0),
            torch.cat([source[name] for name in shares]).to(self.unet.dtype),
            views,
            shares,
            _on_grid(regions, (before.shape[2], before.shape[3])) if regions else None,
        )


def _on_grid(regions: Sequence[npt.NDArray[Any]], size: tuple[int, int]) -> Tensor:
    """Compute the share of each latent's pixels covered by the regions, (B, h, w)."""
    rows = [torch.from_numpy(np.asarray(region, np.float32))[None, None] for region in regions]
    return torch.cat([torch.nn.functional.adaptive_avg_pool2d(row, size)[0] for row in rows])


def branch_shares(text_guidance: float, image_guidance: float) -> dict[str, float]:
    """Compute each guidance branch's coefficient in the output, omitting zero ones.

    The output is e_un + s_T (e_txt - e_img) + s_I (e_img - e_un) (Brooks et al. 2023, Eq. 3).

    Example:
        >>> branch_shares(7.5, 1.5)
        {'text': 7.5, 'image': -6.0, 'uncond': -0.5}
        >>> branch_shares(1.5, 1.0)  # the unconditional branch cancels, so it need not run
        {'text': 1.5, 'image': -0.5}
    """
    shares = (text_guidance, image_guidance - text_guidance, 1 - image_guidance)
    return {name: s for name, s in zip(PIX2PIX_BRANCHES, shares, strict=True) if s != 0}


@dataclass(frozen=True, eq=False)
class Pix2PixTask:
    """Embedded instruction and encoded pictures of some views.

    Attributes:
        text: (branches x B, L, D) embeddings.
        before: (branches x B, C, h, w) latents of the pictures.
        shares: coefficients of the branches in the output, in the order of the UNet's batch.
        region: (B, h, w) edited region, for :class:`attnwarp.editing.small_unet.EditUNet`.
    """

    editor: InstructPix2Pix
    text: Tensor
    before: Tensor
    views: int
    shares: dict[str, float]
    region: Tensor | None = None

    @property
    def branches(self) -> tuple[str, ...]:
        """Guidance branches in the order of the UNet's batch."""
        return tuple(self.shares)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(B, C, h, w) of the latents."""
        _, c, h, w = self.before.shape
        return self.views, c, h, w

    def predict(self, latents: Tensor, timestep: Time) -> Tensor:
        """Compute the guided output for (B, C, h, w) latents at a step."""
        editor = self.editor
        noisy = torch.cat([latents] * len(self.branches))
        step = torch.tensor(int(timestep), device=latents.device)
        if editor.draws:
            editor.unet.region = self.region
        output = editor.unet(
            torch.cat([noisy, self.before], dim=1),
            step,
            encoder_hidden_states=self.text,
            return_dict=False,
        )[0]
        parts = output.chunk(len(self.branches))
        return sum(share * part for share, part in zip(self.shares.values(), parts, strict=True))
