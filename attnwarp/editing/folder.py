"""Diffusion models in local folders, in diffusers' format; nothing is downloaded."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from attnwarp.devices import device_of
from attnwarp.editing.identity import files_of, mark_loaded
from attnwarp.encoders._weights import not_finite, reason_of, silent_transformers
from attnwarp.errors import InputError, install_command
from attnwarp.io.text import read_text

WEIGHTS = ("diffusion_pytorch_model", "model", "pytorch_model")
ENDINGS = {None: (".safetensors", ".bin"), "fp16": (".fp16.safetensors",)}
"""Suffixes of single-file weights, by diffusers' variant; None is the default variant."""

INDICES = {None: "*.index.json", "fp16": "*.index.fp16.json"}
"""Patterns of the index file of sharded weights."""


def require_diffusers() -> None:
    """Raise InputError if the extra is not installed."""
    try:
        import diffusers  # noqa: F401
    except ImportError:
        raise InputError(
            f"editors need diffusers, which is not installed; {install_command('edit')}"
        ) from None


def load_parts(folder: str | Path, *, device: str = "cpu", dtype: torch.dtype) -> dict[str, Any]:
    """Load a folder's UNet, autoencoder, text encoder, tokenizer and a DDIM scheduler."""
    folder = _checked(folder, ("unet", "vae", "text_encoder"), ("tokenizer",), device)

    from diffusers import AutoencoderKL, AutoencoderTiny, DDIMScheduler, UNet2DConditionModel
    from transformers import AutoTokenizer, CLIPTextModel

    from attnwarp.editing.latents import HaarLatents
    from attnwarp.editing.small_unet import EditUNet, PartsUNet

    def model(name: str, *kinds: Any) -> Any:
        place = folder / name
        return load_network(class_of(place, *kinds), place, device, dtype)

    parts = {
        "unet": model("unet", UNet2DConditionModel, EditUNet, PartsUNet),
        "vae": model("vae", AutoencoderKL, AutoencoderTiny, HaarLatents),
        "text_encoder": model("text_encoder", CLIPTextModel),
    }
    words = folder / "tokenizer"
    with readable(words):
        parts["tokenizer"] = AutoTokenizer.from_pretrained(words, local_files_only=True)
    with readable(folder / "scheduler"):
        # DDIMScheduler clips by default; other schedulers' configs lack the setting.
        told = DDIMScheduler.load_config(folder / "scheduler", local_files_only=True)
        parts["scheduler"] = DDIMScheduler.from_config({"clip_sample": False, **told})
    return parts


def load_pipeline(
    folder: str | Path,
    networks: Mapping[str, str],
    optional: Sequence[str] = (),
    *,
    device: str = "cpu",
    dtype: torch.dtype,
) -> dict[str, Any]:
    """Load all parts of a pipeline with a flow: its networks, tokenizers, processor and scheduler.

    Args:
        networks: classes of diffusers or transformers by the name of the network's folder.
        optional: networks that may be missing; they become None, and their tokenizers.
    """
    folder = Path(folder)
    left_out = {name for name in optional if not (folder / name).is_dir()}
    present = [name for name in networks if name not in left_out]
    tokenizers = [_tokenizer_of(name) for name in present if name.startswith("text_encoder")]
    _checked(folder, present, tokenizers, device)
    processor = (folder / "processor").is_dir()
    if processor and importlib.util.find_spec("torchvision") is None:
        raise InputError(
            f"{folder / 'processor'}: needs torchvision, which is not installed; install the one"
            f" that is made for torch {torch.__version__}"
        )
    parts: dict[str, Any] = dict.fromkeys([*left_out, *map(_tokenizer_of, left_out)])

    import diffusers
    import transformers

    for name in present:
        home = diffusers if hasattr(diffusers, networks[name]) else transformers
        kind = class_of(folder / name, getattr(home, networks[name]))
        parts[name] = load_network(kind, folder / name, device, dtype)
    readers = dict.fromkeys(tokenizers, transformers.AutoTokenizer)
    if processor:
        readers["processor"] = transformers.AutoProcessor
    for name, kind in readers.items():
        with readable(folder / name):
            parts[name] = kind.from_pretrained(folder / name, local_files_only=True)
    return {**parts, "scheduler": _scheduler(folder)}


def _scheduler(folder: Path) -> Any:
    import diffusers

    place = folder / "scheduler"
    with readable(place):
        config = json.loads(read_text(place / "scheduler_config.json"))
        return getattr(diffusers, config["_class_name"]).from_pretrained(
            place, local_files_only=True
        )


def _tokenizer_of(text_encoder: str) -> str:
    return text_encoder.replace("text_encoder", "tokenizer")


def _checked(
    folder: str | Path, networks: Sequence[str], tokenizers: Sequence[str], device: str
) -> Path:
    """Refuse an unknown device, and a folder that lacks files; all are named."""
    require_diffusers()
    device_of(device)
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected a model in diffusers' format")
    missing = [lost for name in networks for lost in _missing(folder / name)]
    if not (folder / "scheduler" / "scheduler_config.json").is_file():
        missing.append("scheduler/scheduler_config.json")
    for name in tokenizers:
        words = folder / name
        pair = all((words / file).is_file() for file in ("vocab.json", "merges.txt"))
        if not pair and not any(
            (words / file).is_file() for file in ("tokenizer.json", "spiece.model")
        ):
            missing.append(f"{name}/vocab.json with merges.txt, or {name}/tokenizer.json")
        # This file defines the padding token.
        if not (words / "tokenizer_config.json").is_file():
            missing.append(f"{name}/tokenizer_config.json")
    if missing:
        raise InputError(
            f"{folder}: lacks {', '.join(missing)}; fetch the model again in diffusers' format"
        )
    return folder


def load_controlnet(folder: str | Path, *, device: str = "cpu", dtype: torch.dtype) -> Any:
    """Load a folder's ControlNet."""
    require_diffusers()
    folder = Path(folder)
    missing = _missing(folder)
    if missing:
        raise InputError(f"{folder.parent}: lacks {', '.join(missing)}; fetch the ControlNet again")

    from diffusers import ControlNetModel

    return load_network(class_of(folder, ControlNetModel), folder, device, dtype)


def load_network(kind: Any, folder: Path, device: str, dtype: torch.dtype) -> Any:
    """Load a network of diffusers or transformers from its folder."""
    from transformers import PreTrainedModel

    # Without accelerate, diffusers uses plain loading and warns unless this is requested.
    how: dict[str, Any] = {} if issubclass(kind, PreTrainedModel) else {"low_cpu_mem_usage": False}
    if _variants(folder) == ["fp16"]:
        how["variant"] = "fp16"
    files = files_of(folder)
    with readable(folder), silent_transformers():
        # Silently random values for missing tensors would look like a bad editor.
        network, report = kind.from_pretrained(
            folder, local_files_only=True, torch_dtype=dtype, output_loading_info=True, **how
        )
    if report["missing_keys"]:
        lost = sorted(report["missing_keys"])
        raise InputError(
            f"{folder}: its weights lack {lost[0]} and {len(lost) - 1} more; fetch the model again"
        )
    if damaged := not_finite(network):
        raise InputError(
            f"{folder}: its weights have NaN or infinite values in {damaged[0]}"
            f"{f' and {len(damaged) - 1} more' if len(damaged) > 1 else ''}; fetch the model again"
        )
    network = network.to(device)
    mark_loaded(network, files)
    return network


def index_of(folder: str | Path) -> dict[str, Any]:
    """Read a folder's model_index.json; empty without the file."""
    path = Path(folder) / "model_index.json"
    if not path.is_file():
        return {}
    with readable(Path(folder)):
        return dict(json.loads(read_text(path)))


def pipeline_of(folder: Path) -> str | None:
    """Read the pipeline's name from a folder's model_index.json; None without the file."""
    index = index_of(folder)
    with readable(folder):
        return str(index["_class_name"]) if index else None


def config_of(folder: str | Path, name: str) -> dict[str, Any]:
    """Read a network's configuration in a folder; empty if missing, which loading reports."""
    place = Path(folder) / name
    path = place / "config.json"
    if not path.is_file():
        return {}
    with readable(place):
        config = json.loads(read_text(path))
    if not isinstance(config, dict):
        raise InputError(f"{path}: holds {config!r:.40}, expected an object; fetch the model again")
    return config


def class_of(folder: Path, *kinds: Any) -> Any:
    """Find a network's class by its folder's configuration; the first if none is configured."""
    wanted = config_of(folder.parent, folder.name).get("_class_name")
    names = [kind.__name__ for kind in kinds]
    if wanted is not None and wanted not in names:
        raise InputError(f"{folder}: is of the class {wanted!r}, expected {' or '.join(names)}")
    return kinds[0] if wanted is None else kinds[names.index(wanted)]


@contextmanager
def named(folder: str | Path) -> Iterator[None]:
    """Prefix a network's error with the name of its folder."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{folder}: {error}") from None


@contextmanager
def readable(folder: Path) -> Iterator[None]:
    """Convert the many kinds of errors that transformers, diffusers and tokenizers raise for a
    damaged file into one line.
    """
    try:
        yield
    except Exception as error:
        raise InputError(
            f"{folder}: cannot be read ({reason_of(error)}); fetch the model again"
        ) from None


def _missing(folder: Path) -> list[str]:
    name = folder.name
    lost = [] if (folder / "config.json").is_file() else [f"{name}/config.json"]
    if not _variants(folder):
        lost.append(
            f"{name}/{'model' if name.startswith('text_encoder') else WEIGHTS[0]}.safetensors"
        )
    return lost


def _variants(folder: Path) -> list[str | None]:
    """List the variants of a folder's weights."""
    return [
        variant
        for variant, endings in ENDINGS.items()
        if any((folder / f"{stem}{ending}").is_file() for stem in WEIGHTS for ending in endings)
        or any(folder.glob(INDICES[variant]))
    ]
