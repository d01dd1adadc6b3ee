"""Teach an editor which answer its noise draws, before the networks learn the rest together.

The edited picture alone taught a network nothing of it in 24,000 steps: the mean of the noise is a faint signal. But the
text encoder knows how "make it red" differs from "change its color", and that difference, added to the text's tokens, makes
a trained editor answer red. So the layers that see the noise first learn these differences.
"""

from __future__ import annotations

import numpy as np
import torch
from tokenizers import Tokenizer
from torch import Tensor

from attnwarp.editing.latents import CHANNELS
from training.editors.answers import codes
from training.editors.byte_pairs import tokens_of
from training.editors.net import TOKENS, EditorNet
from training.worlds.editing_pairs import (
    AMBIGUOUS,
    GROUPS,
    LOOKS,
    Worlds,
    ambiguous_instruction,
    instruction,
)

DRAW_STEPS = 3_000
"""Steps of training for the layers alone."""

DRAW_GAIN = 12.0
"""By how much, at first, a noise's nearness to an answer's direction counts: the nearest gets nearly all."""

BATCH = 512
TEXTS = 200
"""Sentences of each kind and each answer."""

ALIGNED = TOKENS - 10
"""From here on nearly every sentence has ended, so tokens stand for the same."""


def _states(net: EditorNet, tokenizer: Tokenizer, texts: list[str]) -> Tensor:
    with torch.no_grad():
        return net.text(tokens_of(tokenizer, texts)).last_hidden_state


def differences(
    net: EditorNet, tokenizer: Tokenizer, worlds: Worlds, rng: np.random.Generator
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Differences of a clear sentence from an open one.

    Returns:
        (TEXTS, D) last tokens of open sentences, by kind; (N, D) of clear ones and of none;
        (LOOKS, D) difference of each answer of an open kind, 0 for the others.
    """
    opened, clear = {}, [_states(net, tokenizer, [""])[:, -1]]
    shifts: Tensor | None = None
    for kind in AMBIGUOUS:
        texts = [ambiguous_instruction(kind, _thing(worlds, rng), rng) for _ in range(TEXTS)]
        states = _states(net, tokenizer, texts)
        opened[kind] = states[:, -1]
        base = states[:, ALIGNED:].mean(dim=(0, 1))
        shifts = torch.zeros((LOOKS, len(base))) if shifts is None else shifts
        for look in GROUPS[kind]:
            having = np.flatnonzero(worlds.valid[:, look])
            if not len(having):
                continue
            texts = []
            for _ in range(TEXTS):
                world = int(rng.choice(having))
                words = instruction(kind, _thing(worlds, rng), worlds.looks[world, look], rng)
                texts.append(words)
            states = _states(net, tokenizer, texts)
            clear.append(states[:, -1])
            shifts[look] = states[:, ALIGNED:].mean(dim=(0, 1)) - base
    assert shifts is not None
    return opened, torch.cat(clear), shifts


def _thing(worlds: Worlds, rng: np.random.Generator) -> int:
    return int(worlds.things[int(rng.integers(len(worlds)))])


def teach_draws(
    net: EditorNet, tokenizer: Tokenizer, worlds: Worlds, *, seed: int, steps: int = DRAW_STEPS
) -> float:
    """Fit ``net.unet.draw`` to the differences of the answers that noises pick; the last losses' mean.

    An open sentence gets the difference of the answer whose direction is nearest to the noise's mean
    (:func:`training.editors.answers.settled`), a clear one and none get 0.
    """
    rng = np.random.default_rng([seed, 1])
    generator = torch.Generator().manual_seed(seed)
    opened, clear, shifts = differences(net, tokenizer, worlds, rng)
    draw, directions = net.unet.draw, codes()
    with torch.no_grad():  # the first answers are those that noises pick
        draw[0].weight[:, :CHANNELS] = 0
        draw[0].weight[:LOOKS, :CHANNELS] = DRAW_GAIN * directions
        draw[2].weight[:, :LOOKS] = shifts.T
    optimizer = torch.optim.AdamW(draw.parameters(), lr=5e-3, weight_decay=0.0)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    kinds, losses = list(AMBIGUOUS), []
    for step in range(steps):
        kind = kinds[step % len(kinds)]
        mean = torch.randn((BATCH, CHANNELS), generator=generator)
        group = list(GROUPS[kind])
        best = torch.tensor(group)[(mean @ directions[group].T).argmax(dim=1)]
        target = shifts[best]
        text = opened[kind][torch.randint(TEXTS, (BATCH,), generator=generator)]
        settled = torch.arange(BATCH) < BATCH // 4
        other = clear[torch.randint(len(clear), (BATCH,), generator=generator)]
        text = torch.where(settled[:, None], other, text)
        target = torch.where(settled[:, None], 0.0, target)
        loss = (draw(torch.cat([mean, text], dim=1)) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        falling.step()
        losses.append(float(loss.detach()))
    return float(np.mean(losses[-100:]))
