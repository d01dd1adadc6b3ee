"""Shared by the recipes: steps along a loss, and checkpoints."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from attnwarp.errors import InputError
from attnwarp.io.file import write_atomically

Tensor = torch.Tensor


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


@dataclass
class Run:
    """A training run that can be killed and resumed: its state is written after epochs.

    Attributes:
        state: everything that has a ``state_dict``, by name.
        recipe: everything else that the result depends on; written into the checkpoint, which can be
            resumed with no other.
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
