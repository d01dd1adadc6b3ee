"""Encoders that figures use: the library's, a small one of pictures alone, and published ones.

    load_encoder("dino-small").images([picture])
    load_encoder("clip:/models/clip-vit-large-patch14-336").texts(["a photo of a bear statue"])

Nothing heavy is imported until an encoder is loaded, and nothing is ever downloaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Protocol, overload, runtime_checkable

import numpy as np
import numpy.typing as npt

from attnwarp import encoders as library
from attnwarp.encoders import (
    Encoder,
    ImageEncoder,
    Kind,
    PerceptualDistance,
    TextImageEncoder,
)
from attnwarp.encoders.base import Image

__all__ = ["BUNDLED", "REAL", "TokenEncoder", "check_kind", "kind_of", "load_encoder"]

BUNDLED: dict[str, tuple[Kind, str]] = library.BUNDLED | {
    "dino-small": (
        "dino",
        "a small image encoder trained on random rendered scenes, without labels",
    ),
}
"""Bundled encoders: name -> (kind, description)."""

REAL: dict[str, tuple[Kind, str]] = {
    "clip:FOLDER": (
        "clip",
        "CLIP in the transformers format, such as openai/clip-vit-large-patch14-336",
    ),
    "dinov2:FOLDER": (
        "dino",
        "DINOv2 in the transformers format, such as facebook/dinov2-with-registers-small",
    ),
    "clip-whole:FOLDER": (
        "clip",
        "the same, of whole pictures resized without antialiasing: the paper's figures",
    ),
    "dinov2-518:FOLDER": (
        "dino",
        "DINOv2 that sees whole pictures at 518 px: the paper's figures",
    ),
    **library.REAL,
}
"""Encoders read from the user's files: pattern -> (kind, description)."""

AUTHORS_SIDE = 518
"""Side in px of DINOv2's pictures in the paper's figures."""


@runtime_checkable
class TokenEncoder(ImageEncoder, Protocol):
    """Encoder from pictures to embeddings and grids of patch embeddings, such as DINO.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval.encoders import TokenEncoder, load_encoder
        >>> encoder = load_encoder("dino-small")
        >>> isinstance(encoder, TokenEncoder), encoder.tokens([np.zeros((64, 64, 3))]).shape
        (True, (1, 8, 8, 192))
    """

    def tokens(self, images: Sequence[Image]) -> npt.NDArray[np.float64]:
        """Embed the patches of preprocessed pictures, (N, h, w, D) float64, by row."""
        ...


def kind_of(name: str) -> Kind:
    """Determine the kind of an encoder by its name, without loading it; InputError if unknown.

    Example:
        >>> kind_of("dinov2:/models/dinov2-small")
        'dino'
    """
    return library.kind_of(name, BUNDLED | REAL)


def check_kind(name: str, kind: Kind) -> None:
    """Refuse a name that is not an encoder of this kind, by an InputError, without loading it.

    Example:
        >>> check_kind("dino-small", "dino")
    """
    library.check_kind(name, kind, BUNDLED | REAL)


@overload
def load_encoder(name: str, kind: Literal["clip"], *, device: str = "cpu") -> TextImageEncoder: ...
@overload
def load_encoder(name: str, kind: Literal["dino"], *, device: str = "cpu") -> TokenEncoder: ...
@overload
def load_encoder(
    name: str, kind: Literal["perceptual"], *, device: str = "cpu"
) -> PerceptualDistance: ...
@overload
def load_encoder(
    name: str, kind: None = None, *, device: str = "cpu"
) -> Encoder | TokenEncoder: ...
def load_encoder(name: str, kind: Kind | None = None, *, device: str = "cpu") -> Any:
    """Load an encoder by name.

    Args:
        name: as for :func:`attnwarp.encoders.load_encoder`; also ``dino-small``, ``clip:FOLDER``
            and ``dinov2:FOLDER``; ``clip-whole:FOLDER`` and ``dinov2-518:FOLDER`` preprocess
            pictures as the paper's authors do.
        kind: expected kind; an encoder of another kind is refused before it is loaded.
        device: "cpu" or "cuda", for real encoders.

    Returns:
        A TextImageEncoder ("clip"), a :class:`TokenEncoder` ("dino") or a PerceptualDistance
        ("perceptual").

    Raises:
        InputError: the name is unknown, the kind differs from the expected one, or weights are
            missing or invalid; the message names the required files.
        MissingExtraError: the encoder needs a package of an extra.

    Example:
        >>> import numpy as np
        >>> encoder = load_encoder("dino-small", "dino")
        >>> encoder.tokens([np.zeros((64, 96, 3))]).shape
        (1, 8, 8, 192)
    """
    check_kind(name, kind or kind_of(name))
    if name == "dino-small":
        from attnwarp_eval.encoders.dino_small import load

        return load()
    if name in library.BUNDLED or name.startswith("lpips:"):
        return library.load_encoder(name, device=device)
    from attnwarp_eval.encoders import pretrained

    scheme, _, place = name.partition(":")
    path = Path(place).expanduser()
    if scheme in ("clip", "clip-whole"):
        whole = scheme == "clip-whole"
        return pretrained.load_clip(path, name=name, device=device, whole=whole)
    side = AUTHORS_SIDE if scheme == "dinov2-518" else None
    return pretrained.load_dinov2(path, name=name, device=device, side=side)
