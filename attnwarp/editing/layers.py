"""Attention layers of a diffusers UNet, and hooks on their outputs.

The feature map of a layer is the attention's output after its projection and before the residual,
(B, H W, C), for self- and cross-attention alike. Forward hooks on the attention modules see exactly
what their processors return, so every processor works, and none has to be replaced.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from attnwarp import check

Kind = Literal["self", "cross"]
Size = tuple[int, int]

PIX2PIX_BRANCHES = ("text", "image", "uncond")
"""Order of the guidance branches in the batch of diffusers' InstructPix2Pix pipeline."""

CONTROLNET_BRANCHES = ("uncond", "text")
"""Order of the guidance branches in the batch of diffusers' ControlNet and plain pipelines."""


@dataclass(frozen=True)
class Layer:
    """An attention layer of a UNet.

    Attributes:
        name: name of the module, such as ``up_blocks.3.attentions.2.transformer_blocks.0.attn2``.
        kind: "self" or "cross".
        level: how often the latents are halved before it; its size is that fraction of theirs.
        channels: channels of its output.
        block: number of its block, as the editor counts them.

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

    def size(self, latent_size: Size) -> Size:
        """(h, w) of the layer. Each stride of 2 rounds an odd side up.

        Example:
            >>> Layer("up_blocks.0.attentions.0", "self", 2, 64).size((50, 64))
            (13, 16)
        """
        h, w = latent_size
        for _ in range(self.level):
            h, w = (h + 1) // 2, (w + 1) // 2
        return h, w


def all_layers(unet: torch.nn.Module) -> tuple[Layer, ...]:
    """Every attention layer of a diffusers UNet, in the order of its processors.

    Args:
        unet: with ``attn_processors`` and ``up_blocks``.
    """
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


def choose_layers(
    unet: torch.nn.Module,
    *,
    kinds: Sequence[Kind] | None = None,
    blocks: Sequence[int] | None = None,
) -> tuple[Layer, ...]:
    """Layers of the paper: those of the up-sampling blocks at the latents' size and at half of it.

    Args:
        unet: a diffusers UNet.
        kinds: kinds of attention to choose; None for all.
        blocks: numbers of up-sampling blocks; None for all.

    Raises:
        ValueError: an unknown kind, or a choice that no layer matches.

    An example is at :func:`record`.
    """
    for kind in kinds or ():
        check.one_of(kind, get_args(Kind), "kinds")
    up = [one for one in all_layers(unet) if one.name.startswith("up_blocks") and one.level <= 1]
    chosen = tuple(
        layer
        for layer in up
        if (kinds is None or layer.kind in kinds) and (blocks is None or layer.block in blocks)
    )
    if not chosen:
        there = sorted({(one.block, one.kind) for one in up})
        listed = ", ".join(f"{kind} in block {block}" for block, kind in there) or "none"
        raise ValueError(f"kinds, blocks: got {kinds} in {blocks}; the editor offers {listed}")
    return chosen


Hook = Callable[[Layer, Tensor, "Call"], Tensor | None]


@dataclass(frozen=True, eq=False)
class Call:
    """One pass of the UNet.

    Attributes:
        timesteps: as the UNet got them.
        latent_size: (h, w).
        batch: rows.
    """

    timesteps: Any
    latent_size: Size
    batch: int

    @functools.cached_property
    def timestep(self) -> float:
        """Timestep of the pass. Reading it waits for a GPU, so only hooks that need it do."""
        return float(torch.as_tensor(self.timesteps).reshape(-1)[0])


@contextmanager
def hooked(unet: torch.nn.Module, layers: Sequence[Layer], hook: Hook) -> Iterator[None]:
    """Call ``hook(layer, features, call)`` on every output of the layers while the block runs.

    Args:
        unet: a diffusers UNet.
        layers: layers of it, by :func:`all_layers` or :func:`choose_layers`.
        hook: its (batch, H W, C) result replaces the features; None leaves them. Gradients flow
            through.

    Raises:
        RuntimeError: at the end, if something kept a layer's hook from being called; the message
            names the likely cause.
    """
    now: list[Call] = []
    called: set[str] = set()

    def begin(_: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
        sample = args[0] if args else kwargs["sample"]
        timestep = args[1] if len(args) > 1 else kwargs["timestep"]
        now[:] = [Call(timestep, (sample.shape[-2], sample.shape[-1]), sample.shape[0])]

    def after(layer: Layer) -> Callable[..., Tensor | None]:
        def call(_: Any, __: Any, output: Tensor) -> Tensor | None:
            if not now:
                raise RuntimeError(
                    f"{layer.name}: was called outside a call of the UNet itself; call unet(...),"
                    " not unet.forward(...)"
                )
            called.add(layer.name)
            h, w = layer.size(now[0].latent_size)
            check.shape(output, (now[0].batch, h * w, layer.channels), layer.name)
            return hook(layer, output, now[0])

        return call

    with ExitStack() as stack:
        stack.callback(unet.register_forward_pre_hook(begin, with_kwargs=True).remove)
        for layer in layers:
            module = unet.get_submodule(layer.name)
            stack.callback(module.register_forward_hook(after(layer)).remove)
        yield
    missing = [layer.name for layer in layers if layer.name not in called]
    if missing:
        raise RuntimeError(_cause(unet, missing, passes=bool(now)))


def _cause(unet: torch.nn.Module, missing: Sequence[str], *, passes: bool) -> str:
    """Reason why hooks of layers were not called."""
    modules = [unet, *map(unet.get_submodule, missing)]
    compiled = any(
        hasattr(module, "_orig_mod") or getattr(module, "_compiled_call_impl", None) is not None
        for module in modules
    )
    listed = f"{missing[0]}{f' and {len(missing) - 1} more' if len(missing) > 1 else ''}"
    if compiled:
        return f"{listed}: not called, as the UNet is compiled; use it before torch.compile"
    if not passes:
        return (
            f"{listed}: not called, as no pass went through this UNet; hand over the module that"
            " the pipeline calls, not a copy or what a wrapper such as torch.compile was made of"
        )
    return (
        f"{listed}: not called in any pass; its forward was replaced, or the block that has it was"
        " skipped or compiled"
    )
