"""Record attention features of a diffusers UNet, warp them along a view's geometry, inject them.

The feature map of a layer is the attention's output after its projection and before the residual,
(B, H W, C), for self- and cross-attention alike. Forward hooks on the attention modules see exactly
what their processors return, so every processor works, and none has to be replaced.
"""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.warp import FeatureWarp, resize_mask
from attnwarp.warp.sampling import work_type

Kind = Literal["self", "cross"]
Block = Literal["down", "mid", "up"]
Size = tuple[int, int]

PIX2PIX_BRANCHES = ("text", "image", "uncond")
"""Order of the guidance branches in the batch of diffusers' InstructPix2Pix pipeline."""

CONTROLNET_BRANCHES = ("uncond", "text")
"""The same of its ControlNet and plain pipelines."""


class TokenWarp(Protocol):
    """The warp of one grid, such as :class:`attnwarp.warp.FeatureWarp`."""

    @property
    def weight(self) -> Tensor:
        """(H W, 1) in [0, 1]: M, 1 where the source shows what the target does."""
        ...

    def warp_tokens(self, source: Tensor) -> Tensor:
        """(1, H W, C) of the source's (1, h w, C) tokens."""
        ...

    def blend_tokens(self, source: Tensor, new: Tensor, alpha: float) -> Tensor:
        """(1, H W, C) of the source's (1, h w, C) tokens, warped, and the target's own."""
        ...


class LayerWarp(Protocol):
    """What leads from a source view to a target view, such as
    :class:`attnwarp.warp.WarpedView`."""

    def at(self, size: Size, *, source_size: Size | None = None) -> TokenWarp:
        """The warp of an (h, w) grid of the target from a grid of the source."""
        ...


Blend = Callable[[TokenWarp, Tensor, Tensor, float], Tensor]
"""(1, H W, C) of a warp, the source's (1, h w, C) tokens, the target's own and the weight a_t."""


@dataclass(frozen=True)
class Layer:
    """An attention layer of a UNet.

    Attributes:
        name: of the module, such as ``up_blocks.3.attentions.2.transformer_blocks.0.attn2``.
        kind: "self" or "cross".
        level: how often the latents are halved before it; its size is that fraction of theirs.
        channels: of its output.

    Example:
        >>> layer = Layer("up_blocks.1.attentions.0.transformer_blocks.0.attn1", "self", 1, 64)
        >>> layer.size((64, 48))  # half the latents' size
        (32, 24)
    """

    name: str
    kind: Kind
    level: int
    channels: int

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
        layers.append(Layer(name, kind, level, module.to_out[0].out_features))  # type: ignore
    return tuple(layers)


def choose_layers(
    unet: torch.nn.Module,
    *,
    fractions: Sequence[float] = (1.0, 0.5),
    kinds: Sequence[Kind] = ("self", "cross"),
    blocks: Sequence[Block] = ("up",),
) -> tuple[Layer, ...]:
    """Layers by their size as a fraction of the latents'; by default those of the paper.

    Args:
        unet: a diffusers UNet.
        fractions: of the latents' side: 1, 0.5, 0.25, ...
        kinds: of attention.
        blocks: "down", "mid" or "up".

    Raises:
        ValueError: an unknown kind or block, or a choice that no layer matches.

    An example is at :func:`record`.
    """
    for kind in kinds:
        check.one_of(kind, get_args(Kind), "kinds")
    for block in blocks:
        check.one_of(block, get_args(Block), "blocks")
    layers = all_layers(unet)
    chosen = tuple(
        layer
        for layer in layers
        if 2.0**-layer.level in tuple(fractions)
        and layer.kind in kinds
        and layer.name.partition("_")[0] in blocks
    )
    if not chosen:
        there = sorted({(layer.name.partition("_")[0], 2.0**-layer.level) for layer in layers})
        listed = ", ".join(f"{block} at {fraction:g}" for block, fraction in there) or "none"
        raise ValueError(
            f"fractions: no {' or '.join(kinds)} attention at {tuple(fractions)} in the"
            f" {' or '.join(blocks)} blocks; this UNet has {listed}"
        )
    return chosen


@dataclass(frozen=True)
class RecordingPlan:
    """What is recorded, and the memory it takes, before anything runs.

    Args:
        layers: to record, see :func:`choose_layers`.
        latent_size: (h, w) of the latents.
        branches: the guidance branches in the order of the batch, such as
            :data:`PIX2PIX_BRANCHES`; ("text",) without guidance.
        keep: those of them to record.
        steps: of denoising.
        views: pictures in a batch.
        dtype: of what is stored. Half precision halves the memory and rounds.
        store: "device" leaves features where they are made, "cpu" moves them to main memory, a
            Path of a folder writes them there. Each recording has a folder of its own in it.
        chosen: numbers of the steps to record, from 0; all of them if left out. The others are
            neither stored nor injected, so half of the steps take half of the memory.

    Raises:
        ValueError: nothing to record, or an unknown branch, step or store; the message names it.

    Example:
        >>> layer = Layer("up_blocks.1.attentions.0.transformer_blocks.0.attn1", "self", 0, 64)
        >>> plan = RecordingPlan((layer,), (32, 32), ("uncond", "text"), ("text",), steps=20)
        >>> plan.bytes == 20 * 32 * 32 * 64 * 4
        True
        >>> print(plan)
        recording 1 layer, 1 branch (text), 20 steps in float32: 5.0 MiB on the device
        >>> from dataclasses import replace
        >>> print(replace(plan, chosen=range(10)))
        recording 1 layer, 1 branch (text), 10 of 20 steps in float32: 2.5 MiB on the device
    """

    layers: tuple[Layer, ...]
    latent_size: Size
    branches: tuple[str, ...]
    keep: tuple[str, ...]
    steps: int
    views: int = 1
    dtype: torch.dtype = torch.float32
    store: Literal["device", "cpu"] | Path = "device"
    chosen: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if not self.layers:
            raise ValueError("layers: got none, expected at least one")
        for branch in self.keep:
            check.one_of(branch, self.branches, "keep")
        if not self.keep:
            raise ValueError("keep: got no branch, expected at least one")
        if not isinstance(self.store, Path) and self.store not in ("device", "cpu"):
            raise ValueError(
                f"store: got {self.store!r}, expected 'device', 'cpu' or a folder as a Path"
            )
        if min(self.steps, self.views, *self.latent_size) < 1:
            raise ValueError(
                f"steps, views, latent_size: got {self.steps}, {self.views}, {self.latent_size},"
                " expected at least 1"
            )
        if self.chosen is not None:
            for number in self.chosen:
                check.number(number, 0, self.steps - 1, "chosen", whole=True)
            if not self.chosen:
                raise ValueError("chosen: got no step, expected at least one")

    @property
    def recorded(self) -> frozenset[int]:
        """Numbers of the steps that are stored, from 0.

        Example:
            >>> layer = Layer("up_blocks.1.attentions.0.transformer_blocks.0.attn1", "self", 0, 64)
            >>> sorted(RecordingPlan((layer,), (8, 8), ("text",), ("text",), steps=3).recorded)
            [0, 1, 2]
        """
        return frozenset(range(self.steps) if self.chosen is None else self.chosen)

    @property
    def bytes(self) -> int:
        """Of all features together."""
        values = 0
        for layer in self.layers:
            h, w = layer.size(self.latent_size)
            values += h * w * layer.channels
        return values * len(self.keep) * self.views * len(self.recorded) * self.dtype.itemsize

    def __str__(self) -> str:
        return in_words([self])


def in_words(plans: Sequence[RecordingPlan]) -> str:
    """A line for the recordings of one or several sources, with the memory of all together.

    Args:
        plans: at least one; layers, branches and steps are said of the first.

    Example:
        >>> layer = Layer("up_blocks.1.attentions.0.transformer_blocks.0.attn1", "self", 0, 64)
        >>> plan = RecordingPlan((layer,), (32, 32), ("uncond", "text"), ("text",), steps=20)
        >>> print(in_words([plan, plan]))
        recording 2 sources, 1 layer, 1 branch (text), 20 steps in float32: 10.0 MiB on the device
    """

    def counted(number: int, word: str) -> str:
        plural = "branches" if word == "branch" else f"{word}s"
        return f"{number} {word if number == 1 else plural}"

    first = plans[0]
    amount = sum(plan.bytes for plan in plans) / 2**20
    size = f"{amount / 1024:.2f} GiB" if amount >= 1024 else f"{amount:.1f} MiB"
    kind = str(first.dtype).removeprefix("torch.")
    sources = f"{len(plans)} sources, " if len(plans) > 1 else ""
    places = {"device": "on the device", "cpu": "in main memory"}
    folders = [plan.store for plan in plans if isinstance(plan.store, Path)]
    some = len(first.recorded)
    some_of = "" if some == first.steps else f"{some} of "
    place = f"in {os.path.commonpath(folders)}" if folders else places[str(first.store)]
    return (
        f"recording {sources}{counted(len(first.layers), 'layer')},"
        f" {counted(len(first.keep), 'branch')} ({', '.join(first.keep)}),"
        f" {some_of}{counted(first.steps, 'step')} in {kind}: {size} {place}"
    )


@dataclass(eq=False)
class Recording:
    """Features of one run, by step, layer and branch.

    Attributes:
        plan: what was recorded.
        timesteps: of the steps so far, in their order, those without features included. A scheduler
            that evaluates a timestep twice (PNDM, Heun) has it twice.
    """

    plan: RecordingPlan
    timesteps: list[float] = field(default_factory=list)
    _features: dict[tuple[int, str], Tensor | Path] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Recording({len(self.timesteps)} steps so far of: {self.plan})"

    @functools.cached_property
    def _folder(self) -> Path:
        """A new folder, so that no other recording writes to the same files."""
        store = Path(self.plan.store)
        store.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix="recording-", dir=store))

    @property
    def bytes(self) -> int:
        """Memory or disk that the features hold, whole storages counted."""
        storages = {}
        for value in self._features.values():
            if isinstance(value, Tensor):
                storages[value.untyped_storage().data_ptr()] = value.untyped_storage().nbytes()
        files = [value for value in self._features.values() if isinstance(value, Path)]
        return sum(storages.values()) + sum(path.stat().st_size for path in files)

    def features(self, timestep: float, layer: Layer, branch: str) -> Tensor:
        """(views, H W, C) features of a step, a layer and a branch; of the first step with that
        timestep.

        Raises:
            ValueError: not recorded; the message names what is.
        """
        return self._features_of(self.step_of(timestep), layer, branch)

    def _features_of(self, number: int, layer: Layer, branch: str) -> Tensor:
        if number not in self.plan.recorded:
            listed = ", ".join(map(str, sorted(self.plan.recorded)))
            raise ValueError(
                f"timestep: {self.timesteps[number]:g} is step {number}, whose features were not"
                f" chosen; those of {listed} were"
            )
        if layer not in self.plan.layers:
            raise ValueError(f"layer: {layer.name} was not recorded")
        check.one_of(branch, self.plan.keep, "branch")
        value = self._features[(number, layer.name)]
        if isinstance(value, Path):
            from safetensors import safe_open

            with safe_open(value, "pt") as stored:
                # The other branches stay on disk.
                return self._of_branch(stored.get_slice("features"), branch)
        return self._of_branch(value, branch)

    def _of_branch(self, value: Any, branch: str) -> Tensor:
        """The rows of a branch, of a tensor or a slice of a file."""
        rows = value.shape[0] if isinstance(value, Tensor) else value.get_shape()[0]
        views = rows // len(self.plan.keep)
        row = self.plan.keep.index(branch) * views
        part: Tensor = value[row : row + views]
        return part

    def step_of(self, timestep: float, begin: int = 0) -> int:
        """The number of a timestep among those of the recorded run, from 0.

        Args:
            begin: of those with that timestep, the first from this number on, or else the first.

        Raises:
            ValueError: the run had no such timestep.
        """
        if timestep not in self.timesteps:
            listed = ", ".join(f"{t:g}" for t in self.timesteps) or "none"
            raise ValueError(
                f"timestep: got {timestep:g}, recorded are {listed}; run both with one scheduler"
                " and the same steps"
            )
        later = timestep in self.timesteps[begin:]
        return self.timesteps.index(timestep, begin if later else 0)

    def _put(self, number: int, layer: Layer, features: Tensor) -> None:
        """Store (branches x views, H W, C) features of the kept branches."""
        plan = self.plan
        key = (number, layer.name)
        # A copy of its own: a slice would keep the whole batch's memory alive.
        stored = torch.empty_like(features, dtype=plan.dtype, memory_format=torch.contiguous_format)
        stored.copy_(features.detach())
        if plan.store == "device":
            self._features[key] = stored
        elif plan.store == "cpu":
            self._features[key] = stored.cpu()
        else:
            from safetensors.torch import save_file

            path = self._folder / f"{number}-{layer.name}.safetensors"
            save_file({"features": stored.cpu()}, path)
            self._features[key] = path


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
        """Of the pass. Reading it waits for a GPU, so only hooks that need it do."""
        return float(torch.as_tensor(self.timesteps).reshape(-1)[0])


@contextmanager
def hooked(unet: torch.nn.Module, layers: Sequence[Layer], hook: Hook) -> Iterator[None]:
    """Call ``hook(layer, features, call)`` on every output of the layers while the block runs.

    Args:
        unet: a diffusers UNet.
        layers: of it, by :func:`all_layers` or :func:`choose_layers`.
        hook: its (batch, H W, C) result replaces the features; None leaves them. Gradients flow
            through.
    """
    now: list[Call] = []

    def begin(_: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
        sample = args[0] if args else kwargs["sample"]
        timestep = args[1] if len(args) > 1 else kwargs["timestep"]
        now[:] = [Call(timestep, (sample.shape[-2], sample.shape[-1]), sample.shape[0])]

    def after(layer: Layer) -> Callable[..., Tensor | None]:
        def call(_: Any, __: Any, output: Tensor) -> Tensor | None:
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


@contextmanager
def record(
    unet: torch.nn.Module, plan: RecordingPlan, *, announce: Callable[[str], None] | None = None
) -> Iterator[Recording]:
    """Record the outputs of the UNet's attention layers while the block runs.

    An output is taken after its projection and before the residual. No bit of it changes.

    Args:
        unet: a diffusers UNet; any pipeline or loop may call it.
        plan: what to record.
        announce: called with the plan in words, the memory included, before anything runs.

    Raises:
        ValueError: latents of another size, a batch of another number of rows, or more steps, than
            planned.

    Example:
        >>> import numpy as np
        >>> from attnwarp.editing.editor import edit
        >>> from attnwarp.editing.small import load_editor
        >>> editor = load_editor("small-plain")
        >>> layers = choose_layers(editor.unet, fractions=(1,), kinds=("self",))
        >>> plan = RecordingPlan(layers, (8, 8), editor.branches, ("text",), steps=1)
        >>> with record(editor.unet, plan) as recording:
        ...     source = edit(editor, [np.zeros((32, 32, 3), np.float32)], "make it red", steps=1)
        >>> recording.features(recording.timesteps[0], layers[0], "text").shape[:2]  # (views, H W)
        torch.Size([1, 64])
    """
    if announce is not None:
        announce(str(plan))
    recording = Recording(plan)
    rows, chosen = len(plan.branches) * plan.views, plan.recorded

    last: list[Call] = []

    def keep(layer: Layer, features: Tensor, call: Call) -> None:
        _check_call(plan, call, rows)
        if last != [call]:
            if len(recording.timesteps) == plan.steps:
                raise ValueError(
                    f"steps: timestep {call.timestep:g} is one more than the {plan.steps} planned;"
                    " plan a step for each pass through the UNet, len(scheduler.timesteps) of them"
                    " (some schedulers make more than they are asked for), and record one run"
                )
            recording.timesteps.append(call.timestep)
            last[:] = [call]
        number = len(recording.timesteps) - 1
        if number not in chosen:
            return
        parts = features.chunk(len(plan.branches))
        selected = torch.cat([parts[plan.branches.index(branch)] for branch in plan.keep])
        recording._put(number, layer, selected)

    with hooked(unet, plan.layers, keep):
        yield recording


def decay(a0: float = 0.9) -> Callable[[int, int], float]:
    """The paper's weight, a_t = a0 (T - t) / T with the step's number t of T.

    Args:
        a0: weight of the first step, in [0, 1].

    Raises:
        ValueError: a weight outside [0, 1].

    Example:
        >>> [round(decay()(step, 4), 3) for step in range(4)]
        [0.9, 0.675, 0.45, 0.225]
    """
    _check_share(a0, "a0")
    return lambda step, steps: a0 * (steps - step) / steps


def constant(a: float) -> Callable[[int, int], float]:
    """The same weight at every step.

    Args:
        a: in [0, 1].

    Raises:
        ValueError: a weight outside [0, 1].

    Example:
        >>> [constant(0.5)(step, 4) for step in range(4)]
        [0.5, 0.5, 0.5, 0.5]
    """
    _check_share(a, "a")
    return lambda step, steps: a


@contextmanager
def inject(
    unet: torch.nn.Module,
    recording: Recording,
    *,
    branches: Sequence[str],
    warps: Sequence[LayerWarp | None] = (None,),
    weight: Callable[[int, int], float] | None = None,
    mask: Tensor | None = None,
    layers: Sequence[Layer] | None = None,
    blend: Blend | None = None,
) -> Iterator[None]:
    """Blend recorded features into the UNet's attention while the block runs.

    F = a (M warp(F_src) + (1 - M) F_new) + (1 - a) F_new, at each layer's own size. Steps whose
    features were not chosen stay as they are.

    Args:
        unet: the UNet that the features came from, or one of its shape.
        recording: features of the source view.
        branches: the guidance branches in the order of the batch; those that were recorded get
            features. One whose share of the guidance is 0 may be missing.
        warps: of the pictures of a batch, one each: :class:`attnwarp.warp.WarpedView` or None for
            the identity.
        weight: a by (step number, number of steps); :func:`decay` if left out.
        mask: (H, W) bool of the target where features may be injected, at any size with the
            target's proportions; everywhere if left out.
        layers: to inject, all recorded ones if left out.
        blend: of tokens along a warp; the formula above if left out. Half precision comes to it as
            float32.

    Raises:
        ValueError: a timestep, layer, branch or size that does not match the recording, or a run
            that was recorded in fewer steps than planned; the message names it.

    Example:
        >>> import numpy as np
        >>> from attnwarp.editing.editor import edit
        >>> from attnwarp.editing.small import load_editor
        >>> editor = load_editor("small-plain")
        >>> plan = RecordingPlan(
        ...     choose_layers(editor.unet), (8, 8), editor.branches, editor.branches, steps=1
        ... )
        >>> picture = np.full((32, 32, 3), 0.5, np.float32)
        >>> with record(editor.unet, plan) as recording:
        ...     source = edit(editor, [picture], "make it red", steps=1)
        >>> with inject(editor.unet, recording, branches=editor.branches, weight=constant(1.0)):
        ...     again = edit(editor, [picture], "make it red", steps=1)
        >>> bool((again.images[0] == source.images[0]).all())  # its own features change no bit
        True
    """
    weight = decay() if weight is None else weight
    plan, recorded = recording.plan, recording.plan.recorded
    chosen = plan.layers if layers is None else tuple(layers)
    for layer in chosen:
        if layer not in plan.layers:
            raise ValueError(f"layers: {layer.name} was not recorded")
    if len(recording.timesteps) < plan.steps:
        raise ValueError(
            f"steps: the recorded run had {len(recording.timesteps)} of {plan.steps} planned steps,"
            " so weights would not fall as they should; plan as many as it has"
        )
    shared = [branch for branch in plan.keep if branch in branches]
    if not shared:
        raise ValueError(
            f"branches: recorded are {', '.join(plan.keep)}, the batch has {', '.join(branches)}"
        )
    if mask is not None and (mask.ndim != 2 or mask.dtype != torch.bool):
        raise ValueError(f"mask: got {mask.dtype} {tuple(mask.shape)}, expected bool (H, W)")
    step = -1
    last: list[Call] = []
    views = len(warps)
    if plan.views not in (1, views):
        raise ValueError(f"warps: got {views}, expected {plan.views}, one for each recorded view")

    def change(layer: Layer, features: Tensor, call: Call) -> Tensor:
        nonlocal step
        rows = len(branches) * views
        if call.batch != rows:
            raise ValueError(
                f"batch: got {call.batch} rows, expected {rows}: {views} views in"
                f" {len(branches)} branches ({', '.join(branches)})"
            )
        if mask is not None:
            h, w = mask.shape
            check.same_aspect((h, w), call.latent_size, "mask", "transpose a mask of (W, H)")
        if last != [call]:
            step = recording.step_of(call.timestep, step + 1)
            last[:] = [call]
        if step not in recorded:
            return features
        alpha = weight(step, plan.steps)
        _check_share(alpha, "weight")
        if alpha == 0:
            return features
        size, source_size = layer.size(call.latent_size), layer.size(plan.latent_size)
        result = features.clone()
        for branch in shared:
            source = recording._features_of(step, layer, branch).to(features.device, features.dtype)
            for view, warp in enumerate(warps):
                row = list(branches).index(branch) * views + view
                own = source[view if plan.views > 1 else 0]
                new = features[row]
                _blend_into(result[row], new, warp, own, alpha, source_size, size, blend)
                if mask is not None:
                    inside = resize_mask(mask.cpu(), size).reshape(-1, 1).to(features.device)
                    result[row] = torch.where(inside, result[row], new)
        return result

    with hooked(unet, chosen, change):
        yield


def _blend_into(
    result: Tensor,  # (H W, C), a copy of new
    new: Tensor,  # (H W, C)
    warp: LayerWarp | None,
    source: Tensor,  # (h w, C)
    alpha: float,
    source_size: Size,
    size: Size,
    blend: Blend | None,
) -> None:
    """Source tokens, warped and blended into the target's own; None is the identity."""
    if warp is None:
        if source_size != size:
            raise ValueError(
                f"size: the recording has {source_size} features, the target {size}; give a warp"
                " between views of different sizes"
            )
        work = work_type(new.dtype)  # half precision is rounded once, as by FeatureWarp
        result.copy_(alpha * source.to(work) + (1 - alpha) * new.to(work))
        return
    layer = warp.at(size, source_size=source_size)
    if blend is not None:
        work = work_type(new.dtype)
        result.copy_(blend(layer, source[None].to(work), new[None].to(work), alpha)[0])
    elif isinstance(layer, FeatureWarp) and not torch.is_grad_enabled():
        # A layer is small: most of a blend's time would go into results and their copies.
        layer.blend_tokens(source[None], result[None], alpha, in_place=True)
    else:
        result.copy_(layer.blend_tokens(source[None], new[None], alpha)[0])


def _check_call(plan: RecordingPlan, call: Call, rows: int) -> None:
    if call.latent_size != plan.latent_size:
        raise ValueError(
            f"latent_size: got latents of {call.latent_size}, planned {plan.latent_size}"
        )
    if call.batch != rows:
        raise ValueError(
            f"batch: got {call.batch} rows, planned {rows}: {plan.views} views in"
            f" {len(plan.branches)} branches ({', '.join(plan.branches)})"
        )


def _check_share(value: float, name: str) -> None:
    if not 0 <= value <= 1:
        raise ValueError(f"{name}: got {value}, expected a number in [0, 1]")
