"""Identity of an editor: SHA-256 of all that decides its pictures.

Weights are hashed once. The hash of a network that was loaded from files is kept in the folder of
derived files by their paths, sizes and times of change; a network made or changed in memory is
hashed each time.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attnwarp.digest import digest, digest_each
from attnwarp.editing.editor import Editor
from attnwarp.editing.schedule import Schedule
from attnwarp.io.file import write_atomically
from attnwarp.process import cache_dir

SAMPLES = 16
"""Number of values of each tensor by which a change that torch does not count is noticed."""


State = tuple[str, int, int]
"""A file's path, size in bytes, and time of change in ns."""


def files_of(folder: Path) -> list[State]:
    """List the states of a folder's files."""
    return [_state(path) for path in sorted(folder.iterdir()) if path.is_file()]


def _state(path: Path) -> State:
    state = path.stat()
    return str(path.resolve()), state.st_size, state.st_mtime_ns


def mark_loaded(network: Any, files: list[State]) -> None:
    """Note on a network the files that it was loaded from, and the state of its tensors."""
    network.loaded_from = files, _versions(network)


def _versions(network: Any) -> dict[str, int] | None:
    """Count the changes of each tensor in place; None if torch does not count them."""
    tensors = network.state_dict()
    if any(tensor.is_inference() for tensor in tensors.values()):
        return None
    return {name: tensor._version for name, tensor in tensors.items()}


def editor_digest(editor: Editor) -> str:
    """Hash an editor's networks, layers, schedule, options and tokenizer (SHA-256)."""
    # One list, since concatenated numbers are ambiguous: 1.5 and 12 read as 1.51 and 2.
    values = [type(editor).__name__, {name: getattr(editor, name) for name in editor.options}]
    values += [*map(repr, editor.layers()), *_identity(editor.schedule)]
    parts: list[Any] = [values]
    for name, part in sorted(editor.parts.items()):
        network = isinstance(part, torch.nn.Module)
        parts += [
            name,
            *([_configuration(part), weights_digest(part)] if network else [_tokens(part)]),
        ]
    return digest(*parts)


def weights_digest(network: torch.nn.Module) -> str:
    """Hash a network's tensors (SHA-256), or find the hash of those in the same files."""
    tensors = sorted(network.state_dict().items())
    parts = (
        part
        for name, tensor in tensors
        for part in (name, str(tensor.dtype), list(tensor.shape), _bytes(tensor.flatten()))
    )
    return _once(_loaded(network), lambda: digest_each(parts))


def file_digest(path: Path) -> str:
    """Hash a file (SHA-256), or find its hash by its path, size and time of change."""

    def made() -> str:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    state = _state(path)
    # A change within the clock's step, a hundredth of a second, could leave the time as it is.
    return _once(None if time.time() - state[2] / 1e9 < 2 else [state], made)


def _once(key: Any, make: Callable[[], str]) -> str:
    """Find a hash in the folder of derived files, or make and keep it; None keeps none."""
    if key is None:
        return make()
    path = cache_dir() / "hashes" / digest(key)
    with suppress(OSError):
        if len(kept := path.read_text()) == 64:
            return kept
    made = make()
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, lambda stream: stream.write(made.encode()), durable=False)
    return made


def _loaded(network: torch.nn.Module) -> list[Any] | None:
    """Describe a network as loaded; None if it is not as its files have it."""
    files, versions = getattr(network, "loaded_from", (None, None))
    if versions is None or versions != _versions(network):
        return None
    samples = {
        name: _bytes(tensor.flatten()[:: max(1, tensor.numel() // SAMPLES)]).tobytes().hex()
        for name, tensor in network.state_dict().items()
    }
    return [files, str(getattr(network, "dtype", "")), samples]


def _bytes(values: torch.Tensor) -> np.ndarray[Any, Any]:
    return values.detach().cpu().contiguous().view(torch.uint8).numpy()


def _identity(schedule: Schedule) -> list[Any]:
    """List the fields of a schedule; a few step numbers identify its spacing of steps."""
    fields = {k: v for k, v in sorted(vars(schedule).items()) if not callable(v)}
    numbers = {k: v.tolist() if isinstance(v, torch.Tensor) else v for k, v in fields.items()}
    spacing = [list(schedule.timesteps(n, (64, 64))) for n in (1, 2, 7)]
    return [type(schedule).__name__, numbers, spacing]


def _configuration(network: Any) -> list[tuple[str, str]]:
    """List a network's configuration, without its path and library version."""
    config = getattr(network, "config", {})
    # transformers' configurations have hundreds of defaults, which change between versions.
    said = config.to_diff_dict() if hasattr(config, "to_diff_dict") else dict(config)
    about = ("architectures", "dtype", "torch_dtype", "transformers_version")
    return sorted((k, repr(v)) for k, v in said.items() if k not in about and k[0] != "_")


def _tokens(tokenizer: Any) -> Any:
    """Identify a tokenizer: vocabulary, merges, rules, padding, and length."""
    padding = [tokenizer.pad_token_id, tokenizer.model_max_length]
    backend = getattr(tokenizer, "backend_tokenizer", None)
    if backend is None:
        return [padding, sorted(tokenizer.get_vocab().items())]
    said = json.loads(backend.to_str())
    # The serialised tokenizer also contains the padding and truncation of its last call.
    return [padding, {k: v for k, v in said.items() if k not in ("padding", "truncation")}]
