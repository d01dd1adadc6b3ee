"""Recipe of ``small-depth``: a depth map and a prompt give a picture, by a small depth ControlNet.

UNet and ControlNet (Zhang et al. 2023, "Adding Conditional Control to Text-to-Image Diffusion Models")
are trained together: with no large text-to-image model to keep, there is nothing to freeze.
Latents, noise schedule and loss are those of :mod:`training.editor`, and so are the first weights.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import yaml
from tokenizers import Tokenizer

from attnwarp.editing.controlnet import control_image
from attnwarp.editing.latents import CHANNELS
from training.clip import true_of
from training.common import Run, groups
from training.editing_pairs import LOOKS, PAIRS_PROTOCOL, SIZE, VIEWS, Worlds, load_pairs
from training.editor import (
    EMA,
    HEADS,
    LAYERS,
    STEPS_AN_EPOCH,
    TEXT_WIDTH,
    WIDTHS,
    EditorNet,
    Pairs,
    Row,
    draw_steps,
    falling_rate,
    loss_of,
    noised,
    picked,
    scheduler,
    tokens_of,
)
from training.worlds import sentence

Tensor = torch.Tensor

CONTROL_WIDTHS = (16, 32, 64)
"""Channels of the convolutions that bring a depth map to the latents' size; each but the first halves it."""

NOISY_FROM = 600
"""Most steps are drawn from here on."""

NO_PROMPT = 0.1
"""Probability that the prompt is left out, for guidance."""

NAMES_PLACE = 0.8
"""Probability that a prompt names the ground, and that it names the time of day, each."""

GUIDANCE = 2.0
"""Of the bundled editor; ControlNet's own 5 to 7.5 saturates its colours."""


@dataclass(frozen=True)
class DepthStage:
    """A part of the training, which can be stopped and gone on with.

    Attributes:
        size: of the pictures in px.
        steps: of ``batch`` pictures each.
        peak: learning rate, which falls over the last 30 %.
        worlds: how many of the training worlds are used.
        start: the editor's stage whose text encoder and UNet this one starts from.
        batch: pictures a step.
        seed: of everything random.
    """

    size: int
    steps: int
    peak: float
    worlds: int
    start: str
    batch: int = 8
    seed: int = 0


DEPTH_STAGES = {"depth-64": DepthStage(64, 6_000, 1e-3, 200, start="plain-64", seed=5)}


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
        context = self.text(tokens).last_hidden_state
        down, middle = self.controlnet(noisy, t, context, control, return_dict=False)
        return self.unet(
            noisy, t, context, down_block_additional_residuals=down, mid_block_additional_residual=middle,
            return_dict=False,
        )[0]  # fmt: skip


@functools.cache
def reserved_prompts() -> frozenset[str]:
    """Descriptions in the package's scenes, in lower case: no recipe may learn from one."""
    import attnwarp_eval

    folder = (Path(attnwarp_eval.__file__).parent / "scenes").resolve()
    edits = [
        edit
        for path in sorted(folder.glob("*.yaml"))
        for edit in yaml.safe_load(path.read_text()).get("edits", ())
    ]
    answers = [answer for edit in edits for answer in edit.get("answers", ())]
    texts = [one[key] for one in (*edits, *answers) for key in ("source", "target") if key in one]
    return frozenset(text.lower() for text in texts)


def attributes_of(worlds: Worlds, world: int) -> npt.NDArray[np.int64]:
    """(LOOKS, 6) attributes of a world's looks, in the order of :func:`training.worlds.attributes`."""
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


class Prompts(Pairs):
    """Draws depth maps with a prompt and the picture that it describes, from worlds."""

    def control(self, row: Row) -> npt.NDArray[np.float32]:
        """(S, S, 3) control picture of a row's depth map."""
        y, x, n = row.corner
        depth = self.worlds.depth[row.world, row.view, y : y + n * self.size, x : x + n * self.size]
        # A mean over an edge would be a depth where nothing is.
        depth = depth[n // 2 :: n, n // 2 :: n]
        if not np.isfinite(depth).any():
            return np.zeros((*depth.shape, 3), dtype=np.float32)
        return control_image(depth[:, ::-1] if row.flip else depth)

    def prompted(
        self, rng: np.random.Generator, noise: Tensor, world: int | None = None
    ) -> tuple[Row, str]:
        """Draw a picture and its prompt; where the prompt is true of several, the noise picks one.

        Args:
            rng: to draw from.
            noise: (48, h, w) of the latents.
            world: any if left out.
        """
        worlds = self.worlds
        world = int(rng.integers(len(worlds))) if world is None else world
        view = int(rng.integers(VIEWS))
        valid = np.flatnonzero(worlds.valid[world])
        looks = attributes_of(worlds, world)
        text, values = draw_prompt(looks[int(rng.choice(valid))], rng)
        candidates = valid[true_of(values[None], looks[valid])[:, 0]]
        look = picked(noise, candidates.tolist())
        corner = self.corner(world, view, rng) if self.size < SIZE else (0, 0, 1)
        row = Row(world, view, look, look, "color", False, corner, bool(rng.uniform() < 0.5))
        return row, text


def recipe_of(name: str, stage: DepthStage) -> dict[str, Any]:
    """Everything that a stage's result depends on."""
    from training import editor

    constants = {key: getattr(editor, key) for key in editor.CONSTANTS}
    constants |= {
        "CONTROL_WIDTHS": CONTROL_WIDTHS, "NO_PROMPT": NO_PROMPT, "NAMES_PLACE": NAMES_PLACE,
    }  # fmt: skip
    return {"stage": name, **asdict(stage), "constants": constants, "pairs": PAIRS_PROTOCOL}


def first_net(tokenizer: Tokenizer, stage: DepthStage, out: Path) -> DepthNet:
    """The networks that a stage starts from."""
    size = tokenizer.get_vocab_size()
    first = EditorNet(size, stage.size, draws=False)
    stored = torch.load(out / f"{stage.start}.pt", weights_only=True)["average"]
    first.load_state_dict(
        {k.removeprefix("module."): v for k, v in stored.items() if k != "n_averaged"}
    )
    return DepthNet(size, stage.size, first)


def train_depth_stage(
    name: str, data: Path, out: Path, *, stage: DepthStage | None = None, threads: int = 1
) -> Path:
    """Train a stage, or go on with it; the checkpoint's path.

    Args:
        name: a key of :data:`DEPTH_STAGES`.
        data: folder of the pictures, rendered where they are missing.
        out: folder of checkpoints, with the one that the stage starts from.
        stage: in place of the one of that name.
        threads: of torch.
    """
    from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

    stage = DEPTH_STAGES[name] if stage is None else stage
    torch.set_num_threads(threads)
    torch.manual_seed(stage.seed)
    tokenizer = Tokenizer.from_file(str(out / "tokenizer.json"))
    prompts = Prompts(load_pairs(data, "edit-train", count=stage.worlds), stage.size, tokenizer)
    net = first_net(tokenizer, stage, out)
    average = AveragedModel(net, multi_avg_fn=get_ema_multi_avg_fn(EMA))
    optimizer = torch.optim.AdamW(groups(net, 0.01), lr=stage.peak, betas=(0.9, 0.99))
    alphas = scheduler().alphas_cumprod

    def epoch(number: int) -> dict[str, float]:
        rng = np.random.default_rng([stage.seed, number])
        generator = torch.Generator().manual_seed(1_000_003 * stage.seed + number)
        net.train()
        total = 0.0
        for step in range(STEPS_AN_EPOCH):
            for group in optimizer.param_groups:
                group["lr"] = falling_rate(number * STEPS_AN_EPOCH + step, stage.steps, stage.peak)
            loss = depth_loss(prompts, net, alphas, stage.batch, rng, generator)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimizer.step()
            average.update_parameters(net)
            total += float(loss.detach()) / STEPS_AN_EPOCH
        return {"loss": total}

    checkpoint = out / f"{name}.pt"
    state = {"net": net, "average": average, "optimizer": optimizer}
    Run(checkpoint, state, stage.steps // STEPS_AN_EPOCH, recipe_of(name, stage)).train(epoch)
    return checkpoint


def depth_loss(
    prompts: Prompts, net: DepthNet, alphas: Tensor, count: int, rng: np.random.Generator,
    generator: torch.Generator,
) -> Tensor:  # fmt: skip
    """The loss of ``count`` pictures at steps drawn at random."""
    assert prompts.tokenizer is not None
    cells = prompts.size // 4
    noise = torch.randn((count, CHANNELS, cells, cells), generator=generator)
    drawn = [prompts.prompted(rng, noise[k]) for k in range(count)]
    rows, texts = [row for row, _ in drawn], [text for _, text in drawn]
    texts = ["" if rng.uniform() < NO_PROMPT else text for text in texts]
    t = draw_steps(count, rng, NOISY_FROM)
    a = alphas[t]
    picture = prompts.latents([prompts.picture(row, row.target) for row in rows])
    control = torch.from_numpy(np.stack([prompts.control(row) for row in rows])).permute(0, 3, 1, 2)
    weight = torch.from_numpy(np.stack([prompts.weight(row) for row in rows]))[:, None]
    tokens = tokens_of(prompts.tokenizer, texts)
    prediction = net(noised(picture, noise, a), control, t, tokens)
    return loss_of(prediction, picture, weight, a)
