"""Encoders of pictures and texts that edits use: small bundled ones, and LPIPS from local files.

    load_encoder("clip-small").images([picture])
    load_encoder("lpips:/models/lpips").distance([edited], [rendered])

Published CLIP and DINOv2, which only measurements use, are in :mod:`attnwarp_eval.encoders`.
Nothing heavy is imported until an encoder is loaded, and nothing is ever downloaded.
"""

from __future__ import annotations

from collections.abc import Mapping
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
    "perceptual-small": ("perceptual", "a small perceptual distance in the manner of LPIPS"),
}
"""Bundled encoders: name -> (kind, description)."""

REAL: dict[str, tuple[Kind, str]] = {
    "lpips:FILE_OR_FOLDER": (
        "perceptual",
        "LPIPS: a torchvision backbone (alex, vgg) and its linear layers",
    ),
}
"""Encoders read from the user's files: pattern -> (kind, description)."""


def kind_of(name: str, known: Mapping[str, tuple[Kind, str]] = BUNDLED | REAL) -> Kind:
    """Determine the kind of an encoder by its name, without loading it.

    Args:
        known: name, or pattern with a colon -> (kind, description).

    Raises:
        InputError: the name is unknown.

    Example:
        >>> kind_of("lpips:/models/lpips")
        'perceptual'
    """
    patterns = {pattern.partition(":")[0]: pattern for pattern in known}
    scheme, colon, place = name.partition(":")
    pattern = patterns.get(scheme)
    if pattern is not None and bool(colon) == (":" in pattern):
        if colon and not place.strip():
            raise InputError(f"encoder {name!r}: no place behind the colon, expected {pattern}")
        return known[pattern][0]
    near = nearest((scheme if colon else name).lower(), list(patterns))
    guess = "." if near is None else f"; did you mean {patterns[near]!r}?"
    raise InputError(f"encoder {name!r}: unknown{guess} Known are {', '.join(known)}")


def check_kind(
    name: str, kind: Kind, known: Mapping[str, tuple[Kind, str]] = BUNDLED | REAL
) -> None:
    """Refuse a name that is not an encoder of this kind, without loading it.

    Raises:
        InputError: the name is unknown, or the encoder is of another kind.

    Example:
        >>> check_kind("clip-small", "clip")
    """
    actual = kind_of(name, known)
    if actual != kind:
        fitting = ", ".join(n for n, (k, _) in known.items() if k == kind)
        raise InputError(
            f"encoder {name!r}: is of kind {actual!r}, expected {kind!r}; name one of {fitting}"
        )


@overload
def load_encoder(name: str, kind: Literal["clip"], *, device: str = "cpu") -> TextImageEncoder: ...
@overload
def load_encoder(
    name: str, kind: Literal["perceptual"], *, device: str = "cpu"
) -> PerceptualDistance: ...
@overload
def load_encoder(name: str, kind: None = None, *, device: str = "cpu") -> Encoder: ...
def load_encoder(name: str, kind: Kind | None = None, *, device: str = "cpu") -> Any:
    """Load an encoder by name.

    Args:
        name: name of a bundled encoder (``clip-small``, ``clip-parts``, ``perceptual-small``), or
            ``lpips:FILE_OR_FOLDER``.
        kind: expected kind; an encoder of another kind is refused before it is loaded.
        device: "cpu" or "cuda", for LPIPS. Bundled encoders are small and stay on the CPU; the loss
            of ``perceptual-small`` is computed on its pictures' device.

    Returns:
        A :class:`TextImageEncoder` ("clip") or a :class:`PerceptualDistance` ("perceptual").

    Raises:
        InputError: the name is unknown, the kind differs from the expected one, or weights are
            missing or invalid; the message names the required files.
        MissingExtraError: the encoder needs a package of an extra.

    Example:
        >>> import numpy as np
        >>> encoder = load_encoder("clip-small", "clip")
        >>> encoder.images([np.zeros((64, 96, 3))]).shape
        (1, 192)
    """
    check_kind(name, kind or kind_of(name))
    if name in BUNDLED:
        from attnwarp.encoders.bundled import load

        return load(name)
    from attnwarp.encoders.lpips import load_lpips

    return load_lpips(Path(name.partition(":")[2]).expanduser(), name=name, device=device)
