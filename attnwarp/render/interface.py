"""Inputs and outputs of a backend of the renderer."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Inputs:
    """Checked inputs of a backend, with defaults resolved. N splats, C channels.

    ``values`` is (N, K, 3) spherical harmonics if ``harmonic``, else (N, C) features. ``K`` is (3,
    3) and ``pose`` the (4, 4) world-to-camera transform, both float64; ``pose`` and ``background``
    (C,) may require gradients.
    """

    kind: str
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    values: Tensor
    harmonic: bool
    origin: Tensor
    K: Tensor
    pose: Tensor
    width: int
    height: int
    background: Tensor
    depth: str
    near: float
    antialiased: bool
    screen_filter: float

    @property
    def leaves(self) -> tuple[Tensor, ...]:
        """Tensors that may require gradients."""
        splats = (self.means, self.quats, self.scales, self.opacities, self.values)
        return (*splats, self.pose, self.background)

    @property
    def channels(self) -> int:
        """Number of channels of the rendered colour."""
        return 3 if self.harmonic else int(self.values.shape[1])


@dataclass(frozen=True)
class Outputs:
    """Outputs of a backend, as in :class:`attnwarp.render.Render`."""

    color: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor
    normal: Tensor
    distortion_ordered: Tensor
    weight: Tensor
    counters: dict[str, int]


PICTURES = (
    "color",
    "alpha",
    "depth",
    "median_depth",
    "normal",
    "distortion_ordered",
)
"""Names of the picture outputs."""

OUTPUTS = (*PICTURES, "weight")
"""Names of the differentiable outputs."""
