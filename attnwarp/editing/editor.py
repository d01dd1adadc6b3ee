"""Editors: their common interface, and the loop that denoises several views together."""

from __future__ import annotations

import textwrap
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.devices import on_cpu_unless_named
from attnwarp.editing.layers import Call, Layer, Network, paper_layers, unet_call
from attnwarp.editing.schedule import DDIM, Grid, Schedule, Size, Time, following
from attnwarp.errors import InputWarning

Image = npt.NDArray[np.float32]
Guide = Literal["picture", "depth"]

Begin = Literal["noise", "picture"]
"""State at the first step: pure noise, or the guide noised to it."""

STEPS = 20

LATENT_CHANNELS = 4
"""Channels of Stable Diffusion's latents; default if an autoencoder's configuration has none."""

MOST_GUIDANCE = 1000.0
"""Upper bound of guidance weights; practical ones are below 20."""


class Task(Protocol):
    """Edit of some views, ready to be denoised."""

    @property
    def branches(self) -> tuple[str, ...]:
        """Guidance branches in the order of the UNet's batch."""
        ...

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(B, C, h, w) of the latents of the views."""
        ...

    def predict(self, latents: Tensor, timestep: Time) -> Tensor:
        """Compute the network's guided output for (B, C, h, w) latents at a step."""
        ...


class Editor(Network, Protocol):
    """Diffusion model that edits views; one file each in :mod:`attnwarp.editing.editors`."""

    @property
    def guide(self) -> Guide:
        """Kind of guide that :meth:`task` takes: a view's picture or its depth map."""
        ...

    @property
    def schedule(self) -> Schedule:
        """Noise schedule."""
        ...

    @property
    def carries(self) -> tuple[str, ...]:
        """Guidance branches whose features methods warp by default."""
        ...

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the attributes that determine edits and that :func:`guided` can set: its
        ``text_guidance``, ``image_guidance`` and ``negative_prompt``, if present, and others.
        """
        ...

    @property
    def parts(self) -> Mapping[str, Any]:
        """Networks and tokenizers by their names in diffusers."""
        ...

    @property
    def begins(self) -> Begin:
        """State at the first step of an edit without ``start``."""
        ...

    @property
    def own_size(self) -> int:
        """Longest side in px of the pictures the model was trained for."""
        ...

    @property
    def own_steps(self) -> int:
        """Number of denoising steps that the model was made for."""
        ...

    @property
    def references(self) -> int:
        """Largest number of pictures beside the guide that a view's edit can see."""
        ...

    @property
    def block_sets(self) -> Mapping[str, Sequence[int]]:
        """Numbers of the layers' blocks, by the name of a set."""
        ...

    @property
    def side_multiple(self) -> int:
        """Number in px to whose multiples the sides of a picture are rounded."""
        ...

    def noise_shape(self, size: Size) -> tuple[int, int, int]:
        """Compute the noise's (C, h, w) for an (H, W) px view. A layer has the size (h, w), halved
        :attr:`~attnwarp.editing.layers.Layer.level` times.
        """
        ...

    def check_text(self, text: str) -> None:
        """Raise ValueError if a text exceeds the model's limit."""
        ...

    def task(
        self,
        guides: Sequence[npt.NDArray[Any]],
        prompt: str,
        regions: Sequence[npt.NDArray[Any]] | None = None,
    ) -> Task:
        """Prepare an edit of views.

        Args:
            guides: pictures or depth maps, depending on :attr:`guide`. An editor that takes
                references takes (1 + R, H, W, 3) too: a picture, then its references.
            prompt: instruction or description, depending on the editor.
            regions: (H, W) edited region of each view in [0, 1]; None for all of it. Some editors
                ignore regions.
        """
        ...

    def encode(self, pictures: Sequence[Image]) -> Tensor:
        """Encode (H, W, 3) pictures in [0, 1] as (B, C, h, w) scaled latents."""
        ...

    def decode(self, latents: Tensor) -> list[Image]:
        """Decode scaled latents to pictures."""
        ...

    def pixels(self, latents: Tensor) -> Tensor:
        """Decode scaled latents to (B, 3, H, W) without clamping: values may leave [0, 1]."""
        ...

    def latents(self, pixels: Tensor) -> Tensor:
        """Encode (B, 3, H, W) pixels as (B, C, h, w) scaled latents; pixels may leave [0, 1]."""
        ...


@dataclass(frozen=True, eq=False)
class Edit:
    """Result of an edit.

    Attributes:
        images: (H, W, 3) float32 sRGB in [0, 1], one per view.
        latents: (B, C, h, w) scaled latents.
        timesteps: executed timesteps of the editor's schedule.
    """

    images: list[Image]
    latents: Tensor
    timesteps: Sequence[Time]


def shared_noise(shape: tuple[int, int, int, int], seed: int) -> Tensor:
    """Draw (B, C, h, w) white noise, the same for all views."""
    return drawn((1, *shape[1:]), seed).expand(shape).clone()


def drawn(shape: Sequence[int], seed: int) -> Tensor:
    """Draw standard normal numbers, float32.

    The draw runs on the CPU, so that every device starts from the same bits, and in float32 even
    if the process's default dtype is float64, which would draw other numbers.
    """
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(tuple(shape), generator=generator, dtype=torch.float32)


@on_cpu_unless_named
def edit(
    editor: Editor,
    guides: Sequence[npt.NDArray[Any]],
    prompt: str,
    *,
    steps: int | None = None,
    seed: int = 0,
    start: int | None = None,
    grid: Grid = "even",
    pictures: Sequence[Image] | None = None,
    noise: Tensor | None = None,
    latents: Tensor | None = None,
    on_step: Callable[[int, int, Tensor], None] | None = None,
    regions: Sequence[npt.NDArray[Any]] | None = None,
) -> Edit:
    """Edit views together. Record or inject attention by running this inside
    :func:`attnwarp.editing.recording.record` or :func:`~attnwarp.editing.injection.inject`.

    Args:
        editor: the model.
        guides: guides of the views, all of one size, as ``editor.task`` takes them.
        prompt: instruction or description, depending on the editor.
        steps: number of denoising steps; the editor's own if omitted.
        seed: seed of the noise shared by the views.
        start: Stable Diffusion's timestep T to start from, as in publications. The views' latents
            are noised to T's share of signal, then ``steps`` steps follow
            (:meth:`attnwarp.editing.schedule.Schedule.published`). None starts as the editor
            :attr:`~Editor.begins`.
        grid: grid of the steps below ``start``; noise is added at ``start`` in both grids.
        pictures: (H, W, 3) pictures noised to ``start``; ``guides`` if omitted.
        noise: (B, C, h, w) noise that replaces the seed's.
        latents: (B, C, h, w) unchanged initial latents, such as those of an inversion; excludes
            ``start`` and ``noise``.
        on_step: callback with the step, the number of steps and the latents, after each step.
        regions: (H, W) edited region of each view in [0, 1]; a bundled editor averages its noise
            there to settle choices that the prompt leaves open. None is the full picture.

    Returns:
        The edited views.

    Raises:
        ValueError: sizes or numbers do not fit, or an argument would be ignored; the message
            names the argument.

    Example:
        >>> import numpy as np
        >>> from attnwarp.editing.small import load_editor
        >>> views = [np.full((32, 32, 3), grey, np.float32) for grey in (0.3, 0.6)]
        >>> result = edit(load_editor("small-plain"), views, "make it red", steps=2)
        >>> result.images[0].shape, result.latents.shape, len(result.timesteps)
        ((32, 32, 3), torch.Size([2, 48, 8, 8]), 2)
    """
    for name, value in (("start", start), ("noise", noise)):
        if latents is not None and value is not None:
            raise ValueError(f"latents: got latents and {name}, expected one of them")
    if pictures is not None and start is None:
        raise ValueError("pictures: got pictures without start, which alone begins from them")
    task = editor.task(guides, prompt, regions)
    device, dtype = editor.network.device, editor.network.dtype
    schedule, steps = editor.schedule, editor.own_steps if steps is None else steps
    timesteps = (
        schedule.timesteps(steps, (task.shape[2], task.shape[3]))
        if start is None
        else schedule.published(start, steps, grid)
    )
    if noise is None:
        noise = shared_noise(task.shape, seed)
    check.shape(noise, task.shape, "noise")
    noise = noise.to(device, dtype)
    if latents is not None:
        check.shape(latents, task.shape, "latents")
        x = latents.to(device, dtype)
    elif start is None and editor.begins == "noise":
        x = noise
    else:
        before = editor.encode(guides if pictures is None else pictures)
        check.shape(before, task.shape, "pictures")
        noised = timesteps[0] if start is None else schedule.published(start, 1)[0]
        x = schedule.add_noise(before, noise, noised)
    with torch.no_grad():
        for number, (now, then) in enumerate(following(timesteps)):
            x = schedule.step(task.predict(x, now), x, now, then)
            if on_step is not None:
                on_step(number, len(timesteps), x)
    return Edit(editor.decode(x), x, timesteps)


@contextmanager
def guided(editor: Any, **values: Any) -> Iterator[None]:
    """Set options of an editor while the block runs; None keeps an option's value.

    Raises:
        ValueError: the editor has no such option.
    """
    given = {name: value for name, value in values.items() if value is not None}
    for name in given:
        if name not in editor.options:
            raise ValueError(f"{name}: this editor has none; leave it out")
    before = {name: getattr(editor, name) for name in given}
    try:
        for name, value in given.items():
            setattr(editor, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(editor, name, value)


def tensor_of(images: Sequence[npt.NDArray[Any]], name: str, multiple: int) -> Tensor:
    """Check (H, W, 3) pictures and stack them as (B, 3, H, W) float32 in [0, 1].

    Args:
        images: pictures, at least one, all of one size.
        multiple: number that divides both sides.

    Raises:
        ValueError: no picture, a wrong shape, several sizes, sides that are not multiples, or
            values that are not finite or not in [0, 1].

    Example:
        >>> import numpy as np
        >>> tensor_of([np.zeros((8, 16, 3))], "pictures", 8).shape
        torch.Size([1, 3, 8, 16])
    """
    if not len(images):
        raise ValueError(f"{name}: got none, expected at least one picture")
    for image in images:
        check.shape(image, ("H", "W", 3), name)
        if image.shape != images[0].shape:
            raise ValueError(
                f"{name}: got {images[0].shape} and {image.shape}, expected one size; edit views"
                " of different sizes apart"
            )
    h, w = images[0].shape[:2]
    if h % multiple or w % multiple:
        width, height = (max(multiple, side - side % multiple) for side in (w, h))
        how = "resize or crop" if width <= w and height <= h else "resize"
        raise ValueError(
            f"{name}: got {w} x {h} px, expected sides that are multiples of {multiple}; {how} to"
            f" {width} x {height}"
        )
    stacked = np.stack([np.asarray(image, dtype=np.float32) for image in images])
    check.finite(stacked, name)
    if stacked.min() < 0 or stacked.max() > 1:
        raise ValueError(f"{name}: got values to {stacked.max():g}, expected sRGB in [0, 1]")
    return torch.from_numpy(stacked).permute(0, 3, 1, 2).contiguous()


def check_length(text: str, length: int, limit: int) -> None:
    """Raise ValueError if a text has more tokens than its encoder takes."""
    if length > limit:
        raise ValueError(
            f"prompt: {textwrap.shorten(text, 60)!r} has {length} tokens, the text encoder"
            f" takes {limit}; shorten it"
        )


def check_networks(
    network: Mapping[str, Any],
    text_encoder: Mapping[str, Any],
    channels: int,
    name: str,
    hint: str = "",
) -> None:
    """Refuse networks whose configurations do not fit each other."""
    if network.get("addition_embed_type") is not None:
        raise ValueError(
            f"{name}: is of Stable Diffusion XL's kind, which takes more than a text; expected"
            " Stable Diffusion 1 or 2"
        )
    classes = ("class_embed_type", "num_class_embeds")
    if any(network.get(key) is not None for key in classes):
        raise ValueError(
            f"{name}: takes a class or a picture's embedding beside the text, as unCLIP and"
            " upscalers do; expected Stable Diffusion 1 or 2"
        )
    takes = network.get("in_channels", channels)
    if takes != channels:
        raise ValueError(f"{name}: takes {takes} channels, expected {channels}{hint}")
    wanted, has = network.get("cross_attention_dim"), text_encoder.get("hidden_size")
    projected = network.get("encoder_hid_dim") is not None
    if isinstance(wanted, int) and has is not None and not projected and wanted != has:
        raise ValueError(
            f"{name}: takes texts of {wanted} channels, and the text encoder gives {has}; are both"
            " of one version of Stable Diffusion?"
        )


def check_scheduler(scheduler: Any) -> None:
    """Refuse a scheduler without DDIM steps, and warn of settings that these steps ignore."""
    from diffusers import DDIMScheduler

    if not isinstance(scheduler, DDIMScheduler):
        raise ValueError(
            f"scheduler: got {type(scheduler).__name__}, expected a DDIMScheduler;"
            " DDIMScheduler.from_config(scheduler.config) makes one of the same schedule"
        )
    used = [name for name in ("clip_sample", "thresholding") if scheduler.config.get(name)]
    if used:
        warnings.warn(
            f"scheduler: {' and '.join(used)} of its configuration is left out: latents are not"
            " clipped here, so pictures differ from those of diffusers' pipelines",
            InputWarning,
            stacklevel=4,
        )


class Defaults:
    """Members of :class:`Editor` that most editors leave as they are."""

    begins: Begin = "noise"
    own_steps: int = STEPS
    references: int = 0
    block_sets: Mapping[str, Sequence[int]] = MappingProxyType({})

    half: torch.dtype = torch.float16
    """Half precision that the networks stand."""

    @classmethod
    def steps_of(cls, index: Mapping[str, Any]) -> int:
        """Find :attr:`own_steps` from the model_index.json of a folder."""
        return cls.own_steps


class Coder(Defaults, ABC):
    """Base of editors whose pictures an autoencoder turns into latents, one picture at a time.

    Attributes:
        vae: the autoencoder, of diffusers.
        factor: side of a latent in px.
    """

    vae: Any
    factor: int

    @abstractmethod
    def latents(self, pixels: Tensor) -> Tensor:
        """Encode (B, 3, H, W) pixels as (B, C, h, w) scaled latents; pixels may leave [0, 1]."""

    @abstractmethod
    def unscaled(self, latents: Tensor) -> Tensor:
        """Convert (B, C, h, w) scaled latents to those of the autoencoder."""

    def raw_latents(self, pictures: Tensor) -> Tensor:
        """Encode (B, 3, H, W) in [0, 1] as (B, C, h, w): the distribution's mode, not scaled.

        Pictures are encoded one by one: Stable Diffusion's autoencoder takes 0.6 GiB for 512 px.
        """
        rows = []
        with torch.no_grad():
            for picture in pictures.split(1):
                coded = self.vae.encode((2 * picture - 1).to(self.vae.device, self.vae.dtype))
                plain = hasattr(coded, "latent_dist")
                rows.append(coded.latent_dist.mode() if plain else coded.latents)
        return torch.cat(rows)

    def encode(self, pictures: Sequence[Image]) -> Tensor:
        """Encode (H, W, 3) pictures in [0, 1] as (B, C, h, w) scaled latents."""
        return self.latents(tensor_of(pictures, "pictures", self.factor))

    def pixels(self, latents: Tensor) -> Tensor:
        """Decode scaled latents to (B, 3, H, W) without clamping: values may leave [0, 1].

        Pictures are decoded one by one, as in :meth:`raw_latents`. Gradients flow to the latents.
        """
        plain = self.unscaled(latents)
        rows = [self.vae.decode(one, return_dict=False)[0] for one in plain.split(1)]
        return torch.cat(rows).float() / 2 + 0.5

    def decode(self, latents: Tensor) -> list[Image]:
        """Decode scaled latents to (H, W, 3) float32 pictures in [0, 1].

        Raises:
            ValueError: the latents or the decoded values are not finite.
        """
        pixels = self.pixels(latents)
        # A NaN would become a black pixel.
        for name, values in (("latents", latents), ("decoded latents", pixels)):
            finite = values.isfinite()
            if not finite.all():
                raise ValueError(
                    f"{name}: {int((~finite).sum())} of {finite.numel()} values are not finite;"
                    " lower the guidance, or load the editor in float32 if it runs in half"
                    " precision"
                )
        return list(pixels.clamp(0, 1).permute(0, 2, 3, 1).cpu().numpy())


class Latent(Coder):
    """UNet with an autoencoder and a text encoder: the base of both Stable Diffusion editors."""

    def __init__(
        self, unet: Any, vae: Any, text_encoder: Any, tokenizer: Any, scheduler: Any
    ) -> None:
        self.unet, self.vae, self.text_encoder = unet, vae, text_encoder
        self.tokenizer, self.scheduler = tokenizer, scheduler
        check_scheduler(scheduler)
        self.schedule = DDIM.of(scheduler)
        self.factor = 2 ** (len(vae.config.block_out_channels) - 1)
        for part in (unet, vae, text_encoder):
            part.eval().requires_grad_(False)

    @property
    def network(self) -> Any:
        """The UNet."""
        return self.unet

    @property
    @abstractmethod
    def branches(self) -> tuple[str, ...]:
        """Guidance branches in the order of the UNet's batch."""

    def layers(self) -> tuple[Layer, ...]:
        """Layers of the paper, :func:`attnwarp.editing.layers.paper_layers`."""
        return paper_layers(self.unet)

    def call(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Call:
        """Describe the pass of a UNet call."""
        return unet_call(self.branches, args, kwargs)

    @property
    def parts(self) -> dict[str, Any]:
        """Networks and tokenizer."""
        names = ("unet", "vae", "text_encoder", "tokenizer")
        return {name: getattr(self, name) for name in names}

    @property
    def own_size(self) -> int:
        """Longest side in px of the pictures the UNet was trained for; a UNet without a
        configured size counts as 64 latents.
        """
        size = getattr(self.unet.config, "sample_size", None) or 64
        return int((max(size) if isinstance(size, list | tuple) else size) * self.factor)

    @property
    def side_multiple(self) -> int:
        """Number in px that divides the sides: two halvings of the latents are exact, as the layers
        with attention need; further halvings are padded by the UNet.
        """
        halvings = len(self.unet.config.block_out_channels) - 1
        return int(self.factor * 2 ** min(2, halvings))

    def noise_shape(self, size: Size) -> tuple[int, int, int]:
        """Compute the latents' (C, h, w) for an (H, W) px view."""
        h, w = size
        return int(self.unet.config.out_channels), h // self.factor, w // self.factor

    def latents(self, pixels: Tensor) -> Tensor:
        """Encode (B, 3, H, W) pixels as (B, C, h, w) scaled latents; pixels may leave [0, 1]."""
        return self.raw_latents(pixels) * self.vae.config.scaling_factor

    def unscaled(self, latents: Tensor) -> Tensor:
        """Convert (B, C, h, w) scaled latents to those of the autoencoder."""
        return latents.to(self.vae.dtype) / self.vae.config.scaling_factor

    @property
    def text_limit(self) -> int:
        """Token limit of the text encoder; some folders' tokenizers have no limit."""
        own = self.tokenizer.model_max_length
        return int(min(own, getattr(self.text_encoder.config, "max_position_embeddings", own)))

    def check_text(self, text: str) -> None:
        """Raise ValueError if a text exceeds the encoder's limit."""
        check_length(text, len(self.tokenizer(text, verbose=False).input_ids), self.text_limit)

    def embed(self, texts: Sequence[str]) -> Tensor:
        """Embed texts, (N, L, D); a text beyond the encoder's limit is refused."""
        limit = self.text_limit
        for text in texts:
            self.check_text(text)
        codes = self.tokenizer(
            list(texts), padding="max_length", max_length=limit, return_tensors="pt"
        ).input_ids
        with torch.no_grad():
            return self.text_encoder(codes.to(self.text_encoder.device))[0].to(self.unet.dtype)
