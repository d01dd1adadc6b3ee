"""Fits of splats that several probes measure: the keys of a study, and the fit of a cell."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

import attnwarp.fit
from attnwarp.fit import FitSettings
from attnwarp.io.lock import locked
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.splats import fitted
from attnwarp_eval.study.probe import Work
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Part, Study, Variant


class Fits(Part):
    """Views and first points of every fit, and fields of :class:`attnwarp.fit.FitSettings`."""

    views: Annotated[int, Field(ge=9, le=10_000)] = 64
    points: Annotated[int, Field(ge=10, le=5_000_000)] = 5000
    noise: Annotated[float, Field(ge=0)] = 0.5
    settings: dict[str, Any] = Field(
        default_factory=dict, description="fields of attnwarp.fit.FitSettings"
    )


class StudyPart(Part):
    """Keys of a study that only this probe reads."""

    fit: Fits = Fits()


class VariantPart(Part):
    """Keys of a variant: its own fields of the fit's settings; ``fitted`` has the other probes take
    fitted splats in place of sampled ones.
    """

    fitted: bool = False
    fit: dict[str, Any] = Field(default_factory=dict)


def settings_of(study: Study, variant: Variant, seed: int) -> FitSettings:
    """The study's fit settings with the variant's own fields."""
    shared, own = study.part(StudyPart).fit.settings, variant.part(VariantPart).fit
    if "seed" in {**shared, **own}:
        raise ValueError("fit.seed: the seeds are the study's own; set seeds there")
    return FitSettings.from_dict({**shared, **own, "seed": seed})


def fit_spec(study: Study, variant: Variant, seed: int) -> Json:
    """Spec of a fit of one scene."""
    fits = study.part(StudyPart).fit
    return {**fits.model_dump(), "settings": settings_of(study, variant, seed).to_dict()}


def fit_of(work: Work, spec: Mapping[str, Any] | None = None) -> attnwarp.fit.Fit:
    """The fit that a cell's spec, or ``spec`` in its place, names under ``fit``.

    It lies below the run's folder, named by what decides it: cells that want the same fit share
    it, and one that was cut short is resumed.
    """
    spec, world = work.spec if spec is None else spec, work.world
    data, folder = spec["fit"], folder_of(work.root, spec)
    folder.mkdir(parents=True, exist_ok=True)
    # Where two workers want one fit, the second reads what the first has done.
    with locked(folder / ".lock", wait=True):
        return fitted.fit_scene(
            world.scene,
            FitSettings.from_dict(data["settings"]),
            folder,
            views=data["views"],
            spp=spec["spp"],
            points=data["points"],
            noise=data["noise"],
            seed=spec["seed"],
            geometry=world.geometry,
        )


def folder_of(root: Path, spec: Mapping[str, Any]) -> Path:
    """The folder of the fit that a cell's spec names under ``fit``, below a run's folder."""
    keys = ("scene", "size", "spp", "seed")
    return root / "fits" / digest({**spec["fit"], **{key: spec[key] for key in keys}})[:16]
