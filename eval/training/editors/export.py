"""Bundled editors in diffusers' format, from a stage's checkpoint."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from tokenizers import Tokenizer

from attnwarp.editing.latents import HaarLatents
from attnwarp.editing.small import SUMS
from training.editors.net import TOKENS, EditorNet, scheduler
from training.editors.recipe import STAGES, tokenizer_of, weights_of


def export_editor(stage: str, out: Path, folder: Path) -> Path:
    """Write a stage's editor to ``folder`` in half precision, as diffusers and transformers load it."""
    tokenizer, plan = tokenizer_of(out), STAGES[stage]
    net = EditorNet(tokenizer.get_vocab_size(), plan.size, draws=plan.draws)
    net.load_state_dict(weights_of(out, stage))
    return write_editor(folder, net, tokenizer, "EditUNet", plan.shift)


def write_editor(
    folder: Path, net: EditorNet, tokenizer: Tokenizer, unet: str, shift: float
) -> Path:
    """Write an editor's folder with the list of its parts and their checksums; ``unet`` is its class."""
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
        "_class_name": "StableDiffusionInstructPix2PixPipeline", "requires_safety_checker": False,
        "unet": ["attnwarp.editing.small_unet", unet],
        "vae": ["attnwarp.editing.latents", "HaarLatents"],
        "text_encoder": ["transformers", "CLIPTextModel"], "tokenizer": ["transformers", "PreTrainedTokenizerFast"],
        "scheduler": ["diffusers", "DDIMScheduler"], "safety_checker": [None, None], "feature_extractor": [None, None],
        "image_encoder": [None, None],
    }  # fmt: skip
    (folder / "model_index.json").write_text(json.dumps(index, indent=1) + "\n")
    _write_sums(folder)
    for path in folder.rglob("*"):  # safetensors makes files that only their owner can read
        path.chmod(0o755 if path.is_dir() else 0o644)
    return folder


def _write_sums(folder: Path) -> None:
    """Write the SHA-256 of every file of an editor, for :func:`attnwarp.editing.small.check_sums`."""
    files = sorted(path for path in folder.rglob("*") if path.suffix in (".json", ".safetensors"))
    sums = {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.name != SUMS
    }
    (folder / SUMS).write_text(json.dumps(sums, indent=1) + "\n")
