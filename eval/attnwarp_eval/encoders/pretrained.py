"""CLIP and DINOv2 from a local folder in the format of transformers. Nothing is ever downloaded.

Three mistakes give plausible figures in transformers and are refused here:

- missing tensors, which transformers fills with random numbers;
- a tokenizer of another model, whose texts are all read at their first token;
- a model of another kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.devices import device_of
from attnwarp.encoders._weights import (
    full_float32,
    not_finite,
    reason_of,
    sha256_of,
    silent_transformers,
)
from attnwarp.encoders.base import EncoderInfo, Image, Kind, checked_image, checked_texts
from attnwarp.encoders.preprocess import Preprocessing, read_json
from attnwarp.errors import InputError, optional_imports
from attnwarp_eval.encoders.preprocessing import read_preprocessing

BATCH = 8
"""Number of pictures in a batch: enough for all cores, few enough to fit next to ViT-L's weights.
"""

_ASK = {
    "clip": (
        "openai/clip-vit-large-patch14-336 (the paper's) or openai/clip-vit-base-patch32 (small)"
    ),
    "dino": "facebook/dinov2-with-registers-small (the paper's) or facebook/dinov2-small",
}
_FILES = {
    "clip": (
        "config.json, model.safetensors (or pytorch_model.bin), preprocessor_config.json, and"
        " tokenizer.json (or vocab.json with merges.txt)"
    ),
    "dino": "config.json, model.safetensors (or pytorch_model.bin) and preprocessor_config.json",
}


class _Pictures:
    """Base of CLIP and DINOv2: preprocessing and network, batch by batch, in float32."""

    def __init__(
        self, about: EncoderInfo, preprocessing: Preprocessing, device: torch.device
    ) -> None:
        self.about = about
        self.preprocess = preprocessing
        self._device = device

    def _run(
        self, images: Sequence[Image], network: Callable[[torch.Tensor], torch.Tensor]
    ) -> list[npt.NDArray[np.float64]]:
        """Compute one result per picture. Only neighbours of equal size share a batch."""
        if isinstance(images, np.ndarray) and images.ndim == 3:
            raise TypeError(
                f"images: got one picture of shape {images.shape}, expected a list of pictures"
            )
        results: list[npt.NDArray[np.float64]] = []
        for start in range(0, len(images), BATCH):
            batch = [
                self.preprocess(checked_image(images[i], f"images[{i}]"))
                for i in range(start, min(start + BATCH, len(images)))
            ]
            for _, equal in groupby(batch, key=lambda picture: picture.shape):
                with full_float32():
                    out = network(torch.from_numpy(np.stack(list(equal))).to(self._device))
                results.extend(out.double().cpu().numpy())
        return results


class Clip(_Pictures):
    """CLIP; see :class:`attnwarp.encoders.TextImageEncoder`.

    Embeddings are the outputs of the two projections. Texts beyond the network's limit (77 tokens
    in published networks) are cut; ``cut`` counts the dropped tokens.
    """

    def __init__(
        self,
        model: Any,
        tokenizer: Any,
        about: EncoderInfo,
        preprocessing: Preprocessing,
        device: torch.device,
    ) -> None:
        super().__init__(about, preprocessing, device)
        self._model = model
        self._tokenizer = tokenizer
        self._length = int(model.config.text_config.max_position_embeddings)

    def images(self, images: Sequence[Image]) -> npt.NDArray[np.float64]:
        """Embed pictures, (N, D) float64, not normalised."""
        rows = self._run(images, lambda x: _pooled(self._model.get_image_features(pixel_values=x)))
        return np.array(rows, dtype=np.float64).reshape(len(rows), self._dim)

    def texts(self, texts: Sequence[str]) -> npt.NDArray[np.float64]:
        """Embed texts, (N, D) float64, not normalised."""
        rows: list[npt.NDArray[np.float64]] = []
        for text in checked_texts(texts):
            # One at a time: prompts are few, and padding could change a row.
            ids = self._ids(text)[0]
            with full_float32():
                out = _pooled(
                    self._model.get_text_features(
                        input_ids=torch.tensor([ids], device=self._device)
                    )
                )
            rows.extend(out.double().cpu().numpy())
        return np.array(rows, dtype=np.float64).reshape(len(rows), self._dim)

    def cut(self, text: str) -> int:
        """Count a text's tokens beyond the network's length, which are dropped."""
        return self._ids(text)[1]

    @property
    def _dim(self) -> int:
        return int(self._model.config.projection_dim)

    def _ids(self, text: str) -> tuple[list[int], int]:
        ids = list(self._tokenizer.encode(text).ids)
        over = max(0, len(ids) - self._length)
        # The network reads a text at its end token, so a cut text ends with it too.
        return (ids[: self._length - 1] + ids[-1:] if over else ids), over


class Dino(_Pictures):
    """DINOv2, with registers or without; see :class:`attnwarp_eval.encoders.TokenEncoder`.

    The embedding of a picture is the class token, that of a patch is the patch's token, both after
    the last normalisation.
    """

    def __init__(
        self, model: Any, about: EncoderInfo, preprocessing: Preprocessing, device: torch.device
    ) -> None:
        super().__init__(about, preprocessing, device)
        self._model = model
        self._patch = int(model.config.patch_size)
        self._special = 1 + int(getattr(model.config, "num_register_tokens", 0))

    def images(self, images: Sequence[Image]) -> npt.NDArray[np.float64]:
        """Embed pictures, (N, D) float64, not normalised."""
        rows = self._run(images, lambda x: self._model(pixel_values=x).last_hidden_state[:, 0])
        return np.array(rows, dtype=np.float64).reshape(len(rows), self._dim)

    def tokens(self, images: Sequence[Image]) -> npt.NDArray[np.float64]:
        """Embed patches, (N, h, w, D) float64; 16 x 16 with the published preprocessing of 224 px.

        Raises:
            ValueError: also if the folder's preprocessing gives pictures of different shapes
                different sizes.
        """
        grids = self._run(images, self._grid)
        if len({grid.shape for grid in grids}) > 1:
            raise ValueError(
                f"images: their grids have the sizes {sorted({grid.shape[:2] for grid in grids})},"
                " expected one; this encoder's preprocessing keeps a picture's shape, so give"
                " pictures of one shape"
            )
        if grids:
            return np.stack(grids)
        height, width = self.preprocess.shape or (0, 0)
        return np.zeros((0, height // self._patch, width // self._patch, self._dim))

    def _grid(self, x: torch.Tensor) -> torch.Tensor:
        tokens = self._model(pixel_values=x).last_hidden_state[:, self._special :]
        return tokens.reshape(
            len(x), x.shape[2] // self._patch, x.shape[3] // self._patch, self._dim
        )

    @property
    def _dim(self) -> int:
        return int(self._model.config.hidden_size)


def load_clip(folder: Path, *, name: str, device: str = "cpu", whole: bool = False) -> Clip:
    """Load CLIP from a folder in the transformers format.

    Args:
        folder: folder with config.json, model.safetensors (or pytorch_model.bin, or either in parts
            with its index), preprocessor_config.json, and tokenizer.json or vocab.json with
            merges.txt.
        whole: True resizes the full picture, without antialiasing and without a crop.
    """
    torch_device = device_of(device)
    _config(folder, name, "clip", ("clip",))
    preprocessing = read_preprocessing(folder)
    tokenizer = _tokenizer(folder, name)
    with optional_imports():
        from transformers import CLIPModel

    model, files = _load(CLIPModel, folder, name, "clip", torch_device)
    side = int(model.config.vision_config.image_size)
    if preprocessing.shape != (side, side):
        raise InputError(
            f"{name}: the preprocessing in {folder} gives"
            f" {preprocessing.shape or 'pictures of any size'}, the network in config.json takes"
            f" ({side}, {side}); the two files are not of one model"
        )
    if whole:
        preprocessing = replace(preprocessing, resize=(side, side), crop=None, antialias=False)
    _fitting_tokenizer(tokenizer, model.config.text_config, folder, name)
    about = EncoderInfo(
        name,
        "clip",
        str(folder),
        sha256_of(files),
        str(preprocessing),
        side,
        int(model.config.projection_dim),
    )
    return Clip(model, tokenizer, about, preprocessing, torch_device)


def load_dinov2(folder: Path, *, name: str, device: str = "cpu", side: int | None = None) -> Dino:
    """Load DINOv2 from a folder in the transformers format, with or without registers.

    Args:
        folder: folder with config.json, model.safetensors (or pytorch_model.bin, or either in parts
            with its index) and preprocessor_config.json.
        side: px to which the full picture is resized, without antialiasing and without a crop;
            None for the published preprocessing.
    """
    torch_device = device_of(device)
    config = _config(folder, name, "dino", ("dinov2", "dinov2_with_registers"))
    preprocessing = read_preprocessing(folder)
    if side is not None:
        preprocessing = replace(preprocessing, resize=(side, side), crop=None, antialias=False)
    with optional_imports():
        from transformers import Dinov2Model, Dinov2WithRegistersModel

    kind = Dinov2Model if config["model_type"] == "dinov2" else Dinov2WithRegistersModel
    model, files = _load(kind, folder, name, "dino", torch_device)
    shape, patch = preprocessing.shape, int(model.config.patch_size)
    if shape is not None and min(shape) < patch:
        raise InputError(
            f"{name}: the preprocessing in {folder} gives {shape} px, smaller than one patch of"
            f" {patch}"
        )
    size = shape[0] if shape is not None and shape[0] == shape[1] else None
    about = EncoderInfo(
        name,
        "dino",
        str(folder),
        sha256_of(files),
        str(preprocessing),
        size,
        int(model.config.hidden_size),
    )
    return Dino(model, about, preprocessing, torch_device)


def _config(folder: Path, name: str, kind: Kind, types: tuple[str, ...]) -> dict[str, Any]:
    if not folder.is_dir():
        raise InputError(f"{name}: there is no folder {folder}. {_how(kind, folder)}")
    path = folder / "config.json"
    if not path.is_file():
        raise InputError(f"{name}: {folder} has no config.json. {_how(kind, folder)}")
    config = read_json(path)
    if config.get("model_type") not in types:
        raise InputError(
            f"{name}: {path} is of model_type {config.get('model_type')!r}, expected"
            f" {' or '.join(map(repr, types))}. {_how(kind, folder)}"
        )
    return config


def _how(kind: Kind, folder: Path) -> str:
    return (
        f"Place these files there: {_FILES[kind]}. They are published on the Hugging Face hub, for"
        f" instance as {_ASK[kind]}: on a machine with a network, `hf download MODEL_ID --local-dir"
        f" {folder}`; this program itself fetches nothing"
    )


def _weight_files(folder: Path, name: str, kind: Kind) -> list[Path]:
    for single in ("model.safetensors", "pytorch_model.bin"):
        if (folder / single).is_file():
            return [folder / single]
        index = folder / f"{single}.index.json"
        if index.is_file():
            parts = sorted(
                {folder / str(part) for part in read_json(index).get("weight_map", {}).values()}
            )
            missing = [part.name for part in parts if not part.is_file()]
            if missing or not parts:
                raise InputError(
                    f"{name}: {index} names {', '.join(missing) or 'no files'}, not in {folder}"
                )
            return parts
    raise InputError(
        f"{name}: {folder} has no model.safetensors and no pytorch_model.bin. {_how(kind, folder)}"
    )


def _load(
    model_class: Any, folder: Path, name: str, kind: Kind, device: torch.device
) -> tuple[Any, list[Path]]:
    files = _weight_files(folder, name, kind)
    try:
        with silent_transformers():
            model, loading_info = model_class.from_pretrained(
                str(folder), local_files_only=True, output_loading_info=True, dtype=torch.float32,
                use_safetensors=files[0].suffix == ".safetensors",
            )  # fmt: skip
    except InputError:
        raise
    except Exception as error:  # transformers raises many kinds of errors for inconsistent files
        raise InputError(
            f"{name}: the weights in {folder} cannot be loaded: {reason_of(error)}; fetch its files"
            " again"
        ) from None
    missing = sorted(str(key) for key in loading_info["missing_keys"])
    if missing:
        raise InputError(
            f"{name}: {files[0]} lacks {len(missing)} tensors that config.json calls for,"
            f" {missing[0]} first; the files are not of one model. {_how(kind, folder)}"
        )
    if bad := not_finite(model):
        raise InputError(f"{name}: {bad[0]} in {files[0]} is NaN or infinite; fetch the file again")
    return model.to(device).eval().requires_grad_(False), files


def _tokenizer(folder: Path, name: str) -> Any:
    """Load a ``tokenizers.Tokenizer`` that neither pads nor cuts."""
    with optional_imports():
        from tokenizers import Tokenizer

    tokenizer_file, vocabulary_file, merges_file = (
        folder / file for file in ("tokenizer.json", "vocab.json", "merges.txt")
    )
    if tokenizer_file.is_file():
        try:
            tokenizer = Tokenizer.from_str(tokenizer_file.read_text(encoding="utf-8"))
        except Exception as error:  # the Rust side raises a bare Exception
            raise InputError(
                f"{name}: {tokenizer_file}: not a tokenizer ({error}); fetch the file again"
            ) from None
    elif vocabulary_file.is_file() and merges_file.is_file():
        with optional_imports():
            from transformers import CLIPTokenizer

        lines = merges_file.read_text(encoding="utf-8").splitlines()
        pairs = [
            tuple(line.split())
            for line in lines
            if line.strip() and not line.startswith("#version")
        ]
        bad_pair = next((pair for pair in pairs if len(pair) != 2), None)
        if bad_pair is not None:
            raise InputError(
                f"{name}: {merges_file}: a line reads {' '.join(bad_pair)!r}, expected two words;"
                " fetch it again"
            )
        try:
            # These keywords, since an older version's vocab_file= is ignored and leaves two tokens.
            tokenizer_class: Any = CLIPTokenizer
            tokenizer = tokenizer_class(vocab=read_json(vocabulary_file), merges=pairs)._tokenizer
        except InputError:
            raise
        except Exception as error:  # as above
            raise InputError(
                f"{name}: {vocabulary_file} and {merges_file} do not fit each other ({error})"
            ) from None
    else:
        raise InputError(
            f"{name}: {folder} has no tokenizer.json, nor vocab.json with merges.txt."
            f" {_how('clip', folder)}"
        )
    tokenizer.no_padding()
    tokenizer.no_truncation()
    return tokenizer


def _fitting_tokenizer(tokenizer: Any, config: Any, folder: Path, name: str) -> None:
    """Refuse another model's tokenizer: the network would silently read the wrong token."""
    first, last = tokenizer.encode("a").ids[0], tokenizer.encode("a").ids[-1]
    top = max(tokenizer.get_vocab().values())
    # Old files have 2 for any tokenizer; the network then reads at the highest token number.
    expected = top if config.eos_token_id == 2 else config.eos_token_id
    if first == last or last != expected or top >= config.vocab_size:
        raise InputError(
            f"{name}: the tokenizer in {folder} has {top + 1} tokens and ends a text with {last},"
            f" the model in config.json knows {config.vocab_size} and expects {expected}; the files"
            " are not of one model"
        )


def _pooled(output: Any) -> torch.Tensor:
    """Return the pooled output, which some versions of transformers wrap in an object."""
    return output if isinstance(output, torch.Tensor) else output.pooler_output


__all__ = ["Clip", "Dino", "load_clip", "load_dinov2"]
