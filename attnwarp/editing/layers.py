"""Attention layers of a network, and hooks on their image tokens.

The feature map of a layer is the attention's output after its projection and before the residual,
(B, H W, C), for self-, cross- and joint attention alike. Forward hooks on the attention modules see
exactly what their processors return, so every processor works, and none has to be replaced.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.editing.schedule import Size

Kind = Literal["self", "cross", "joint", "key", "value"]
"""Kinds of features: outputs of self-, cross- and joint attention, and keys and values. Keys are
taken before positions turn them, so a carried key is turned at the place where it arrives."""

OUTPUTS: tuple[Kind, ...] = ("self", "cross", "joint")

Rows = Literal["image", "image first", "after text"]
"""Image rows of a layer's sequence: all rows, the first ones (rows of reference pictures or of the
text follow), or the rows after the text."""

PIX2PIX_BRANCHES = ("text", "image", "uncond")
"""Order of the guidance branches in the batch of diffusers' InstructPix2Pix pipeline."""

CONTROLNET_BRANCHES = ("uncond", "text")
"""Order of the guidance branches in the batch of diffusers' ControlNet and plain pipelines."""


@dataclass(frozen=True, eq=False)
class Call:
    """Description of one pass of a network.

    Attributes:
        timesteps: timesteps as passed to the network.
        latent_size: (h, w) of the latents.
        batch: number of rows.
        branches: guidance branches in the order of the batch. An editor that runs branches
            sequentially has one branch per pass.
        text: number of text tokens, which precede the image's in some layers.
    """

    timesteps: Any
    latent_size: Size
    batch: int
    branches: tuple[str, ...]
    text: int = 0

    @functools.cached_property
    def timestep(self) -> float:
        """Timestep of the pass. Reading it synchronises with the GPU, so avoid needless reads."""
        return float(torch.as_tensor(self.timesteps).reshape(-1)[0])


@dataclass(frozen=True)
class Layer:
    """Attention layer of a network.

    Attributes:
        name: name of the module, such as ``up_blocks.3.attentions.2.transformer_blocks.0.attn2``.
        kind: kind of the features, :data:`Kind`.
        level: number of halvings of the latents before the layer.
        channels: C of the layer's features.
        block: number of the layer's block, in the editor's count.
        at: "output" takes the features from the module's output, "input" from its input. Parallel
            blocks use the input of their projection, since their output mixes in more.
        rows: image rows of the sequence.
        first: number of the features' first channel, where a module puts others before them.

    Example:
        >>> layer = Layer("up_blocks.1.attentions.0.transformer_blocks.0.attn1", "self", 1, 64)
        >>> layer.size((64, 48))  # half the latents' size
        (32, 24)
    """

    name: str
    kind: Kind
    level: int
    channels: int
    block: int = 0
    at: Literal["output", "input"] = "output"
    rows: Rows = "image"
    first: int = 0

    def size(self, latent_size: Size) -> Size:
        """Compute the (h, w) of the layer. Each stride of 2 rounds an odd side up.

        Example:
            >>> Layer("up_blocks.0.attentions.0", "self", 2, 64).size((50, 64))
            (13, 16)
        """
        h, w = latent_size
        for _ in range(self.level):
            h, w = (h + 1) // 2, (w + 1) // 2
        return h, w

    def image_tokens(self, value: Any, call: Call) -> Tensor:
        """Extract (B, h w, C) image tokens of the module's output or input: a tuple's first tensor,
        the image rows, heads side by side, and of an input or a shared projection C channels.

        Example:
            >>> layer = Layer("attn", "joint", 0, 2, rows="after text")
            >>> call = Call(999, (1, 2), 1, ("text",), text=1)
            >>> sequence = torch.arange(8.0).reshape(1, 4, 2)  # text, image, image, another
            >>> layer.image_tokens((sequence, None), call).tolist()
            [[[2.0, 3.0], [4.0, 5.0]]]
        """
        tensor = value[0] if isinstance(value, tuple) else value
        tokens: Tensor = tensor if self.rows == "image" else tensor[:, self._span(call)]
        tokens = tokens.flatten(2)
        if self.at == "input" or self.first:
            tokens = tokens[..., self.first : self.first + self.channels]
        h, w = self.size(call.latent_size)
        check.shape(tokens, (call.batch, h * w, self.channels), self.name)
        return tokens

    def put_back(self, value: Any, tokens: Tensor, call: Call) -> Any:
        """Replace the image tokens in the module's output or input; others keep their bits."""
        tensor = value[0] if isinstance(value, tuple) else value
        if tensor.shape == tokens.shape:
            changed = tokens
        else:
            changed = tensor.clone(memory_format=torch.contiguous_format)
            channels = slice(self.first, self.first + self.channels)
            changed.view(*tensor.shape[:2], -1)[:, self._span(call), channels] = tokens
        return (changed, *value[1:]) if isinstance(value, tuple) else changed

    def _span(self, call: Call) -> slice:
        h, w = self.size(call.latent_size)
        first = call.text if self.rows == "after text" else 0
        return slice(first, first + h * w)


class Network(Protocol):
    """Network whose attention is recorded and replaced: any editor, or :class:`BareUNet`."""

    @property
    def network(self) -> Any:
        """Torch module called in each pass."""
        ...

    @property
    def branches(self) -> tuple[str, ...]:
        """Guidance branches of a step, in execution order."""
        ...

    def layers(self) -> tuple[Layer, ...]:
        """Layers whose features a method may warp."""
        ...

    def call(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Call:
        """Describe a pass of the network from the call's arguments."""
        ...


@dataclass(frozen=True)
class BareUNet:
    """UNet of diffusers, used in a custom pipeline or loop.

    Args:
        branches: guidance branches in the order of its batch, such as :data:`PIX2PIX_BRANCHES`;
            ("text",) without guidance.
    """

    network: Any
    branches: tuple[str, ...] = ("text",)

    def layers(self) -> tuple[Layer, ...]:
        """Layers of the paper, :func:`paper_layers`."""
        return paper_layers(self.network)

    def call(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Call:
        """Describe a pass of the UNet, by :func:`unet_call`."""
        return unet_call(self.branches, args, kwargs)


def unet_call(branches: tuple[str, ...], args: Sequence[Any], kwargs: Mapping[str, Any]) -> Call:
    """Describe a pass of a diffusers UNet from the call's arguments."""
    sample = args[0] if args else kwargs["sample"]
    timestep = args[1] if len(args) > 1 else kwargs["timestep"]
    return Call(timestep, (sample.shape[-2], sample.shape[-1]), sample.shape[0], branches)


def all_layers(unet: torch.nn.Module) -> tuple[Layer, ...]:
    """List all attention layers of a diffusers UNet, in the order of its processors."""
    levels = len(list(unet.get_submodule("up_blocks").children()))
    layers = []
    for processor in unet.attn_processors:  # type: ignore[union-attr]
        name = processor.removesuffix(".processor")
        place, _, rest = name.partition(".")
        index = int(rest.partition(".")[0]) if place != "mid_block" else 0
        level = {
            "down_blocks": index,
            "mid_block": levels - 1,
            "up_blocks": levels - 1 - index,
        }.get(place)
        if level is None:
            continue
        module = unet.get_submodule(name)
        kind: Kind = "cross" if name.endswith("attn2") else "self"
        channels: int = module.to_out[0].out_features  # type: ignore
        layers.append(Layer(name, kind, level, channels, index))
    return tuple(layers)


def paper_layers(unet: torch.nn.Module) -> tuple[Layer, ...]:
    """List the layers of a diffusers UNet that the paper warps: those of the up-sampling blocks at
    the latents' size and at half of it.
    """
    layers = all_layers(unet)
    return tuple(one for one in layers if one.name.startswith("up_blocks") and one.level <= 1)


def choose_layers(
    layers: Sequence[Layer],
    *,
    kinds: Sequence[Kind] | None = None,
    blocks: Sequence[int | str] | None = None,
    sets: Mapping[str, Sequence[int]] | None = None,
) -> tuple[Layer, ...]:
    """Select layers of an editor.

    Args:
        kinds: kinds of features to choose; None for all outputs of attention.
        blocks: numbers of blocks, or names of ``sets``; None for all.
        sets: numbers of blocks by the name of their set.

    Raises:
        ValueError: a kind or a set is unknown, or no layer matches.
    """
    for kind in kinds or ():
        check.one_of(kind, get_args(Kind), "kinds")
    named, numbers = sets or {}, set[int]()
    for block in blocks or ():
        if isinstance(block, str):
            check.one_of(block, list(named), "blocks")
        numbers.update(named[block] if isinstance(block, str) else [block])
    chosen = tuple(
        layer
        for layer in layers
        if layer.kind in (OUTPUTS if kinds is None else kinds)
        and (blocks is None or layer.block in numbers)
    )
    if not chosen:
        there = sorted({(layer.block, layer.kind) for layer in layers})
        listed = ", ".join(f"{kind} in block {block}" for block, kind in there) or "none"
        raise ValueError(f"kinds, blocks: got {kinds} in {blocks}; the editor offers {listed}")
    return chosen


Hook = Callable[[Layer, Tensor, Call], Tensor | None]


@contextmanager
def hooked(editor: Network, layers: Sequence[Layer], hook: Hook) -> Iterator[None]:
    """Call ``hook(layer, features, call)`` on the image tokens of the layers while the block runs.

    Args:
        hook: function whose (batch, H W, C) result replaces the features; None keeps them.
            Gradients flow through.

    Raises:
        RuntimeError: at the end of the block, if a layer's hook was never called; the message names
            the likely cause.
    """
    network, now = editor.network, list[Call]()
    called: set[str] = set()

    def begin(_: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
        now[:] = [editor.call(args, kwargs)]

    def see(layer: Layer, value: Any) -> Any:
        if not now:
            raise RuntimeError(
                f"{layer.name}: was called outside a call of the network itself; call"
                " network(...), not network.forward(...)"
            )
        called.add(layer.name)
        changed = hook(layer, layer.image_tokens(value, now[0]), now[0])
        return None if changed is None else layer.put_back(value, changed, now[0])

    def before(layer: Layer, _: Any, args: tuple[Any, ...]) -> Any:
        changed = see(layer, args[0])
        return None if changed is None else (changed, *args[1:])

    def after(layer: Layer, _: Any, __: Any, output: Any) -> Any:
        return see(layer, output)

    with ExitStack() as stack:
        stack.callback(network.register_forward_pre_hook(begin, with_kwargs=True).remove)
        for layer in layers:
            module = network.get_submodule(layer.name)
            handle = (
                module.register_forward_hook(functools.partial(after, layer))
                if layer.at == "output"
                else module.register_forward_pre_hook(functools.partial(before, layer))
            )
            stack.callback(handle.remove)
        yield
    missing = [layer.name for layer in layers if layer.name not in called]
    if missing:
        raise RuntimeError(_cause(network, missing, passes=bool(now)))


class Steps:
    """Counter of denoising steps by the passes of a network: a repeated branch begins the next
    step.
    """

    def __init__(self) -> None:
        self._last: Call | None = None
        self._ran: set[str] = set()

    def begins(self, call: Call) -> bool:
        """Return True at the first layer of a step's first pass."""
        if call is self._last:
            return False
        self._last = call
        first = not self._ran or not self._ran.isdisjoint(call.branches)
        self._ran = set(call.branches) | (set() if first else self._ran)
        return first


def check_rows(call: Call, views: int) -> None:
    """Raise ValueError unless a pass has one row per view in each of its branches."""
    if call.batch != len(call.branches) * views:
        raise ValueError(
            f"batch: got {call.batch} rows, expected {len(call.branches) * views}: {views} views in"
            f" {len(call.branches)} branches ({', '.join(call.branches)})"
        )


def _cause(network: torch.nn.Module, missing: Sequence[str], *, passes: bool) -> str:
    """Explain why hooks of layers were not called."""
    modules = [network, *map(network.get_submodule, missing)]
    compiled = any(
        hasattr(module, "_orig_mod") or getattr(module, "_compiled_call_impl", None) is not None
        for module in modules
    )
    listed = f"{missing[0]}{f' and {len(missing) - 1} more' if len(missing) > 1 else ''}"
    if compiled:
        return f"{listed}: not called, as the network is compiled; use it before torch.compile"
    if not passes:
        return (
            f"{listed}: not called, as no pass went through this network; hand over the module that"
            " the pipeline calls, not a copy or what a wrapper such as torch.compile was made of"
        )
    return (
        f"{listed}: not called in any pass; its forward was replaced, or the block that has it was"
        " skipped or compiled"
    )
