"""Encoders of pictures and words shared by several probes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field, model_validator

from attnwarp.encoders import Kind
from attnwarp.errors import InputError
from attnwarp_eval.encoders import kind_of, load_encoder
from attnwarp_eval.study.schema import Part, Study, StudyError


class EncodersPart(Part):
    """Keys of a study: the encoders of every probe."""

    encoders: dict[Kind, str] = Field(
        default_factory=dict, description="by kind, as load_encoder takes them"
    )

    @model_validator(mode="after")
    def _check_encoders(self) -> EncodersPart:
        for kind, name in self.encoders.items():
            try:
                actual = kind_of(name)
            except InputError as error:
                raise ValueError(f"encoders.{kind}: {error}") from None
            if actual != kind:
                raise ValueError(f"encoders.{kind}: {name!r} is of kind {actual!r}")
        return self


def encoder_sources(part: EncodersPart) -> dict[str, str]:
    """Names of encoders by kind, for a cell's sources."""
    return {str(kind): part.encoders[kind] for kind in sorted(part.encoders)}


def encoder_identities(part: EncodersPart) -> dict[str, dict[str, Any]]:
    """Identities of encoders: different weights give different cells, another folder does not."""
    identities = {}
    for kind, name in part.encoders.items():
        try:
            identities[kind] = identity(name, kind)
        except InputError as error:
            raise StudyError(f"encoders.{kind}: {error}") from None
    return {str(kind): identities[kind] for kind in sorted(identities)}


def identity(name: str, kind: Kind) -> dict[str, Any]:
    """Entries that decide an encoder's figures: weights and preprocessing, not the path.

    Raises:
        InputError: see :func:`attnwarp_eval.encoders.load_encoder`.
    """
    return identity_of(load_encoder(name, kind))


def identity_of(encoder: Any) -> dict[str, Any]:
    """Identity of a loaded encoder, as :func:`identity` gives it."""
    about = encoder.about.to_dict()
    return {key: about[key] for key in ("kind", "weights_sha256", "preprocessing", "size", "dim")}


def loaded(names: Mapping[str, str], expected: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Encoders by kind.

    Args:
        names: names for :func:`attnwarp_eval.encoders.load_encoder`, by kind.
        expected: :func:`identity` of each at planning, by kind.

    Raises:
        InputError: an encoder cannot be loaded, or has changed.
    """
    encoders = {}
    for kind, planned in expected.items():
        encoders[kind] = load_encoder(names[kind])
        if identity_of(encoders[kind]) != planned:
            raise InputError(
                f"encoder {names[kind]!r}: its weights have changed since the run was planned;"
                " start the run again"
            )
    return encoders


def encoders_named(study: Study, spec: Mapping[str, Any]) -> str:
    """Sentence on the encoders of a cell, with the first digits of their weights' SHA-256."""
    names = study.part(EncodersPart).encoders
    encoders = [
        f"{kind} `{names[kind]}` ({identity['weights_sha256'][:12]})"
        for kind, identity in spec["encoders"].items()
    ]
    return f"Encoders: {', '.join(encoders) or 'none, so what needs one is left out'}."
