"""First stage of clip-small: linear heads name each attribute of a picture, to train the image tower.

In whole sentences, colour and ground nearly identify a picture of the batch, so shapes, which are
harder, are learned late. Here every picture of a batch has its own geometry. The heads are used in
training alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn import functional

from attnwarp.encoders.nets import ClipSmall
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, GROUNDS, OBJECTS, TIMES
from training.common import Run, channels_last, crops, descend, groups, rate, settings
from training.worlds.data import Pictures, load

SEED = 4
EPOCHS = 50
BATCH = 128
CROP = 80
SCALE = (0.5, 0.85)
"""Shares of a picture's side: the thing stands about the middle, and background costs time."""
PEAK = 2e-3
SCRAMBLED = 0.3
"""Share of pictures with scrambled colours, for which only the thing is a target: it must be
recognised in colours that training never shows it in."""
SMOOTHING = 0.05
KEPT = 200
"""Held-out worlds of "train-shapes": recipes are tuned on them, not on the test sets."""

Ints = npt.NDArray[np.int64]


class Heads(nn.Module):
    """A linear classifier per attribute, of the picture's features."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.counts = {
            0: len(OBJECTS),
            1: len(FINISHES),
            2: len(COLORS),
            4: len(GROUNDS),
            5: len(TIMES),
        }
        self.guess = nn.Linear(dim, sum(self.counts.values()))

    def scores(self, x: torch.Tensor) -> dict[int, torch.Tensor]:
        """(N, dim) features -> for each attribute's column, (N, words)."""
        parts = self.guess(x).float().split(list(self.counts.values()), dim=1)
        return dict(zip(self.counts, parts, strict=True))

    def forward(self, x: torch.Tensor, attributes: Ints) -> torch.Tensor:
        """Cross-entropy of (N, dim) features with the attributes (N, 6), mean over attributes;
        -1 is left out.
        """
        total = torch.zeros(())
        for column, scores in self.scores(x).items():
            labels = torch.from_numpy(attributes[:, column])
            if bool((labels >= 0).any()):
                loss = functional.cross_entropy(
                    scores, labels, ignore_index=-1, label_smoothing=SMOOTHING
                )
                total = total + (2 if column == 0 else 1) * loss
        return total / (len(self.counts) + 1)


@dataclass(frozen=True)
class Part:
    """A split, in the units that training draws.

    Attributes:
        views: for each view of each world, the rows of its looks.
        times: how often an epoch shows it.
    """

    pictures: Pictures
    views: list[Ints]
    times: int = 1


def pictures_of(data: Path) -> list[Part]:
    """All pictures that clip-small is trained on; Mitsuba's, which are few, four times each
    epoch."""
    parts = []
    for name, times in (
        ("train", 1),
        ("train-rendered", 4),
        ("train-moved", 1),
        ("train-shapes", 1),
    ):
        pictures = load(data, name)
        worlds = np.unique(pictures.world)
        held_out = (
            np.isin(pictures.world, worlds[-KEPT:])
            if name == "train-shapes"
            else np.zeros(len(pictures), bool)
        )
        keys = pictures.world * 8 + pictures.view
        order = np.flatnonzero(~held_out)
        order = order[np.argsort(keys[order], kind="stable")]
        views = list(np.split(order, np.flatnonzero(np.diff(keys[order])) + 1))
        parts.append(Part(pictures, views, times))
    return parts


def scrambled(
    images: torch.Tensor, which: npt.NDArray[np.bool_], rng: np.random.Generator
) -> torch.Tensor:
    """(N, 3, H, W) with the colours of ``which`` mixed at random, the same everywhere in a
    picture."""
    rows = np.flatnonzero(which)
    mix = rng.dirichlet([0.5, 0.5, 0.5], (len(rows), 3))
    mixed = torch.einsum("nij,njhw->nihw", torch.from_numpy(mix).float(), images[rows])
    out = images.clone()
    out[rows] = mixed
    return out


def warm_start(sets: list[Part], out: Path, *, epochs: int = EPOCHS) -> Path:
    """Train the image tower and the heads; the checkpoint's path, with the states ``vision``,
    ``norm`` and ``heads``.
    """
    torch.manual_seed(SEED)
    model = channels_last(ClipSmall(1))
    vision, pool = model.vision, model.pool
    heads = Heads(pool.project.in_features)
    optimizer = torch.optim.AdamW(
        [*groups(vision, 0.05), *groups(pool.norm, 0.0), *groups(heads, 0.05)], lr=PEAK
    )
    units = [
        (k, rows) for k, part in enumerate(sets) for rows in part.views for _ in range(part.times)
    ]
    each = len(units) // BATCH

    def epoch(number: int) -> dict[str, float]:
        rng = np.random.default_rng([SEED, number])
        order = rng.permutation(len(units))
        vision.train()
        total = 0.0
        for step in range(each):
            for group in optimizer.param_groups:
                group["lr"] = rate(number * each + step, epochs * each, PEAK, 200)
            chosen = [units[u] for u in order[step * BATCH : (step + 1) * BATCH]]
            drawn = [(sets[k].pictures, int(rows[rng.integers(len(rows))])) for k, rows in chosen]
            images = crops(np.stack([p.images[r] for p, r in drawn]), CROP, rng, scale=SCALE)
            attributes = np.stack([p.attributes[r] for p, r in drawn])
            is_scrambled = rng.uniform(size=BATCH) < SCRAMBLED
            images = scrambled(images, is_scrambled, rng)
            attributes[is_scrambled, 1:] = -1
            with torch.autocast("cpu", torch.bfloat16):
                loss = heads(pool.features(vision(images)[-1]), attributes)
            descend(optimizer, vision, loss)
            total += float(loss.detach())
        return {"heads": total / each}

    checkpoint = out / "clip-small-naming.pt"
    state = {"vision": vision, "norm": pool.norm, "heads": heads, "optimizer": optimizer}
    Run(checkpoint, state, epochs, recipe()).train(epoch)
    return checkpoint


def recipe() -> dict[str, Any]:
    """Settings and data that a checkpoint depends on."""
    return settings(globals(), "train", "train-rendered", "train-moved", "train-shapes")
