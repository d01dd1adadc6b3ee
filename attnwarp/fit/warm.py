"""Compilation of kernels before timing starts."""

from __future__ import annotations

import threading

import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians, Kind
from attnwarp.losses import normal_consistency
from attnwarp.render import render
from attnwarp.reporting import SILENT, Reporter

QUIET_SECONDS = 5.0
"""Log compilation that takes longer than this; loading a cached kernel takes about one second."""

_ready: set[tuple[Kind, str]] = set()


def compile_kernels(
    kind: Kind, report: Reporter = SILENT, device: torch.device | str = "cpu"
) -> None:
    """Compile the renderer and its gradients, or load them from the cache.

    Otherwise the first iteration compiles them, and the fit's seconds include a minute that no
    later fit takes. Further calls in a process do nothing.

    Args:
        kind: kind of the splats, "2d" or "3d".
        report: receiver of one line if compilation takes seconds.
        device: device of the splats: numba compiles for a CPU, Warp for a GPU.

    Example:
        >>> from attnwarp.fit import compile_kernels
        >>> compile_kernels("2d")
    """
    place = torch.device(device)
    if (kind, place.type) in _ready:
        return
    text = "loading the renderer; after an installation it is compiled once, in about a minute"
    timer = threading.Timer(QUIET_SECONDS, report.log, [text])
    timer.daemon = True
    timer.start()
    try:
        # A caller may have disabled gradients.
        with torch.inference_mode(False), torch.enable_grad():
            _call_all(kind, place)
    finally:
        timer.cancel()
    _ready.add((kind, place.type))


def _call_all(kind: Kind, device: torch.device) -> None:
    """Render one splat and its loss's gradients, in float32 like fits, for any torch default."""
    single = torch.float32
    means = torch.zeros(1, 3, requires_grad=True, dtype=single)
    disc = Gaussians(
        kind,
        means,
        torch.tensor([[1, 0, 0, 0]], dtype=single),
        torch.ones(1, 2 if kind == "2d" else 3, dtype=single),
        torch.ones(1, dtype=single),
        torch.zeros(1, 1, 3, dtype=single),
    )
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), width=16, height=16, fov_y=40, up=(0, 1, 0))
    view = render(disc.to(device=device), camera)
    (view.color.sum() + normal_consistency(view) + view.distortion_ordered.sum()).backward()
