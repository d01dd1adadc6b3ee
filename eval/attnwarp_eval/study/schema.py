"""The parts of a study's YAML that every probe shares.

Keys of a single probe are defined with that probe; :mod:`attnwarp_eval.study.study` joins them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    field_validator,
    model_validator,
)

from attnwarp import check
from attnwarp.errors import InputError, suggest
from attnwarp.warp import PRESETS, WarpSettings
from attnwarp_eval.drawn.population import Population
from attnwarp_eval.scene.file import scene_name

if TYPE_CHECKING:
    from attnwarp_eval.scene.scene import Scene

P = TypeVar("P", bound="Part")


class StudyError(InputError):
    """A study that cannot be run; the message names the file, the value and the remedy.

    Example:
        >>> from attnwarp_eval.study import StudyError, load_study
        >>> try:
        ...     load_study("quik")
        ... except StudyError as error:
        ...     print(error)
        quik: no such study...quick...
    """


def _no_truth(value: Any) -> Any:
    # pydantic counts true as 1.
    if isinstance(value, bool):
        raise ValueError(f"got {value}, expected a whole number")
    return value


Whole = Annotated[int, BeforeValidator(_no_truth)]


class Part(BaseModel):
    """Keys of a study's YAML; an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def part(self, kind: type[P]) -> P:
        """Cast the object to one of its parts.

        Raises:
            TypeError: the object lacks that part; only a study read through
                :mod:`attnwarp_eval.study.study` has the parts of every probe.
        """
        if not isinstance(self, kind):
            raise TypeError(f"{type(self).__name__} has no part {kind.__name__}")
        return self


class Splats(Part):
    """Gaussians sampled on the scene's surfaces."""

    kind: Literal["2d", "3d"] = "2d"
    count: Annotated[Whole, Field(ge=1, le=5_000_000)] = 40_000
    position_noise: Annotated[float, Field(ge=0)] = 0.0
    normal_noise: Annotated[float, Field(ge=0, le=90)] = 0.0

    @field_validator("kind", mode="before")
    @classmethod
    def _as_text(cls, value: Any) -> Any:
        return value.lower() if isinstance(value, str) else value


class Variant(Part):
    """One row of a table: the source of depth, and the settings of the warp.

    ``preset`` is a preset of the warp, by default "corrected". For an editing variant it is a
    preset of its method.
    """

    preset: str | None = None
    set: dict[str, Any] = Field(default_factory=dict)
    geometry: Literal["splats", "truth"] = "splats"
    splats: dict[str, Any] = Field(default_factory=dict)

    def settings(self) -> WarpSettings:
        """Settings of the preset, overridden by this variant's fields."""
        name = "corrected" if self.preset is None else self.preset
        check.one_of(name, list(PRESETS), "preset")
        return WarpSettings.from_dict({**PRESETS[name].to_dict(), **self.set})


class Ablation(Part):
    """A table of the report: variants against a baseline, paired on scene and view."""

    title: str
    probe: str = ""
    baseline: str
    variants: Annotated[list[str], Field(min_length=1)]
    note: str = ""


class Front(Part):
    """A figure of the report: a metric (lower is better) against the seconds of the method.

    Seconds taken in turn are used if a probe has them for all variants, else seconds of the cells.
    """

    title: str
    probe: str = ""
    metric: str
    variants: list[str]


FIGURE = re.compile(r"\{([^{}|]+)\|([^{}|]+)\}")
"""A figure within a sentence of :class:`Answer`: ``{column|variant}``."""


class AnswerColumn(Part):
    """A column of an answer's table: a metric, over targets within a range of yaws, in degrees.

    With ``control`` and ``alone``, for sentences only: the share of a variant's gain over ``alone``
    that the control reaches, with its interval.
    """

    metric: str
    probe: str = ""
    yaw: tuple[float, float] | None = None
    control: str = ""
    alone: str = ""


class AnswerPictures(Part):
    """Pictures of an answer, side by side: columns are views, rows the variants.

    Args:
        caption: text above the pictures.
        probe: probe that draws the pictures.
        scene: scene of the pictures; the first one with pictures if this has none.
        first: label of a leading row -> its content, the same for all variants.
    """

    caption: str
    probe: str = ""
    scene: str = ""
    first: dict[str, str] = Field(default_factory=dict)
    content: str
    variants: Annotated[list[str], Field(min_length=1)]


class Answer(Part):
    """Opening of a report: a question, sentences, pictures, one table.

    A sentence holds figures as ``{column|variant}``; a sentence with a figure that this run lacks
    is left out. ``variants`` are the table's rows, each with a description;
    ``columns`` are titles with their metrics, ``figures`` further columns for sentences only.
    ``decides`` is the column by which a variant is recommended.
    """

    question: str
    sentences: list[str] = Field(default_factory=list)
    variants: Annotated[dict[str, str], Field(min_length=2, max_length=5)]
    columns: Annotated[dict[str, AnswerColumn], Field(min_length=1, max_length=4)]
    decides: str
    figures: dict[str, AnswerColumn] = Field(default_factory=dict)
    pictures: list[AnswerPictures] = Field(default_factory=list)


class Pictures(Part):
    """Variants and views whose pictures are saved."""

    variants: list[str] = Field(default_factory=list)
    views: list[str] = Field(default_factory=list)


class Study(Part):
    """Scenes x variants x seeds x probes, and the contents of the report.

    Example:
        >>> from attnwarp_eval.study import load_study
        >>> study = load_study("quick", size=256)
        >>> study.size, study.seeds, study.variants["paper"].preset
        (256, [0], 'paper')
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    title: str = ""
    description: str = ""
    size: Annotated[Whole, Field(ge=16, le=4096)] = 512
    scenes: list[str] = Field(
        default_factory=list,
        description="names, paths, or a population such as {drawn: 8, seed: 7}",
    )
    population: Population | None = Field(None, description="of which the scenes are a sample")
    views: list[str] = Field(
        default_factory=list, description="target views by name; all of them if empty"
    )
    seeds: Annotated[list[Annotated[Whole, Field(ge=0, lt=2**32)]], Field(min_length=1)] = Field(
        default_factory=lambda: [0]
    )
    spp: Annotated[Whole, Field(ge=1)] = 16
    feature_sizes: list[Whole] = Field(
        default_factory=list, description="image size, 1/8 and 1/16 of it if left out"
    )
    feature_channels: Annotated[Whole, Field(ge=1, le=4096)] = 8
    timing_rounds: Annotated[Whole, Field(ge=3)] = 15
    splats: Splats = Splats()
    variants: dict[str, Variant] = Field(default_factory=dict)
    probes: Annotated[dict[str, list[str]], Field(min_length=1)]
    ablations: list[Ablation] = Field(default_factory=list)
    fronts: list[Front] = Field(default_factory=list)
    answer: Answer | None = None
    pictures: Pictures = Pictures()
    _left_out: tuple[str, ...] = PrivateAttr(default=())

    @property
    def scene_names(self) -> list[str]:
        """Names of the scenes in cells and reports: files that share a name are named by path."""
        names = [scene_name(where) for where in self.scenes]
        return [
            where if names.count(name) > 1 else name
            for where, name in zip(self.scenes, names, strict=True)
        ]

    @property
    def sampled(self) -> str:
        """Description of the population that the scenes sample; empty without one."""
        if self.population is None:
            return ""
        count, words = len(self.scenes), self.population.words
        return words if count == self.population.count else f"{count} of {words}"

    @property
    def scenes_in_words(self) -> str:
        """The population, or the scenes' names."""
        return self.sampled or f"scenes {', '.join(self.scene_names)}"

    @property
    def left_out(self) -> tuple[str, ...]:
        """Scenes of the study's file that are not chosen; other keys may name them."""
        return self._left_out

    @model_validator(mode="before")
    @classmethod
    def _feature_sizes_follow_the_image(cls, data: Any) -> Any:
        size = data.get("size", 512) if isinstance(data, dict) else None
        if isinstance(size, int) and not data.get("feature_sizes"):
            # The latent sizes of a diffusion UNet's first two levels of attention.
            return {
                **data,
                "feature_sizes": sorted(
                    {size, max(1, size // 8), max(1, size // 16)}, reverse=True
                ),
            }
        return data

    @model_validator(mode="after")
    def _check_values(self) -> Study:
        for size in self.feature_sizes:
            if not 1 <= size <= self.size:
                raise ValueError(
                    f"feature_sizes: got {size}, expected 1 to {self.size}, the image size"
                )
        for key in ("scenes", "seeds", "views"):
            check_distinct(getattr(self, key), key)
        return self

    def check_scenes(self, names: Iterable[str], key: str, scenes: Iterable[Scene]) -> None:
        """Refuse names of unknown scenes; scenes left out are known.

        Raises:
            StudyError: a name of an unknown scene.
        """
        known = [*(scene.name for scene in scenes), *map(scene_name, self.left_out)]
        for name in names:
            if name not in known:
                raise StudyError(
                    f"{key}: the study has no scene {name!r}{did_you_mean(name, known)}"
                )

    def check_variants(self, names: Iterable[str], key: str, probe: str = "") -> None:
        """Raise ValueError unless every name is a variant that ``probe`` measures.

        Args:
            key: key of the YAML, for the message.
            probe: probe with the table that needs them; any if empty.
        """
        for name in names:
            if name not in self.variants:
                near = did_you_mean(name, self.variants)
                raise ValueError(f"{key}: no variant {name!r}{near}")
            # A variant that is never measured would silently be missing from its table.
            if probe and name not in self.probes.get(probe, []):
                raise ValueError(f"{key}: {name!r} is not measured; add it to probes.{probe}")

    def splats_of(self, variant: Variant) -> Splats:
        """The study's splats, overridden by the variant's fields."""
        return Splats.model_validate({**self.splats.model_dump(), **variant.splats})

    def views_of(self, scene: Scene) -> list[str]:
        """Names of the measured targets of a scene, in the scene's order.

        Raises:
            StudyError: the study names a view that the scene lacks.
        """
        available = [camera.name for camera in scene.targets]
        for name in self.views:
            if name not in available:
                raise StudyError(
                    f"views: scene {scene.name!r} has no view"
                    f" {name!r}{did_you_mean(name, available)}"
                )
        return [name for name in available if not self.views or name in self.views]

    def pictures_of(self, views: Iterable[str], variant: str | None = None) -> tuple[str, ...]:
        """Views whose pictures the study saves, in the order of ``views``.

        Args:
            variant: variant of the cell; None without one, as in the calibration.
        """
        if variant is not None and variant not in self.pictures.variants:
            return ()
        available = set(views)
        return tuple(view for view in self.pictures.views if view in available)


def check_distinct(values: list[Any], key: str) -> None:
    """Raise ValueError if a value of the YAML's ``key`` is named twice."""
    if len(set(values)) != len(values):
        raise ValueError(f"{key}: something is named twice in {values}")


def did_you_mean(name: str, available: Iterable[str]) -> str:
    """The end of an error message: the nearest available name, or all of them."""
    names = list(available)
    return suggest(name, names) or f"; there are {', '.join(map(repr, names))}"
