"""Memory of an editor: its weights and activations, and diffusers' memory-saving options."""

from __future__ import annotations

import json
import math
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

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


class _Live(TorchDispatchMode):
    """Counter of the bytes of live tensors that operations create."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.most = 0
        self._seen: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        # A view of what an operation reads, such as of a weight, is no new memory.
        read = {s._cdata for s in _storages((args, kwargs))}
        for storage in _storages(result):
            if storage._cdata not in self._seen | read:
                self._seen.add(storage._cdata)
                self.now += storage.nbytes()
                self.most = max(self.most, self.now)
                weakref.finalize(storage, self._free, storage._cdata, storage.nbytes())
        return result

    def _free(self, key: int, count: int) -> None:
        self._seen.discard(key)
        self.now -= count


def _storages(values: Any) -> list[Any]:
    tensors = (value for value in tree_leaves(values) if isinstance(value, torch.Tensor))
    return [tensor.untyped_storage() for tensor in tensors]


class _Fused(TorchFunctionMode):
    """Attention as fused kernels run it: without its table of scores."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.nn.functional.scaled_dot_product_attention:
            return torch.empty_like(args[0] if args else kwargs["query"])
        return func(*args, **(kwargs or {}))


def peak_bytes(run: Callable[[], Any]) -> int:
    """Measure the largest number of bytes that tensors created by a function hold at once.

    Attention counts as fused. On torch's device "meta" nothing is computed or held.

    Example:
        >>> def twice():
        ...     x = torch.zeros(10, dtype=torch.float32, device="meta")
        ...     return x + 1
        >>> peak_bytes(twice)
        80
    """
    with torch.no_grad(), _Live() as live, _Fused():
        run()
    return live.most


def announced(
    name_or_folder: str,
    dtype: torch.dtype,
    device: str,
    size: int | None = None,
    recorded: Callable[[Editor, tuple[int, int]], str] | None = None,
) -> str | None:
    """Describe the memory of an editor's weights, a view's edit and its features, before anything
    is loaded.

    Args:
        size: side of a square view in px; the editor's own if omitted.
        recorded: (editor without weights, (h, w) of a view's latents) -> words on features.

    Example:
        >>> announced("small-plain", torch.float16, "cuda")
        'weights of the editor in float16: 0.01 GiB'
    """
    from attnwarp.editing.small import bundled, folders_of, kind_of

    folder, control = folders_of(name_or_folder)
    plain = name_or_folder in bundled() or control is not None
    rehearse = None if plain else getattr(kind_of(folder), "rehearsed", None)
    if rehearse is None and device == "cpu":
        return None
    weights = folder_bytes(folder, dtype)
    if control is not None and control.parent != folder:
        weights += folder_bytes(control, dtype)
    kind = str(dtype).removeprefix("torch.")
    line = f"weights of the editor in {kind}: {weights / 2**30:.2f} GiB"
    if rehearse is None:
        return line
    editor, side, peak = rehearse(folder, dtype, size)
    line += f"; an edit of a view of {side} x {side} px beside them: {peak / 2**30:.2f} GiB"
    return f"{line}; {recorded(editor, editor.noise_shape((side, side))[1:])}" if recorded else line


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
