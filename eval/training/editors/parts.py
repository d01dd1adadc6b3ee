"""An editor that answers in parts: "make each part another color" gives every part a colour that the noise there draws.

It starts from the weights of ``small-plain``. Run from the folder eval/: python -m training.editors.parts train OUT;
a stopped training goes on.
"""

from __future__ import annotations

import colorsys
import functools
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from safetensors.torch import load_file
from tokenizers import Tokenizer
from torch import Tensor
from torch.nn import functional
from transformers import PreTrainedTokenizerFast

from attnwarp.editing.editors.pix2pix import InstructPix2Pix
from attnwarp.editing.latents import BLOCK, CHANNELS, HaarLatents
from attnwarp.editing.small import IMAGE_GUIDANCE, TEXT_GUIDANCE, WEIGHTS
from attnwarp.editing.small_unet import SETTLED, PartsUNet
from attnwarp.io.file import write_atomically
from attnwarp_eval.drawn.worlds import COLORS, HSV, shade
from attnwarp_eval.scene.base import linear_rgb
from training.common import descend
from training.editors.answers import codes
from training.editors.byte_pairs import tokens_of
from training.editors.draws import ALIGNED, DRAW_GAIN
from training.editors.export import write_editor
from training.editors.net import (
    SHIFT,
    EditorNet,
    draw_steps,
    loss_of,
    noised,
    scheduler,
)
from training.editors.pool import MOST_THING_WEIGHT, THING_WEIGHT
from training.editors.recipe import DROP, weights_of
from training.steps import STEPS_AN_EPOCH, Task, train_steps
from training.worlds import recolors

START = WEIGHTS / "small-plain"

SENTENCES = (
    "make each part another color", "give each part a new color", "paint each part in a different color",
    "make every part another color", "give every part another color", "change the color of each part",
)  # fmt: skip

PALETTE = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "white")
"""The answers of a part."""

RANDOM_COLORS, SHADES = 5, 64
"""Colours before an edit: the named ones and this many others, in that many shades each."""

FORBIDDEN = 4.0
"""An answer's score falls by up to so much where the picture before has its colour."""

TEACH_STEPS, TEACH_BATCH = 1_500, 16


@dataclass(frozen=True)
class Plan:
    """The training."""

    steps: int = 6_000
    peak: float = 6e-4
    warm: int = 50
    seed: int = 21
    batch: int = 32
    worlds: int = 600
    size: int = 64
    noisy_from: int = 850


def palette() -> Tensor:
    """(8, 3) linear colours of the answers."""
    rgb = [colorsys.hsv_to_rgb(HSV[c][0] / 360, *HSV[c][1:]) for c in PALETTE]
    return torch.tensor(
        [linear_rgb("#" + "".join(f"{round(255 * v):02x}" for v in c)) for c in rgb]
    )


def srgb(linear: Tensor) -> Tensor:
    """Linear values as sRGB in [0, 1]."""
    value = linear.clamp(0, 1)
    return torch.where(
        value <= 0.0031308, 12.92 * value, 1.055 * value.clamp(min=1e-6) ** (1 / 2.4) - 0.055
    )


def directions() -> Tensor:
    """(8, 48) directions of the noise, one an answer."""
    return codes()[[COLORS.index(c) for c in PALETTE]]


class PartsNet(EditorNet):
    """Network and text encoder, with the weights of ``small-plain``."""

    def __init__(self, vocabulary: int, size: int = 64) -> None:
        super().__init__(vocabulary, size, draws=False)
        self.unet = PartsUNet.from_config(self.unet.config)
        flat = srgb(palette())[:, :, None, None].expand(-1, -1, BLOCK, BLOCK)
        self.unet.hues = HaarLatents().encode(2 * flat - 1, return_dict=False)[0][:, :3, 0, 0]
        for module, folder, name in (
            (self.unet, "unet", "diffusion_pytorch_model"), (self.text, "text_encoder", "model")
        ):  # fmt: skip
            stored = load_file(START / folder / f"{name}.safetensors")
            stored = {k: v.float() for k, v in stored.items() if not k.startswith("draw.")}
            missing = module.load_state_dict(stored, strict=False)
            assert not missing.unexpected_keys, missing


class PartsPool:
    """Pictures in light and parts, coloured by the batch."""

    def __init__(self, table: Mapping[str, Any], tokenizer: Tokenizer) -> None:
        shape = table["light"].shape
        self.light = torch.from_numpy(table["light"]).view(-1, *shape[2:])
        self.parts = torch.from_numpy(table["parts"]).flatten(0, 1)
        self.tokens, self.empty = (
            tokens_of(tokenizer, list(SENTENCES)),
            tokens_of(tokenizer, [""])[0],
        )
        rng = np.random.default_rng(41)
        named = [[linear_rgb(shade(c, rng)) for _ in range(SHADES)] for c in COLORS]
        others = rng.uniform(size=(RANDOM_COLORS, SHADES, 3)) ** 2.2
        self.bank = torch.cat([torch.tensor(named), torch.from_numpy(others).float()])
        self.palette, self.directions, self.coder = palette(), directions(), HaarLatents()

    def cut(
        self, size: int, generator: torch.Generator, number: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """Light (n, n, 3) and parts (n, n) of a picture: the full one, or a part of ``size`` about the thing; maybe mirrored.

        Args:
            number: number of the picture, shown in full and not mirrored; drawn if left out.
        """
        whole, full = number is not None, recolors.SIZE
        draw = torch.rand(6, generator=generator).tolist()
        number = int(draw[0] * len(self.light)) if number is None else number
        far = whole or draw[1] < 0.4
        parts = self.parts[number, int(draw[2] * (2 if far else 3))]
        if far:
            y, x, n = 0, 0, full
        else:
            pixels, n = parts.nonzero(), size
            middle = (
                pixels[int(draw[3] * len(pixels))].float()
                if len(pixels)
                else torch.tensor([full / 2, full / 2])
            )
            low = middle - (0.25 + 0.5 * torch.tensor(draw[3:5])) * n
            y, x = (int(v) for v in low.clamp(0, full - n))
        cuts = self.light[number, y : y + n, x : x + n].float(), parts[y : y + n, x : x + n].long()
        return (cuts[0].flip(1), cuts[1].flip(1)) if draw[5] < 0.5 and not whole else cuts

    def colored(self, cuts: list[tuple[Tensor, Tensor]], colors: Tensor, size: int) -> Tensor:
        """(B, 48, h, w) latents of pictures whose parts have (B, 16, 3) linear colours."""
        out = []
        for (light, parts), color in zip(cuts, colors, strict=True):
            color = torch.cat([torch.ones(1, 3), color])
            picture = srgb(light * color[parts]).permute(2, 0, 1)
            out.append(functional.avg_pool2d(picture, len(parts) // size))
        return self.coder.encode(2 * torch.stack(out) - 1, return_dict=False)[0]

    def before(self, count: int, generator: torch.Generator) -> Tensor:
        """(B, 16, 3) colours before an edit, each of another name."""
        kind = torch.rand(count, len(self.bank), generator=generator).argsort(dim=1)
        return self.bank[kind, torch.randint(SHADES, kind.shape, generator=generator)]

    def shares(self, cuts: list[tuple[Tensor, Tensor]], cells: int) -> Tensor:
        """(B, N, 17) share of each cell that shows each part; the first is none."""
        rows = [
            functional.one_hot(parts, len(self.bank) + 1).permute(2, 0, 1).float()
            for _, parts in cuts
        ]
        return torch.stack(
            [functional.avg_pool2d(r, r.shape[1] // cells).flatten(1).T for r in rows]
        )

    def answers(self, evidence: Tensor, shares: Tensor) -> Tensor:
        """(B, 16) the answer of each part: the one of the highest score, by the evidence averaged over the part."""
        mean = (
            shares[:, :, 1:].transpose(1, 2)
            @ evidence
            / shares[:, :, 1:].sum(dim=1).clamp(min=1e-6)[..., None]
        )
        scores = mean[..., :CHANNELS] @ self.directions.T - FORBIDDEN * mean[..., CHANNELS:]
        return scores.argmax(dim=2)

    def batch(
        self, plan: Plan, unet: PartsUNet, alphas: Tensor, count: int, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Pairs as the network gets them: the parts' answers are what their white noise selects, at settled steps any."""
        t, cells = draw_steps(count, generator, plan.noisy_from), plan.size // BLOCK
        cuts = [self.cut(plan.size, generator) for _ in range(count)]
        shares, before = (
            self.shares(cuts, cells),
            self.colored(cuts, self.before(count, generator), plan.size),
        )
        noise, other = torch.randn((2, count, CHANNELS, cells, cells), generator=generator)
        with torch.no_grad():
            evidence = unet.evidence(
                torch.where((t < SETTLED)[:, None, None, None], other, noise), before
            )
        after = self.colored(cuts, self.palette[self.answers(evidence, shares)], plan.size)
        thing = shares[:, :, 1:].sum(dim=2)
        gain = (THING_WEIGHT / thing.mean(dim=1).clamp(min=1e-3)).clamp(1, MOST_THING_WEIGHT)[
            :, None
        ]
        weight = (1 + (thing > 0) * (gain - 1)).view(count, 1, cells, cells)
        drop = torch.rand(count, generator=generator)
        tokens = self.tokens[torch.randint(len(self.tokens), (count,), generator=generator)]
        no_text = (drop < DROP) | ((drop >= 2 * DROP) & (drop < 3 * DROP))
        no_picture = ((drop >= DROP) & (drop < 3 * DROP))[:, None, None, None]
        return {
            "noisy": noised(after, noise, alphas[t]), "before": torch.where(no_picture, 0.0, before), "t": t,
            "tokens": torch.where(no_text[:, None], self.empty, tokens), "target": after, "weight": weight, "alpha": alphas[t],
            "source": before,
        }  # fmt: skip


def loss(net: PartsNet, x: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of a batch, and that of an unchanged picture beside it."""
    found = loss_of(
        net(x["noisy"], x["before"], x["t"], x["tokens"]), x["target"], x["weight"], x["alpha"]
    )
    return found, {
        "loss": found.detach(),
        "unedited": loss_of(x["source"], x["target"], x["weight"], x["alpha"]),
    }


def teach_kin(unet: PartsUNet, pool: PartsPool, plan: Plan, steps: int = TEACH_STEPS) -> float:
    """Teach which cells belong to a part, by the picture before; the last losses' mean. The weights are kept from then on."""
    optimizer = torch.optim.AdamW(unet.kin.parameters(), lr=2e-3)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    generator, losses = torch.Generator().manual_seed(plan.seed), []
    for _ in range(steps):
        cuts = [pool.cut(plan.size, generator) for _ in range(TEACH_BATCH)]
        shares = pool.shares(cuts, plan.size // BLOCK)
        before = pool.colored(cuts, pool.before(TEACH_BATCH, generator), plan.size)
        same = shares @ shares.transpose(1, 2)
        off = -(same / same.sum(dim=2, keepdim=True) * unet.alike(before)).sum(dim=2)
        thing = 1 - shares[:, :, 0]
        value = (off * (0.1 + thing)).sum() / (0.1 + thing).sum()
        descend(optimizer, unet.kin, value)
        falling.step()
        losses.append(float(value.detach()))
    unet.kin.requires_grad_(False)
    return float(np.mean(losses[-100:]))


def teach_pick(net: PartsNet, tokenizer: Tokenizer, plan: Plan, steps: int = TEACH_STEPS) -> float:
    """Teach what each answer adds to the text: the difference of "make it red" and an open sentence; the last losses' mean."""

    def states(texts: list[str]) -> Tensor:
        with torch.no_grad():
            return net.text(tokens_of(tokenizer, texts)).last_hidden_state

    opened, pick, generator = (
        states(list(SENTENCES)),
        net.unet.pick,
        torch.Generator().manual_seed(plan.seed),
    )
    base, forms = (
        opened[:, ALIGNED:].mean(dim=(0, 1)),
        ("make it {}", "paint it {}", "turn it {}", "color it {}"),
    )
    shifts = (
        torch.stack(
            [states([f.format(c) for f in forms])[:, ALIGNED:].mean(dim=(0, 1)) for c in PALETTE]
        )
        - base
    )
    empty = states([""])[:, -1]
    with torch.no_grad():
        pick[0].weight[:, : CHANNELS + len(PALETTE)] = 0
        pick[0].weight[: len(PALETTE), :CHANNELS] = DRAW_GAIN * directions()
        pick[0].weight[: len(PALETTE), CHANNELS : CHANNELS + len(PALETTE)] = (
            -DRAW_GAIN * FORBIDDEN * torch.eye(len(PALETTE))
        )
        pick[2].weight[:, : len(PALETTE)] = shifts.T
    optimizer, losses = torch.optim.AdamW(pick.parameters(), lr=5e-3, weight_decay=0.0), []
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        mean = torch.randn((256, CHANNELS), generator=generator)
        near = torch.rand((256, len(PALETTE)), generator=generator) ** 4
        best = (mean @ directions().T - FORBIDDEN * near).argmax(dim=1)
        silent = (torch.arange(256) < 64)[:, None]
        text = opened[torch.randint(len(opened), (256,), generator=generator), -1]
        found = pick(torch.cat([mean, near, torch.where(silent, empty, text)], dim=1))
        value = (found - torch.where(silent, 0.0, shifts[best])).square().mean()
        descend(optimizer, pick, value)
        falling.step()
        losses.append(float(value.detach()))
    return float(np.mean(losses[-100:]))


def recipe_of(plan: Plan) -> dict[str, Any]:
    """Everything that the result depends on."""
    names = (
        "SENTENCES",
        "PALETTE",
        "RANDOM_COLORS",
        "SHADES",
        "FORBIDDEN",
        "TEACH_STEPS",
        "TEACH_BATCH",
    )
    return {
        **asdict(plan),
        **{name: globals()[name] for name in names},
        "pictures": recolors.RECOLORS_PROTOCOL,
    }


app = typer.Typer(no_args_is_help=True)


@app.command()
def train(
    out: Path,
    worlds: Annotated[
        int, typer.Option(help="Training worlds, rendered where they are missing.")
    ] = 600,
) -> None:
    """Train, or go on with it (a step takes 1.3 s of one CPU core)."""
    train_parts(out, Plan(worlds=worlds))


def train_parts(out: Path, plan: Plan, teach_steps: int = TEACH_STEPS) -> PartsNet:
    """Train with the pictures and checkpoints of a folder, or go on with it; the network with its averaged weights."""
    torch.set_num_threads(1)
    tokenizer = Tokenizer.from_file(str(START / "tokenizer" / "tokenizer.json"))
    pool = PartsPool(recolors.load(out / "data", "train", plan.worlds), tokenizer)
    first, alphas = out / "parts-start.pt", scheduler(SHIFT).alphas_cumprod
    torch.manual_seed(plan.seed)
    net = PartsNet(tokenizer.get_vocab_size(), plan.size)
    if not first.exists():
        taught = (
            teach_kin(net.unet, pool, plan, teach_steps),
            teach_pick(net, tokenizer, plan, teach_steps),
        )
        print("parts {:.3f}, answers {:.5f}".format(*taught), flush=True)
        write_atomically(first, functools.partial(torch.save, net.state_dict()))
    net.load_state_dict(torch.load(first, weights_only=True))
    net.unet.kin.requires_grad_(False)  # the answers depend on it
    draw = functools.partial(pool.batch, plan, net.unet, alphas)
    tasks = [Task(1.0, plan.batch, draw, functools.partial(loss, net))]
    train_steps(
        net, plan, tasks, out / "parts.pt", recipe_of(plan), torch.device("cpu"), warm=plan.warm
    )
    return load_parts(out)


def load_parts(out: Path, *, averaged: bool = True) -> PartsNet:
    """The network with the averaged or the last weights of a folder's checkpoint, or as it was taught where there is none."""
    tokenizer = Tokenizer.from_file(str(START / "tokenizer" / "tokenizer.json"))
    net = PartsNet(tokenizer.get_vocab_size())
    if not (out / "parts.pt").exists():
        weights = torch.load(out / "parts-start.pt", weights_only=True)
    elif averaged:
        weights = weights_of(out, "parts")
    else:
        weights = torch.load(out / "parts.pt", weights_only=True)["net"]
    net.load_state_dict(weights)
    return net.eval()


@app.command()
def export(out: Path, folder: Path = WEIGHTS / "small-parts") -> None:
    """Write the editor with its averaged weights, into the package if no other folder is named."""
    tokenizer = Tokenizer.from_file(str(START / "tokenizer" / "tokenizer.json"))
    typer.echo(write_editor(folder, load_parts(out), tokenizer, "PartsUNet", SHIFT))


@app.command()
def assess(
    out: Path,
    worlds: Annotated[int, typer.Option(help="Test worlds, a multiple of 10.")] = 40,
    averaged: Annotated[
        bool, typer.Option(help="Averaged weights; early in a training the last ones are better.")
    ] = True,
) -> None:
    """Measure the editor as far as it has come, on worlds that it has never seen (15 minutes)."""
    from training.assess.part_answers import Cases, Kept, part_figures

    torch.set_num_threads(1)
    table = recolors.load(out / "data", "test", worlds)
    editor, step = editor_of(out, averaged)
    pool = PartsPool(table, Tokenizer.from_file(str(START / "tokenizer" / "tokenizer.json")))
    name = f"assessed-{worlds}-{step:05d}" + "-last" * (not averaged)
    for one in part_figures(editor, Cases(table, pool), kept=Kept(out / f"{name}.json")):
        print(f"| {one.what} | {one} | {one.count} |", flush=True)


def editor_of(out: Path, averaged: bool) -> tuple[InstructPix2Pix, int]:
    """The editor of a folder's checkpoint, with the bundled editors' guidance, and the number of its steps."""
    path, net = out / "parts.pt", load_parts(out, averaged=averaged)
    epochs = int(torch.load(path, weights_only=True)["epoch"]) if path.exists() else 0
    words = PreTrainedTokenizerFast.from_pretrained(START / "tokenizer")
    editor = InstructPix2Pix(
        net.unet, HaarLatents(), net.text, words, scheduler(SHIFT), text_guidance=TEXT_GUIDANCE, image_guidance=IMAGE_GUIDANCE
    )  # fmt: skip
    return editor, STEPS_AN_EPOCH * epochs


if __name__ == "__main__":
    app()
