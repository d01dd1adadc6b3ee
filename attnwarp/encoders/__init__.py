"""Encoders of pictures and texts: small bundled ones, and published ones from a local folder.

    load_encoder("clip-small").images([picture])
    load_encoder("clip:/models/clip-vit-large-patch14-336").texts(["a photo of a bear statue"])

Nothing heavy is imported until an encoder is loaded, and nothing is ever downloaded.
"""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path
from typing import Any, Literal, overload

from attnwarp.encoders.base import (
    Encoder,
    EncoderInfo,
    ImageEncoder,
    Kind,
    PerceptualDistance,
    PlaceEncoder,
    TextImageEncoder,
    TokenEncoder,
)
from attnwarp.errors import InputError, nearest

__all__ = [
    "BUNDLED",
    "REAL",
    "Encoder",
    "EncoderInfo",
    "ImageEncoder",
    "Kind",
    "PerceptualDistance",
    "PlaceEncoder",
    "TextImageEncoder",
    "TokenEncoder",
    "available",
    "check_kind",
    "kind_of",
    "load_encoder",
]

BUNDLED: dict[str, tuple[Kind, str]] = {
    "clip-small": ("clip", "a small text and image encoder trained on random rendered scenes"),
    "clip-parts": (
        "clip",
        "clip-small, taught things with parts, and what each place of a picture shows",
    ),
    "dino-small": (
        "dino",
        "a small image encoder trained on random rendered scenes, without labels",
    ),
    "perceptual-small": ("perceptual", "a small perceptual distance in the manner of LPIPS"),
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
    "lpips:FILE_OR_FOLDER": (
        "perceptual",
        "LPIPS: a torchvision backbone (alex, vgg) and its linear layers",
    ),
}
"""Encoders read from the user's files: pattern -> (kind, description)."""

AUTHORS_SIDE = 518
"""Side in px of DINOv2's pictures in the paper's figures."""

_SCHEMES = {pattern.partition(":")[0]: kind for pattern, (kind, _) in REAL.items()}


def available() -> dict[str, str]:
    """List the bundled encoders: name -> description.

    Example:
        >>> list(available())
        ['clip-small', 'clip-parts', 'dino-small', 'perceptual-small']
    """
    return {name: line for name, (_, line) in BUNDLED.items()}


def kind_of(name: str) -> Kind:
    """Determine the kind of an encoder by its name, without loading it.

    Raises:
        InputError: the name is unknown.

    Example:
        >>> kind_of("dinov2:/models/dinov2-small")
        'dino'
    """
    scheme, colon, place = name.partition(":")
    if name in BUNDLED:
        return BUNDLED[name][0]
    if colon and scheme in _SCHEMES:
        if not place.strip():
            raise InputError(
                f"encoder {name!r}: no place behind the colon, expected {_pattern(scheme)}"
            )
        return _SCHEMES[scheme]
    names = [*BUNDLED, *_SCHEMES]
    near = nearest((scheme if colon else name).lower(), names)
    guess = "." if near is None else f"; did you mean {_pattern(near)!r}?"
    raise InputError(f"encoder {name!r}: unknown{guess} Known are {', '.join([*BUNDLED, *REAL])}")


def check_kind(name: str, kind: Kind) -> None:
    """Refuse a name that is not an encoder of this kind, without loading it.

    Raises:
        InputError: the name is unknown, or the encoder is of another kind.

    Example:
        >>> check_kind("dino-small", "dino")
    """
    actual = kind_of(name)
    if actual != kind:
        fitting = ", ".join(n for n, (k, _) in (BUNDLED | REAL).items() if k == kind)
        raise InputError(
            f"encoder {name!r}: is of kind {actual!r}, expected {kind!r}; name one of {fitting}"
        )


@overload
def load_encoder(name: str, kind: Literal["clip"], *, device: str = "cpu") -> TextImageEncoder: ...
@overload
def load_encoder(name: str, kind: Literal["dino"], *, device: str = "cpu") -> TokenEncoder: ...
@overload
def load_encoder(
    name: str, kind: Literal["perceptual"], *, device: str = "cpu"
) -> PerceptualDistance: ...
@overload
def load_encoder(name: str, kind: None = None, *, device: str = "cpu") -> Encoder: ...
def load_encoder(name: str, kind: Kind | None = None, *, device: str = "cpu") -> Any:
    """Load an encoder by name.

    Args:
        name: name of a bundled encoder (``clip-small``, ``clip-parts``, ``dino-small``,
            ``perceptual-small``), or ``clip:FOLDER``, ``dinov2:FOLDER``, ``lpips:FILE_OR_FOLDER``;
            ``clip-whole:FOLDER`` and ``dinov2-518:FOLDER`` preprocess pictures as the paper's
            authors do.
        kind: expected kind; an encoder of another kind is refused before it is loaded.
        device: "cpu" or "cuda", for real encoders. Bundled encoders are small and stay on the CPU;
            the loss of ``perceptual-small`` is computed on its pictures' device.

    Returns:
        A :class:`TextImageEncoder` ("clip"), a :class:`TokenEncoder` ("dino") or a
        :class:`PerceptualDistance` ("perceptual").

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
    if kind is None:
        kind_of(name)
    else:
        check_kind(name, kind)
    if name in BUNDLED:
        if importlib.util.find_spec("attnwarp.encoders.bundled") is None:
            raise InputError(
                f"encoder {name!r}: this installation carries no bundled weights; name a real one:"
                f" {', '.join(REAL)}"
            )
        return importlib.import_module("attnwarp.encoders.bundled").load(name)
    scheme, _, place = name.partition(":")
    path = Path(place).expanduser()
    if scheme == "lpips":
        from attnwarp.encoders.lpips import load_lpips

        return load_lpips(path, name=name, device=device)
    from attnwarp.encoders import pretrained

    if scheme in ("clip", "clip-whole"):
        whole = scheme == "clip-whole"
        return pretrained.load_clip(path, name=name, device=device, whole=whole)
    side = AUTHORS_SIDE if scheme == "dinov2-518" else None
    return pretrained.load_dinov2(path, name=name, device=device, side=side)


def _pattern(name: str) -> str:
    return next((pattern for pattern in REAL if pattern.partition(":")[0] == name), name)
