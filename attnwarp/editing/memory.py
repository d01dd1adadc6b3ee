"""Memory of an editor: what its weights take, and diffusers' own switches that take less."""

from __future__ import annotations

from typing import Any

import torch

from attnwarp.devices import device_of
from attnwarp.editing.editor import Editor
from attnwarp.errors import optional_imports

BLOCKS = {"offload_type": "block_level", "num_blocks_per_group": 1}

LEAVES = {"offload_type": "leaf_level"}
"""Offloading of networks whose parts are called from outside their own forward."""


def networks_of(editor: Editor) -> dict[str, Any]:
    """Networks of an editor by name."""
    return {k: part for k, part in editor.parts.items() if isinstance(part, torch.nn.Module)}


def weight_bytes(editor: Editor) -> int:
    """Bytes of an editor's weights as loaded; what layers compute comes on top.

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
    """Keep an editor's weights in main memory, and compute on a device all the same.

    Each block of a network is moved to the device while it computes (diffusers' group offloading),
    and the autoencoder takes pictures larger than it was made for in tiles, whose seams it blends.
    Attention in slices is none of it: torch's own attention takes less memory than slices do.

    Args:
        editor: editor with networks that lie in main memory.
        device: that computes, "cpu" or "cuda".

    Raises:
        InputError: no such device.
        MissingExtraError: accelerate is not installed, by which diffusers moves blocks.

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
