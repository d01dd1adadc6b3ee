"""Sixty discs about the origin, for tests of what is done with splats."""

import torch

from attnwarp import Gaussians


def few_splats():
    """Opaque enough to be seen, small, and of any colour; the same ones each time."""
    generator = torch.Generator().manual_seed(0)
    return Gaussians(
        "2d",
        torch.randn(60, 3, generator=generator) * 0.4,
        torch.nn.functional.normalize(torch.randn(60, 4, generator=generator), dim=1),
        torch.full((60, 2), 0.15),
        torch.full((60,), 0.9),
        torch.randn(60, 1, 3, generator=generator) * 0.5,
    )
