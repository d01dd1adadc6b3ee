"""Held-out PSNR of splats fitted to edited pictures, without a fit's hours.

Papers fit splats to most of the edited views, and compare renders with the others. Here shapes stay
and a splat has one colour for all views. The best colours are then the solution of a linear least
squares problem, found from the colours before the edit: a splat that no fitted view shows keeps its
own.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.metrics._pictures import picture
from attnwarp_eval.metrics.image import psnr_of_mse

if TYPE_CHECKING:
    import torch

    from attnwarp.camera import Camera
    from attnwarp.gaussians import Gaussians

ITERATIONS = 10
"""Steps of conjugate gradients. After these, pictures that splats can represent have only a
resolution error left."""


@dataclass(frozen=True, eq=False)
class Refit:
    """Splats with colours fitted to pictures, against them.

    Attributes:
        fitted: dB of renders and pictures in the fitted views; NaN without any.
        held_out: dB in the views held out; NaN without any.
        renders: by the number of a view held out, (H, W, 3) its render over its picture, in [0, 1].
    """

    fitted: float
    held_out: float
    renders: dict[int, npt.NDArray[np.float32]]


def refit(
    splats: Gaussians,
    cameras: Sequence[Camera],
    sets: Sequence[Sequence[Any]],
    held: Collection[int] = (),
) -> list[Refit]:
    """Fit splats' colours to sets of pictures, and compare renders with the pictures.

    Uncovered parts of a pixel show the picture. A PSNR is that of the mean squared error over all
    pixels of its views.

    Args:
        splats: splats of the scene before the edit.
        sets: V pictures each, (H, W, 3) sRGB in [0, 1] of their cameras' sizes. All sets are
            fitted at once, in little more time than one.
        held: numbers of the views that are held out from the fit.

    Raises:
        ValueError: a set with a wrong number of pictures, a picture that is not sRGB in [0, 1]
            or has another size than its camera, or no view to fit.

    Example:
        >>> import numpy as np, torch
        >>> from attnwarp import Camera, Gaussians
        >>> from attnwarp_eval.metrics.refit import refit
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 9.0), torch.ones(1), torch.zeros(1, 1, 3))
        >>> view = dict(width=16, height=16, fov_y=40, up=(0, 1, 0))
        >>> cameras = [Camera.look_at((x, 0, 3), (0, 0, 0), **view) for x in (0, 1)]
        >>> grey, darker = np.full((16, 16, 3), 0.5), np.full((16, 16, 3), 0.3)
        >>> round(refit(disc, cameras, [(grey, darker)])[0].fitted)  # the disc takes their mean
        20
        >>> round(refit(disc, cameras, [(grey, darker)], held=[1])[0].held_out)  # or the first
        14
    """
    import torch

    from attnwarp.gaussians import SH_C0
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
    kept = [view for view in range(len(cameras)) if view not in held]
    if not kept:
        raise ValueError("held: got every view, expected one to fit at least")
    count = 3 * len(stacks)
    values = torch.zeros(
        len(splats), count, dtype=torch.float32, device=splats.means.device, requires_grad=True
    )
    with torch.enable_grad():
        views = [render(splats, cameras[view], features=values) for view in kept]
    covered = [view.alpha.detach()[..., None] for view in views]

    def asked(view: int, alpha: torch.Tensor) -> torch.Tensor:
        given = np.concatenate([one[view] for one in stacks], axis=-1)
        return torch.from_numpy(given).to(alpha) * alpha

    wanted = [asked(view, alpha) for view, alpha in zip(kept, covered, strict=True)]

    def shown(colors: torch.Tensor) -> list[torch.Tensor]:
        with torch.no_grad():
            return [render(splats, cameras[view], features=colors).color for view in kept]

    def gathered(pictures: Sequence[torch.Tensor]) -> torch.Tensor:
        # Renders are linear in colours: the gradient is their transpose, for any colours.
        (sums,) = torch.autograd.grad(
            [view.color for view in views], values, list(pictures), retain_graph=True
        )
        return sums

    weight = gathered([alpha.expand(*alpha.shape[:2], count) for alpha in covered])
    scale = torch.where(weight > 0, 1 / weight.clamp_min(1e-12), 0.0)
    before = (0.5 + SH_C0 * splats.sh[:, 0]).to(values).repeat(1, len(stacks))
    colors = torch.where(weight > 0, scale * gathered(wanted), before)
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
    fitted = [_squares(one) for one in left]
    others: dict[int, tuple[npt.NDArray[Any], npt.NDArray[Any]]] = {}
    with torch.no_grad():
        for view in sorted(held):
            made = render(splats, cameras[view], features=colors)
            error = asked(view, made.alpha[..., None]) - made.color
            over = asked(view, torch.ones_like(made.alpha[..., None])) - error
            others[view] = _squares(error), over.clamp(0, 1).cpu().numpy()

    def psnr(views: Sequence[int], squares: Sequence[npt.NDArray[Any]], place: int) -> float:
        pixels = 3 * sum(shapes[view][0] * shapes[view][1] for view in views)
        return psnr_of_mse(float(sum(s[place] for s in squares)) / pixels) if views else np.nan

    return [
        Refit(
            psnr(kept, fitted, place),
            psnr(list(others), [squares for squares, _ in others.values()], place),
            {v: over[..., 3 * place : 3 * place + 3] for v, (_, over) in others.items()},
        )
        for place in range(len(stacks))
    ]


def _squares(error: torch.Tensor) -> npt.NDArray[np.float64]:
    """(S,) sums of squares over the pixels of each set."""
    each = (error.double() ** 2).sum((0, 1)).cpu().numpy()
    return np.asarray(each.reshape(-1, 3).sum(1))
