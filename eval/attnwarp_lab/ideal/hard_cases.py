"""Hard cases of the ideal editor and of labels: nearly certain answers, parts of one token."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import partial

import mpmath
import numpy as np
import torch

from attnwarp_eval.stability.case import Bound, Way, ways
from attnwarp_eval.stability.case import hard as hard_of
from attnwarp_eval.stability.cases.metrics import against
from attnwarp_lab.ideal.editor import Answers, IdealUNet
from attnwarp_lab.ideal.labels import label_transport

hard = partial(hard_of, package=__package__)


def _visible_tokens(visible: float, way: Way) -> float:
    """Error of the shares of right, wrong and missing labels among a few visible tokens of 64."""
    tokens, seen = np.zeros((8, 8), np.int16), np.zeros((8, 8), bool)
    seen.ravel()[np.random.default_rng(0).permutation(64)[: int(visible)]] = True
    carried = (np.arange(64) % 3 - 2).astype(np.int16).reshape(8, 8)  # none, outside, right
    result = label_transport(carried, tokens, tokens, seen, ~seen)
    taken = [int(label) for label, shown in zip(carried.flat, seen.flat, strict=True) if shown]
    hidden = [int(label) for label, shown in zip(carried.flat, seen.flat, strict=True) if not shown]
    counted = {
        "right": (taken.count(0), taken),
        "wrong": (taken.count(-1), taken),
        "none": (taken.count(-2), taken),
        "painted_hidden": (hidden.count(0), hidden),
    }
    return max(
        against(float(Fraction(n, len(of))) if of else math.nan, result[f"labels.{name}"])
        for name, (n, of) in counted.items()
    )


def _ideal(tokens: int, alpha: float, way: Way) -> float:
    """Error of the ideal editor's picture, at an alpha-bar, for a part of some of 64 tokens."""
    random, answers = np.random.default_rng(int(tokens)), 3
    before = random.random((32, 32, 3)).astype(np.float32)
    after = random.random((answers, 32, 32, 3)).astype(np.float32)
    parts = np.full(64, -1)
    parts[random.permutation(64)[:tokens]] = 0
    view = Answers(before, after, parts.reshape(8, 8))
    a = torch.tensor([alpha], dtype=torch.float64).float()
    net = IdealUNet([view], a).to(way.dtype)
    z, change = net.before[0].double(), net.change[0].double()
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(z.shape, generator=generator, dtype=torch.float64)
    x = (a.double().sqrt() * (z + change[1]) + (1 - a.double()).sqrt() * noise).to(way.dtype)
    result = net(x.T.reshape(1, -1, 8, 8), 0, views=[0])[0].flatten(1).T.double()

    now, inside = mpmath.mpf(float(a)), parts >= 0
    with mpmath.workdps(40):
        root = mpmath.sqrt(now)
        logs = []
        for k in range(answers):
            # |x - sqrt(a) z_k|^2 but for what all answers share, from exact sums of products.
            d, rest = change[k][inside].flatten(), x[inside].double().flatten()
            fit = mpmath.fdot(d.tolist(), rest.tolist())
            own = mpmath.fdot(d.tolist(), z[inside].flatten().tolist())
            energy = mpmath.fdot(d.tolist(), d.tolist())
            logs.append((root * fit - now * own - now / 2 * energy) / (1 - now))
        weights = [mpmath.exp(value - max(logs)) for value in logs]
        shares = torch.tensor([float(w / sum(weights)) for w in weights], dtype=torch.float64)
    expected = z + torch.where(
        torch.from_numpy(inside)[:, None], torch.einsum("k,knc->nc", shares, change), 0.0
    )
    return float((result - expected).abs().max())


IDEAL = Bound("of 1", 1e-3, "a quarter of a step of an 8-bit picture is 1e-3")

CASES = [
    hard("ideal_alpha_bar", lambda alpha, way: _ideal(16, alpha, way), ways("ideal"), bounds=IDEAL),
    hard(
        "part_of_one_token",
        lambda tokens, way: _ideal(int(tokens), 0.01, way),
        ways("ideal"),
        bounds=IDEAL,
    ),
    hard(
        "visible_tokens",
        _visible_tokens,
        (Way("metrics"),),
        bounds=Bound("of 1", 1e-12, "a fraction of whole numbers"),
    ),
]
