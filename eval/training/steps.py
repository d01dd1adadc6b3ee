"""The steps of a training: minibatches drawn many at a time, weights averaged, and on a GPU each step as one graph.

A small network's step is a thousand short kernels. Starting them one by one takes longer than they do; a recorded graph
starts them all at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from training.common import Run, descend, groups

EMA = 0.999
WARM = 500
STEPS_AN_EPOCH = 100
SAVE_SECONDS = 30.0
"""Least time between two checkpoints."""

DRAWN = 8
"""Minibatches of a task that are drawn at once."""

Inputs = dict[str, Tensor]


def constants() -> dict[str, float]:
    """Constants that every training's result depends on, by name."""
    return {"EMA": EMA, "WARM": WARM, "STEPS_AN_EPOCH": STEPS_AN_EPOCH, "DRAWN": DRAWN}


@dataclass(frozen=True, eq=False)
class Task:
    """One kind of step.

    Attributes:
        share: share of the steps.
        count: number of rows in a minibatch.
        draw: (rows, generator) -> inputs, each with one row a pair.
        loss: inputs -> the loss, and what to print of it.
    """

    share: float
    count: int
    draw: Callable[[int, torch.Generator], Inputs]
    loss: Callable[[Mapping[str, Tensor]], tuple[Tensor, dict[str, Tensor]]]


class Plan(Protocol):
    """Stage as :func:`train_steps` reads it."""

    @property
    def steps(self) -> int:
        """Steps of the whole stage."""

    @property
    def peak(self) -> float:
        """Learning rate."""

    @property
    def seed(self) -> int:
        """Seed of everything random."""


def falling_rate(step: int, total: int, peak: float, warm: int = WARM) -> float:
    """The learning rate: linear up to ``peak``, constant, and down to a fiftieth over the last 30 %."""
    if step < warm:
        return peak * (step + 1) / warm
    left = (total - step) / (0.3 * total)
    return peak * min(1.0, 0.02 + 0.98 * left)


def train_steps(
    net: torch.nn.Module, plan: Plan, tasks: Sequence[Task], checkpoint: Path, recipe: Mapping[str, Any],
    device: torch.device, warm: int = WARM,
) -> None:  # fmt: skip
    """Take a stage's steps, or those that are left, with an average of the weights beside them.

    Args:
        recipe: inputs that decide the result, see :class:`training.common.Run`.
        warm: steps until the rate is at its peak.
    """
    recipe = {**recipe, "device": device.type}  # optimizers of a CPU and of a GPU hold other states
    stepper = Stepper(net, plan.peak, tasks, device)
    shares = np.array([task.share for task in tasks])

    def epoch(number: int) -> dict[str, float]:
        rng = np.random.default_rng([plan.seed, number])
        generator = torch.Generator(device).manual_seed(1_000_003 * plan.seed + number)
        net.train()
        sums: dict[str, Tensor] = {}
        counts: dict[str, int] = {}
        order = rng.choice(len(tasks), STEPS_AN_EPOCH, p=shares / shares.sum())
        for step, (index, inputs) in enumerate(minibatches(tasks, order.tolist(), generator)):
            rate = falling_rate(number * STEPS_AN_EPOCH + step, plan.steps, plan.peak, warm)
            for key, value in stepper.step(index, inputs, rate).items():
                name = f"{key} {index}" if len(tasks) > 1 else key
                # Read once an epoch: a GPU would wait for each.
                sums[name] = sums.get(name, torch.zeros((), device=device)) + value
                counts[name] = counts.get(name, 0) + 1
        return {key: float(value) / counts[key] for key, value in sums.items()}

    state = {"net": net, "average": stepper.average, "optimizer": stepper.optimizer}
    Run(checkpoint, state, plan.steps // STEPS_AN_EPOCH, recipe, every=SAVE_SECONDS).train(epoch)


def minibatches(
    tasks: Sequence[Task], order: Sequence[int], generator: torch.Generator
) -> Iterator[tuple[int, Inputs]]:
    """The minibatches of tasks in an order, :data:`DRAWN` of each drawn at once."""
    left: dict[int, list[Inputs]] = {}
    for index in order:
        if not left.get(index):
            task = tasks[index]
            drawn = task.draw(DRAWN * task.count, generator)
            parts = {key: value.split(task.count) for key, value in drawn.items()}
            left[index] = [{key: parts[key][k] for key in parts} for k in range(DRAWN)]
        yield index, left[index].pop()


class Stepper:
    """A network, its optimizer and its average, and the steps that change them."""

    def __init__(
        self, net: torch.nn.Module, peak: float, tasks: Sequence[Task], device: torch.device
    ) -> None:
        from torch.optim.swa_utils import AveragedModel

        self.net, self.tasks, self.device = net, tasks, device
        self.average = AveragedModel(net)
        self.graphs: dict[int, tuple[torch.cuda.CUDAGraph, Inputs, dict[str, Tensor]]] = {}
        on_gpu = device.type == "cuda"
        # A graph holds numbers as they were when it was recorded, so the rate has to be a tensor there.
        rate = torch.tensor(peak, device=device) if on_gpu else peak
        self.optimizer = torch.optim.AdamW(
            groups(net, 0.01), lr=rate, betas=(0.9, 0.99), capturable=on_gpu
        )

    def step(self, index: int, inputs: Inputs, rate: float) -> dict[str, Tensor]:
        """One step of a task; what its loss says of it."""
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"] = group["lr"].to(self.device).fill_(rate)
            else:
                group["lr"] = rate
        if self.device.type != "cuda":
            return self.now(index, inputs)
        if index not in self.graphs:
            parts = self.now(index, inputs)
            self.graphs[index] = self.recorded(index, inputs)
            return parts
        graph, place, parts = self.graphs[index]
        for key, value in inputs.items():
            place[key].copy_(value)
        graph.replay()
        return parts

    def now(self, index: int, inputs: Inputs) -> dict[str, Tensor]:
        """One step, kernel by kernel."""
        self.optimizer.zero_grad(set_to_none=True)
        loss, parts = self.tasks[index].loss(inputs)
        descend(self.optimizer, self.net, loss)
        with torch.no_grad():
            for own, new in zip(
                self.average.module.parameters(), self.net.parameters(), strict=True
            ):
                own.lerp_(new, 1 - EMA)
        return parts

    def recorded(
        self, index: int, inputs: Inputs
    ) -> tuple[torch.cuda.CUDAGraph, Inputs, dict[str, Tensor]]:
        """A step as a graph, the place of its inputs and of what its loss says."""
        place = {key: value.clone() for key, value in inputs.items()}
        # Libraries set themselves up on first use, which a graph cannot hold; gradients alone change no weight.
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(2):
                self.optimizer.zero_grad(set_to_none=True)
                self.tasks[index].loss(place)[0].backward()
        torch.cuda.current_stream().wait_stream(stream)
        self.optimizer.zero_grad(set_to_none=True)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            parts = self.now(index, place)
        return graph, place, parts
