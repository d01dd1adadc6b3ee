"""Memory of an editor: its weights, and diffusers' memory-saving options."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch

from attnwarp.devices import device_of
from attnwarp.editing.editor import Editor
from attnwarp.errors import optional_imports

BLOCKS = {"offload_type": "block_level", "num_blocks_per_group": 1}

LEAVES = {"offload_type": "leaf_level"}
"""Offloading options of networks whose submodules are called outside their forward."""


def networks_of(editor: Editor) -> dict[str, Any]:
    """Map names to the networks of an editor."""
    return {k: part for k, part in editor.parts.items() if isinstance(part, torch.nn.Module)}


def weight_bytes(editor: Editor) -> int:
    """Count the bytes of an editor's loaded weights; activations need additional memory."""
    return sum(
        tensor.numel() * tensor.itemsize
        for network in networks_of(editor).values()
        for tensor in network.state_dict().values()
    )


def folder_bytes(folder: Path, dtype: torch.dtype) -> int:
    """Count the bytes of a folder's weights in a dtype, from the heads of its safetensors files;
    networks in other formats count as their files.
    """
    total = 0
    for place in {path.parent for name in ("", "*/") for path in folder.glob(f"{name}config.json")}:
        files = [f for f in place.glob("*.safetensors") if ".fp16." not in f.name]
        for path in files or [*place.glob("*.safetensors"), *place.glob("*.bin")]:
            total += (
                _tensor_bytes(path, dtype) if path.suffix == ".safetensors" else path.stat().st_size
            )
    return total


def _tensor_bytes(path: Path, dtype: torch.dtype) -> int:
    with path.open("rb") as stream:
        head = json.loads(stream.read(int.from_bytes(stream.read(8), "little")))
    head.pop("__metadata__", None)
    return sum(math.prod(tensor["shape"]) for tensor in head.values()) * dtype.itemsize


def announced(name_or_folder: str, dtype: torch.dtype, device: str) -> str | None:
    """Describe the memory of an editor's weights, before anything is loaded; None for a small
    editor on a processor.

    Example:
        >>> announced("small-plain", torch.float16, "cuda")
        'weights of the editor in float16: 0.01 GiB'
    """
    from attnwarp.editing.joint import Joint
    from attnwarp.editing.small import bundled, folders_of, kind_of

    folder, control = folders_of(name_or_folder)
    plain = name_or_folder in bundled() or control is not None
    if device == "cpu" and (plain or not issubclass(kind_of(folder), Joint)):
        return None
    weights = folder_bytes(folder, dtype)
    if control is not None and control.parent != folder:
        weights += folder_bytes(control, dtype)
    kind = str(dtype).removeprefix("torch.")
    return f"weights of the editor in {kind}: {weights / 2**30:.2f} GiB"


def save_memory(editor: Editor, device: str) -> None:
    """Keep an editor's weights in main memory, and compute on a device.

    Each block of a network is moved to the device while it computes (diffusers' group offloading),
    and the autoencoder processes pictures beyond its training size in blended tiles. Attention is
    not sliced, since torch's attention takes less memory than slices do.

    Raises:
        InputError: the device is unknown.
        MissingExtraError: accelerate, which diffusers needs to move blocks, is not installed.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> load_editor("small-plain", low_memory=True).network.device  # on a GPU: cuda
        device(type='cpu')
    """
    with optional_imports():
        import accelerate  # noqa: F401
    from diffusers.hooks import apply_group_offloading

    for name, network in networks_of(editor).items():
        coder = name.startswith(("vae", "text_encoder"))
        if hasattr(network, "enable_tiling"):
            network.enable_tiling()
        apply_group_offloading(
            network, onload_device=device_of(device), offload_device=torch.device("cpu"),
            **(LEAVES if coder else BLOCKS),
        )  # fmt: skip
