"""Recipe of the bundled editors: a picture and an instruction in, the edited picture out.

A small InstructPix2Pix (Brooks et al. 2023) in diffusers' format: the picture before the edit is concatenated to the
noisy latents. It predicts the edited picture itself, from betas whose last step is pure noise (Lin et al. 2024,
"Common diffusion noise schedules and sample steps are flawed").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tokenizers import (
    Tokenizer,
    decoders,
    models,
    normalizers,
    pre_tokenizers,
    processors,
    trainers,
)

from attnwarp.editing.latents import BLOCK, CHANNELS, HaarLatents
from attnwarp.editing.small_unet import OPEN, SETTLED, EditUNet
from training.common import Run, groups
from training.editing_pairs import (
    AMBIGUOUS,
    GROUPS,
    LOOKS,
    PAIR_SPLITS,
    PAIRS_PROTOCOL,
    SIZE,
    THING,
    VIEWS,
    Worlds,
    ambiguous_instruction,
    edit_looks,
    instruction,
    load_mixed,
)

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
COARSE = 12
"""The first channels of the latents are means and coarse details (:func:`attnwarp.editing.latents.haar_basis`)."""
DROP = 0.05
"""Probability that the text, the picture or both are left out, each."""
UNCLEAR = 0.35
"""Share of pairs whose instruction leaves the answer to the noise."""
KINDS = {"color": 0.45, "material": 0.15, "pattern": 0.05, "ground": 0.2, "time": 0.15}
EMA = 0.999
WARM = 200
STEPS_AN_EPOCH = 100
THING_WEIGHT = 0.25
MOST_THING_WEIGHT = 8.0
"""Cells of the thing weigh 0.25 / (its share of the picture), at least 1 and at most 8: small things would hardly
be learned. The mask depends on the picture before alone, so the best prediction stays the same."""

HALF_PLANES = 0.7
"""Of the regions of composed results; the others are boxes."""

INJECTED_SHARE = 0.7
"""Of the steps of a stage with injection; the others are plain."""

CONSTANTS = (
    "WIDTHS", "LAYERS", "HEADS", "TEXT_WIDTH", "TEXT_LAYERS", "VOCABULARY", "TOKENS", "T_STEPS", "NOISY_SHARE",
    "MOST_WEIGHT", "DROP", "UNCLEAR", "KINDS", "EMA", "WARM", "STEPS_AN_EPOCH", "THING_WEIGHT", "MOST_THING_WEIGHT",
)  # fmt: skip
"""What every stage's result depends on."""


@dataclass(frozen=True)
class Stage:
    """A part of the training, which can be stopped, gone on with, and started from another's result.

    Attributes:
        size: of the pictures in px; latents have a quarter of it.
        steps: of ``batch`` pairs each.
        peak: learning rate, which falls over the last 30 %.
        worlds: how many of the training worlds of one thing each are used.
        parts: how many of those of things with parts (:mod:`training.assemblies`).
        start: the stage whose networks this one starts from.
        inject: "none", "features" (recorded features of another run are mixed in, the target composed to match) or
            "control" (the same pairs and steps without the injection).
        seed: of everything random.
        unclear: share of pairs whose instruction leaves the answer to the noise.
        draws: whether the noise's mean adds to the text (:class:`attnwarp.editing.small_unet.EditUNet`).
        shift: of the noise schedule, see :func:`scheduler`.
        noisy_from: :data:`NOISY_SHARE` of the steps are drawn from here on.
        composed: share of the open pairs at settled steps whose result has one answer in a region and another
            outside it. Without them the network takes a thing to have one colour, and its late steps undo
            an answer that holds in a part only.
    """

    size: int
    steps: int
    peak: float
    worlds: int
    start: str | None = None
    inject: str = "none"
    batch: int = 8
    seed: int = 0
    parts: int = 0
    unclear: float = UNCLEAR
    draws: bool = True
    shift: float = SHIFT
    noisy_from: int = 850
    composed: float = 0.0


STAGES = {
    "plain-64": Stage(64, 24_000, 1e-3, 200, draws=False, shift=1, noisy_from=600),
    "drawn-64": Stage(64, 5_000, 8e-4, 200, start="plain-64", seed=5, unclear=0.5),
    "features-64": Stage(64, 2_500, 4e-4, 200, start="drawn-64", inject="features", seed=2),
    "control-64": Stage(64, 2_500, 4e-4, 200, start="drawn-64", inject="control", seed=2),
    "local-64": Stage(64, 4_000, 8e-4, 200, start="drawn-64", seed=6, unclear=0.6, noisy_from=700, composed=0.7),
    "steady-64": Stage(64, 12_000, 8e-4, 600, start="local-64", seed=7, composed=0.7),
    "carried-64": Stage(64, 4_000, 6e-4, 600, start="steady-64", inject="features", seed=8, composed=0.7),
    "parts-64": Stage(64, 16_000, 6e-4, 200, start="drawn-64", seed=4, parts=595),
    "parts-128": Stage(128, 16_000, 6e-4, 600, start="parts-64", seed=1, parts=595),
    "features-128": Stage(128, 6_000, 4e-4, 600, start="parts-128", inject="features", seed=3, parts=595),
    "control-128": Stage(128, 6_000, 4e-4, 600, start="parts-128", inject="control", seed=3, parts=595),
}  # fmt: skip
"""``small-plain`` is "drawn-64" and ``small`` "features-64". Those from "local-64" on are to follow them: features carry
*where* better after composed pairs, but the first of such stages, with mostly open instructions, edited worse."""


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
        context = self.text(tokens).last_hidden_state
        return self.unet(torch.cat([noisy, before], dim=1), t, context, return_dict=False)[0]


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


def make_tokenizer(count: int = 20_000, worlds: int = 200) -> Tokenizer:
    """Byte pairs learned from instructions: any text can be written with it, words of the worlds in a token or two."""
    rng = np.random.default_rng(20)
    split = PAIR_SPLITS["edit-train"]
    corpus = []
    drawn = [edit_looks(k, split)[0] for k in range(worlds)]
    for k in range(count):
        looks = drawn[k % worlds]
        kind = list(KINDS)[int(rng.integers(len(KINDS)))]
        look = looks[int(rng.choice(list(GROUPS[kind])))]
        row = np.array([look.finish, look.color, look.second, look.ground, look.time])
        corpus.append(instruction(kind, k % 25, row, rng))
        if kind in AMBIGUOUS:
            corpus.append(ambiguous_instruction(kind, k % 25, rng))
    tokenizer = Tokenizer(models.BPE())
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFKC(), normalizers.Lowercase()])
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=True)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=VOCABULARY, special_tokens=["<pad>", "<end>"], initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )  # fmt: skip
    tokenizer.train_from_iterator(corpus, trainer)
    tokenizer.post_processor = processors.TemplateProcessing(
        single="$A <end>", special_tokens=[("<end>", 1)]
    )
    tokenizer.enable_padding(pad_id=0, pad_token="<pad>", length=TOKENS)
    tokenizer.enable_truncation(TOKENS)
    return tokenizer


def tokens_of(tokenizer: Tokenizer, texts: Sequence[str]) -> Tensor:
    """(N, 24) int64, padded with 0."""
    return torch.tensor(
        [code.ids for code in tokenizer.encode_batch(list(texts))], dtype=torch.int64
    )


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


def picked(noise: Tensor, candidates: Sequence[int]) -> int:
    """The answer that a noise picks: the look whose direction is nearest to the noise's mean over the picture.

    Directions are orthonormal and the noise is white, so every candidate is picked as often.

    Args:
        noise: (48, h, w).
        candidates: indices of looks.
    """
    scores = codes()[list(candidates)] @ noise.mean(dim=(1, 2))
    return int(candidates[int(scores.argmax())])


def settled(noise: Tensor, answer: int, kind: str) -> Tensor:
    """The noise with the answer that it picks among a kind's exchanged for another.

    The two answers' shares of the noise's mean change places, so that the result is white noise that picks
    ``answer``. A pick among the answers that a world happens to have would be a riddle: neither the noise
    nor the text tells which these are, and the best prediction of a riddle is a mixture of colours.

    Args:
        noise: (48, h, w), white.
        answer: index of the look to be picked.
        kind: a key of :data:`training.editing_pairs.GROUPS`.
    """
    directions, mean = codes(), noise.mean(dim=(1, 2))
    best = picked(noise, GROUPS[kind])
    shift = (directions[best] - directions[answer]) @ mean * (directions[answer] - directions[best])
    return noise + shift[:, None, None]


@dataclass(frozen=True, eq=False)
class Batch:
    """Pairs with their noise.

    Attributes:
        before, after: (B, 48, h, w) latents.
        noise: (B, 48, h, w).
        tokens: (B, 24).
        t: (B,) steps.
        weight: (B, 1, h, w) of the cells.
        world, view, source, target: what each pair shows; which pixels, in ``corner``: (y, x, zoomed).
        unclear: whether the noise picked the answer.
    """

    before: Tensor
    after: Tensor
    noise: Tensor
    tokens: Tensor
    t: Tensor
    weight: Tensor
    rows: list[Row]


@dataclass(frozen=True)
class Row:
    """Which pictures a pair is made of."""

    world: int
    view: int
    source: int
    target: int
    kind: str
    unclear: bool
    corner: tuple[int, int, int]
    flip: bool


class Pairs:
    """Draws batches of pairs from worlds.

    Args:
        worlds: at :data:`training.editing_pairs.SIZE`.
        size: of the pictures in px, 64 or 128. At 64, half of the pictures are a quarter of the full one about
            the thing, so that things come large and small.
        tokenizer: of the instructions; :meth:`batch` needs it.
    """

    def __init__(self, worlds: Worlds, size: int, tokenizer: Tokenizer | None) -> None:
        self.worlds, self.size, self.tokenizer = worlds, size, tokenizer
        self.coder = HaarLatents()

    def corner(self, world: int, view: int, rng: np.random.Generator) -> tuple[int, int, int]:
        """Where a picture is cut from: (y, x, px of the full picture to one of the cut)."""
        step = SIZE // self.size
        if step == 1 or rng.uniform() < 0.5:
            return 0, 0, step
        seen = np.argwhere(self.worlds.ids[world, view] == THING)
        y, x = seen[int(rng.integers(len(seen)))] if len(seen) else (SIZE // 2, SIZE // 2)
        low = [
            int(np.clip(v - rng.uniform(0.25, 0.75) * self.size, 0, SIZE - self.size))
            for v in (y, x)
        ]
        return low[0], low[1], 1

    def cut(self, full: npt.NDArray[Any], row: Row) -> npt.NDArray[np.float32]:
        """The part of a full picture (128, 128, ...) that a row shows, as means of blocks."""
        y, x, n = row.corner
        part = full[y : y + n * self.size, x : x + n * self.size].astype(np.float32)
        part = part.reshape(self.size, n, self.size, n, *full.shape[2:]).mean(axis=(1, 3))
        return part[:, ::-1] if row.flip else part

    def picture(self, row: Row, look: int) -> npt.NDArray[np.float32]:
        """(S, S, 3) in [-1, 1]."""
        return self.cut(self.worlds.images[row.world, row.view, look], row) / 127.5 - 1

    def thing(self, row: Row) -> npt.NDArray[np.float32]:
        """(S, S) share of each pixel that the thing covers."""
        return self.cut(self.worlds.ids[row.world, row.view] == THING, row)

    def latents(self, pictures: Sequence[npt.NDArray[np.float32]]) -> Tensor:
        """(B, 48, h, w) of (S, S, 3) pictures."""
        x = torch.from_numpy(np.ascontiguousarray(np.stack(pictures))).permute(0, 3, 1, 2)
        return self.coder.encode(x, return_dict=False)[0]

    def row(self, rng: np.random.Generator, kinds: dict[str, float], unclear: float) -> Row:
        """Draw a pair."""
        worlds = self.worlds
        while True:
            world, view = int(rng.integers(len(worlds))), int(rng.integers(VIEWS))
            kind = str(
                rng.choice(list(kinds), p=np.array(list(kinds.values())) / sum(kinds.values()))
            )
            valid = worlds.valid[world]
            targets = [k for k in GROUPS[kind] if valid[k]]
            open_ended = kind in AMBIGUOUS and rng.uniform() < unclear
            source = int(rng.choice(worlds.sources(world, kind)))
            targets = [
                k
                for k in targets
                if k != source
                and not np.array_equal(worlds.looks[world, k], worlds.looks[world, source])
            ]
            if targets:
                break
        corner, flip = self.corner(world, view, rng), bool(rng.uniform() < 0.5)
        return Row(world, view, source, int(rng.choice(targets)), kind, open_ended, corner, flip)

    def text(self, row: Row, rng: np.random.Generator) -> str:
        """The instruction of a row."""
        thing = int(self.worlds.things[row.world])
        if row.unclear:
            return ambiguous_instruction(row.kind, thing, rng)
        return instruction(row.kind, thing, self.worlds.looks[row.world, row.target], rng)

    def composed(self, row: Row, rng: np.random.Generator) -> npt.NDArray[np.float32]:
        """(S, S, 3) result with an answer drawn anew in a region whose edge goes through what is edited."""
        other = answered(self.worlds, row, rng)
        region = cut_region(self.thing(row) > 0, rng)
        return np.where(
            region[..., None], self.picture(row, other.target), self.picture(row, row.target)
        )

    def weight(self, row: Row) -> npt.NDArray[np.float32]:
        """(h, w) weight of the cells, see :data:`THING_WEIGHT`."""
        cells = self.size // BLOCK
        if row.kind in ("ground", "time"):
            return np.ones((cells, cells), dtype=np.float32)
        mask = self.thing(row)
        share = mask.reshape(cells, BLOCK, cells, BLOCK).mean(axis=(1, 3))
        gain = np.clip(THING_WEIGHT / max(float(mask.mean()), 1e-3), 1, MOST_THING_WEIGHT)
        return (1 + (gain - 1) * (share > 0)).astype(np.float32)

    def batch(
        self, count: int, rng: np.random.Generator, generator: torch.Generator, *, t: Tensor | None = None,
        kinds: dict[str, float] | None = None, unclear: float = UNCLEAR, noisy_from: int = 600, composed: float = 0.0,
    ) -> Batch:  # fmt: skip
        """Draw ``count`` pairs; where the instruction is unclear, the noise picks the target.

        Of the unclear ones at steps below :data:`SETTLED`, the share ``composed`` has a second answer in a region.
        """
        if self.tokenizer is None:
            raise ValueError("tokenizer: got None, which a batch of instructions needs")
        cells = self.size // BLOCK
        noise = torch.randn((count, CHANNELS, cells, cells), generator=generator)
        rows = [self.row(rng, kinds or KINDS, unclear) for _ in range(count)]
        for k, row in enumerate(rows):
            if row.unclear:
                noise[k] = settled(noise[k], row.target, row.kind)
        texts = [self.text(r, rng) for r in rows]
        if t is None:
            t = draw_steps(count, rng, noisy_from)
        results = [self.picture(r, r.target) for r in rows]
        if composed:
            for k, row in enumerate(rows):
                if row.unclear and t[k] < SETTLED and rng.uniform() < composed:
                    results[k] = self.composed(row, rng)
        return Batch(
            self.latents([self.picture(r, r.source) for r in rows]), self.latents(results),
            noise, tokens_of(self.tokenizer, texts), t,
            torch.from_numpy(np.stack([self.weight(r) for r in rows]))[:, None], rows,
        )  # fmt: skip


def answered(worlds: Worlds, row: Row, rng: np.random.Generator) -> Row:
    """The row with an answer of its own."""
    valid = worlds.valid[row.world]
    allowed = worlds.sources(row.world, row.kind)
    source = row.source if row.source in allowed else int(allowed[0])
    looks = worlds.looks[row.world]
    targets = [
        k for k in GROUPS[row.kind]
        if valid[k] and k != source and not np.array_equal(looks[k], looks[source])
    ]  # fmt: skip
    return replace(row, source=source, target=int(rng.choice(targets)))


def cut_region(thing: npt.NDArray[np.bool_], rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """(S, S) a half-plane at any angle, or a box, whose edge goes through a pixel of the thing."""
    size = len(thing)
    pixels = np.argwhere(thing)
    y0, x0 = pixels[int(rng.integers(len(pixels)))] if len(pixels) else (size // 2, size // 2)
    y, x = np.mgrid[0:size, 0:size]
    if rng.uniform() < HALF_PLANES:
        angle = rng.uniform(0, 2 * math.pi)
        return (x - x0) * math.cos(angle) + (y - y0) * math.sin(angle) > 0
    y1, x1 = rng.integers(0, size, 2)
    return (y >= min(y0, y1)) & (y <= max(y0, y1)) & (x >= min(x0, x1)) & (x <= max(x0, x1))


def draw_steps(count: int, rng: np.random.Generator, noisy_from: int) -> Tensor:
    """(count,) steps, more of them noisy."""
    noisy = rng.integers(noisy_from, T_STEPS, count)
    rest = rng.integers(0, noisy_from, count)
    return torch.from_numpy(np.where(rng.uniform(size=count) < NOISY_SHARE, noisy, rest))


def dropped(batch: Batch, empty: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """The conditions, left out at random: (before, tokens)."""
    draw = torch.from_numpy(rng.uniform(size=len(batch.t)))
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


def falling_rate(step: int, total: int, peak: float, warm: int = WARM) -> float:
    """The learning rate: linear up to ``peak``, constant, and down to a fiftieth over the last 30 %."""
    if step < warm:
        return peak * (step + 1) / warm
    left = (total - step) / (0.3 * total)
    return peak * min(1.0, 0.02 + 0.98 * left)


def recipe_of(name: str, stage: Stage) -> dict[str, Any]:
    """Everything that a stage's result depends on; a checkpoint of another recipe is not gone on with."""
    constants = {key: globals()[key] for key in CONSTANTS}
    if stage.draws:
        from training import editor_draws

        constants |= {key: getattr(editor_draws, key) for key in ("DRAW_STEPS", "DRAW_GAIN")}
        constants["SETTLED"], constants["OPEN"] = SETTLED, OPEN
    if stage.inject != "none":
        from training import editor_injection

        names = (
            "FIRST_WEIGHT", "WEIGHT_SPREAD", "LEAST_WEIGHT", "MOST_ALPHA", "CARRIED", "MOST_OWN", "NO_TEXT", "WAYS",
            "INJECTED_KINDS",
        )  # fmt: skip
        constants |= {key: getattr(editor_injection, key) for key in names}
        constants["INJECTED_SHARE"] = INJECTED_SHARE
    if stage.composed:
        constants["HALF_PLANES"] = HALF_PLANES
    fields = asdict(stage)
    # Checkpoints from before a field existed do not name it.
    for key, before in (
        ("parts", 0),
        ("unclear", UNCLEAR),
        ("draws", False),
        ("shift", 1),
        ("composed", 0.0),
    ):
        if fields[key] == before:
            del fields[key]
    return {"stage": name, **fields, "constants": constants, "pairs": PAIRS_PROTOCOL}


def train_stage(
    name: str, data: Path, out: Path, *, stage: Stage | None = None, threads: int = 1
) -> Path:
    """Train a stage, or go on with it; the checkpoint's path.

    Args:
        name: a key of :data:`STAGES`.
        data: folder of the pictures, rendered where they are missing.
        out: folder of checkpoints.
        stage: in place of the one of that name.
        threads: of torch.
    """
    from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

    stage = STAGES[name] if stage is None else stage
    torch.set_num_threads(threads)
    torch.manual_seed(stage.seed)
    out.mkdir(parents=True, exist_ok=True)
    words = out / "tokenizer.json"
    if not words.exists():
        make_tokenizer().save(str(words))
    tokenizer = Tokenizer.from_file(str(words))
    counts: dict[str, int | None] = {"edit-train": stage.worlds}
    if stage.parts:
        counts["parts-train"] = stage.parts
    pairs = Pairs(load_mixed(data, counts), stage.size, tokenizer)
    net = EditorNet(tokenizer.get_vocab_size(), stage.size, draws=stage.draws)
    if stage.start is not None:
        stored = torch.load(out / f"{stage.start}.pt", weights_only=True)["average"]
        weights = {k.removeprefix("module."): v for k, v in stored.items() if k != "n_averaged"}
        begins = stage.draws and not STAGES[stage.start].draws
        if begins:
            weights |= {k: v for k, v in net.state_dict().items() if k.startswith("unet.draw.")}
        net.load_state_dict(weights)
        if begins and not (out / f"{name}.pt").exists():
            from training.editor_draws import teach_draws

            teach_draws(net, tokenizer, pairs.worlds, seed=stage.seed)
    average = AveragedModel(net, multi_avg_fn=get_ema_multi_avg_fn(EMA))
    optimizer = torch.optim.AdamW(groups(net, 0.01), lr=stage.peak, betas=(0.9, 0.99))
    alphas = scheduler(stage.shift).alphas_cumprod
    empty = tokens_of(tokenizer, [""])[0]
    step_loss = _step(stage, pairs, net, alphas, empty)

    def epoch(number: int) -> dict[str, float]:
        rng = np.random.default_rng([stage.seed, number])
        generator = torch.Generator().manual_seed(1_000_003 * stage.seed + number)
        net.train()
        sums: dict[str, float] = {}
        for step in range(STEPS_AN_EPOCH):
            for group in optimizer.param_groups:
                group["lr"] = falling_rate(number * STEPS_AN_EPOCH + step, stage.steps, stage.peak)
            loss, parts = step_loss(rng, generator)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimizer.step()
            average.update_parameters(net)
            for key, value in parts.items():
                sums[key] = sums.get(key, 0.0) + value / STEPS_AN_EPOCH
        return sums

    checkpoint = out / f"{name}.pt"
    state = {"net": net, "average": average, "optimizer": optimizer}
    Run(checkpoint, state, stage.steps // STEPS_AN_EPOCH, recipe_of(name, stage)).train(epoch)
    return checkpoint


def _step(
    stage: Stage, pairs: Pairs, net: EditorNet, alphas: Tensor, empty: Tensor
) -> Callable[[np.random.Generator, torch.Generator], tuple[Tensor, dict[str, float]]]:
    """One step's loss, and what to print of it."""

    def plain(
        rng: np.random.Generator, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, float]]:
        batch = pairs.batch(
            stage.batch,
            rng,
            generator,
            unclear=stage.unclear,
            noisy_from=stage.noisy_from,
            composed=stage.composed,
        )
        before, tokens = dropped(batch, empty, rng)
        a = alphas[batch.t]
        prediction = net(noised(batch.after, batch.noise, a), before, batch.t, tokens)
        loss = loss_of(prediction, batch.after, batch.weight, a)
        # Of an unchanged picture, for comparison: 1 means nothing is edited.
        nothing = loss_of(batch.before, batch.after, batch.weight, a)
        return loss, {"loss": float(loss.detach()), "unedited": float(nothing)}

    if stage.inject == "none":
        return plain

    def injected(
        rng: np.random.Generator, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, float]]:
        from training.editor_injection import injected_loss

        # Some plain steps among them, so that clear instructions are not forgotten.
        if rng.uniform() >= INJECTED_SHARE:
            loss, parts = plain(rng, generator)
            return loss, {f"plain {key}": value for key, value in parts.items()}
        inject = stage.inject == "features"
        return injected_loss(
            pairs, net, alphas, empty, stage.batch // 2, rng, generator, inject=inject, noisy_from=stage.noisy_from,
        )  # fmt: skip

    return injected
