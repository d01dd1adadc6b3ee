"""Files of weights: hashing, reading, devices and precision."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch

from attnwarp.errors import InputError


def sha256_of(files: Sequence[Path]) -> str:
    """Hash the files' bytes (SHA-256), concatenated in the order of their names."""
    total = hashlib.sha256()
    for path in sorted(files, key=lambda p: p.name):
        with path.open("rb") as stream:
            while block := stream.read(1 << 22):
                total.update(block)
    return total.hexdigest()


def state_of(path: Path) -> dict[str, torch.Tensor]:
    """Read the tensors of a .safetensors, .pth, .pt or .bin file to the CPU; run no code."""
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # both readers raise many kinds of errors
        if isinstance(error, OSError) and error.filename is not None:
            raise
        raise InputError(
            f"{path}: cannot be read as weights ({reason_of(error)}); fetch the file again"
        ) from None
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        state = state["state_dict"]
    if not isinstance(state, dict) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise InputError(f"{path}: holds no dictionary of tensors, expected a state dict")
    return {str(key): value for key, value in state.items()}


def reason_of(error: Exception) -> str:
    """Return the first line of a weight reader's error. torch's advice to load a file that may run
    code is dropped.
    """
    text = str(error).strip()
    if "weights_only" in text or "Unsupported operand" in text:
        return "it holds other objects than tensors, which could run code"
    return (text.splitlines() or [type(error).__name__])[0]


def not_finite(network: torch.nn.Module) -> list[str]:
    """List the tensors of a network that hold NaN or infinite values."""
    return [name for name, v in network.state_dict().items() if not bool(v.isfinite().all())]


@contextmanager
def silent_transformers() -> Iterator[None]:
    """Silence transformers' progress bar and advice; checks of what was loaded replace them."""
    from transformers import utils

    level, bars = utils.logging.get_verbosity(), utils.logging.is_progress_bar_enabled()
    utils.logging.set_verbosity(logging.CRITICAL)
    utils.logging.disable_progress_bar()
    try:
        yield
    finally:
        utils.logging.set_verbosity(level)
        if bars:
            utils.logging.enable_progress_bar()


@contextmanager
def full_float32() -> Iterator[None]:
    """Disable gradients, and use full float32 in convolutions: cuDNN defaults to TF32, of 10
    bits.
    """
    with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        yield
