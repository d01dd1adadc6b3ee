"""Memory of an editor: what its weights take, and diffusers' own switches that take less."""

from __future__ import annotations

from typing import Any

import torch

from attnwarp.devices import device_of
from attnwarp.errors import optional_imports

NETWORKS: dict[str, dict[str, Any]] = {
    "unet": {"offload_type": "block_level", "num_blocks_per_group": 1},
    "controlnet": {"offload_type": "block_level", "num_blocks_per_group": 1},
    # Their parts are called from outside the network's own forward.
    "vae": {"offload_type": "leaf_level"},
    "text_encoder": {"offload_type": "leaf_level"},
}
"""Networks of an editor, and what of each is moved together."""


def weight_bytes(editor: Any) -> int:
    """Bytes of an editor's weights as loaded; what layers compute comes on top.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> round(weight_bytes(load_editor("small-plain")) / 2**20)  # MiB
        14
    """
    return sum(
        tensor.numel() * tensor.itemsize
        for name in NETWORKS
        if (network := getattr(editor, name, None)) is not None
        for tensor in network.state_dict().values()
    )


def save_memory(editor: Any, device: str) -> None:
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
        >>> load_editor("small-plain", low_memory=True).unet.device  # on a GPU: cuda
        device(type='cpu')
    """
    with optional_imports():
        import accelerate  # noqa: F401
    from diffusers.hooks import apply_group_offloading

    if hasattr(editor.vae, "enable_tiling"):
        editor.vae.enable_tiling()
    for name, how in NETWORKS.items():
        if (network := getattr(editor, name, None)) is not None:
            apply_group_offloading(
                network, onload_device=device_of(device), offload_device=torch.device("cpu"), **how
            )
