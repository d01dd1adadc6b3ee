"""Share of signal of the ideal editor: solved from the step at which answers settle, and checked.

A part's evidence grows with its pixels, so one schedule settles large parts at once and small ones
never. The share is solved from a target: the share of the steps after which answers settle.

A view edited alone moves in the span of its parts' changes: with r = x - sqrt(a) z_0 and the Gram
matrices G_kl = sum over the part's tokens of <D_k, D_l>, the K numbers y_k = <r, D_k> of a part
decide its evidence, y_k - a / 2 G_kk over 1 - a, and a DDIM step takes them to

y'_k = sqrt(a') (G w)_k + sqrt((1 - a') / (1 - a)) (y_k - sqrt(a) (G w)_k).

From pure noise y is N(0, G). So thousands of edits take a moment, for pictures of any size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.optimize import brentq
from torch import Tensor

from attnwarp.editing.schedule import PUBLISHED_STEPS, following, steps_from
from attnwarp_lab.ideal.editor import Answers, IdealUNet, schedule

DRAWS = 200
"""Number of edits of each view alone."""

HELD = 0.5
"""Posterior weight above which an answer counts as settled."""

SHARES = (1e-5, 1e4)
"""Range of shares of signal searched."""

FREQUENCY, AGREEMENT = 0.5, 0.25
"""Largest relative distance of an answer's frequency from 1/K, and of agreement from 1/K. Four
answers at the limit of the first (3/8, 3/8, 1/8, 1/8) agree by chance at that of the second."""


@dataclass(frozen=True)
class Alone:
    """Statistics of views edited alone, with separate noise.

    Attributes:
        settled: mean over views and parts of the share of steps before the final answer holds.
        frequencies: frequency of each answer.
        agreement: share of (view, part) with the first view's answer, among parts of both.
    """

    settled: float
    frequencies: tuple[float, ...]
    agreement: float

    def fault(self) -> str | None:
        """Reason why the editor is not ideal, in words; None if it is ideal.

        Example:
            >>> Alone(0.4, (0.25, 0.26, 0.24, 0.25), 0.26).fault() is None
            True
            >>> Alone(0.1, (0.9, 0.1, 0.0, 0.0), 0.82).fault()
            'alone, answers come in 90 %, 10 %, 0 %, 0 % of cases, expected 25 % of each'
        """
        chance = 1 / len(self.frequencies)
        if max(abs(f / chance - 1) for f in self.frequencies) > FREQUENCY:
            came = ", ".join(f"{100 * f:.0f} %" for f in self.frequencies)
            return f"alone, answers come in {came} of cases, expected {100 * chance:.0f} % of each"
        if abs(self.agreement / chance - 1) > AGREEMENT:
            return (
                f"alone, views agree in {100 * self.agreement:.0f} % of parts, expected"
                f" {100 * chance:.0f} %, as chance has it"
            )
        return None


@dataclass(frozen=True, eq=False)
class Grams:
    """Gram matrices of the parts of some views.

    Attributes:
        matrices: (N, K, K) float64 of each part that a view shows.
        view, part: (N,) the view's number and the part.
        row, answer: (M,) and (M, K): what is counted, such as several places of one part. Each is
            of one of the N parts, and each of the part's answers stands for one of its own answers,
            from 0. ``view`` and ``part`` are then (M,). None counts the parts and their answers.
    """

    matrices: Tensor
    view: npt.NDArray[np.int64]
    part: npt.NDArray[np.int64]
    row: Tensor | None = None
    answer: Tensor | None = None

    def counted(self, weights: Tensor) -> Tensor:
        """(T, M, R, A) weights of what is counted, of (T, N, R, K) weights of the parts."""
        if self.row is None or self.answer is None:
            return weights
        index = self.answer[None, :, None].expand(len(weights), -1, weights.shape[2], -1)
        sums = weights.new_zeros(*index.shape[:3], int(self.answer.max()) + 1)
        return sums.scatter_add(3, index, weights[:, self.row])

    @classmethod
    def of(cls, views: Sequence[Answers]) -> Grams:
        """Compute the matrices of views with their answers."""
        net = IdealUNet(views, schedule().alphas)
        matrices, view, part = [], [], []
        for number, (change, parts) in enumerate(zip(net.change, net.parts, strict=True)):
            for p in parts.unique().tolist():
                if p >= 0:
                    own = change[:, parts == p].flatten(1).double()
                    matrices.append(own @ own.T)
                    view.append(number)
                    part.append(p)
        if not matrices:
            raise ValueError("views: no token shows a part of the thing; take larger pictures")
        return cls(torch.stack(matrices), np.array(view), np.array(part))


def edit_alone(grams: Grams, start: Tensor, share: float, steps: int) -> Tensor:
    """(T, N, R, K) posterior weights at each step of views that are edited alone.

    Args:
        grams: Gram matrices of the parts.
        start: (N, R, K) <noise, D_k> of each part and draw.
        share: share of signal.
        steps: T.
    """
    alphas, G, y = schedule(share).alphas.double(), grams.matrices, start.double()
    energy = torch.diagonal(G, dim1=1, dim2=2)[:, None]
    weights = []
    for now, then in following(steps_from(PUBLISHED_STEPS - 1, steps)):
        a, b = alphas[now], alphas.new_tensor(1.0) if then is None else alphas[then]
        w = torch.softmax((a.sqrt() * y - a / 2 * energy) / (1 - a), dim=-1)
        weights.append(w)
        toward = w @ G
        y = b.sqrt() * toward + ((1 - b) / (1 - a)).sqrt() * (y - a.sqrt() * toward)
    return torch.stack(weights)


def settling_steps(weights: Tensor) -> Tensor:
    """(N, R) number of steps before the final answer holds for good.

    Args:
        weights: (T, N, R, K).

    Example:
        >>> import torch
        >>> weights = torch.tensor([[0.5, 0.5], [0.9, 0.1], [0.3, 0.7], [0.1, 0.9]])
        >>> settling_steps(weights[:, None, None]).tolist()
        [[2]]
    """
    final = weights[-1].argmax(dim=-1)
    held = weights.gather(-1, final.expand(len(weights), *final.shape)[..., None])[..., 0] > HELD
    # Steps, counted from the end, for which the answer holds without a gap.
    return len(weights) - held.flip(0).long().cumprod(dim=0).sum(dim=0)


def _starts(grams: Grams, seed: int) -> Tensor:
    """(N, R, K) draws of N(0, G)."""
    values, vectors = torch.linalg.eigh(grams.matrices)
    root = vectors * values.clamp_min(0).sqrt()[:, None]
    generator = torch.Generator().manual_seed(seed)
    n, k, _ = root.shape
    white = torch.randn((n, DRAWS, k), generator=generator, dtype=torch.float64)
    return white @ root.transpose(1, 2)


def alone(grams: Grams, share: float, steps: int, seed: int = 1) -> Alone:
    """Edit views alone, each with fresh noise.

    Args:
        grams: Gram matrices of the parts; agreement is measured with the first view.
        share: share of signal.
        steps: number of steps of denoising.
        seed: seed of the noise.
    """
    weights = grams.counted(edit_alone(grams, _starts(grams, seed), share, steps))
    answers = weights[-1].argmax(dim=-1).numpy()
    count = weights.shape[-1]
    frequencies = np.bincount(answers.ravel(), minlength=count) / answers.size
    first = {int(p): k for k, p in enumerate(grams.part) if grams.view[k] == grams.view[0]}
    pairs = [
        answers[k] == answers[first[int(p)]]
        for k, p in enumerate(grams.part)
        if grams.view[k] != grams.view[0] and int(p) in first
    ]
    return Alone(
        float(settling_steps(weights).double().mean()) / steps,
        tuple(float(f) for f in frequencies),
        float(np.mean(pairs)) if pairs else 1 / count,
    )


def solve_share(grams: Grams, settled: float, steps: int) -> float:
    """Share of signal at which answers settle after a share of the steps.

    Args:
        grams: Gram matrices of the parts.
        settled: in (0, 1): mean over views and parts of the share of steps before the final answer
            holds.
        steps: number of steps of denoising.

    Raises:
        ValueError: answers cannot settle at that share; the message has the range.
    """

    def excess(log_share: float) -> float:
        return alone(grams, float(np.exp(log_share)), steps, seed=0).settled - settled

    low, high = np.log(SHARES)
    latest, earliest = excess(low) + settled, excess(high) + settled
    if not earliest < settled < latest:
        raise ValueError(
            f"settled: got {settled:g}, expected a number between {earliest:.2f} and {latest:.2f},"
            f" as answers settle with {steps} steps"
        )
    return float(np.exp(brentq(excess, low, high, xtol=1e-3)))
