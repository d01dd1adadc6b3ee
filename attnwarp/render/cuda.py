"""The GPU backend: gsplat, where it and CUDA are present.

Colour, alpha, depth, normal, distortion_l2_ndc and weight have the definitions of
:mod:`attnwarp.render.reference`. Each splat's colour, normal, depth z, 1/z and 1/z^2 are composited
as features, and the outputs are made from the sums. Differences of gsplat (1.5.3):

- Depth is that of the splat's centre. "intersection" and "peak" are refused; ask for
  depth="center".
- A 2D splat is cut off by a box of 3.33 times its one-sigma extent. In perspective the box is too
  small (colour errors up to 1.6e-2), and the screen filter sits in its middle. Only centres are
  tested against ``near``, so a splat that crosses the camera plane is drawn wrong. These errors
  cannot be corrected from outside. So kind "2d" is refused unless the environment accepts them by
  ``ATTNWARP_GSPLAT_2D=1``.
- Of the camera's K only fx, fy, cx and cy are read: a camera with skew (K[0, 1] not 0) is refused.
- alpha is clamped at 0.999 or 0.99 depending on the version, and the splat that brings the
  transmittance below 1e-4 is left out. Both differ by less than 1 % of a pixel, behind opaque
  splats.
- There is no median depth and no distortion_l1 of a feature: both are NaN everywhere.
- Splats of equal depth are drawn in the order of the input.
- ``weight`` carries no gradient.
"""

from __future__ import annotations

import importlib.util
import os

import torch

from attnwarp.errors import install_command
from attnwarp.render import harmonics, reference
from attnwarp.render.interface import Inputs, Outputs

Tensor = torch.Tensor

ACCEPT_2D = "ATTNWARP_GSPLAT_2D"


def reason_not() -> str | None:
    """Reason why this backend cannot run here, or None if it can."""
    if not torch.cuda.is_available():
        return "needs a GPU that torch can see"
    if importlib.util.find_spec("gsplat") is None:
        return f"needs gsplat; {install_command('gpu')}"
    return None


def refuse(inputs: Inputs) -> None:
    """Raise ValueError where gsplat would compute something else than was asked for."""
    if inputs.depth != "center":
        raise ValueError(
            f"depth: got {inputs.depth!r}, but gsplat knows the depth of a splat's centre only; "
            "pass depth='center', or use backend 'cpu'"
        )
    skew = float(inputs.K[0, 1])
    if skew != 0:
        raise ValueError(
            f"camera: K[0, 1], its skew, is {skew:.6g}, but gsplat reads only fx, fy, cx and cy of"
            " K; use backend 'cpu', or a camera with K[0, 1] = 0 if the skew is rounding"
        )
    if inputs.kind == "2d" and os.environ.get(ACCEPT_2D) != "1":
        raise ValueError(
            "backend: gsplat cuts 2D splats off by a box that is too small in perspective; use"
            f" backend 'cpu', or set {ACCEPT_2D}=1 to accept it (attnwarp.render.cuda says what it"
            " costs)"
        )


def render(inputs: Inputs) -> Outputs:
    """Render with gsplat; see :func:`attnwarp.render.render`.

    Raises:
        ValueError: something was asked for that gsplat computes differently.
        RuntimeError: no GPU, or no gsplat.
    """
    refuse(inputs)
    reason = reason_not()
    if reason is not None:
        raise RuntimeError(f"backend: 'cuda' {reason}; or use backend 'cpu'")
    return composite(inputs, rasterize)


def composite(inputs: Inputs, rasterizer: object) -> Outputs:
    """The outputs, from a rasterizer that composites features: (inputs, (N, F) features) -> (H, W,
    F) sums, (H, W) alpha."""
    assert callable(rasterizer)
    means = inputs.means
    R, t = inputs.pose[:3, :3], inputs.pose[:3, 3]
    # The camera is subtracted in float64, whatever the splats' own precision.
    centers = means.double() @ R.T.to(means.device) + (R @ inputs.origin + t).to(means.device)
    z = centers[:, 2].clamp(min=inputs.near)
    axis = (
        torch.full((len(means),), 2, device=means.device)
        if inputs.kind == "2d"
        else inputs.scales.argmin(dim=-1)
    )
    world = reference.rotation_matrices(inputs.quats).gather(
        2, axis[:, None, None].expand(-1, 3, 1)
    )[..., 0]
    facing = (world.double() * (centers @ R.to(means.device))).sum(-1)
    normals = world * torch.where(facing > 0, -1.0, 1.0).to(world.dtype)[:, None]
    if inputs.harmonic:
        direction = torch.nn.functional.normalize(centers @ R.to(means.device), dim=-1)
        colors = harmonics.color(inputs.values, direction.to(inputs.values.dtype))
    else:
        colors = inputs.values
    # A channel of ones: its gradient in the splats is their weight.
    ones = torch.ones(len(means), 1, device=means.device, requires_grad=True)
    inverse = 1 / z
    geometry = torch.stack([z, inverse, inverse * inverse], dim=-1)
    wanted = torch.is_grad_enabled()
    with torch.enable_grad():  # the weights are a gradient, whether or not the caller wants any
        features = torch.cat([colors.float(), normals.float(), geometry.float(), ones], dim=-1)
        sums, alpha = rasterizer(inputs, features)
        (weight,) = torch.autograd.grad(sums[..., -1].sum(), ones, retain_graph=wanted)
    if not wanted:
        sums, alpha = sums.detach(), alpha.detach()
    c = inputs.channels
    drawn = alpha.detach() > 0
    safe = torch.where(drawn, alpha, 1.0)
    nan = torch.full_like(alpha, torch.nan)
    near, far = inputs.ndc
    scale = (far * near / (far - near)) ** 2
    color = sums[..., :c] + (1 - alpha)[..., None] * inputs.background.to(sums.dtype)
    return Outputs(
        color=color,
        alpha=alpha,
        depth=torch.where(drawn, sums[..., c + 3] / safe, nan),
        median_depth=nan,
        normal=sums[..., c : c + 3],
        distortion_ordered=nan.clone(),
        distortion_l2_ndc=scale * (alpha * sums[..., c + 5] - sums[..., c + 4] ** 2).clamp(min=0),
        weight=weight[:, 0],
        counters={"splats": len(means)},
        exact=nan.clone,
    )


def rasterize(inputs: Inputs, features: Tensor) -> tuple[Tensor, Tensor]:
    """Composite (N, F) features with gsplat's CUDA kernels: (H, W, F) and (H, W)."""
    from gsplat import rasterization, rasterization_2dgs

    device = inputs.means.device
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = inputs.pose[:3, :3]
    view[:3, 3] = inputs.pose[:3, :3] @ inputs.origin + inputs.pose[:3, 3]
    common = {
        "means": inputs.means.float(),
        "quats": inputs.quats.float(),
        "opacities": inputs.opacities.float(),
        "colors": features,
        "viewmats": view.float().to(device)[None],
        "Ks": inputs.K.float().to(device)[None],
        "width": inputs.width,
        "height": inputs.height,
        "near_plane": inputs.near,
    }
    if inputs.kind == "3d":
        mode = "antialiased" if inputs.antialiased else "classic"
        pictures, alphas, _ = rasterization(
            scales=inputs.scales.float(), rasterize_mode=mode, eps2d=inputs.screen_filter, **common
        )
    else:
        flat = torch.cat(
            [inputs.scales.float(), torch.ones_like(inputs.scales[:, :1]).float()], dim=1
        )
        pictures, alphas, *_ = rasterization_2dgs(scales=flat, **common)
    return pictures[0], alphas[0, ..., 0]
