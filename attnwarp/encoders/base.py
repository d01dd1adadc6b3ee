"""Protocols of encoders, and the validation of their inputs.

Nothing heavy is imported here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

Kind = Literal["clip", "dino", "perceptual"]

Image = npt.NDArray[Any]
"""(H, W, 3) sRGB, floating, in [0, 1]."""


@dataclass(frozen=True)
class EncoderInfo:
    """Identity of an encoder, stored with every result: encoders' figures are not comparable.

    Attributes:
        name: argument of :func:`attnwarp.encoders.load_encoder`.
        kind: "clip" (images and texts in one space), "dino" (images alone) or "perceptual" (a
            distance of images).
        source: "bundled", or the folder or file of the weights.
        weights_sha256: SHA-256 of the weights' file, or of several files' bytes in the order
            of their names.
        preprocessing: steps before the network, in words.
        size: side in px of the network's square input; None if pictures keep their size.
        dim: length of an embedding; None for a distance.

    Example:
        >>> from attnwarp.encoders import load_encoder
        >>> about = load_encoder("perceptual-small").about
        >>> about.name, about.kind, about.source, len(about.weights_sha256), about.dim
        ('perceptual-small', 'perceptual', 'bundled', 64, None)
    """

    name: str
    kind: Kind
    source: str
    weights_sha256: str
    preprocessing: str
    size: int | None = None
    dim: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """Convert the fields to JSON values."""
        return asdict(self)


@runtime_checkable
class ImageEncoder(Protocol):
    """Encoder from pictures to embeddings.

    Example:
        >>> import numpy as np
        >>> from attnwarp.encoders import ImageEncoder, load_encoder
        >>> encoder = load_encoder("clip-small")
        >>> isinstance(encoder, ImageEncoder), encoder.images([np.zeros((64, 96, 3))]).shape
        (True, (1, 192))
    """

    @property
    def about(self) -> EncoderInfo:
        """Identity of the encoder."""
        ...

    def images(self, images: Sequence[Image]) -> npt.NDArray[np.float64]:
        """Embed pictures, (N, D) float64, not normalised; an empty list gives (0, D).

        Args:
            images: N pictures (H, W, 3), sRGB, floating, in [0, 1], of any sizes. A picture's
                embedding does not depend on the others in the list.

        Raises:
            ValueError: a picture has a wrong shape, dtype or range; the message names its index.
        """
        ...


@runtime_checkable
class TextImageEncoder(ImageEncoder, Protocol):
    """Encoder of pictures and texts into one space, such as CLIP.

    Example:
        >>> from attnwarp.encoders import TextImageEncoder, load_encoder
        >>> encoder = load_encoder("clip-small")
        >>> isinstance(encoder, TextImageEncoder)
        True
        >>> red, again = encoder.texts(["a red sphere", "a red sphere"])
        >>> bool((red == again).all())
        True
    """

    def texts(self, texts: Sequence[str]) -> npt.NDArray[np.float64]:
        """Embed texts, (N, D) float64, not normalised; an empty list gives (0, D)."""
        ...


@runtime_checkable
class PlaceEncoder(Protocol):
    """Encoder that scores, by words, which objects each region of a picture shows.

    Example:
        >>> import numpy as np
        >>> from attnwarp.encoders import load_encoder
        >>> encoder = load_encoder("clip-parts")
        >>> isinstance(encoder, PlaceEncoder)
        True
        >>> encoder.shown(np.zeros((64, 96, 3)), ["a red sphere", "the sky"]).shape
        (8, 12, 2)
    """

    def shown(self, image: Image, texts: Sequence[str]) -> npt.NDArray[np.float64]:
        """Estimate the probability of each text for each region, (h, w, T) float64 in [0, 1].

        Args:
            image: (H, W, 3) sRGB, floating, in [0, 1].
            texts: T texts; any number of them may describe a region.

        Raises:
            ValueError: the picture has a wrong shape, dtype or range.
        """
        ...


@runtime_checkable
class PerceptualDistance(Protocol):
    """Distance of pictures that follows human judgement, such as LPIPS.

    Example:
        >>> import numpy as np
        >>> from attnwarp.encoders import load_encoder
        >>> encoder = load_encoder("perceptual-small", "perceptual")
        >>> black, white = np.zeros((64, 64, 3)), np.ones((64, 64, 3))
        >>> same, other = encoder.distance([black, black], [black, white])
        >>> bool(same == 0), bool(other > 0)
        (True, True)
    """

    @property
    def about(self) -> EncoderInfo:
        """Identity of the network."""
        ...

    def distance(self, a: Sequence[Image], b: Sequence[Image]) -> npt.NDArray[np.float64]:
        """Compute distances, (N,) float64, 0 for equal pictures.

        Args:
            a, b: N pictures each, (H, W, 3), sRGB, floating, in [0, 1] (the scaling to [-1, 1]
                happens inside); ``a[i]`` and ``b[i]`` of one size, which may differ from pair to
                pair.

        Raises:
            ValueError: the lists differ in length, a pair differs in size, or a picture is invalid;
                the message names the index.
        """
        ...


Encoder = ImageEncoder | TextImageEncoder | PerceptualDistance


def checked_images(images: Sequence[Image], name: str = "images") -> list[npt.NDArray[np.float32]]:
    """Validate pictures and convert them to float32.

    Raises:
        TypeError: one picture where a list was expected.
        ValueError: a picture is not (H, W, 3), floating, finite and in [0, 1]; the message names
            the index.
    """
    if isinstance(images, np.ndarray) and images.ndim == 3:
        raise TypeError(
            f"{name}: got one picture of shape {images.shape}, expected a list of pictures"
        )
    return [checked_image(image, f"{name}[{i}]") for i, image in enumerate(images)]


def checked_image(image: Image, name: str = "image") -> npt.NDArray[np.float32]:
    """Validate one picture and convert it to float32; errors as in :func:`checked_images`."""
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise ValueError(
            f"{name}: got shape {array.shape}, expected (H, W, 3) with at least one pixel"
        )
    if array.dtype.kind != "f":
        raise ValueError(
            f"{name}: got {array.dtype}, expected floating sRGB in [0, 1]; divide 8 bits by 255"
        )
    # Tested before conversion: a float64 of 1e300 is out of range and must not overflow first.
    if not np.isfinite(array).all():
        raise ValueError(
            f"{name}: {int((~np.isfinite(array)).sum())} values are NaN or infinite, expected none"
        )
    low, high = float(array.min()), float(array.max())
    if low < 0 or high > 1:
        raise ValueError(f"{name}: got values in [{low:g}, {high:g}], expected [0, 1]")
    return array.astype(np.float32)


def checked_pairs(
    a: Sequence[Image], b: Sequence[Image]
) -> list[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]:
    """Validate pairs of pictures, equal in size within each pair, and convert them to float32.

    Raises:
        TypeError, ValueError: as :func:`checked_images`; also if the lists differ in length or a
            pair differs in size.
    """
    left, right = checked_images(a, "a"), checked_images(b, "b")
    if len(left) != len(right):
        raise ValueError(f"b: got {len(right)} pictures, expected {len(left)}, as a")
    for i, (first, second) in enumerate(zip(left, right, strict=True)):
        if first.shape != second.shape:
            raise ValueError(
                f"b[{i}]: got {second.shape[1]} x {second.shape[0]} px, expected {first.shape[1]} x"
                f" {first.shape[0]}, as a[{i}]"
            )
    return list(zip(left, right, strict=True))


def checked_texts(texts: Sequence[str]) -> list[str]:
    """Validate a list of texts.

    Raises:
        TypeError: the argument is one string instead of a list, or an item is not a string.
    """
    if isinstance(texts, str):
        raise TypeError(f"texts: got one string {texts!r}, expected a list of strings")
    for i, text in enumerate(texts):
        if not isinstance(text, str):
            raise TypeError(f"texts[{i}]: got {type(text).__name__}, expected a string")
    return list(texts)
