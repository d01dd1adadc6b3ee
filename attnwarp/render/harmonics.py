"""Real spherical harmonics to degree 3, in the sign and order of the common splat files."""

from __future__ import annotations

import torch

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip


def basis(direction: torch.Tensor, degree: int) -> torch.Tensor:
    """Compute the values of the harmonics, (..., (degree + 1)^2).

    Args:
        direction: (..., 3) unit vectors from the camera to the splat, in world axes.
        degree: highest degree, 0 to 3.
    """
    x, y, z = direction.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree > 0:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree > 1:
        values += [
            C2[0] * x * y,
            C2[1] * y * z,
            C2[2] * (2 * z * z - x * x - y * y),
            C2[3] * x * z,
            C2[4] * (x * x - y * y),
        ]
    if degree > 2:
        values += [
            C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            C3[2] * y * (4 * z * z - x * x - y * y),
            C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            C3[4] * x * (4 * z * z - x * x - y * y),
            C3[5] * z * (x * x - y * y),
            C3[6] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, dim=-1)


def color(sh: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Compute colours (N, 3), max(0, sum_k sh_k Y_k + 0.5), of (N, K, 3) coefficients along (N, 3)
    unit directions.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    return (torch.einsum("nk,nkc->nc", basis(direction, degree), sh) + 0.5).clamp_min(0)
