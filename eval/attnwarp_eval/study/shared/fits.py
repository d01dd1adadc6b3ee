"""Fits of splats shared by several probes: study keys, and the fit of a cell."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

import attnwarp.fit
from attnwarp.errors import InputWarning
from attnwarp.fit import FitSettings
from attnwarp.io.lock import locked
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.splats import fitted
from attnwarp_eval.study.probe import Work
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Part, Study, Variant


class Fits(Part):
    """Views and initial points of every fit, and fields of :class:`attnwarp.fit.FitSettings`."""

    views: Annotated[int, Field(ge=9, le=10_000)] = 64
    points: Annotated[int, Field(ge=10, le=5_000_000)] = 5000
    noise: Annotated[float, Field(ge=0)] = 0.5
    seed: Annotated[
        int | None,
        Field(ge=0, description="of every fit, so that all seeds of the study share a scene's"),
    ] = None
    settings: dict[str, Any] = Field(
        default_factory=dict, description="fields of attnwarp.fit.FitSettings"
    )


class StudyPart(Part):
    """Keys of a study that only this probe reads."""

    fit: Fits = Fits()


class VariantPart(Part):
    """Keys of a variant: its fields of the fit's settings; ``fitted`` makes the other probes use
    fitted splats in place of sampled ones.
    """

    fitted: bool = False
    fit: dict[str, Any] = Field(default_factory=dict)


def settings_of(study: Study, variant: Variant | None, seed: int) -> FitSettings:
    """The study's fit settings, overridden by the variant's fields, if any."""
    shared = study.part(StudyPart).fit.settings
    own = {} if variant is None else variant.part(VariantPart).fit
    if "seed" in {**shared, **own}:
        raise ValueError("fit.seed: the seeds are the study's own; set seeds there")
    return FitSettings.from_dict({**shared, **own, "seed": seed})


def fit_spec(study: Study, variant: Variant | None, seed: int) -> Json:
    """Spec of a fit of one scene."""
    fits = study.part(StudyPart).fit
    settings = settings_of(study, variant, seed if fits.seed is None else fits.seed)
    return {**fits.model_dump(exclude_none=True), "settings": settings.to_dict()}


def fit_of(work: Work, spec: Mapping[str, Any] | None = None) -> attnwarp.fit.Fit:
    """Run or load the fit under ``fit`` in a cell's spec, or in ``spec``.

    The fit is saved below the run's folder under a name from its spec: cells with the same fit
    share it, and an interrupted fit is resumed.
    """
    spec, world = work.spec if spec is None else spec, work.world
    data, folder = spec["fit"], folder_of(work.root, spec)
    folder.mkdir(parents=True, exist_ok=True)
    lock = folder / ".lock"
    # If two workers need one fit, the second reads the first's result.
    with ExitStack() as held:
        try:
            held.enter_context(locked(lock, wait=False))
        except BlockingIOError:
            warnings.warn(
                f"{work.cell.title}: waits for process {lock.read_text()}, which makes this fit",
                InputWarning,
                stacklevel=2,
            )
            held.enter_context(locked(lock, wait=True))
        return fitted.fit_scene(
            world.scene,
            FitSettings.from_dict(data["settings"]),
            folder,
            views=data["views"],
            spp=spec["spp"],
            points=data["points"],
            noise=data["noise"],
            seed=data.get("seed", spec["seed"]),
            geometry=world.geometry,
        )


def folder_of(root: Path, spec: Mapping[str, Any]) -> Path:
    """Folder, below a run's folder, of the fit under ``fit`` in a cell's spec."""
    keys = ("seed", "scene", "size", "spp")
    return root / "fits" / digest({key: spec[key] for key in keys} | spec["fit"])[:16]
