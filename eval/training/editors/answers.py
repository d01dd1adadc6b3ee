"""Answer that a noise picks: directions of the noise's mean, one a look."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from attnwarp.editing.latents import CHANNELS
from training.worlds.editing_pairs import GROUPS, LOOKS

COARSE = 12
"""The first channels of the latents are means and coarse details (:func:`attnwarp.editing.latents.haar_basis`)."""

KIND_NAMES = tuple(GROUPS)
"""A kind's number in a batch is its place here."""


def codes() -> Tensor:
    """(LOOKS, 48) orthonormal directions, one an answer, in the channels of fine details.

    A picture's own mean there is nearly 0, so noise mixed with a picture still tells which it picks.
    Rows of the cosine transform, without the constant one.
    """
    fine = CHANNELS - COARSE
    k = torch.arange(1, LOOKS + 1, dtype=torch.float64)[:, None]
    c = torch.arange(fine, dtype=torch.float64)[None]
    rows = (2 / fine) ** 0.5 * torch.cos(math.pi * (c + 0.5) * k / fine)
    return torch.cat([torch.zeros((LOOKS, COARSE)), rows.float()], dim=1)


def membership() -> Tensor:
    """(kinds, LOOKS) bool: which looks are answers of a kind."""
    member = torch.zeros((len(KIND_NAMES), LOOKS), dtype=torch.bool)
    for k, name in enumerate(KIND_NAMES):
        member[k, list(GROUPS[name])] = True
    return member


def settled(noise: Tensor, answer: Tensor, kind: Tensor) -> Tensor:
    """White noise with the answer that it picks among a kind's exchanged for another.

    A noise picks the look whose direction is nearest to its mean over the picture. The two answers' shares of the mean
    change places, so that the result is white noise that picks ``answer``. A pick among the answers that a world
    happens to have would be a riddle: neither the noise nor the text tells which these are, and the best
    prediction of a riddle is a mixture of colours.

    Args:
        noise: (B, 48, h, w), white.
        answer: (B,) look to be picked.
        kind: (B,) place in :data:`KIND_NAMES`.
    """
    directions = codes().to(noise)
    mean = noise.mean(dim=(2, 3))
    scores = mean @ directions.T
    others = ~membership().to(noise.device)[kind]
    best = scores.masked_fill(others, -torch.inf).argmax(dim=1)
    share = scores.gather(1, best[:, None]) - scores.gather(1, answer[:, None])
    return noise + (share * (directions[answer] - directions[best]))[:, :, None, None]
