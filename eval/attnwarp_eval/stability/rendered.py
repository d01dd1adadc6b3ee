"""Splats rendered by a backend, compared with the same splats at 50 digits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.render import Render, render
from attnwarp_eval.stability.case import Bound, Direction, Way, ways
from attnwarp_eval.stability.exact import FIELDS, ExactSplats, Pixel

_FORWARD = ways("reference", "cpu") + ways("gpu", precisions=("float32",))
RENDERERS = _FORWARD + tuple(replace(way, direction="backward") for way in _FORWARD)
"""Every renderer, forward and backward."""

UNDECIDED = 2e-7
"""An alpha this close to the cut-off 1/255 may be drawn or not, by rounding alone in float32."""

GRADIENT = Bound(
    "relative", 1e-3, "of a gradient's length; a step of an optimiser does not tell 0.1 %"
)
ALPHA = Bound("alpha or relative depth", 1e-5, "1/400 of a step of an 8-bit picture")


@dataclass(frozen=True)
class Shot:
    """Splats before a camera, and the pixels that are compared.

    Attributes:
        gaussians: in float64; a way converts them.
        pixels: (row, column) of each pixel.
        options: options of :func:`attnwarp.render.render` besides the backend: ``near``,
            ``antialiased`` and ``depth``.
        unmoved: an easy version of the shot, for the oracle; None for the shot itself.
    """

    gaussians: Gaussians
    camera: Camera
    pixels: Sequence[tuple[int, int]]
    options: dict[str, Any] = field(default_factory=dict)
    unmoved: Shot | None = None

    def exact(self, dtype: torch.dtype) -> ExactSplats:
        """The oracle of the values as ``dtype`` stores them."""
        made = self.unmoved or self
        return ExactSplats(made.gaussians.to(dtype=dtype), made.camera, **made.options)

    def render(self, way: Way, gaussians: Gaussians | None = None) -> Render:
        """The picture by a way."""
        splats = self.gaussians.to(dtype=way.dtype) if gaussians is None else gaussians
        if way.backend == "gpu" and torch.cuda.is_available():
            splats = splats.to(device="cuda")
        return render(splats, self.camera, backend=way.backend, **self.options)


def front_camera(size: int = 33, focal: float = 40.0) -> Camera:
    """A camera at the origin that looks along +z, its principal point in the middle."""
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(K, np.eye(4), size, size)


def quaternion_to(normal: Any) -> np.ndarray:
    """(4,) shortest rotation (wxyz) from the z axis to a unit vector."""
    x, y, z = normal
    quat = np.array([1 + z, -y, x, 0.0])
    length = np.linalg.norm(quat)
    return np.array([0.0, 1, 0, 0]) if length < 1e-9 else quat / length


def splats(
    means: Any,
    scales: Any = 0.1,
    opacities: Any = 0.5,
    *,
    kind: str = "2d",
    normals: Any = None,
    quats: Any = None,
    colors: Any = 1.0,
) -> Gaussians:
    """Discs or balls in float64 at chosen points; they face a camera at the origin that looks along
    +z, unless ``normals`` (N, 3) or ``quats`` (N, 4) turn them.
    """
    points = torch.as_tensor(np.asarray(means), dtype=torch.float64).reshape(-1, 3)
    n = len(points)
    turned = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(n, 1)
    if normals is not None:
        rows = [quaternion_to(v) for v in np.asarray(normals).reshape(-1, 3)]
        turned = torch.tensor(np.stack(rows))
    if quats is not None:
        turned = torch.as_tensor(np.asarray(quats), dtype=torch.float64).reshape(n, 4)
    axes = 2 if kind == "2d" else 3
    return Gaussians(
        "2d" if kind == "2d" else "3d",
        points,
        turned,
        torch.as_tensor(scales, dtype=torch.float64).expand(n, axes).clone(),
        torch.as_tensor(opacities, dtype=torch.float64).expand(n).clone(),
        Gaussians.sh_from_rgb(torch.as_tensor(colors, dtype=torch.float64).expand(n, 3)),
    )


def against_exact(
    build: Callable[[float], Shot], outputs: Sequence[str] = ("alpha", "depth")
) -> Callable[[float, Way], float]:
    """The measure of a case whose oracle is :class:`ExactSplats`.

    Args:
        build: function that builds the shot of a level.
        outputs: ``alpha``, ``depth`` or both. Alpha counts absolutely, depth relatively.
    """

    @cache
    def shot(level: float) -> Shot:
        return build(level)

    @cache
    def truth(level: float, precision: str) -> list[Pixel]:
        made = shot(level)
        exact = made.exact(getattr(torch, precision))
        return [exact.pixel(column + 0.5, row + 0.5) for row, column in made.pixels]

    @cache
    def gradient(level: float, precision: str) -> dict[str, np.ndarray]:
        made = shot(level)
        exact = made.exact(getattr(torch, precision))
        points = [(column + 0.5, row + 0.5) for row, column in made.pixels[::2]]
        return exact.gradient(points, _weights(truth(level, precision)[::2], outputs))

    def measure(level: float, way: Way) -> float:
        made = shot(level)
        pixels = truth(level, way.precision)
        if way.direction == "forward":
            return _difference(made.render(way), made, pixels, outputs)
        result = _backward(made, way, _weights(pixels[::2], outputs))
        return relative_gradient(result, gradient(level, way.precision))

    return measure


def relative_gradient(result: dict[str, np.ndarray], exact: dict[str, np.ndarray]) -> float:
    """The largest relative error of a gradient over its fields, by their lengths. A field whose
    exact gradient is a millionth of the largest, or less, counts against that millionth.
    """
    if not all(np.isfinite(value).all() for value in result.values()):
        return math.inf
    lengths = {name: float(np.linalg.norm(value)) for name, value in exact.items()}
    least = 1e-6 * max(lengths.values())
    if least == 0:
        return max(float(np.abs(value).max()) for value in result.values())
    return max(
        float(np.linalg.norm(result[name].reshape(-1) - exact[name].reshape(-1)))
        / max(lengths[name], least)
        for name in exact
    )


def _weights(pixels: Sequence[Pixel], outputs: Sequence[str]) -> list[tuple[float, float]]:
    """Weights of the loss: different for each pixel, so that no two errors cancel. Every second
    pixel takes part, since the exact gradient costs most of a sweep.
    """
    return [
        (
            1.0 + 0.25 * k if "alpha" in outputs else 0.0,
            0.5 - 0.125 * k if "depth" in outputs and pixel.depth is not None else 0.0,
        )
        for k, pixel in enumerate(pixels)
    ]


def _difference(view: Render, made: Shot, pixels: Sequence[Pixel], outputs: Sequence[str]) -> float:
    worst = 0.0
    for (row, column), exact in zip(made.pixels, pixels, strict=True):
        if exact.nearest_threshold < UNDECIDED:
            continue
        alpha, depth = float(view.alpha[row, column]), float(view.depth[row, column])
        if math.isnan(alpha) or (exact.depth is None) != math.isnan(depth):
            return math.inf
        if "alpha" in outputs:
            worst = max(worst, abs(alpha - float(exact.alpha)))
        if "depth" in outputs and exact.depth is not None:
            worst = max(worst, abs(float((depth - exact.depth) / exact.depth)))
    return worst


def _backward(
    made: Shot, way: Way, weights: Sequence[tuple[float, float]]
) -> dict[str, np.ndarray]:
    base = made.gaussians.to(dtype=way.dtype)
    leaves = {name: getattr(base, name).clone().requires_grad_() for name in FIELDS}
    leafy = Gaussians(base.kind, **leaves, sh=base.sh, origin=base.origin)
    view = made.render(way, leafy)
    loss = torch.zeros((), dtype=torch.float64)
    for (row, column), (a, b) in zip(made.pixels[::2], weights, strict=True):
        loss = loss + a * view.alpha[row, column].double().cpu()
        if b:
            loss = loss + b * view.depth[row, column].double().cpu()
    loss.backward()
    return {
        name: np.zeros(leaf.shape) if leaf.grad is None else leaf.grad.double().cpu().numpy()
        for name, leaf in leaves.items()
    }


def render_bounds(alpha: Bound = ALPHA, gradient: Bound = GRADIENT) -> dict[Direction, Bound]:
    """The bounds of a rendering case."""
    return {"forward": alpha, "backward": gradient}
