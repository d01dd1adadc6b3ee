"""Recipe of dino-small: self-distillation with multi-crop (Caron et al. 2021), without labels.

A student sees small crops and predicts the output of a teacher, its own moving average, for large
crops. The two large crops show one thing from two sides, so the network learns what both sides
share. Patches are trained too: a small crop's patches predict the teacher's patches at the same
place (a dense form of the same loss, as in Zhou et al. 2022 without masks).
"""

from __future__ import annotations

import copy
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn import functional

from attnwarp_eval.encoders.dino_small import DinoSmall
from training.common import Run, channels_last, groups, placed_crops, rate, settings
from training.worlds.data import Pictures, load

SEED = 2
EPOCHS = 20
BATCH = 96
PEAK = 1.2e-3
LARGE, SMALL = 96, 48
PROTOTYPES = 768
DENSE_PROTOTYPES = 192
STUDENT_TEMPERATURE, TEACHER_TEMPERATURE = 0.1, 0.04
CONTRAST = 1.0
"""Weight of the contrast between two views of a thing and those of the batch's other things. Without
it, accuracy among 64 things stops rising early: 48 % after two epochs, 49 % after five."""
SPREAD = 0.1
"""Weight of the term that keeps class tokens apart."""
DENSE = 0.5
"""Weight of the patches' loss beside the class token's."""

Tensor = torch.Tensor


class Head(nn.Module):
    """A projection to scores of prototypes, its last layer normalised, as in DINO."""

    def __init__(self, dim: int, hidden: int, count: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(dim, hidden), nn.GELU(), nn.Linear(hidden, 128))
        self.prototypes = nn.Parameter(torch.randn(count, 128) / 11)

    def forward(self, x: Tensor) -> Tensor:
        """(..., dim) -> (..., count)."""
        return (
            functional.normalize(self.mlp(x), dim=-1)
            @ functional.normalize(self.prototypes, dim=-1).T
        )


class Distiller(nn.Module):
    """A network with one head for the class token and one for patches."""

    def __init__(self) -> None:
        super().__init__()
        self.net = DinoSmall()
        self.head = Head(self.net.dim, 512, PROTOTYPES)
        self.dense = Head(self.net.dim, 256, DENSE_PROTOTYPES)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(N, 3, H, W) -> class scores (N, P), patch scores (N, P, h, w), class tokens (N, D)."""
        cls, patches = self.net(x)
        return self.head(cls), self.dense(patches.permute(0, 2, 3, 1)).permute(0, 3, 1, 2), cls


def balanced(scores: Tensor, rounds: int = 3) -> Tensor:
    """Centred and sharpened targets: every prototype is used equally over the batch, every row sums
    to one.

    Sinkhorn and Knopp's normalisation in place of a running centre (Caron et al. 2020, section 3.1;
    Oquab et al. 2023): in batches this small a running centre lags behind.

    Args:
        scores: (N, P) of the teacher.
        rounds: number of rounds of normalising columns, then rows.

    Returns:
        (N, P), rows that sum to 1.
    """
    q = torch.exp((scores - scores.max()) / TEACHER_TEMPERATURE)
    for _ in range(rounds):
        q = q / q.sum(dim=0, keepdim=True).clamp(min=1e-12)
        q = q / q.sum(dim=1, keepdim=True).clamp(min=1e-12)
    return q


def contrast(first: Tensor, second: Tensor) -> Tensor:
    """Cross-entropy of finding each thing's other view in the batch (van den Oord et al. 2018),
    both ways.

    Args:
        first, second: (N, D) class tokens of the two views.
    """
    logits = (
        functional.normalize(first.float(), dim=-1)
        @ functional.normalize(second.float(), dim=-1).T
        / STUDENT_TEMPERATURE
    )
    diagonal = torch.arange(len(first))
    return 0.5 * (
        functional.cross_entropy(logits, diagonal) + functional.cross_entropy(logits.T, diagonal)
    )


def spread(tokens: Tensor) -> Tensor:
    """Minus the mean logarithm of the distance to the nearest neighbour (Sablayrolles et al. 2019,
    KoLeo).
    """
    unit = functional.normalize(tokens.float(), dim=-1)
    near = (unit @ unit.T).fill_diagonal_(-1).max(dim=1).values
    return -torch.log((2 - 2 * near).clamp(min=1e-6).sqrt()).mean()


def places(inner: Tensor, outer: Tensor, size: int) -> Tensor:
    """Positions of the patches of one crop in another crop of the same picture.

    Args:
        inner, outer: (N, 2, 3) maps of the crops to the picture's [-1, 1].
        size: patches along a side of the inner crop.

    Returns:
        (N, size, size, 2) in the outer crop's [-1, 1]; outside of it where it does not reach.
    """
    grid = functional.affine_grid(inner, [len(inner), 1, size, size], align_corners=False)
    turn, shift = outer[:, :, :2], outer[:, None, None, :, 2]
    return torch.einsum("nij,nhwj->nhwi", torch.linalg.inv(turn), grid - shift)


def _views(pictures: Pictures) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
    """For every world and surface: the pictures from its first side, and from its second."""
    surface = pictures.attributes[:, 1:4]
    keys: dict[tuple[int, ...], tuple[list[int], list[int]]] = {}
    for row in range(len(pictures)):
        key = (int(pictures.world[row]), *(int(v) for v in surface[row]))
        keys.setdefault(key, ([], []))[int(pictures.view[row])].append(row)
    return [(np.array(a), np.array(b)) for a, b in keys.values()]


def train(data: Path, out: Path, *, epochs: int = EPOCHS) -> Path:
    """Train dino-small; the checkpoint's path."""
    torch.manual_seed(SEED)
    out.mkdir(parents=True, exist_ok=True)
    # Things that move from ground to ground teach that the ground is not the thing; they are the
    # larger half.
    sets = [load(data, "train-moved"), load(data, "train-shapes"), load(data, "train")]
    things = [(k, *views) for k, pictures in enumerate(sets) for views in _views(pictures)]
    student = channels_last(Distiller())
    teacher = copy.deepcopy(student)
    teacher.requires_grad_(False)
    optimizer = torch.optim.AdamW(groups(student, 0.05), lr=PEAK)
    each = len(things) // BATCH

    def epoch(number: int) -> dict[str, float]:
        rng = np.random.default_rng([SEED, number])
        order = rng.permutation(len(things))
        student.train()
        teacher.train()
        sums = np.zeros(4)
        for step in range(each):
            now = number * each + step
            for group in optimizer.param_groups:
                group["lr"] = rate(now, epochs * each, PEAK, 200)
            chosen = [things[k] for k in order[step * BATCH : (step + 1) * BATCH]]
            # Never the same look from both sides, where there are two: ground and light must not
            # tell things apart.
            drawn = [
                (sets[k].images, a[n % len(a)], b[(n + 1) % len(b)])
                for k, a, b in chosen
                for n in [int(rng.integers(2))]
            ]
            sides = [
                np.stack([images[a] for images, a, _ in drawn]),
                np.stack([images[b] for images, _, b in drawn]),
            ]
            large = [placed_crops(side, LARGE, rng, scale=(0.6, 1.0), tone=0.2) for side in sides]
            small = [placed_crops(side, SMALL, rng, scale=(0.25, 0.5), tone=0.2) for side in sides]
            with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
                t_cls, t_patch, _ = teacher(torch.cat([x for x, _ in large]))
            with torch.autocast("cpu", torch.bfloat16):
                s_large, _, tokens = student(torch.cat([x for x, _ in large]))
                s_small, s_small_patch, _ = student(torch.cat([x for x, _ in small]))
            # Each side is balanced by itself: a thing must be one of many on either.
            target = [balanced(t) for t in t_cls.float().chunk(2)]
            n, p, h, w = t_patch.shape
            flat = balanced(t_patch.float().permute(0, 2, 3, 1).reshape(-1, p))
            dense_target = flat.view(n, h, w, p).permute(0, 3, 1, 2).chunk(2)
            by_crop = [
                functional.log_softmax(s / STUDENT_TEMPERATURE, dim=1)
                for s in (*s_large.chunk(2), *s_small.chunk(2))
            ]
            terms = [
                -(t * s).sum(1).mean()
                for k, t in enumerate(target)
                for j, s in enumerate(by_crop)
                if j != k
            ]
            cls = torch.stack(terms).mean()
            dense_terms = []
            for side, scores in enumerate(s_small_patch.chunk(2)):
                positions = places(small[side][1], large[side][1], SMALL // DinoSmall.patch)
                inside = (positions.abs() <= 1).all(dim=-1)
                wanted = functional.grid_sample(dense_target[side], positions, align_corners=False)
                loss = -(
                    wanted * functional.log_softmax(scores.float() / STUDENT_TEMPERATURE, dim=1)
                ).sum(1)
                dense_terms.append((loss * inside).sum() / inside.sum().clamp(min=1))
            dense = torch.stack(dense_terms).mean()
            apart = torch.stack([spread(side) for side in tokens.chunk(2)]).mean()
            told_apart = contrast(*tokens.chunk(2))
            loss = cls + DENSE * dense + SPREAD * apart + CONTRAST * told_apart
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(student.parameters(), 2.0)
            if (
                number == 0
            ):  # the prototypes stand still at first, which keeps the start from collapsing
                student.head.prototypes.grad = student.dense.prototypes.grad = None
            optimizer.step()
            keep = 1 - 0.02 * (0.5 + 0.5 * math.cos(math.pi * now / (epochs * each)))
            with torch.no_grad():
                for teacher_parameter, student_parameter in zip(
                    teacher.parameters(), student.parameters(), strict=True
                ):
                    teacher_parameter.lerp_(student_parameter, 1 - keep)
            same = (target[0].argmax(1) == target[1].argmax(1)).float().mean()
            sums += [
                float(cls.detach()),
                float(dense.detach()),
                float(told_apart.detach()),
                float(same),
            ]
        return dict(
            zip(("class", "patches", "contrast", "same prototype"), sums / each, strict=True)
        )

    checkpoint = out / "dino-small.pt"
    recipe = settings(globals(), "train-moved", "train-shapes", "train")
    Run(
        checkpoint, {"student": student, "teacher": teacher, "optimizer": optimizer}, epochs, recipe
    ).train(epoch)
    return checkpoint
