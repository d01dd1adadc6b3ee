"""Recipe of the bundled editors: a picture and an instruction in, the edited picture out.

The network is in :mod:`training.editors.net`. Its stages can be stopped, gone on with, and started from another's result.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tokenizers import Tokenizer

from attnwarp.editing.small_unet import OPEN, SETTLED
from attnwarp.errors import InputError
from attnwarp_eval.drawn import assemblies
from attnwarp_eval.drawn.worlds import OBJECTS
from training import steps
from training.editors import draws as editor_draws
from training.editors import net as editor_net
from training.editors import pool as editor_pool
from training.editors.byte_pairs import learn_byte_pairs, tokens_of
from training.editors.net import (
    SHIFT,
    TOKENS,
    VOCABULARY,
    EditorNet,
    draw_steps,
    loss_of,
    noised,
    scheduler,
)
from training.editors.pool import Batch, PairPool
from training.steps import Task, train_steps
from training.worlds.editing_pairs import (
    AMBIGUOUS,
    GROUPS,
    PAIR_SPLITS,
    PAIRS_PROTOCOL,
    PARTS,
    ambiguous_instruction,
    edit_looks,
    instruction,
    load_mixed,
)

Tensor = torch.Tensor

DROP = 0.05
"""Probability that the text, the picture or both are left out, each."""
UNCLEAR = 0.35
"""Share of pairs whose instruction leaves the answer to the noise."""
KINDS = {"color": 0.45, "material": 0.15, "pattern": 0.05, "ground": 0.2, "time": 0.15}

NET_CONSTANTS = (
    "WIDTHS", "LAYERS", "HEADS", "TEXT_WIDTH", "TEXT_LAYERS", "VOCABULARY", "TOKENS", "T_STEPS", "NOISY_SHARE",
    "MOST_WEIGHT",
)  # fmt: skip
"""Constants that every stage's result depends on, of :mod:`training.editors.net`."""


@dataclass(frozen=True)
class Stage:
    """A part of the training, which can be stopped, gone on with, and started from another's result.

    Attributes:
        size: size of the pictures in px; latents have a quarter of it.
        peak: learning rate, which falls over the last 30 %.
        worlds: how many of the training worlds of one thing each are used.
        parts: how many of those of things with parts (:mod:`attnwarp_eval.drawn.assemblies`).
        start: the stage whose networks this one starts from.
        batch: pictures of ``size`` in a step; there are a quarter as many large ones.
        unclear: share of pairs whose instruction leaves the answer to the noise.
        draws: whether the noise's mean adds to the text (:class:`attnwarp.editing.small_unet.EditUNet`).
        noisy_from: :data:`training.editors.net.NOISY_SHARE` of the steps are drawn from here on.
        composed: share of the open pairs at settled steps whose result has one answer in a region and another
            outside it. Without them the network takes a thing to have one colour, and its late steps undo
            an answer that holds in a part only.
        large: share of the steps on pictures of twice that size, a quarter as many at a time.
    """

    size: int
    steps: int
    peak: float
    worlds: int
    start: str | None = None
    batch: int = 256
    seed: int = 0
    parts: int = 0
    unclear: float = UNCLEAR
    draws: bool = True
    shift: float = SHIFT
    noisy_from: int = 850
    composed: float = 0.0
    large: float = 0.0


STAGES = {
    "plain": Stage(64, 11_500, 1.5e-3, 1800, parts=1190, draws=False, large=0.2, seed=11),
    "drawn": Stage(64, 12_000, 1.2e-3, 1800, parts=1190, start="plain", composed=0.7, large=0.25, seed=12),
}  # fmt: skip
"""``small-plain`` is "drawn"."""


def make_tokenizer(count: int = 80_000, worlds: int = 200) -> Tokenizer:
    """Byte pairs learned from instructions: any text can be written with it, words of the worlds in a token or two."""
    rng = np.random.default_rng(20)
    split = PAIR_SPLITS["edit-train"]
    corpus = []
    drawn = [edit_looks(k, split)[0] for k in range(worlds)]
    things = len(OBJECTS) + len(assemblies.KINDS) * len(PARTS)
    for k in range(count):
        looks, thing = drawn[k % worlds], k % things
        kind = list(KINDS)[int(rng.integers(len(KINDS)))]
        look = looks[int(rng.choice(list(GROUPS[kind])))]
        row = np.array([look.finish, look.color, look.second, look.ground, look.time])
        corpus.append(instruction(kind, thing, row, rng))
        if kind in AMBIGUOUS:
            corpus.append(ambiguous_instruction(kind, thing, rng))
    return learn_byte_pairs(corpus, vocabulary=VOCABULARY, length=TOKENS)


def dropped(batch: Batch, empty: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The conditions, left out at random: (before, tokens)."""
    draw = torch.rand(len(batch.t), generator=generator, device=generator.device)
    no_text = (draw < DROP) | ((draw >= 2 * DROP) & (draw < 3 * DROP))
    no_picture = (draw >= DROP) & (draw < 3 * DROP)
    before = torch.where(no_picture[:, None, None, None], 0.0, batch.before)
    return before, torch.where(no_text[:, None], empty, batch.tokens)


def constants() -> dict[str, Any]:
    """Constants that every stage's result depends on, by name."""
    own = {"DROP": DROP, "UNCLEAR": UNCLEAR, "KINDS": KINDS}
    return own | {key: getattr(editor_net, key) for key in NET_CONSTANTS}


def recipe_of(name: str, stage: Stage) -> dict[str, Any]:
    """Everything that a stage's result depends on; a checkpoint of another recipe is not gone on with."""
    of_stages = constants() | steps.constants()
    names = ("SENTENCES", "POINTS", "THING_WEIGHT", "MOST_THING_WEIGHT", "HALF_PLANES")
    of_stages |= {key: getattr(editor_pool, key) for key in names}
    if stage.draws:
        of_stages |= {key: getattr(editor_draws, key) for key in ("DRAW_STEPS", "DRAW_GAIN")}
        of_stages["SETTLED"], of_stages["OPEN"] = SETTLED, OPEN
    return {"stage": name, **asdict(stage), "constants": of_stages, "pairs": PAIRS_PROTOCOL}


def tokenizer_of(out: Path) -> Tokenizer:
    """The tokenizer of a folder of checkpoints, made where it is missing."""
    path = out / "tokenizer.json"
    if not path.exists():
        out.mkdir(parents=True, exist_ok=True)
        make_tokenizer().save(str(path))
    return Tokenizer.from_file(str(path))


def pool_of(stage: Stage, data: Path, tokenizer: Tokenizer, device: torch.device | str) -> PairPool:
    """The pictures and sentences that a stage is trained on; pictures are rendered where they are missing."""
    counts: dict[str, int | None] = {"edit-train": stage.worlds}
    if stage.parts:
        counts["parts-train"] = stage.parts
    return PairPool(load_mixed(data, counts), tokenizer, device)


def train_stage(
    name: str, data: Path, out: Path, *, stage: Stage | None = None, threads: int = 1, device: torch.device | str = "cpu",
    pool: PairPool | None = None,
) -> Path:  # fmt: skip
    """Train a stage, or go on with it; the checkpoint's path."""
    stage = STAGES[name] if stage is None else stage
    device = torch.device(device)
    torch.set_num_threads(threads)
    torch.manual_seed(stage.seed)
    tokenizer = tokenizer_of(out)
    pool = pool_of(stage, data, tokenizer, device) if pool is None else pool
    net = EditorNet(tokenizer.get_vocab_size(), stage.size, draws=stage.draws)
    if stage.start is not None:
        weights = weights_of(out, stage.start)
        begins = stage.draws and not any(k.startswith("unet.draw.") for k in weights)
        if begins:
            weights |= {k: v for k, v in net.state_dict().items() if k.startswith("unet.draw.")}
        net.load_state_dict(weights)
        if begins and not (out / f"{name}.pt").exists():
            editor_draws.teach_draws(net, tokenizer, pool.worlds, seed=stage.seed)
    net.to(device)
    alphas = scheduler(stage.shift).alphas_cumprod.to(device)
    empty = tokens_of(tokenizer, [""])[0].to(device)
    checkpoint = out / f"{name}.pt"
    tasks = tasks_of(stage, pool, net, alphas, empty)
    train_steps(net, stage, tasks, checkpoint, recipe_of(name, stage), device)
    return checkpoint


def weights_of(out: Path, stage: str) -> dict[str, Tensor]:
    """The averaged weights that a stage ended with.

    Raises:
        InputError: it was not trained.
    """
    path = out / f"{stage}.pt"
    if not path.exists():
        raise InputError(f"{path}: no such file; train the stage {stage} first")
    stored = torch.load(path, weights_only=True, map_location="cpu")["average"]
    return {k.removeprefix("module."): v for k, v in stored.items() if k != "n_averaged"}


def tasks_of(
    stage: Stage, pool: PairPool, net: EditorNet, alphas: Tensor, empty: Tensor
) -> list[Task]:
    """Tasks of a stage's steps: small pictures or large ones."""
    tasks = []
    for size, share in ((stage.size, 1 - stage.large), (2 * stage.size, stage.large)):
        if share == 0:
            continue
        count = max(2, stage.batch // (size // stage.size) ** 2)
        draw = functools.partial(plain_inputs, pool, stage, alphas, empty, size)
        tasks.append(Task(share, count, draw, functools.partial(plain_loss, net)))
    return tasks


def plain_inputs(
    pool: PairPool, stage: Stage, alphas: Tensor, empty: Tensor, size: int, count: int, generator: torch.Generator
) -> dict[str, Tensor]:  # fmt: skip
    """Pairs as the network gets them, with their targets."""
    t = draw_steps(count, generator, stage.noisy_from)
    batch = pool.batch(
        count, generator, size=size, t=t, kinds=KINDS, unclear=stage.unclear, composed=stage.composed
    )  # fmt: skip
    before, tokens = dropped(batch, empty, generator)
    a = alphas[t]
    return {
        "noisy": noised(batch.after, batch.noise, a), "before": before, "t": t, "tokens": tokens, "target": batch.after,
        "weight": batch.weight, "alpha": a, "source": batch.before,
    }  # fmt: skip


def plain_loss(net: EditorNet, x: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of :func:`plain_inputs`, and that of an unchanged picture beside it: the same means nothing is edited."""
    prediction = net(x["noisy"], x["before"], x["t"], x["tokens"])
    loss = loss_of(prediction, x["target"], x["weight"], x["alpha"])
    nothing = loss_of(x["source"], x["target"], x["weight"], x["alpha"])
    return loss, {"loss": loss.detach(), "unedited": nothing}
