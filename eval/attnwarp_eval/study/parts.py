"""The parts of a study's YAML: what its variants are made of, and what its report shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

if TYPE_CHECKING:
    from attnwarp.warp.settings import WarpSettings


class Part(BaseModel):
    """What a study's YAML may say; an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Splats(Part):
    """Gaussians sampled on the scene's surfaces."""

    kind: Literal["2d", "3d"] = "2d"
    count: Annotated[int, Field(ge=1, le=5_000_000)] = 40_000
    position_noise: Annotated[float, Field(ge=0)] = 0.0
    normal_noise: Annotated[float, Field(ge=0, le=90)] = 0.0

    @field_validator("kind", mode="before")
    @classmethod
    def _as_text(cls, value: Any) -> Any:
        return value.lower() if isinstance(value, str) else value


class Fits(Part):
    """Splats fitted to true pictures from all around the scene; the ``fit`` probe measures them on
    views held out.
    """

    views: Annotated[int, Field(ge=9, le=10_000)] = 64
    points: Annotated[int, Field(ge=10, le=5_000_000)] = 5000
    noise: Annotated[float, Field(ge=0)] = 0.5
    settings: dict[str, Any] = Field(
        default_factory=dict, description="fields of attnwarp.fit.FitSettings"
    )


class Variant(Part):
    """One row of a table: where depth comes from, and how the warp is made.

    ``fit`` changes fields of the study's fit settings; only the ``fit`` probe reads it.
    """

    preset: str = "corrected"
    set: dict[str, Any] = Field(default_factory=dict)
    geometry: Literal["splats", "truth"] = "splats"
    splats: dict[str, Any] = Field(default_factory=dict)
    fit: dict[str, Any] = Field(default_factory=dict)

    def settings(self) -> WarpSettings:
        """The preset with this variant's own fields."""
        from attnwarp import check
        from attnwarp.warp.settings import PRESETS, WarpSettings

        check.one_of(self.preset, list(PRESETS), "preset")
        return WarpSettings.from_dict({**PRESETS[self.preset].to_dict(), **self.set})


class Ablation(Part):
    """A table of the report: variants against a baseline, paired on scene and view."""

    title: str
    probe: Literal["depth", "warp", "fit"] = "warp"
    baseline: str
    variants: list[str]
    note: str = ""


class Front(Part):
    """A figure of the report: a metric (lower is better) against the seconds of the method, for
    these variants.

    Seconds come from the ``timing`` probe where it has all of them, taken in turn; else from the
    cells themselves.
    """

    title: str
    probe: Literal["depth", "warp", "fit"] = "warp"
    metric: str
    variants: list[str]


class Yaw(Part):
    """The variants whose masks the report shows by yaw."""

    variants: list[str] = Field(default_factory=list)


class Pictures(Part):
    """Which variants and views are kept as pictures."""

    variants: list[str] = Field(default_factory=list)
    views: list[str] = Field(default_factory=list)
