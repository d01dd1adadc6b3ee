"""Recipe of the bundled editors: a picture and an instruction in, the edited picture out.

A small InstructPix2Pix (Brooks et al. 2023) in diffusers' format: the picture before the edit is concatenated to the
noisy latents. It predicts the edited picture itself, from betas whose last step is pure noise (Lin et al. 2024,
"Common diffusion noise schedules and sample steps are flawed").
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tokenizers import Tokenizer

from attnwarp.editing.latents import BLOCK, CHANNELS
from attnwarp.editing.small_unet import OPEN, SETTLED, EditUNet
from attnwarp.errors import InputError
from training import assemblies, editor_pool, steps
from training.byte_pairs import learn_byte_pairs
from training.editing_pairs import (
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
from training.editor_pool import Batch, PairPool
from training.steps import Task, train_steps
from training.worlds import OBJECTS

Tensor = torch.Tensor

WIDTHS = (64, 128)
LAYERS = 1
HEADS = 4
TEXT_WIDTH = 128
TEXT_LAYERS = 2
VOCABULARY = 1500
TOKENS = 24

T_STEPS = 1000
NOISY_SHARE = 0.6
"""Share of the steps drawn from the noisier ones, where the answer is decided."""
MOST_WEIGHT = 5.0
SD_BETAS = (0.00085, 0.012)
"""Stable Diffusion's, first and last."""
SHIFT = 16.0
"""How many times the signal-to-noise amplitude of Stable Diffusion's is at a step, see :func:`scheduler`."""
DROP = 0.05
"""Probability that the text, the picture or both are left out, each."""
UNCLEAR = 0.35
"""Share of pairs whose instruction leaves the answer to the noise."""
KINDS = {"color": 0.45, "material": 0.15, "pattern": 0.05, "ground": 0.2, "time": 0.15}
INJECTED_SHARE = 0.7
"""Of the steps of a stage with injection; the others are plain."""

CONSTANTS = (
    "WIDTHS", "LAYERS", "HEADS", "TEXT_WIDTH", "TEXT_LAYERS", "VOCABULARY", "TOKENS", "T_STEPS", "NOISY_SHARE",
    "MOST_WEIGHT", "DROP", "UNCLEAR", "KINDS",
)  # fmt: skip
"""What every stage's result depends on."""


@dataclass(frozen=True)
class Stage:
    """A part of the training, which can be stopped, gone on with, and started from another's result.

    Attributes:
        size: of the pictures in px; latents have a quarter of it.
        steps: of them.
        peak: learning rate, which falls over the last 30 %.
        worlds: how many of the training worlds of one thing each are used.
        parts: how many of those of things with parts (:mod:`training.assemblies`).
        start: the stage whose networks this one starts from.
        inject: "none", "features" (recorded features of another run are mixed in, the target composed to match) or
            "control" (the same pairs and steps without the injection).
        batch: pictures of ``size`` in a step; an injected pair is two of them, and there are a quarter as many large ones.
        seed: of everything random.
        unclear: share of pairs whose instruction leaves the answer to the noise.
        draws: whether the noise's mean adds to the text (:class:`attnwarp.editing.small_unet.EditUNet`).
        shift: of the noise schedule, see :func:`scheduler`.
        noisy_from: :data:`NOISY_SHARE` of the steps are drawn from here on.
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
    inject: str = "none"
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
    "features": Stage(
        64, 7_800, 8e-4, 1800, parts=1190, start="drawn", inject="features", composed=0.7, large=0.25, seed=13
    ),
    "control": Stage(
        64, 7_800, 8e-4, 1800, parts=1190, start="drawn", inject="control", composed=0.7, large=0.25, seed=13
    ),
}  # fmt: skip
"""``small-plain`` is "drawn" and ``small`` "features"."""


class EditorNet(torch.nn.Module):
    """The UNet and the text encoder, trained together."""

    def __init__(self, vocabulary: int, size: int, *, draws: bool = True) -> None:
        super().__init__()
        from transformers import CLIPTextConfig, CLIPTextModel

        self.unet = EditUNet(
            sample_size=size // BLOCK, in_channels=2 * CHANNELS, out_channels=CHANNELS,
            down_block_types=("DownBlock2D",) * len(WIDTHS), mid_block_type="UNetMidBlock2D",
            up_block_types=("CrossAttnUpBlock2D",) * len(WIDTHS), block_out_channels=WIDTHS, layers_per_block=LAYERS,
            cross_attention_dim=TEXT_WIDTH, attention_head_dim=HEADS, norm_num_groups=16,
        )  # fmt: skip
        if not draws:
            self.unet.draw = None
        self.text = CLIPTextModel(
            CLIPTextConfig(
                vocab_size=vocabulary, hidden_size=TEXT_WIDTH, intermediate_size=2 * TEXT_WIDTH,
                num_hidden_layers=TEXT_LAYERS, num_attention_heads=4, max_position_embeddings=TOKENS,
                pad_token_id=0, bos_token_id=1, eos_token_id=1,
            )
        )  # fmt: skip
        # The first prediction is the picture before the edit.
        torch.nn.init.zeros_(self.unet.conv_out.weight)
        torch.nn.init.zeros_(self.unet.conv_out.bias)

    def forward(self, noisy: Tensor, before: Tensor, t: Tensor, tokens: Tensor) -> Tensor:
        """(B, 48, h, w) predicted latents of the edited pictures."""
        with halves(noisy.device):
            context = self.text(tokens).last_hidden_state
            both = torch.cat([noisy, before], dim=1)
            return self.unet(both, t, context, return_dict=False)[0].float()


def halves(device: torch.device) -> torch.autocast:
    """Matrices multiplied in bfloat16 where the device is a GPU; pictures, targets and losses stay in float32."""
    on_gpu = device.type == "cuda"
    # A recorded graph cannot use weights that were converted outside it.
    return torch.autocast(device.type, torch.bfloat16, enabled=on_gpu, cache_enabled=False)


def scheduler(shift: float = 1.0) -> Any:
    """The noise schedule and the sampler, as diffusers' pipelines load them.

    Args:
        shift: by which the ratio of signal to noise, in amplitude, is multiplied at every step. A mean
            over a thing is read from as many cells as it has, so the same step of Stable Diffusion hides
            four times as much on 16 x 16 latents as on its 64 x 64 (Hoogeboom et al. 2023, "simple
            diffusion", section 2.3). More of it shows an answer while features still have most of
            their weight.
    """
    from diffusers import DDIMScheduler

    settings: dict[str, Any] = {
        "num_train_timesteps": T_STEPS, "beta_schedule": "scaled_linear", "beta_start": SD_BETAS[0], "beta_end": SD_BETAS[1],
        "rescale_betas_zero_snr": True, "timestep_spacing": "trailing", "prediction_type": "sample", "clip_sample": False,
        "set_alpha_to_one": True, "steps_offset": 0,
    }  # fmt: skip
    plain = DDIMScheduler(**settings)
    if shift == 1:
        return plain
    alphas = plain.alphas_cumprod.double()
    shifted = shift**2 * alphas / (1 + (shift**2 - 1) * alphas)
    before = torch.cat([torch.ones(1, dtype=torch.float64), shifted[:-1]])
    betas = (1 - shifted / before).tolist()
    return DDIMScheduler(**settings | {"rescale_betas_zero_snr": False, "trained_betas": betas})


def make_tokenizer(count: int = 80_000, worlds: int = 200) -> Tokenizer:
    """Byte pairs learned from instructions: any text can be written with it, words of the worlds in a token or two.

    Args:
        count: of instructions, about things and parts in turn.
        worlds: whose looks they name.
    """
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
    return learn_byte_pairs(corpus, vocabulary=VOCABULARY, most_tokens=TOKENS, length=TOKENS)


def tokens_of(tokenizer: Tokenizer, texts: Sequence[str]) -> Tensor:
    """(N, 24) int64, padded with 0."""
    return torch.tensor(
        [code.ids for code in tokenizer.encode_batch(list(texts))], dtype=torch.int64
    )


def draw_steps(count: int, generator: torch.Generator, noisy_from: int) -> Tensor:
    """(count,) steps, more of them noisy, on the generator's device."""
    device = generator.device
    noisy = torch.randint(noisy_from, T_STEPS, (count,), generator=generator, device=device)
    rest = torch.randint(0, noisy_from, (count,), generator=generator, device=device)
    share = torch.rand(count, generator=generator, device=device)
    return torch.where(share < NOISY_SHARE, noisy, rest)


def dropped(batch: Batch, empty: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The conditions, left out at random: (before, tokens)."""
    draw = torch.rand(len(batch.t), generator=generator, device=generator.device)
    no_text = (draw < DROP) | ((draw >= 2 * DROP) & (draw < 3 * DROP))
    no_picture = (draw >= DROP) & (draw < 3 * DROP)
    before = torch.where(no_picture[:, None, None, None], 0.0, batch.before)
    return before, torch.where(no_text[:, None], empty, batch.tokens)


def noised(x: Tensor, noise: Tensor, alphas: Tensor) -> Tensor:
    """sqrt(alpha-bar) x + sqrt(1 - alpha-bar) noise, with (B,) alpha-bar."""
    a = alphas[:, None, None, None]
    return a.sqrt() * x + (1 - a).sqrt() * noise


def loss_of(prediction: Tensor, target: Tensor, weight: Tensor, alphas: Tensor) -> Tensor:
    """Mean squared error of the edited picture's latents, weighted by cell and by min(SNR + 1, 5)."""
    by_step = (alphas / (1 - alphas) + 1).clamp(max=MOST_WEIGHT)
    error = (prediction - target).square().mean(dim=1, keepdim=True)
    return (by_step[:, None, None, None] * weight * error).mean()


def recipe_of(name: str, stage: Stage) -> dict[str, Any]:
    """Everything that a stage's result depends on; a checkpoint of another recipe is not gone on with."""
    constants = {key: globals()[key] for key in CONSTANTS}
    constants |= steps.constants()
    names = ("SENTENCES", "POINTS", "THING_WEIGHT", "MOST_THING_WEIGHT", "HALF_PLANES")
    constants |= {key: getattr(editor_pool, key) for key in names}
    if stage.draws:
        from training import editor_draws

        constants |= {key: getattr(editor_draws, key) for key in ("DRAW_STEPS", "DRAW_GAIN")}
        constants["SETTLED"], constants["OPEN"] = SETTLED, OPEN
    if stage.inject != "none":
        from training import editor_injection

        of_injection = (
            "FIRST_WEIGHT", "WEIGHT_SPREAD", "LEAST_WEIGHT", "MOST_ALPHA", "CARRIED", "MOST_OWN", "NO_TEXT", "WAYS",
            "INJECTED_KINDS",
        )  # fmt: skip
        constants |= {key: getattr(editor_injection, key) for key in of_injection}
        constants["INJECTED_SHARE"] = INJECTED_SHARE
    return {"stage": name, **asdict(stage), "constants": constants, "pairs": PAIRS_PROTOCOL}


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
    """Train a stage, or go on with it; the checkpoint's path.

    Args:
        name: a key of :data:`STAGES`.
        data: folder of the pictures, rendered where they are missing.
        out: folder of checkpoints.
        stage: in place of the one of that name.
        threads: of torch.
        device: of torch; on a GPU matrices are multiplied in bfloat16.
        pool: on that device, if it is there already.
    """
    stage = STAGES[name] if stage is None else stage
    device = torch.device(device)
    torch.set_num_threads(threads)
    torch.manual_seed(stage.seed)
    tokenizer = tokenizer_of(out)
    pool = pool_of(stage, data, tokenizer, device) if pool is None else pool
    net = EditorNet(tokenizer.get_vocab_size(), stage.size, draws=stage.draws)
    spent = 0.0
    if stage.start is not None:
        weights = weights_of(out, stage.start)
        begins = stage.draws and not any(k.startswith("unet.draw.") for k in weights)
        if begins:
            weights |= {k: v for k, v in net.state_dict().items() if k.startswith("unet.draw.")}
        net.load_state_dict(weights)
        if begins and not (out / f"{name}.pt").exists():
            from training.editor_draws import teach_draws

            start = time.perf_counter()
            teach_draws(net, tokenizer, pool.worlds, seed=stage.seed)
            spent = time.perf_counter() - start
    net.to(device)
    alphas = scheduler(stage.shift).alphas_cumprod.to(device)
    empty = tokens_of(tokenizer, [""])[0].to(device)
    checkpoint = out / f"{name}.pt"
    train_steps(
        net, stage, tasks_of(stage, pool, net, alphas, empty), checkpoint, recipe_of(name, stage), device, spent
    )  # fmt: skip
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
    """What a stage's steps are of: plain pairs or injected ones, small pictures or large ones."""
    tasks = []
    for size, share in ((stage.size, 1 - stage.large), (2 * stage.size, stage.large)):
        if share == 0:
            continue
        count = max(2, stage.batch // (size // stage.size) ** 2)
        injected = 0.0 if stage.inject == "none" else INJECTED_SHARE
        draw = functools.partial(plain_inputs, pool, stage, alphas, empty, size)
        # Some plain steps among those with injection, so that clear instructions are not forgotten.
        tasks.append(Task(share * (1 - injected), count, draw, functools.partial(plain_loss, net)))
        if injected:
            from training import editor_injection

            inject = stage.inject == "features"
            drawn = functools.partial(
                editor_injection.inputs, pool, alphas, empty, size, inject=inject, noisy_from=stage.noisy_from
            )  # fmt: skip
            loss = functools.partial(editor_injection.injected_loss, net, inject=inject)
            tasks.append(Task(share * injected, count // 2, drawn, loss))
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
