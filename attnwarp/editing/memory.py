"""Memory of an editor: the size of its weights, and diffusers' memory-saving options."""

from __future__ import annotations

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
    """Count the bytes of an editor's loaded weights; activations need additional memory.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> round(weight_bytes(load_editor("small-plain")) / 2**20)  # MiB
        14
    """
    return sum(
        tensor.numel() * tensor.itemsize
        for network in networks_of(editor).values()
        for tensor in network.state_dict().values()
    )


def save_memory(editor: Editor, device: str) -> None:
    """Keep an editor's weights in main memory, and compute on a device.

    Each block of a network is moved to the device while it computes (diffusers' group offloading),
    and the autoencoder processes pictures beyond its training size in blended tiles. Attention is
    not sliced, since torch's attention takes less memory than slices do.

    Args:
        editor: editor whose networks are in main memory.
        device: computing device, "cpu" or "cuda".

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
