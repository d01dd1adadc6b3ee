"""Recorded attention features: the plan, its memory, and the recording."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.editing.layers import Call, Layer, Network, Steps, check_rows, hooked
from attnwarp.editing.schedule import Size


@dataclass(frozen=True)
class RecordingPlan:
    """Plan of a recording: the features to keep and their memory, computed in advance.

    Args:
        layers: layers to record, :func:`choose_layers`.
        latent_size: (h, w) of the latents.
        keep: guidance branches to record, such as ("text", "image"); ("text",) without guidance.
        steps: number of steps of denoising.
        views: pictures in a batch.
        dtype: dtype of the stored features. Half precision halves the memory and rounds.
        store: "device" keeps features on their device, "cpu" moves them to main memory, a Path of a
            folder writes them there, each recording into a separate subfolder.
        chosen: numbers of the steps to record, from 0; all steps if omitted. Other steps are
            neither stored nor injected, so half of the steps take half of the memory.

    Raises:
        ValueError: nothing to record, or a branch, step or store is unknown; the message names it.

    Example:
        >>> layer = Layer("up_blocks.1.attentions.0.transformer_blocks.0.attn1", "self", 0, 64)
        >>> plan = RecordingPlan((layer,), (32, 32), ("text",), steps=20)
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
    keep: tuple[str, ...]
    steps: int
    views: int = 1
    dtype: torch.dtype = torch.float32
    store: Literal["device", "cpu"] | Path = "device"
    chosen: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if not self.layers:
            raise ValueError("layers: got none, expected at least one")
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
        """Numbers of the stored steps, from 0.

        Example:
            >>> layer = Layer("up_blocks.1.attentions.0.transformer_blocks.0.attn1", "self", 0, 64)
            >>> sorted(RecordingPlan((layer,), (8, 8), ("text",), steps=3).recorded)
            [0, 1, 2]
        """
        return frozenset(range(self.steps) if self.chosen is None else self.chosen)

    @property
    def bytes(self) -> int:
        """Total bytes of all features."""
        values = 0
        for layer in self.layers:
            h, w = layer.size(self.latent_size)
            values += h * w * layer.channels
        return values * len(self.keep) * self.views * len(self.recorded) * self.dtype.itemsize

    def __str__(self) -> str:
        def counted(number: int, word: str) -> str:
            plural = "branches" if word == "branch" else f"{word}s"
            return f"{number} {word if number == 1 else plural}"

        amount = self.bytes / 2**20
        size = f"{amount / 1024:.2f} GiB" if amount >= 1024 else f"{amount:.1f} MiB"
        kind = str(self.dtype).removeprefix("torch.")
        places = {"device": "on the device", "cpu": "in main memory"}
        some = len(self.recorded)
        some_of = "" if some == self.steps else f"{some} of "
        place = f"in {self.store}" if isinstance(self.store, Path) else places[self.store]
        return (
            f"recording {counted(len(self.layers), 'layer')},"
            f" {counted(len(self.keep), 'branch')} ({', '.join(self.keep)}),"
            f" {some_of}{counted(self.steps, 'step')} in {kind}: {size} {place}"
        )


@dataclass(eq=False)
class Recording:
    """Features of one run, by step, layer and branch.

    Attributes:
        plan: plan of the recording.
        timesteps: timesteps of the steps so far, in order, including steps without features. A
            scheduler that evaluates a timestep twice (PNDM, Heun) lists it twice.
    """

    plan: RecordingPlan
    timesteps: list[float] = field(default_factory=list)
    _features: dict[tuple[int, str, str], Tensor | Path] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Recording({len(self.timesteps)} steps so far of: {self.plan})"

    @functools.cached_property
    def _folder(self) -> Path:
        """Create a new folder, so that no other recording writes to the same files."""
        store = Path(self.plan.store)
        store.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix="recording-", dir=store))

    def state(self) -> dict[str, Any]:
        """Return the timesteps and the features, tensors in main memory: what :meth:`of_state`
        takes.
        """
        keys = self._features
        return {
            "timesteps": [*self.timesteps],
            "features": {key: self._loaded(key).cpu() for key in keys},
        }

    @classmethod
    def of_state(cls, plan: RecordingPlan, state: Mapping[str, Any]) -> Recording:
        """Make a finished recording from its plan and its :meth:`state`."""
        return cls(plan, state["timesteps"], state["features"])

    @property
    def bytes(self) -> int:
        """Bytes of the features' memory or files, counting complete storages."""
        storages = {}
        for value in self._features.values():
            if isinstance(value, Tensor):
                storages[value.untyped_storage().data_ptr()] = value.untyped_storage().nbytes()
        files = [value for value in self._features.values() if isinstance(value, Path)]
        return sum(storages.values()) + sum(path.stat().st_size for path in files)

    def features(self, timestep: float, layer: Layer, branch: str) -> Tensor:
        """Return (views, H W, C) features of a step, a layer and a branch; of the first step if the
        timestep repeats.

        Raises:
            ValueError: the features are not recorded; the message lists the recorded ones.
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
        return self._loaded((number, layer.name, branch))

    def _loaded(self, key: tuple[int, str, str]) -> Tensor:
        value = self._features[key]
        if isinstance(value, Path):
            from safetensors.torch import load_file

            return load_file(value)["features"]
        return value

    def step_of(self, timestep: float, begin: int = 0) -> int:
        """Find the number, from 0, of a timestep's step in the recorded run.

        Args:
            begin: number of the step at which the search begins; if it finds nothing, the first
                step of that timestep is taken.

        Raises:
            ValueError: the run lacks the timestep.
        """
        if timestep not in self.timesteps:
            listed = ", ".join(f"{t:g}" for t in self.timesteps) or "none"
            raise ValueError(
                f"timestep: got {timestep:g}, recorded are {listed}; run both with one scheduler"
                " and the same steps"
            )
        later = timestep in self.timesteps[begin:]
        return self.timesteps.index(timestep, begin if later else 0)

    def _check_range(self, number: int, layer: Layer, features: Tensor, stored: Tensor) -> None:
        """Refuse features that overflowed in half precision."""
        largest = torch.finfo(self.plan.dtype).max
        if largest >= torch.finfo(features.dtype).max or not bool(torch.isinf(stored).any()):
            return
        value = float(features.detach().abs().amax())
        kind = str(self.plan.dtype).removeprefix("torch.")
        raise ValueError(
            f"dtype: step {number} (timestep {self.timesteps[number]:g}) of {layer.name} has a"
            f" feature of {value:g}, beyond {kind}'s {largest:g}; record in bfloat16, which has the"
            " range of float32, or in float32"
        )

    def _put(self, number: int, layer: Layer, branch: str, features: Tensor) -> None:
        """Store (views, H W, C) features of a branch."""
        plan = self.plan
        key = (number, layer.name, branch)
        # Copy, since a slice would keep the full batch's memory alive.
        stored = torch.empty_like(features, dtype=plan.dtype, memory_format=torch.contiguous_format)
        stored.copy_(features.detach())
        self._check_range(number, layer, features, stored)
        if plan.store == "device":
            self._features[key] = stored
        elif plan.store == "cpu":
            self._features[key] = stored.cpu()
        else:
            from safetensors.torch import save_file

            path = self._folder / f"{number}-{layer.name}-{branch}.safetensors"
            save_file({"features": stored.cpu()}, path)
            self._features[key] = path


@contextmanager
def record(editor: Network, plan: RecordingPlan) -> Iterator[Recording]:
    """Record the image tokens of attention layers, unchanged, while the block runs.

    Args:
        editor: editor whose network is recorded; any loop may call it.
            :class:`~attnwarp.editing.layers.BareUNet` records the UNet of another pipeline.
        plan: features to record; ``print(plan)`` shows their memory.

    Raises:
        ValueError: the editor lacks a branch, or the size of the latents, the number of rows or the
            number of steps differs from the plan.

    Example:
        >>> import numpy as np
        >>> from attnwarp.editing.editor import edit
        >>> from attnwarp.editing.layers import choose_layers
        >>> from attnwarp.editing.small import load_editor
        >>> editor = load_editor("small-plain")
        >>> layers = choose_layers(editor.layers(), kinds=("self",))
        >>> plan = RecordingPlan(layers, (8, 8), ("text",), steps=1)
        >>> with record(editor, plan) as recording:
        ...     source = edit(editor, [np.zeros((32, 32, 3), np.float32)], "make it red", steps=1)
        >>> recording.features(recording.timesteps[0], layers[-1], "text").shape[:2]  # (views, H W)
        torch.Size([1, 64])
    """
    for branch in plan.keep:
        check.one_of(branch, editor.branches, "keep")
    recording, chosen, steps = Recording(plan), plan.recorded, Steps()

    def keep(layer: Layer, features: Tensor, call: Call) -> None:
        if call.latent_size != plan.latent_size:
            raise ValueError(
                f"latent_size: got latents of {call.latent_size}, planned {plan.latent_size}"
            )
        check_rows(call, plan.views)
        if steps.begins(call):
            if len(recording.timesteps) == plan.steps:
                raise ValueError(
                    f"steps: timestep {call.timestep:g} is one more than the {plan.steps} planned;"
                    " plan a step for each timestep of the network, len(scheduler.timesteps) of"
                    " them (some schedulers make more than they are asked for), and record one run"
                )
            recording.timesteps.append(call.timestep)
        number = len(recording.timesteps) - 1
        if number not in chosen:
            return
        for branch, part in zip(call.branches, features.chunk(len(call.branches)), strict=True):
            if branch in plan.keep:
                recording._put(number, layer, branch, part)

    with hooked(editor, plan.layers, keep):
        yield recording
