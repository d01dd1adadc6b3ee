"""Likeness of a fit to its pictures, beside that of their own mean colours."""

from __future__ import annotations

import math

import numpy as np
import torch

from attnwarp.fit.settings import FitSettings
from attnwarp.fit.start import extent_of
from attnwarp.fit.views import Views
from attnwarp.gaussians import Gaussians
from attnwarp.render import render

LOOKS = 8
"""Largest number of views whose renders are compared with their pictures."""

EXPLAINED = 0.5
"""Least share of the pictures' variance that splats must explain to know the scene. Views that a
sound fit has not seen are 10 dB nearer to their renders than to their own mean colours, a share of
0.9; of wrong poses renders are blurs, little better than the mean colour, a share of 0."""


def beside_mean_color(gaussians: Gaussians, views: Views) -> tuple[float, float]:
    """Compute the PSNR in dB of renders, and of each picture's own mean colour in their place.

    What masks ignore is left out. At most :data:`LOOKS` views count, evenly spread.

    Example:
        >>> import numpy as np
        >>> from attnwarp.fit import Views
        >>> from attnwarp.fit.quality import beside_mean_color
        >>> from attnwarp.trial import disc, view
        >>> stripes = np.zeros((16, 16, 3))
        >>> stripes[:, ::2] = 1
        >>> _, plain = beside_mean_color(disc(), Views([view(side=16)], [stripes]))
        >>> round(plain, 2)  # a variance of 1/4
        6.02
    """
    near = FitSettings().near * extent_of(views.cameras, gaussians.world_means())
    black = torch.zeros(3, dtype=torch.float32, device=gaussians.means.device)
    chosen = np.unique(np.linspace(0, len(views) - 1, LOOKS).round().astype(int)).tolist()
    errors = np.zeros(2)
    for k in chosen:
        with torch.no_grad():
            color = render(gaussians, views.cameras[k], near=near).color
            shown = views.exposed(k, color).clamp(0, 1)
        target, kept = views.target(k, black), views.kept(k, black.device)
        mean = (target if kept is None else target[kept]).reshape(-1, 3).mean(0)
        errors += [views.error(k, picture, black) for picture in (shown, mean.expand_as(target))]
    psnr, plain = (-10 * math.log10(max(value / len(chosen), 1e-9)) for value in errors)
    return psnr, plain


def say_unlike(psnr: float, plain: float) -> str:
    """Write a sentence, without its full stop, if splats explain too little of the pictures; else
    an empty one.

    Args:
        psnr, plain: results of :func:`beside_mean_color`, in dB.

    Example:
        >>> from attnwarp.fit.quality import say_unlike
        >>> say_unlike(12.1, 11.0)[:62], say_unlike(24.0, 13.0)
        ('the splats hardly know the scene: their renders are 12.1 dB fr', '')
    """
    if psnr >= plain - 10 * math.log10(1 - EXPLAINED):
        return ""
    return (
        f"the splats hardly know the scene: their renders are {psnr:.1f} dB from the pictures,"
        f" whose own mean colours are {plain:.1f} dB from them; check that the cameras' poses"
        " belong to the pictures, and take more iterations or more pictures that overlap"
    )
