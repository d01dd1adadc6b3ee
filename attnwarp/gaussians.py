"""Gaussians: scenes as 2D (surfel) or 3D Gaussian splats."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.digest import digest

Kind = Literal["2d", "3d"]

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi)); a colour c is stored as (c - 0.5) /
SH_C0.
"""


SCREEN_FILTER = 0.3
"""Variance in square pixels that 3DGS adds to a projected splat."""

LEAST_FILTER, LARGEST_FILTER = 1e-4, 100.0
"""Limits of the screen filter, px^2: without a filter, a splat seen edge-on has no width."""


@dataclass(eq=False)
class Gaussians:
    """Set of N Gaussian splats.

    Args:
        kind: "2d" for flat discs with two scales (2DGS), "3d" for ellipsoids with three (3DGS).
        means: (N, 3) centres, float32 or float64, relative to ``origin``, in scene units.
        quats: (N, 4) rotations as wxyz, any length but zero. They rotate the splat's axes into
            world axes; the third axis of a 2D splat is its normal.
        scales: (N, 2) for "2d", (N, 3) for "3d": standard deviations, linear, positive, in scene
            units.
        opacities: (N,) in [0, 1].
        sh: (N, (degree + 1)^2, 3) spherical-harmonic coefficients of sRGB colour, degree 0 to 3, in
            the layout of the common PLY files: colour = max(0, sum_k sh_k Y_k(direction) + 0.5).
        origin: (3,) float64 world position of the zero of ``means``, which keeps far-away scenes
            exact.
        antialiased: True for splats fitted with the antialiased (opacity-compensated) 3DGS
            rasteriser.
        screen_filter: variance in square pixels added to a projected 3D splat: 0.3 in 3DGS, 0.1 in
            Mip-Splatting. A model must be drawn with the filter it was fitted with. 2D splats use
            a separate filter.
        far: distance from the camera, in scene units, beyond which a splat belongs to the sky:
            it is drawn behind all others and counts in colour alone.

    Raises:
        ValueError: a wrong shape, a non-finite value, a zero quaternion, a scale that is not
            positive, or an opacity outside [0, 1]; the message names the argument and the first
            bad row.
        TypeError: an argument is neither a tensor nor a NumPy array (which is converted).

    Example:
        >>> import torch
        >>> from attnwarp import Gaussians
        >>> red = Gaussians(
        ...     "2d",
        ...     means=torch.tensor([[0.0, 0.0, 2.0]]),
        ...     quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.tensor([[0.3, 0.3]]),
        ...     opacities=torch.tensor([0.9]),
        ...     sh=Gaussians.sh_from_rgb(torch.tensor([[1.0, 0.0, 0.0]])),
        ... )
        >>> len(red), red.sh_degree, red.normals().tolist()
        (1, 0, [[0.0, 0.0, 1.0]])
    """

    kind: Kind
    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    origin: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    antialiased: bool = False
    screen_filter: float = SCREEN_FILTER
    far: float = math.inf

    def __post_init__(self) -> None:
        check.one_of(self.kind, ("2d", "3d"), "kind")
        for name in ("means", "quats", "scales", "opacities", "sh"):
            setattr(self, name, check.tensor(getattr(self, name), name))
        n = self.means.shape[0] if self.means.ndim else 0
        check.shape(self.means, ("N", 3), "means")
        check.shape(self.quats, (n, 4), "quats")
        check.shape(self.scales, (n, 2 if self.kind == "2d" else 3), "scales")
        check.shape(self.opacities, (n,), "opacities")
        check.shape(self.sh, (n, "K", 3), "sh")
        if self.sh.shape[1] not in (1, 4, 9, 16):
            raise ValueError(
                f"sh: got {self.sh.shape[1]} coefficients a channel, expected 1, 4, 9 or 16 (degree"
                " 0 to 3)"
            )
        for name in ("means", "quats", "scales", "opacities", "sh"):
            tensor = getattr(self, name)
            if tensor.dtype not in (torch.float32, torch.float64):
                raise ValueError(f"{name}: got {tensor.dtype}, expected float32 or float64")
            check.finite(tensor, name)
        low, high = LEAST_FILTER, LARGEST_FILTER
        self.screen_filter = float(check.number(self.screen_filter, low, high, "screen_filter"))
        if not self.far > 0:
            raise ValueError(f"far: got {self.far}, expected a positive distance in scene units")
        self.origin = np.array(self.origin, dtype=np.float64)
        check.shape(self.origin, (3,), "origin")
        check.finite(self.origin, "origin")
        quats, scales, opacity = (x.detach() for x in (self.quats, self.scales, self.opacities))
        self._refuse(quats.square() @ quats.new_ones(4) == 0, "quats", "zero quaternion")
        if n and scales.min() <= 0:  # a reduction by row takes ten times as long
            self._refuse((scales <= 0).any(dim=-1), "scales", "a scale that is not positive")
        self._refuse((opacity < 0) | (opacity > 1), "opacities", "opacity outside [0, 1]")

    @staticmethod
    def _refuse(bad: torch.Tensor, name: str, what: str) -> None:
        if bool(bad.any()):
            index = int(torch.nonzero(bad)[0, 0])
            raise ValueError(
                f"{name}: {what} at index {index} ({int(bad.sum())} of {bad.shape[0]} rows)"
            )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @staticmethod
    def sh_from_rgb(rgb: check.Array) -> torch.Tensor:
        """Convert (N, 3) sRGB colours in [0, 1] to degree-0 coefficients, (N, 1, 3)."""
        rgb = check.tensor(rgb, "rgb")
        check.shape(rgb, ("N", 3), "rgb")
        return ((rgb - 0.5) / SH_C0)[:, None, :]

    def rotations(self) -> torch.Tensor:
        """Compute rotation matrices, (N, 3, 3); column k is the splat's axis k in the world."""
        # Squares of tiny or huge numbers overflow or underflow; scaling by a power of two is exact.
        largest = self.quats.detach().abs().amax(dim=-1, keepdim=True)
        scale = torch.frexp(largest).mantissa / largest
        quats = self.quats * scale.clamp(max=1 / torch.finfo(scale.dtype).tiny)
        w, x, y, z = torch.nn.functional.normalize(quats, dim=-1, eps=0).unbind(-1)
        rows = [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ]  # fmt: skip
        return torch.stack(rows, dim=-1).reshape(-1, 3, 3)

    def normals(self) -> torch.Tensor:
        """Compute unit normals in world coordinates, (N, 3), of arbitrary sign.

        A normal is the third axis of a 2D splat, the axis of the smallest scale of a 3D splat.
        """
        R = self.rotations()
        if self.kind == "2d":
            return R[:, :, 2]
        axis = self.scales.argmin(dim=-1)
        return R.gather(2, axis[:, None, None].expand(-1, 3, 1))[:, :, 0]

    def world_means(self) -> npt.NDArray[np.float64]:
        """Compute centres in world coordinates, (N, 3) float64, origin included."""
        return self.means.detach().cpu().numpy().astype(np.float64) + self.origin

    def select(self, index: torch.Tensor) -> Gaussians:
        """Select splats by an (N,) boolean mask or an (M,) integer index, in that order."""
        return self.unchecked(**self._changed(lambda tensor: tensor[index]))

    def to(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Gaussians:
        """Copy the splats to another floating dtype or device."""
        return replace(self, **self._changed(lambda x: x.to(dtype=dtype, device=device)))

    def with_sh_degree(self, degree: int) -> Gaussians:
        """Limit or extend harmonics to ``degree``: higher ones are dropped, missing ones are 0.

        Example:
            >>> from attnwarp.trial import disc
            >>> disc().with_sh_degree(3).sh.shape
            torch.Size([1, 16, 3])
        """
        if degree not in (0, 1, 2, 3):
            raise ValueError(f"degree: got {degree}, expected 0 to 3")
        count = (degree + 1) ** 2
        missing = self.sh.new_zeros(len(self), max(0, count - self.sh.shape[1]), 3)
        return replace(self, sh=torch.cat([self.sh[:, :count], missing], dim=1))

    def used_sh_degree(self) -> int:
        """Find the highest degree of the harmonics with a nonzero coefficient.

        Example:
            >>> from attnwarp.trial import disc
            >>> disc().with_sh_degree(3).used_sh_degree()
            0
        """
        used = torch.nonzero((self.sh != 0).any(dim=2).any(dim=0))
        return math.isqrt(int(used.max())) if len(used) else 0

    def digest(self) -> str:
        """Hash the splats (SHA-256), as hexadecimal digits."""
        names = ("means", "quats", "scales", "opacities", "sh")
        arrays = [getattr(self, name).detach().cpu().numpy() for name in names]
        far = () if math.isinf(self.far) else (self.far,)
        return digest(self.kind, self.antialiased, self.screen_filter, self.origin, *arrays, *far)

    def detach(self) -> Gaussians:
        """Detach the splats from autograd."""
        return self.unchecked(**self._changed(torch.Tensor.detach))

    def unchecked(self, **changes: Any) -> Gaussians:
        """Copy with fields changed to values that need no check, such as parts of these."""
        made = copy(self)
        vars(made).update(changes)
        return made

    def _changed(self, change: Any) -> dict[str, Any]:
        names = ("means", "quats", "scales", "opacities", "sh")
        return {name: change(getattr(self, name)) for name in names}
