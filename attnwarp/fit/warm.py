"""Kernels that are compiled before a clock starts."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians, Kind
from attnwarp.losses import normal_consistency
from attnwarp.render import render

SILENT_SECONDS = 2.0
"""A person is told of a compilation that takes longer."""

_ready: set[Kind] = set()


def _nobody(text: str) -> None:
    pass


def compile_kernels(kind: Kind, say: Callable[[str], object] | None = None) -> None:
    """Have numba compile the CPU renderer and its gradients, or load what it compiled before.

    Otherwise the first iteration does so, and the seconds of a fit hold a minute that no later fit
    takes. Further calls in a process do nothing.

    Args:
        kind: of the splats, "2d" or "3d".
        say: told once if it takes seconds.

    Example:
        >>> from attnwarp.fit import compile_kernels
        >>> compile_kernels("2d")
    """
    if kind in _ready:
        return
    text = "compiling the renderer, once after an installation: about a minute"
    timer = threading.Timer(SILENT_SECONDS, say or _nobody, [text])
    timer.daemon = True
    timer.start()
    try:
        disc = Gaussians(
            kind, torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
            torch.ones(1, 2 if kind == "2d" else 3), torch.ones(1), torch.zeros(1, 1, 3),
        )  # fmt: skip
        camera = Camera.look_at((0, 0, 3), (0, 0, 0), width=16, height=16, fov_y=40, up=(0, 1, 0))
        view = render(
            replace(disc, means=disc.means.clone().requires_grad_()), camera, backend="cpu"
        )
        (view.color.sum() + normal_consistency(view)).backward()
    finally:
        timer.cancel()
    _ready.add(kind)
