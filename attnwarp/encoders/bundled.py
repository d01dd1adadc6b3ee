"""Bundled encoders, trained from scratch by eval/training/; their weights are in
weights/.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional

from attnwarp.encoders._weights import full_float32, sha256_of
from attnwarp.encoders.base import (
    EncoderInfo,
    Image,
    Kind,
    checked_images,
    checked_pairs,
    checked_texts,
)
from attnwarp.encoders.nets import ClipParts, ClipSmall, PerceptualSmall
from attnwarp.encoders.preprocess import Preprocessing, resize
from attnwarp.errors import InputError, optional_imports

WEIGHTS = Path(__file__).parent / "weights"

BATCH = 32

Array = npt.NDArray[np.float64]


def load(name: str, folder: Path = WEIGHTS) -> BundledClip | BundledPerceptual:
    """Load a bundled encoder: "clip-small", "clip-parts" or "perceptual-small"."""
    kinds: dict[str, Callable[[str, Path], Any]] = {
        "clip-small": BundledClip, "clip-parts": BundledClipParts,
        "perceptual-small": BundledPerceptual,
    }  # fmt: skip
    if name not in kinds:
        raise InputError(f"encoder {name!r}: not bundled, expected one of {', '.join(kinds)}")
    encoder: BundledClip | BundledPerceptual = kinds[name](name, folder)
    return encoder


def identity_of(
    name: str,
    kind: Kind,
    files: Sequence[Path],
    preprocessing: str,
    size: int | None,
    dim: int | None,
) -> EncoderInfo:
    """Identify a bundled encoder by its files; InputError if its card names other weights."""
    sha256 = sha256_of(files)
    card = files[0].with_name(f"{name}.md")
    # A changed weight is undetectable by itself; the card's hash identifies the trained weights.
    if card.is_file() and sha256 not in card.read_text(encoding="utf-8"):
        raise InputError(
            f"{files[0]}: not the weights that {card.name} names, or damaged; install the package"
            " again, or train it (eval/training/README.md)"
        )
    return EncoderInfo(name, kind, "bundled", sha256, preprocessing, size, dim)


def read_weights(net: torch.nn.Module, path: Path) -> None:
    """Load weights, stored in half precision, into a network in single precision on the CPU."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        # A network is created in the process's default dtype, which may be float64.
        net.to("cpu", torch.float32)
        net.load_state_dict({key: value.float() for key, value in load_file(path).items()})
    except FileNotFoundError:
        raise InputError(
            f"{path}: missing; install the package again, or train it (eval/training/README.md)"
        ) from None
    except (SafetensorError, RuntimeError) as error:
        raise InputError(
            f"{path}: not the weights of this version ({str(error).splitlines()[0]})"
        ) from None
    net.eval().requires_grad_(False)


class OfSquares:
    """Base of the encoders with square input: preprocessing in batches."""

    about: EncoderInfo
    preprocess: Preprocessing

    def rows(
        self,
        images: Sequence[Image],
        network: Callable[[torch.Tensor], torch.Tensor],
        shape: tuple[int, ...],
    ) -> Array:
        """Compute a row of a shape for each picture."""
        checked, rows = checked_images(images), []
        for start in range(0, len(checked), BATCH):
            stack = np.stack([self.preprocess(image) for image in checked[start : start + BATCH]])
            batch = torch.from_numpy(stack).to(memory_format=torch.channels_last)
            with full_float32():
                rows.append(network(batch).double().numpy())
        return np.concatenate(rows) if rows else np.zeros((0, *shape))


class BundledClip(OfSquares):
    """clip-small: a :class:`~attnwarp.encoders.base.TextImageEncoder`."""

    network: type[ClipSmall] = ClipSmall
    net: ClipSmall

    def __init__(self, name: str, folder: Path) -> None:
        with optional_imports():
            from tokenizers import Tokenizer

        vocabulary_file = folder / f"{name}.tokenizer.json"
        if not vocabulary_file.is_file():
            raise InputError(
                f"{vocabulary_file}: missing; install the package again, or train it"
                " (eval/training/README.md)"
            )
        self.tokenizer = Tokenizer.from_file(str(vocabulary_file))
        self.net = self.network(self.tokenizer.get_vocab_size())
        weights = folder / f"{name}.safetensors"
        read_weights(self.net, weights)
        self.preprocess = Preprocessing(
            resize=ClipSmall.size, crop=(ClipSmall.size, ClipSmall.size)
        )
        dim = self.net.pool.project.out_features
        description = f"{self.preprocess}; mean of the picture's embedding and its mirror image's"
        self.about = identity_of(
            name, "clip", [weights, vocabulary_file], description, ClipSmall.size, dim
        )

    def images(self, images: Sequence[Image]) -> Array:
        """Embed pictures, (N, D) float64, not normalised.

        An embedding averages the picture's and its mirror image's: training captions never
        distinguish left from right, so any difference between the two is an error.
        """

        def mean(batch: torch.Tensor) -> torch.Tensor:
            return 0.5 * (self.net.images(batch) + self.net.images(batch.flip(-1)))

        return self.rows(images, mean, (self.about.dim or 0,))

    def cut(self, text: str) -> int:
        """Count a text's tokens beyond the network's length, which are dropped."""
        return sum(len(rest.ids) - 1 for rest in self.tokenizer.encode(text).overflowing)

    def texts(self, texts: Sequence[str]) -> Array:
        """Embed texts, (N, D) float64, not normalised; unknown words are split into pieces."""
        checked = checked_texts(texts)
        if not checked:
            return np.zeros((0, self.about.dim or 0))
        with full_float32():
            codes = torch.tensor(
                [code.ids for code in self.tokenizer.encode_batch(checked)], dtype=torch.int64
            )
            return self.net.texts(codes).double().numpy()


class BundledClipParts(BundledClip):
    """clip-parts: clip-small that is also a :class:`~attnwarp.encoders.base.PlaceEncoder`."""

    network = ClipParts
    net: ClipParts

    def shown(self, image: Image, texts: Sequence[str]) -> Array:
        """Estimate probabilities, (h, w, T), see :class:`~attnwarp.encoders.base.PlaceEncoder`.

        A region has 8 x 8 px. The picture is resized to multiples of 32 px. Results are averaged
        with the mirror image's.
        """
        (picture,) = checked_images([image])
        height, width = (max(1, round(side / 32)) * 32 for side in picture.shape[:2])
        pixels = torch.from_numpy(resize(picture, (height, width)).transpose(2, 0, 1)).contiguous()
        words = functional.normalize(torch.from_numpy(self.texts(texts)), dim=-1)
        with full_float32():
            there, mirrored = self.net.places(torch.stack([pixels, pixels.flip(-1)])).double()
        places = functional.normalize(there, dim=0), functional.normalize(mirrored, dim=0).flip(-1)
        patches = self.net.patches
        cosines = torch.einsum("dhw,td->hwt", 0.5 * (places[0] + places[1]), words)
        return torch.sigmoid(patches.scale.double().exp() * cosines + patches.bias.double()).numpy()


class BundledPerceptual:
    """perceptual-small: a :class:`~attnwarp.encoders.base.PerceptualDistance`.

    Attributes:
        smallest: shortest accepted side of a picture, px.
    """

    smallest = 1

    def __init__(self, name: str, folder: Path) -> None:
        self.net = PerceptualSmall()
        weights = folder / f"{name}.safetensors"
        read_weights(self.net, weights)
        self.about = identity_of(
            name, "perceptual", [weights], "as it is, at its own size", None, None
        )

    def distance(self, a: Sequence[Image], b: Sequence[Image]) -> Array:
        """Compute distances, (N,) float64, 0 for equal pictures; about (strength of the
        distortion / 5)^2, see the model card.
        """
        distances = []
        self.net.to("cpu")
        with full_float32():
            for first, second in checked_pairs(a, b):
                x, y = (torch.from_numpy(image).permute(2, 0, 1)[None] for image in (first, second))
                distances.append(float(self.net(x, y)))
        return np.array(distances, dtype=np.float64)

    def loss(self, image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Compute the distance () of two (H, W, 3) pictures in [0, 1], differentiable."""
        return self.between(self.features(image), self.features(target))

    def features(self, picture: torch.Tensor) -> list[torch.Tensor]:
        """Compute features for :meth:`between` of a picture (H, W, 3) in [0, 1], differentiable.
        The network moves to the picture's device."""
        return self.net.to(picture.device).stack(picture.permute(2, 0, 1)[None])

    def between(self, image: list[torch.Tensor], target: list[torch.Tensor]) -> torch.Tensor:
        """Compute the distance () of two pictures from their :meth:`features`."""
        return self.net.between(image, target)[0]
