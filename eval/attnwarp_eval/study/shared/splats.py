"""The splats of a variant: sampled on the scene's surfaces, or fitted to its true pictures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attnwarp import Gaussians
from attnwarp_eval.canonical_json import canonical_json
from attnwarp_eval.study.probe import Work
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared import fits
from attnwarp_eval.world import splats


def splats_spec(study: Study, variant: Variant, seed: int) -> Json:
    """Spec of a variant's splats in a cell's spec: an entry ``fit`` or ``splats``."""
    if variant.part(fits.VariantPart).fitted:
        return {"fit": fits.fit_spec(study, variant, seed)}
    return {"splats": study.splats_of(variant).model_dump()}


def surface_spec(study: Study, variant: Variant, seed: int) -> Json:
    """Spec of a variant's depth: the truth, or splats."""
    if variant.geometry == "truth":
        return {"geometry": "truth"}
    if variant.part(fits.VariantPart).fitted:
        # A fit depends on the samples a pixel of its pictures.
        return {"spp": study.spp, **splats_spec(study, variant, seed)}
    return splats_spec(study, variant, seed)


def check_splats(study: Study, probe: str, what: str) -> None:
    """Raise ValueError if a rendering probe, of ``what``, measures a variant without splats."""
    for name in study.probes.get(probe, []):
        if study.variants[name].geometry != "splats":
            raise ValueError(
                f"probes.{probe}: {name!r} renders nothing, so there is no {what}; leave it out"
            )


def splats_meaning(study: Study, variant: Variant) -> str:
    """Key shared by variants with the same splats, for claims."""
    return canonical_json(splats_spec(study, variant, 0))


def surface_meaning(study: Study, variant: Variant) -> tuple[Any, ...]:
    """Key shared by variants with the same depth and rules, for claims."""
    return variant.settings(), variant.geometry, splats_meaning(study, variant)


def is_fitted(spec: Mapping[str, Any]) -> bool:
    """Return True if a cell's splats are fitted; a fit's seconds are in its folder alone."""
    return "fit" in spec


def splats_of(work: Work, spec: Mapping[str, Any] | None = None) -> Gaussians:
    """Splats of a cell's spec, or of ``spec`` in its place."""
    spec = work.spec if spec is None else spec
    if is_fitted(spec):
        return fits.fit_of(work, spec).gaussians
    return splats(work.cell.scene_file, spec["size"], spec["seed"], **spec["splats"])
