"""Transformers with joint attention of text, picture and reference pictures, on a flow.

An editor of this kind states where tokens lie as data (:class:`Stack`); how its network is called
stands in its file in :mod:`attnwarp.editing.editors`. All features follow one rule: a layer's
feature map is the first D channels of the image rows of its output projection's input. Rows of the
text and of reference pictures, which show the view itself, are never recorded or replaced.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from attnwarp import check
from attnwarp.editing.editor import MOST_GUIDANCE, Coder, Guide, check_length, tensor_of
from attnwarp.editing.layers import Call, Layer, Rows
from attnwarp.editing.schedule import Flow, Size, Time

TOKEN = 2
"""Side of a packed token in latents."""

BRANCHES = ("text", "uncond")
"""Branches of guidance that runs the negative prompt in a pass of its own, after the first."""


@dataclass(frozen=True)
class Stack:
    """Stack of equal blocks of a transformer.

    Attributes:
        name: name of its list of modules.
        count: key of the configuration with the number of blocks, or with their numbers.
        projection: module of the output projection, in a block.
        rows: image rows of the projection's input.
        keys: module that returns the keys before their turning.
        values: module that returns the values.
        fused: number of the values' slice, each as wide as a feature, in a shared projection.
        after: key of the configuration with the number of blocks that are counted before.
    """

    name: str
    count: str
    projection: str = "attn.to_out.0"
    rows: Rows = "image first"
    keys: str = "attn.norm_k"
    values: str = "attn.to_v"
    fused: int = 0
    after: str | None = None


def stack_layers(
    stacks: Sequence[Stack], config: Mapping[str, Any], level: int
) -> tuple[Layer, ...]:
    """List the layers of a transformer from its configuration; no weights are needed.

    Args:
        level: halvings from latents to tokens.

    Example:
        >>> config = {"num_layers": 2, "num_attention_heads": 2, "attention_head_dim": 8}
        >>> layers = stack_layers([Stack("blocks", "num_layers")], config, 1)
        >>> [(layer.name, layer.kind) for layer in layers][:2]
        [('blocks.0.attn.to_out.0', 'joint'), ('blocks.0.attn.norm_k', 'key')]
    """
    width = config["num_attention_heads"] * config["attention_head_dim"]
    layers = []
    for stack in stacks:
        count, before = config[stack.count], config[stack.after] if stack.after else 0
        for index in range(count) if isinstance(count, int) else count:
            place, block = f"{stack.name}.{index}", before + index
            same = {"level": level, "channels": width, "block": block, "rows": stack.rows}
            layers += [
                Layer(f"{place}.{stack.projection}", "joint", at="input", **same),
                Layer(f"{place}.{stack.keys}", "key", **same),
                Layer(f"{place}.{stack.values}", "value", first=stack.fused * width, **same),
            ]
    return tuple(layers)


def pack(latents: Tensor) -> Tensor:
    """Pack (B, C, h, w) latents as (B, h w / 4, 4 C) tokens of 2 x 2 latents.

    Example:
        >>> pack(torch.arange(4.0).reshape(1, 1, 2, 2)).tolist()
        [[[0.0, 1.0, 2.0, 3.0]]]
    """
    return pixel_unshuffle(latents, TOKEN).flatten(2).transpose(1, 2)


def unpack(tokens: Tensor, size: Size) -> Tensor:
    """Unpack (B, h w / 4, 4 C) tokens to (B, C, h, w) latents."""
    rows = tokens.transpose(1, 2).unflatten(2, (size[0] // TOKEN, size[1] // TOKEN))
    return pixel_shuffle(rows, TOKEN)


def grid_ids(size: Size, picture: int, axes: int) -> Tensor:
    """Compute the (h w, axes) positions of a picture's tokens: its number, row and column, then 0.

    Example:
        >>> grid_ids((1, 2), 10, 4).tolist()
        [[10.0, 0.0, 0.0, 0.0], [10.0, 0.0, 1.0, 0.0]]
    """
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    ids = torch.zeros(*size, axes, dtype=torch.float32)
    ids[..., 0], ids[..., 1], ids[..., 2] = picture, y, x
    return ids.flatten(0, 1)


def linear_shift(config: Mapping[str, Any], tokens: int, most: float = 1.15) -> float:
    """Compute the shift mu of a flow for a number of tokens: linear between two numbers of the
    scheduler's configuration (Esser et al. 2024, section 5.3.2, as diffusers configures it).

    Example:
        >>> round(linear_shift({}, 4096), 6)
        1.15
    """
    few, many = config.get("base_image_seq_len", 256), config.get("max_image_seq_len", 4096)
    low, high = config.get("base_shift", 0.5), config.get("max_shift", most)
    return float(low + (high - low) * (tokens - few) / (many - few))


class Joint(Coder):
    """Base of editors with joint attention.

    Args:
        text_guidance: s of v = v_un + s (v_txt - v_un); 1 runs no negative prompt.
        negative_prompt: words of the branch without the instruction.
        parts: networks, tokenizers and the scheduler, by their names in diffusers.
    """

    guide: Guide = "picture"
    carries = BRANCHES
    options: tuple[str, ...] = ("text_guidance", "negative_prompt")
    own_size = 1024
    half = torch.bfloat16

    pipeline: ClassVar[str]
    """Pipeline of diffusers whose text encoding is used."""
    networks: ClassVar[Mapping[str, str]]
    """Classes of the networks, by the name of their folder."""
    optional: ClassVar[tuple[str, ...]] = ()
    """Networks that a folder may lack."""
    stacks: ClassVar[tuple[Stack, ...]]
    more_sets: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    """Published sets of blocks, of a network that has them all."""
    words: ClassVar[tuple[str, int]]
    """Name of the tokenizer that counts a text's tokens, and their limit."""

    def __init__(
        self, *, text_guidance: float = 1.0, negative_prompt: str = "", **parts: Any
    ) -> None:
        import diffusers

        self.pipe = getattr(diffusers, self.pipeline)(**parts)
        self.network, self.vae = parts["transformer"], parts["vae"]
        most = MOST_GUIDANCE
        self.text_guidance = check.number(text_guidance, -most, most, "text_guidance")
        self.negative_prompt = negative_prompt
        self.parts = {
            name: part
            for name, part in parts.items()
            if part is not None and (name in self.networks or name.startswith("tokenizer"))
        }
        for name in set(self.networks) & set(self.parts):
            self.parts[name].eval().requires_grad_(False)
        config = self.network.config
        self.factor, self.token = int(self.pipe.vae_scale_factor), self.token_of(config)
        self.side_multiple = self.factor * self.token
        self.schedule = self.flow(parts["scheduler"])
        self._layers = stack_layers(self.stacks, config, self.token - 1)
        self.block_sets = self.sets_of(self._layers)
        self._now: tuple[tuple[str, ...], Size] = ((), (0, 0))

    @classmethod
    def from_folder(
        cls,
        folder: str | Path,
        *,
        device: str = "cpu",
        dtype: torch.dtype = torch.float32,
        **settings: Any,
    ) -> Self:
        """Load an editor from a local folder in diffusers' format; nothing is downloaded.

        Raises:
            InputError: files are missing or of another kind; the message names them.
        """
        from attnwarp.editing.folder import index_of, load_pipeline, named

        with named(folder):
            parts = load_pipeline(folder, cls.networks, cls.optional, device=device, dtype=dtype)
            return cls(**parts, **cls.told(index_of(folder)), **settings)

    @classmethod
    def told(cls, index: Mapping[str, Any]) -> dict[str, Any]:
        """Read settings from a folder's model_index.json."""
        return {}

    # --- layers

    @classmethod
    def token_of(cls, config: Mapping[str, Any]) -> int:
        """Compute the side of a token in latents: 1 or 2."""
        return TOKEN

    @classmethod
    def sets_of(cls, layers: Sequence[Layer]) -> dict[str, tuple[int, ...]]:
        """Name sets of the layers' blocks: all, those of each kind of block, and published ones."""
        blocks = {layer.block for layer in layers}
        single = {layer.block for layer in layers if layer.rows == "after text"}
        sets = {"all": blocks, "double": blocks - single, "single": single}
        named = {name: tuple(sorted(numbers)) for name, numbers in sets.items() if numbers}
        return named | {k: v for k, v in cls.more_sets.items() if blocks.issuperset(v)}

    def layers(self) -> tuple[Layer, ...]:
        """Outputs, keys and values of all blocks."""
        return self._layers

    def call(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Call:
        """Describe a pass of the network; the task that runs it knows branches and size."""
        branches, size = self._now
        tokens, text = kwargs["hidden_states"], kwargs["encoder_hidden_states"]
        return Call(kwargs["timestep"], size, len(tokens), branches, text.shape[1])

    # --- pictures and latents

    def noise_shape(self, size: Size) -> tuple[int, int, int]:
        """Compute the latents' (C, h, w) for an (H, W) px view."""
        h, w = size
        return self.channels, h // self.factor, w // self.factor

    @property
    def channels(self) -> int:
        """Number of channels of the latents."""
        return int(self.network.config.in_channels) // TOKEN**2

    def latents(self, pixels: Tensor) -> Tensor:
        """Encode (B, 3, H, W) pixels as (B, C, h, w) scaled latents; pixels may leave [0, 1]."""
        return self.scaled(self.raw_latents(pixels))

    def scaled(self, latents: Tensor) -> Tensor:
        """Scale the autoencoder's (B, C, h, w) latents to those that the network denoises."""
        c = self.vae.config
        return (latents - c.shift_factor) * c.scaling_factor

    def unscaled(self, latents: Tensor) -> Tensor:
        """Convert (B, C, h, w) scaled latents to those of the autoencoder."""
        c = self.vae.config
        return latents.to(self.vae.dtype) / c.scaling_factor + c.shift_factor

    # --- what an editor's file adds

    def flow(self, scheduler: Any) -> Flow:
        """Convert the model's scheduler."""
        return Flow.of(scheduler, self.mu, self.token)

    def mu(self, scheduler: Any, tokens: int, steps: int) -> float:
        """Compute the schedule's shift for a number of tokens and of steps."""
        return linear_shift(scheduler.config, tokens)

    @abstractmethod
    def embed(self, words: str, pictures: Sequence[Tensor]) -> dict[str, Any]:
        """Encode words as arguments of the network, one row for each view.

        Args:
            pictures: (B, 3, H, W) pictures of the views in [0, 1], then each further reference.
        """

    def places(self, size: Size, pictures: int, text: Mapping[str, Any]) -> dict[str, Any]:
        """Compute the network's arguments beside tokens and text, such as the tokens' positions.

        Args:
            size: (h, w) of a picture in tokens.
            pictures: number of reference pictures, the view's own included.
            text: result of :meth:`embed`.
        """
        return {}

    @property
    def scale(self) -> float:
        """Weight of the instruction against the negative prompt; 1 runs one pass."""
        return self.text_guidance

    @property
    def branches(self) -> tuple[str, ...]:
        """Guidance branches in the order in which they run."""
        return BRANCHES if self.scale != 1 else BRANCHES[:1]

    def combined(self, text: Tensor, uncond: Tensor) -> Tensor:
        """Combine the branches' (B, N, C) velocities."""
        return uncond + self.scale * (text - uncond)

    def check_text(self, text: str) -> None:
        """Raise ValueError if a text exceeds the encoder's limit."""
        name, limit = self.words
        if name in self.parts:
            check_length(text, len(self.parts[name](text, verbose=False).input_ids), limit)

    # --- an edit

    def task(
        self,
        guides: Sequence[npt.NDArray[Any]],
        prompt: str,
        regions: Sequence[npt.NDArray[Any]] | None = None,
    ) -> JointTask:
        """Prepare an edit of pictures by one instruction; regions are ignored.

        Args:
            guides: (H, W, 3) pictures in [0, 1], or (1 + R, H, W, 3): a picture and R references.
        """
        self.check_text(prompt)
        stacks = [np.asarray(one)[None] if np.ndim(one) == 3 else np.asarray(one) for one in guides]
        counts = {len(one) for one in stacks}
        if len(counts) > 1 or max(counts, default=1) > 1 + self.references:
            raise ValueError(
                f"guides: got {' and '.join(str(n - 1) for n in sorted(counts))} references,"
                f" expected one number for all views, at most {self.references}"
            )
        pictures = [
            tensor_of([one[k] for one in stacks], "guides", self.side_multiple)
            for k in range(max(counts, default=1))
        ]
        texts = {"text": prompt, "uncond": self.negative_prompt}
        inputs = {branch: self.embed(texts[branch], pictures) for branch in self.branches}
        h, w = (side // self.side_multiple for side in pictures[0].shape[2:])
        for text in inputs.values():
            text.update(self.places((h, w), len(pictures), text))
        return JointTask(
            self,
            (len(stacks), *self.noise_shape((pictures[0].shape[2], pictures[0].shape[3]))),
            self.passes(inputs),
            self.seen(pictures),
        )

    def passes(self, inputs: dict[str, Any]) -> Sequence[Pass]:
        """Arrange the branches' arguments as passes of the network: one pass each."""
        return [((branch,), given) for branch, given in inputs.items()]

    def seen(self, pictures: Sequence[Tensor]) -> Tensor | None:
        """Encode reference pictures as (B, N, C) tokens that follow the image's."""
        return torch.cat([pack(self.latents(one)) for one in pictures], 1).to(self.network.dtype)

    def packed(self, latents: Tensor) -> Tensor:
        """Pack latents as the network takes them."""
        return pack(latents)

    def unpacked(self, tokens: Tensor, size: Size) -> Tensor:
        """Unpack the network's output to latents of a size."""
        return unpack(tokens, size)

    def clock(self, timestep: Time, like: Tensor) -> Tensor:
        """Convert a share of noise to the network's (B,) time, rounded as diffusers rounds it."""
        return (1000 * torch.tensor(timestep, dtype=torch.float32)).to(like).expand(
            len(like)
        ) / 1000


Pass = tuple[tuple[str, ...], dict[str, Any]]
"""Guidance branches of a pass of the network, and its arguments."""


@dataclass(frozen=True, eq=False)
class JointTask:
    """Embedded instruction and encoded pictures of some views.

    Attributes:
        shape: (B, C, h, w) of the latents.
        passes: passes of a step, in order.
        references: (B, N, C) tokens of reference pictures, if the network takes any.
    """

    editor: Joint
    shape: tuple[int, int, int, int]
    passes: Sequence[Pass]
    references: Tensor | None

    @property
    def branches(self) -> tuple[str, ...]:
        """Guidance branches in the order in which they run."""
        return tuple(branch for branches, _ in self.passes for branch in branches)

    def predict(self, latents: Tensor, timestep: Time) -> Tensor:
        """Compute the guided velocity of (B, C, h, w) latents at a share of noise."""
        editor, size = self.editor, (latents.shape[2], latents.shape[3])
        tokens, outputs = editor.packed(latents), dict[str, Tensor]()
        given = tokens if self.references is None else torch.cat([tokens, self.references], 1)
        for branches, inputs in self.passes:
            rows = given.repeat(len(branches), *[1] * (given.ndim - 1))
            editor._now = branches, size
            velocity = editor.network(
                hidden_states=rows,
                timestep=editor.clock(timestep, rows),
                return_dict=False,
                **inputs,
            )[0]
            parts = velocity[:, : tokens.shape[1]].chunk(len(branches))
            outputs |= zip(branches, parts, strict=True)
        guided = editor.combined(**outputs) if len(outputs) > 1 else outputs["text"]
        return editor.unpacked(guided, size)
