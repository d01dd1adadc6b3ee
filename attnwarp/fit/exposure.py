"""Exposure: an affine change of colour for each picture, which only the fit sees."""

from __future__ import annotations

from typing import Any

import torch

from attnwarp.fit.model import adam_step

Tensor = torch.Tensor

RATE, LAST_RATE = 1e-2, 1e-3
"""Learning rates at the beginning and the end, exponential in between (3DGS)."""


class Exposure:
    """Affine changes of colour, whose mean over the pictures is none: a colour that all pictures
    share belongs to the splats.

    Attributes:
        leaf: (count, 3, 4) changes of the colours' linear part and offset, before the mean is
            subtracted.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.leaf = torch.zeros(count, 3, 4, dtype=torch.float32, device=device)
        self.leaf.requires_grad_(True)
        self.first = torch.zeros_like(self.leaf.detach())
        self.second = torch.zeros_like(self.first)
        self.steps = 0

    def __call__(self, color: Tensor, index: int) -> Tensor:
        """Change a render (H, W, 3) as the picture ``index`` was exposed."""
        change = self.leaf[index] - self.leaf.mean(dim=0)
        return color + color @ change[:, :3].T + change[:, 3]

    def step(self, progress: float) -> None:
        """Take one Adam step, then clear the gradient; ``progress`` is in [0, 1]."""
        if self.leaf.grad is not None:
            rate = RATE ** (1 - progress) * LAST_RATE**progress
            adam_step(self.leaf, self.first, self.second, self.steps, rate)
        self.steps += 1

    def state(self) -> dict[str, Any]:
        """Collect the state that the next step depends on."""
        parts = [self.leaf.detach(), self.first, self.second]
        return {"steps": self.steps, "parts": [part.cpu().clone() for part in parts]}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state`."""
        self.steps = int(state["steps"])
        parts = [part.to(self.leaf.device, copy=True) for part in state["parts"]]
        leaf, self.first, self.second = parts
        self.leaf = leaf.requires_grad_(True)
