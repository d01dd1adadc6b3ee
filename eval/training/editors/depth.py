"""Recipe of ``small-depth``: a depth map and a prompt give a picture, by a small depth ControlNet.

UNet and ControlNet (Zhang et al. 2023, "Adding Conditional Control to Text-to-Image Diffusion Models")
are trained together: with no large text-to-image model to keep, there is nothing to freeze.
Latents, noise schedule and loss are those of :mod:`training.editors.net`, and the first weights are an editor's.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tokenizers import Tokenizer

from attnwarp.editing.latents import BLOCK, CHANNELS
from training.editors.answers import codes
from training.editors.net import (
    HEADS,
    LAYERS,
    TEXT_WIDTH,
    WIDTHS,
    EditorNet,
    draw_steps,
    halves,
    loss_of,
    noised,
    scheduler,
)
from training.editors.pool import PicturePool, Rows
from training.editors.recipe import tokenizer_of, weights_of
from training.encoders.byte_pairs import tokens_of
from training.encoders.clip import true_of
from training.steps import Task, train_steps
from training.worlds.editing_pairs import (
    LOOKS,
    PAIRS_PROTOCOL,
    SIZE,
    VIEWS,
    Worlds,
    load_pairs,
    scene_edits,
)
from training.worlds.words import sentence

Tensor = torch.Tensor

CONTROL_WIDTHS = (16, 32, 64)
"""Channels of the convolutions that bring a depth map to the latents' size; each but the first halves it."""

NOISY_FROM = 600
"""Most steps are drawn from here on."""

NO_PROMPT = 0.1
"""Probability that the prompt is left out, for guidance."""

PROMPTS = 64
"""Made ahead for each world."""

NAMES_PLACE = 0.8
"""Probability that a prompt names the ground, and that it names the time of day, each."""


@dataclass(frozen=True)
class DepthStage:
    """A part of the training, which can be stopped and gone on with.

    Attributes:
        size: size of the pictures in px.
        peak: learning rate, which falls over the last 30 %.
        start: the editor's stage whose text encoder and UNet this one starts from.
    """

    size: int
    steps: int
    peak: float
    worlds: int
    start: str
    batch: int = 256
    seed: int = 0


DEPTH_STAGES = {"depth": DepthStage(64, 6_000, 1e-3, 1800, start="plain", seed=5)}


class DepthNet(torch.nn.Module):
    """UNet, ControlNet and text encoder, trained together."""

    def __init__(self, vocabulary: int, size: int, first: EditorNet | None = None) -> None:
        super().__init__()
        from diffusers import ControlNetModel, UNet2DConditionModel

        first = EditorNet(vocabulary, size, draws=False) if first is None else first
        self.text = first.text
        shape = {
            "down_block_types": ("DownBlock2D",) * len(WIDTHS), "mid_block_type": "UNetMidBlock2D", "block_out_channels": WIDTHS,
            "layers_per_block": LAYERS, "cross_attention_dim": TEXT_WIDTH, "attention_head_dim": HEADS, "norm_num_groups": 16,
        }  # fmt: skip
        self.unet = UNet2DConditionModel(
            sample_size=first.unet.config.sample_size, in_channels=CHANNELS, out_channels=CHANNELS,
            up_block_types=("CrossAttnUpBlock2D",) * len(WIDTHS), **shape,
        )  # fmt: skip
        weights = first.unet.state_dict()
        # The editor's other input channels are the picture before the edit, which there is none of here.
        weights["conv_in.weight"] = weights["conv_in.weight"][:, :CHANNELS]
        self.unet.load_state_dict(weights)
        self.controlnet = ControlNetModel(
            in_channels=CHANNELS, conditioning_embedding_out_channels=CONTROL_WIDTHS, **shape
        )
        for part in ("conv_in", "time_embedding", "down_blocks", "mid_block"):
            getattr(self.controlnet, part).load_state_dict(getattr(self.unet, part).state_dict())

    def forward(self, noisy: Tensor, control: Tensor, t: Tensor, tokens: Tensor) -> Tensor:
        """(B, 48, h, w) predicted latents, of (B, 3, 4 h, 4 w) control pictures and (B, 24) tokens."""
        with halves(noisy.device):
            context = self.text(tokens).last_hidden_state
            down, middle = self.controlnet(noisy, t, context, control, return_dict=False)
            return self.unet(
                noisy, t, context, down_block_additional_residuals=down, mid_block_additional_residual=middle,
                return_dict=False,
            )[0].float()  # fmt: skip


@functools.cache
def reserved_prompts() -> frozenset[str]:
    """Descriptions in the package's scenes, in lower case."""
    edits = scene_edits()
    answers = [answer for edit in edits for answer in edit.get("answers", ())]
    texts = [one[key] for one in (*edits, *answers) for key in ("source", "target") if key in one]
    return frozenset(text.lower() for text in texts)


def attributes_of(worlds: Worlds, world: int) -> npt.NDArray[np.int64]:
    """(LOOKS, 6) attributes of a world's looks, in the order of :func:`training.worlds.draw.attributes`."""
    thing = np.full((LOOKS, 1), worlds.things[world])
    return np.concatenate([thing, worlds.looks[world]], axis=1)


def draw_prompt(look: Sequence[int], rng: np.random.Generator) -> tuple[str, npt.NDArray[np.int64]]:
    """A prompt that is true of a look, and the attributes that it names, -1 for the others."""
    thing, finish, color, second, ground, time = (int(v) for v in look)
    if rng.uniform() < 0.15:
        finish = color = second = -1
    elif finish == 0:
        finish = -1  # a plain surface is named by its colour alone
    if rng.uniform() >= NAMES_PLACE:
        ground = -1
    if rng.uniform() >= NAMES_PLACE:
        time = -1
    values = (thing, finish, color, second, ground, time)
    while True:
        text = sentence(values, rng)
        if text.lower() not in reserved_prompts():
            return text, np.array(values)


class PromptPool(PicturePool):
    """Depth maps, prompts and pictures of worlds on one device."""

    def __init__(
        self, worlds: Worlds, tokenizer: Tokenizer, device: torch.device | str = "cpu", *, prompts: int = PROMPTS
    ) -> None:  # fmt: skip
        super().__init__(worlds, device)
        tokens, true = prompts_of(worlds, tokenizer, prompts)
        self.tokens, self.true = tokens.to(self.device), true.to(self.device)
        self.depth = torch.from_numpy(worlds.depth).to(self.device).view(-1)

    def control(self, rows: Rows, size: int) -> Tensor:
        """(B, 3, S, S) control pictures, see :func:`attnwarp.editing.editors.controlnet.control_image`."""
        number = (rows.world * VIEWS + rows.view)[:, None, None] * SIZE**2
        # One pixel of each block: a mean over an edge would be a depth where nothing is.
        depth = self.depth[number + self.pixels(rows, size, SIZE // size)[..., -1]]
        near = torch.where(depth.isfinite(), 1 / (depth + 1e-5), 0.0)
        near = near / near.amax(dim=(1, 2), keepdim=True).clamp(min=1e-30)
        return near[:, None].expand(-1, 3, -1, -1)

    def prompted(
        self, noise: Tensor, generator: torch.Generator, *, size: int
    ) -> tuple[Rows, Tensor]:
        """Draw pictures and (B, 24) tokens of their prompts; where one is true of several, the noise picks."""
        count = len(noise)
        tokens, true = self.tokens, self.true
        world = self.integers(len(tokens), count, generator)
        view = self.integers(VIEWS, count, generator)
        prompt = self.integers(tokens.shape[1], count, generator)
        scores = noise.mean(dim=(2, 3)) @ codes().to(noise).T
        look = scores.masked_fill(~true[world, prompt], -torch.inf).argmax(dim=1)
        y, x, zoom = self.corner(world, view, size, generator)
        flip = self.uniform(generator, count) < 0.5
        zero = torch.zeros_like(world)
        rows = Rows(world, view, look, look, zero, flip & False, y, x, zoom, flip)
        return rows, tokens[world, prompt].long()


def prompts_of(
    worlds: Worlds, tokenizer: Tokenizer, prompts: int = PROMPTS
) -> tuple[Tensor, Tensor]:
    """(N, P, 24) tokens of prompts and the (N, P, LOOKS) looks they are true of."""
    rng = np.random.default_rng(32)
    texts, true = [], np.zeros((len(worlds), prompts, LOOKS), dtype=bool)
    for world in range(len(worlds)):
        looks, valid = attributes_of(worlds, world), np.flatnonzero(worlds.valid[world])
        for number in range(prompts):
            text, values = draw_prompt(looks[int(rng.choice(valid))], rng)
            texts.append(text)
            true[world, number, valid] = true_of(values[None], looks[valid])[:, 0]
    tokens = torch.tensor(
        [code.ids for code in tokenizer.encode_batch(texts)], dtype=torch.int16
    ).view(len(worlds), prompts, -1)
    return tokens, torch.from_numpy(true)


def recipe_of(name: str, stage: DepthStage) -> dict[str, Any]:
    """Everything that a stage's result depends on."""
    from training import steps
    from training.editors import pool as editor_pool
    from training.editors import recipe as editor

    constants = editor.constants() | steps.constants()
    names = ("POINTS", "THING_WEIGHT", "MOST_THING_WEIGHT")
    constants |= {key: getattr(editor_pool, key) for key in names}
    constants |= {
        "CONTROL_WIDTHS": CONTROL_WIDTHS, "NO_PROMPT": NO_PROMPT, "NAMES_PLACE": NAMES_PLACE, "PROMPTS": PROMPTS,
        "NOISY_FROM": NOISY_FROM,
    }  # fmt: skip
    return {"stage": name, **asdict(stage), "constants": constants, "pairs": PAIRS_PROTOCOL}


def first_net(tokenizer: Tokenizer, stage: DepthStage, out: Path) -> DepthNet:
    """The networks that a stage starts from."""
    size = tokenizer.get_vocab_size()
    first = EditorNet(size, stage.size, draws=False)
    first.load_state_dict(weights_of(out, stage.start))
    return DepthNet(size, stage.size, first)


def train_depth_stage(
    name: str, data: Path, out: Path, *, stage: DepthStage | None = None, threads: int = 1,
    device: torch.device | str = "cpu", pool: PromptPool | None = None,
) -> Path:  # fmt: skip
    """Train a stage, or go on with it; the checkpoint's path."""
    stage = DEPTH_STAGES[name] if stage is None else stage
    device = torch.device(device)
    torch.set_num_threads(threads)
    torch.manual_seed(stage.seed)
    tokenizer = tokenizer_of(out)
    if pool is None:
        pool = PromptPool(load_pairs(data, "edit-train", count=stage.worlds), tokenizer, device)
    net = first_net(tokenizer, stage, out).to(device)
    alphas = scheduler().alphas_cumprod.to(device)
    empty = tokens_of(tokenizer, [""])[0].to(device)

    draw = functools.partial(depth_inputs, pool, alphas, empty, stage.size)
    task = Task(1.0, stage.batch, draw, functools.partial(depth_loss, net))
    checkpoint = out / f"{name}.pt"
    train_steps(net, stage, [task], checkpoint, recipe_of(name, stage), device)
    return checkpoint


def depth_inputs(
    pool: PromptPool, alphas: Tensor, empty: Tensor, size: int, count: int, generator: torch.Generator
) -> dict[str, Tensor]:  # fmt: skip
    """Pictures at steps drawn at random as the network gets them, with their targets."""
    cells = size // BLOCK
    noise = torch.randn((count, CHANNELS, cells, cells), generator=generator, device=pool.device)
    rows, tokens = pool.prompted(noise, generator, size=size)
    left_out = pool.uniform(generator, count) < NO_PROMPT
    tokens = torch.where(left_out[:, None], empty, tokens)
    t = draw_steps(count, generator, NOISY_FROM)
    alpha = alphas[t]
    picture = pool.latents(pool.pictures(rows, rows.target, size))
    return {
        "noisy": noised(picture, noise, alpha), "control": pool.control(rows, size), "t": t, "tokens": tokens,
        "target": picture, "weight": pool.weight(rows, size), "alpha": alpha,
    }  # fmt: skip


def depth_loss(net: DepthNet, x: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of :func:`depth_inputs`."""
    prediction = net(x["noisy"], x["control"], x["t"], x["tokens"])
    loss = loss_of(prediction, x["target"], x["weight"], x["alpha"])
    return loss, {"loss": loss.detach()}
