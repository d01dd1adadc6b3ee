"""Shared by the recipes: crops, the learning rate, and checkpoints."""

from __future__ import annotations

import functools
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional

from attnwarp.errors import InputError
from attnwarp.io.file import write_atomically

Tensor = torch.Tensor
Model = TypeVar("Model", bound=torch.nn.Module)

TURN = 8.0
"""Degrees to either side by which crops are turned."""


def crops(
    images: npt.NDArray[np.uint8], out: int, rng: np.random.Generator, *, scale: tuple[float, float]
) -> Tensor:
    """(N, 3, out, out) float32 in [0, 1], channels last: the crops of :func:`placed_crops`."""
    return placed_crops(images, out, rng, scale=scale)[0]


def placed_crops(
    images: npt.NDArray[np.uint8], out: int, rng: np.random.Generator, *, scale: tuple[float, float],
    tone: float = 0.12,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Random crops of square pictures, brightened and darkened a little. Half of them are mirrored.

    Args:
        images: (N, S, S, 3).
        out: side of a crop in px.
        scale: shares of S, of which the crop's side is drawn.
        tone: strength of the change in brightness and contrast; hues stay.

    Returns:
        The crops, (N, 3, out, out) float32 in [0, 1], channels last; and (N, 2, 3) maps from the
        crop's [-1, 1] to the picture's.
    """
    n = len(images)
    side = rng.uniform(*scale, n)
    angle = np.radians(rng.uniform(-TURN, TURN, n))
    mirror = np.where(rng.uniform(size=n) < 0.5, -1.0, 1.0)
    free = np.maximum(1 - side * (np.abs(np.cos(angle)) + np.abs(np.sin(angle))), 0)
    shift = rng.uniform(-1, 1, (n, 2)) * free[:, None]
    theta = np.zeros((n, 2, 3))
    theta[:, 0, 0], theta[:, 0, 1] = side * np.cos(angle) * mirror, -side * np.sin(angle)
    theta[:, 1, 0], theta[:, 1, 1] = side * np.sin(angle) * mirror, side * np.cos(angle)
    theta[:, :, 2] = shift
    x = torch.from_numpy(images).permute(0, 3, 1, 2).float().div_(255)
    shrink = scale[1] * images.shape[1] / out
    if shrink >= 2:  # bilinear taps would alias
        x = functional.avg_pool2d(x, int(shrink))
    grid = functional.affine_grid(
        torch.from_numpy(theta).float(), [n, 3, out, out], align_corners=False
    )
    x = functional.grid_sample(x, grid, padding_mode="reflection", align_corners=False)
    gain = torch.from_numpy(np.exp(rng.normal(0, tone, (n, 1, 1, 1)))).float()
    gamma = torch.from_numpy(np.exp(rng.normal(0, tone, (n, 1, 1, 1)))).float()
    x = (x.clamp(1e-4, 1) ** gamma) * gain
    return x.clamp(0, 1).to(memory_format=torch.channels_last), torch.from_numpy(theta).float()


def channels_last(model: Model) -> Model:
    """The model with its convolutions channels last, which is faster on a CPU."""
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return model


def rate(step: int, total: int, peak: float, warm: int) -> float:
    """The learning rate: linear up to ``peak``, then half a cosine down to a hundredth of it."""
    if step < warm:
        return peak * (step + 1) / warm
    progress = (step - warm) / max(1, total - warm)
    return peak * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress)))


def groups(model: torch.nn.Module, decay: float) -> list[dict[str, Any]]:
    """Parameters for AdamW: matrices decay, biases, norms and scales do not."""
    matrices = [p for p in model.parameters() if p.ndim >= 2]
    others = [p for p in model.parameters() if p.ndim < 2]
    return [{"params": matrices, "weight_decay": decay}, {"params": others, "weight_decay": 0.0}]


def descend(optimizer: torch.optim.Optimizer, model: torch.nn.Module, loss: Tensor) -> None:
    """Take a step along a loss whose gradient is cut to a length of 1."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimizer.step()


def settings(module: Mapping[str, Any], *splits: str) -> dict[str, Any]:
    """Settings of a recipe: its constants, by their upper-case names, and its pictures.

    Args:
        module: the recipe's ``globals()``, imported constants such as the words for colours
            included.
        splits: names of the pictures that it is trained on, in :data:`training.worlds.data.SPLITS`.
    """
    from training.worlds.data import DATA_PROTOCOL, SPLITS

    plain = (bool, int, float, str, tuple, list, dict)
    constants = {
        name: value for name, value in module.items() if name.isupper() and isinstance(value, plain)
    }
    return constants | {
        "data": {"protocol": DATA_PROTOCOL, **{name: asdict(SPLITS[name]) for name in splits}}
    }


@dataclass
class Run:
    """A training run that can be killed and resumed: its state is written after epochs.

    Attributes:
        state: everything that has a ``state_dict``, by name.
        recipe: the other settings of the result, see :func:`settings`; written into the checkpoint,
            which can be resumed with no other.
        every: least seconds between two checkpoints; 0 writes one after each epoch.
    """

    path: Path
    state: dict[str, Any]
    epochs: int
    recipe: Mapping[str, Any]
    every: float = 0.0

    def train(self, epoch: Callable[[int], dict[str, float]]) -> None:
        """Run the epochs that are left; each draws from generators seeded by its number, so a
        resumed run is the same.

        Raises:
            InputError: the checkpoint is of another recipe.
        """
        first, saved = 0, time.perf_counter()
        recipe = json.loads(json.dumps({"epochs": self.epochs, **self.recipe}))  # tuples as lists
        if self.path.exists():
            stored = torch.load(self.path, weights_only=True, map_location="cpu")
            before = json.loads(stored["recipe"])
            others = [name for name in {**recipe, **before} if before.get(name) != recipe.get(name)]
            if others:
                names = ", ".join(others)
                raise InputError(
                    f"{self.path}: was made with other {names}; remove it to train from the start"
                )
            for name, thing in self.state.items():
                thing.load_state_dict(stored[name])
            first = int(stored["epoch"])
        for number in range(first, self.epochs):
            start = time.perf_counter()
            words = ", ".join(f"{k} {v:.4g}" for k, v in epoch(number).items())
            now = time.perf_counter()
            print(f"epoch {number + 1}/{self.epochs}: {words}, {now - start:.0f} s", flush=True)
            if number + 1 < self.epochs and now - saved < self.every:
                continue
            saved = now
            states = {name: thing.state_dict() for name, thing in self.state.items()}
            about = {"epoch": number + 1, "recipe": json.dumps(recipe)}
            write_atomically(self.path, functools.partial(torch.save, {**states, **about}))
