"""Bundled editors in diffusers' format, from a stage's checkpoint."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tokenizers import Tokenizer

from attnwarp.editing.latents import HaarLatents
from attnwarp.editing.small import write_sums
from training import steps
from training.editors.depth import DEPTH_STAGES, DepthNet
from training.editors.net import TOKENS, EditorNet, scheduler
from training.editors.recipe import STAGES, tokenizer_of


@dataclass(frozen=True)
class Spent:
    """Steps and time that a stage took so far.

    Attributes:
        steps: taken.
        seconds: of them.
        device: on which.
    """

    steps: int
    seconds: float
    device: str


def averaged(stage: str, out: Path) -> tuple[EditorNet, Tokenizer, Spent]:
    """The averaged networks of a checkpoint, the tokenizer, and what it took so far."""
    tokenizer = tokenizer_of(out)
    net = EditorNet(tokenizer.get_vocab_size(), STAGES[stage].size, draws=STAGES[stage].draws)
    return net, tokenizer, _load(net, out / f"{stage}.pt")


def depth_averaged(stage: str, out: Path) -> tuple[DepthNet, Tokenizer, Spent]:
    """Averaged network, as :func:`averaged`, of a stage of :mod:`training.editors.depth`."""
    tokenizer = tokenizer_of(out)
    net = DepthNet(tokenizer.get_vocab_size(), DEPTH_STAGES[stage].size)
    return net, tokenizer, _load(net, out / f"{stage}.pt")


def _load(net: torch.nn.Module, checkpoint: Path) -> Spent:
    """Load a checkpoint's averaged weights."""
    stored = torch.load(checkpoint, weights_only=True, map_location="cpu")
    average = {k.removeprefix("module."): v for k, v in stored["average"].items()}
    del average["n_averaged"]
    net.load_state_dict(average)
    net.eval()
    taken = steps.STEPS_AN_EPOCH * int(stored["epoch"])
    return Spent(taken, float(stored["seconds"]), stored.get("device", "one CPU core"))


def export_editor(stage: str, out: Path, folder: Path) -> Path:
    """Write a stage's editor to ``folder`` in half precision, as diffusers and transformers load it."""
    net, tokenizer, _ = averaged(stage, out)
    parts = {"unet": ["attnwarp.editing.small_unet", "EditUNet"]}
    pipeline = "StableDiffusionInstructPix2PixPipeline"
    return _write(folder, net, tokenizer, pipeline, parts, STAGES[stage].shift)


def export_depth_editor(stage: str, out: Path, folder: Path) -> Path:
    """Write a stage of :mod:`training.editors.depth` to ``folder``, as :func:`export_editor` does."""
    net, tokenizer, _ = depth_averaged(stage, out)
    net.half()
    net.controlnet.save_pretrained(folder / "controlnet")
    parts = {
        "unet": ["diffusers", "UNet2DConditionModel"], "controlnet": ["diffusers", "ControlNetModel"],
    }  # fmt: skip
    return _write(folder, net, tokenizer, "StableDiffusionControlNetPipeline", parts, 1)


def _write(
    folder: Path, net: Any, tokenizer: Tokenizer, pipeline: str, parts: dict[str, list[str]],
    shift: float,
) -> Path:  # fmt: skip
    """Write what both kinds have, the list of all parts and their checksums."""
    from transformers import PreTrainedTokenizerFast

    net.half()
    net.unet.save_pretrained(folder / "unet")
    net.text.save_pretrained(folder / "text_encoder")
    HaarLatents().save_pretrained(folder / "vae")
    scheduler(shift).save_pretrained(folder / "scheduler")
    words = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", eos_token="<end>", model_max_length=TOKENS
    )
    words.save_pretrained(folder / "tokenizer")
    index = {
        "_class_name": pipeline, "requires_safety_checker": False, **parts,
        "vae": ["attnwarp.editing.latents", "HaarLatents"],
        "text_encoder": ["transformers", "CLIPTextModel"], "tokenizer": ["transformers", "PreTrainedTokenizerFast"],
        "scheduler": ["diffusers", "DDIMScheduler"], "safety_checker": [None, None], "feature_extractor": [None, None],
        "image_encoder": [None, None],
    }  # fmt: skip
    (folder / "model_index.json").write_text(json.dumps(index, indent=1) + "\n")
    write_sums(folder)
    for path in folder.rglob("*"):  # safetensors makes files that only their owner can read
        path.chmod(0o755 if path.is_dir() else 0o644)
    return folder


def facts_of(stage: str, out: Path) -> dict[str, object]:
    """Facts in an editor's card about its training."""
    spent, plan = averaged(stage, out)[2], STAGES[stage]
    before, seconds, start = 0, spent.seconds, plan.start
    while start is not None:
        earlier = averaged(start, out)[2]
        before, seconds, start = (
            before + earlier.steps,
            seconds + earlier.seconds,
            STAGES[start].start,
        )
    done = spent.steps >= plan.steps
    return {
        "steps": spent.steps, "planned": plan.steps, "before": before, "batch": plan.batch, "minutes": seconds / 60,
        "device": spent.device, "worlds": plan.worlds, "parts": plan.parts, "large": plan.size * 2 if plan.large else 0,
        "state": "The stage is complete." if done else "Unfinished: a milestone, to be replaced.",
        "injection": {
            "none": "none; what its attention features carry, it learned from editing alone.",
            "features": "trained with injected features, so that its features would carry the answer; the figures of swapped"
            " features say how far they do. No claim about an editor's own working may rest on it alone.",
            "control": "the same steps as the injection stage without the injection.",
        }[plan.inject],
    }  # fmt: skip


def depth_facts_of(stage: str, out: Path) -> dict[str, object]:
    """Facts in the card of an editor of depth maps about its training."""
    spent, plan = depth_averaged(stage, out)[2], DEPTH_STAGES[stage]
    done = spent.steps >= plan.steps
    return {
        "steps": spent.steps, "planned": plan.steps, "batch": plan.batch, "minutes": spent.seconds / 60,
        "device": spent.device, "worlds": plan.worlds,
        "start": plan.start,
        "state": "The stage is complete." if done else "Unfinished: a milestone, to be replaced.",
    }  # fmt: skip
