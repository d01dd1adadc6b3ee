"""Edit PSNR without a fit's hours: only splats' colours are fitted to the edited pictures.

A paper's Edit PSNR compares edited pictures with renders of the scene that was tuned on them. Here
shapes stay and a splat has one colour for all views. The best colours are then the solution of a
linear least squares problem, whose residual no such scene can show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from attnwarp_eval.metrics._pictures import picture
from attnwarp_eval.metrics.image import psnr_of_mse

if TYPE_CHECKING:
    import torch

    from attnwarp.camera import Camera
    from attnwarp.gaussians import Gaussians

ITERATIONS = 10
"""Steps of conjugate gradients. After these, pictures that splats can represent have only a
resolution error left."""


def refit_psnr(
    splats: Gaussians, cameras: Sequence[Camera], sets: Sequence[Sequence[Any]]
) -> list[float]:
    """Compute the Edit PSNR of sets of pictures, each against splats with colours fitted to it.

    Uncovered parts of a pixel show the picture. Higher is better, in
    dB; the PSNR is that of the mean squared error over all pictures of a set.

    Args:
        splats: splats of the scene; their colours are ignored.
        cameras: cameras of the V views.
        sets: V pictures each, (H, W, 3) sRGB in [0, 1] of their cameras' sizes. All sets are
            fitted at once, in little more time than one.

    Raises:
        ValueError: a set with a wrong number of pictures, or a picture that is not sRGB in [0, 1]
            or has another size than its camera.

    Example:
        >>> import numpy as np, torch
        >>> from attnwarp import Camera, Gaussians
        >>> from attnwarp_lab.probes.audit.refit import refit_psnr
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 9.0), torch.ones(1), torch.zeros(1, 1, 3))
        >>> view = dict(width=16, height=16, fov_y=40, up=(0, 1, 0))
        >>> cameras = [Camera.look_at((x, 0, 3), (0, 0, 0), **view) for x in (0, 1)]
        >>> grey, darker = np.full((16, 16, 3), 0.5), np.full((16, 16, 3), 0.3)
        >>> one = refit_psnr(disc, cameras, [(grey, darker)])[0]
        >>> round(one)  # the disc takes their mean, 0.4
        20
    """
    import torch

    from attnwarp.render import render

    shapes = [(camera.height, camera.width, 3) for camera in cameras]
    stacks = []
    for place, pictures in enumerate(sets):
        if len(pictures) != len(cameras):
            raise ValueError(
                f"sets[{place}]: got {len(pictures)} pictures, expected {len(cameras)}, one a"
                " camera"
            )
        stacks.append(
            [
                picture(one, f"sets[{place}][{view}]", shape=shape)
                for view, (one, shape) in enumerate(zip(pictures, shapes, strict=True))
            ]
        )
    if not stacks:
        return []
    count = 3 * len(stacks)
    values = torch.zeros(
        len(splats), count, dtype=torch.float32, device=splats.means.device, requires_grad=True
    )
    with torch.enable_grad():
        views = [render(splats, camera, features=values) for camera in cameras]
    covered = [view.alpha.detach()[..., None] for view in views]
    wanted = [
        torch.from_numpy(np.concatenate([one[view] for one in stacks], axis=-1)).to(alpha) * alpha
        for view, alpha in enumerate(covered)
    ]

    def shown(colors: torch.Tensor) -> list[torch.Tensor]:
        with torch.no_grad():
            return [render(splats, camera, features=colors).color for camera in cameras]

    def gathered(pictures: Sequence[torch.Tensor]) -> torch.Tensor:
        # Renders are linear in colours: the gradient is their transpose, for any colours.
        (sums,) = torch.autograd.grad(
            [view.color for view in views], values, list(pictures), retain_graph=True
        )
        return sums

    weight = gathered([alpha.expand(*alpha.shape[:2], count) for alpha in covered])
    scale = torch.where(weight > 0, 1 / weight.clamp_min(1e-12), 0.0)
    colors = scale * gathered(wanted)
    left = [w - s for w, s in zip(wanted, shown(colors), strict=True)]
    residual = gathered(left)
    step = scaled = scale * residual
    power = (residual * scaled).sum(0)
    for _ in range(ITERATIONS):
        moved = shown(step)
        length = torch.stack([(one**2).sum((0, 1)) for one in moved]).sum(0)
        stride = torch.where(length > 0, power / length.clamp_min(1e-30), 0.0)
        colors = colors + stride * step
        left = [one - stride * change for one, change in zip(left, moved, strict=True)]
        residual = gathered(left)
        scaled = scale * residual
        former, power = power, (residual * scaled).sum(0)
        step = scaled + torch.where(former > 0, power / former.clamp_min(1e-30), 0.0) * step
    squares = torch.stack([(one.double() ** 2).sum((0, 1)) for one in left]).sum(0).cpu().numpy()
    pixels = 3 * sum(height * width for height, width, _ in shapes)
    return [psnr_of_mse(float(s) / pixels) for s in squares.reshape(-1, 3).sum(1)]
