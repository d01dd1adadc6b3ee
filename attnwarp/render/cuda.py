"""The GPU backend: gsplat, where it and CUDA are present."""

from __future__ import annotations

import importlib.util

import torch

from attnwarp.render.reference import Inputs, Outputs


def render(inputs: Inputs) -> Outputs:
    """Render with gsplat; see :func:`attnwarp.render.render`."""
    if not torch.cuda.is_available():
        raise RuntimeError("backend: 'cuda' needs a GPU that torch can see; use 'cpu'")
    if importlib.util.find_spec("gsplat") is None:
        raise RuntimeError("backend: 'cuda' needs gsplat; install attnwarp[gpu], or use 'cpu'")
    raise RuntimeError("backend: 'cuda' cannot render this yet; use 'cpu'")
