"""Exposure: an affine change of colour for each picture, which only the fit sees."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.fit.model import adam_step
from attnwarp.fit.views import expose
from attnwarp.io import FileFormatError
from attnwarp.io.file import write_atomically

Tensor = torch.Tensor
Changes = npt.NDArray[np.float64]

EXPOSURES = "exposures.json"

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

    def __call__(self, index: int, color: Tensor) -> Tensor:
        """Change a render (H, W, 3) as the picture ``index`` was exposed."""
        return expose(color, self.changes()[index])

    def changes(self) -> Tensor:
        """Compute the pictures' changes of colour, (count, 3, 4)."""
        return self.leaf - self.leaf.mean(dim=0)

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


def write_exposures(
    folder: Path, cameras: Sequence[Camera], changes: Iterable[npt.NDArray[np.floating[Any]]]
) -> None:
    """Write the (3, 4) changes of colour of fitted views beside their splats, by the cameras'
    names; without changes, remove those of an earlier fit.
    """
    path = folder / EXPOSURES
    named = {camera.name: change.tolist() for camera, change in zip(cameras, changes, strict=False)}
    if not named:
        path.unlink(missing_ok=True)
        return
    write_atomically(path, lambda stream: stream.write(f"{json.dumps(named, indent=1)}\n".encode()))


def read_exposures(splats: Path) -> dict[str, Changes]:
    """Read the (3, 4) changes of colour that a fit with exposure wrote beside its splats, by the
    cameras' names; empty without such a file.

    Raises:
        FileFormatError: the file is damaged.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp.fit import read_exposures
        >>> read_exposures(Path("scene/splats.ply"))
        {}
    """
    path = splats.parent / EXPOSURES
    if not path.is_file():
        return {}
    try:
        named = {
            name: np.asarray(change, dtype=np.float64)
            for name, change in json.loads(path.read_text()).items()
        }
        for name, change in named.items():
            check.shape(change, (3, 4), name)
            check.finite(change, name)
    except (AttributeError, TypeError, ValueError) as error:
        raise FileFormatError(path, f"is damaged: {error}; remove it, or fit again") from None
    return named
