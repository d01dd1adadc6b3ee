"""Parts of a scene file about light beyond sun, sky and diffuse surfaces: materials, lamps, fog,
lens, effects.

These are only descriptions; :mod:`attnwarp_eval.scene.transport` derives the light transport that
they need.
"""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import Field, ValidationInfo, field_validator, model_validator

from attnwarp_eval.scene.base import Color, Positive, Spec, Vector

# Materials
# --------------------------------------------------------------------------------------------------


class DiffuseMaterial(Spec):
    """Scatters light evenly, in the colour of the object's texture. The default material."""

    type: Literal["diffuse"] = "diffuse"


class MirrorMaterial(Spec):
    """Reflects all incident light, times ``tint``."""

    type: Literal["mirror"]
    tint: Color = "#ffffff"


class MetalMaterial(Spec):
    """A conductor with measured indices of refraction; ``roughness`` 0 is polished, above that
    GGX."""

    type: Literal["metal"]
    metal: Literal["Ag", "Al", "Au", "Cr", "Cu", "W"] = "Al"
    roughness: float = Field(0.0, ge=0, le=1)
    tint: Color = "#ffffff"

    @field_validator("roughness")
    @classmethod
    def _not_nearly_smooth(cls, value: float) -> float:
        return _roughness(value)


class PlasticMaterial(Spec):
    """A diffuse base in the object's texture under a rough (GGX) dielectric coat.

    A smooth coat would be diffuse and specular at once, and light through it would be counted
    twice: see docs/truth/scenes.md.
    """

    type: Literal["plastic"]
    ior: float = Field(1.49, gt=1, le=3)
    roughness: float = Field(0.1, ge=0.01, le=1)


class InteriorSpec(Spec):
    """Filling of a glass object: scatters and absorbs light inside (subsurface scattering).

    ``sigma_t`` is the extinction per scene unit, ``albedo`` times ``tint`` the share that is
    scattered, ``g`` the mean cosine of the scattering angle (Henyey-Greenstein).
    """

    sigma_t: Positive
    albedo: float = Field(0.9, ge=0, le=1)
    tint: Color = "#ffffff"
    g: float = Field(0.0, gt=-0.99, lt=0.99)


class GlassMaterial(Spec):
    """A dielectric. ``thin`` means a pane without thickness, which shifts nothing; ``roughness``
    above 0 is frosted.

    ``abbe`` is the Abbe number of real glass of this kind. Dispersion is not simulated, only
    named.
    """

    type: Literal["glass"]
    ior: float = Field(1.5, gt=1, le=3)
    roughness: float = Field(0.0, ge=0, le=1)
    thin: bool = False
    tint: Color = "#ffffff"
    interior: InteriorSpec | None = None
    abbe: Positive | None = None

    @field_validator("roughness")
    @classmethod
    def _not_nearly_smooth(cls, value: float) -> float:
        return _roughness(value)

    @model_validator(mode="after")
    def _a_pane_has_no_inside(self) -> GlassMaterial:
        if self.thin and (self.roughness or self.interior):
            raise ValueError(
                "got thin glass with roughness or an interior, but a thin pane has neither; drop"
                " 'thin'"
            )
        return self


def _roughness(value: float) -> float:
    if 0 < value < 0.01:
        raise ValueError(
            f"got {value}, expected 0 (smooth) or at least 0.01: below that rendering only makes"
            " noise of it"
        )
    return value


Material = Annotated[
    DiffuseMaterial | MirrorMaterial | MetalMaterial | PlasticMaterial | GlassMaterial,
    Field(discriminator="type"),
]

TEXTURED = (DiffuseMaterial, PlasticMaterial)
"""Materials whose colour is the object's texture; the others have a ``tint``."""


class EmissionSpec(Spec):
    """Uniform radiance of a surface: along a rectangle's normal, out of closed shapes."""

    radiance: Positive
    color: Color = "#ffffff"


# Lights
# --------------------------------------------------------------------------------------------------


class PointSpec(Spec):
    """A point lamp. ``intensity`` in power per solid angle: intensity / d^2 at distance d."""

    type: Literal["point"]
    position: Vector
    intensity: Positive
    color: Color = "#ffffff"


class SpotSpec(Spec):
    """A point lamp with a cone about ``target``, fading from ``beam`` to ``cutoff`` degrees."""

    type: Literal["spot"]
    position: Vector
    target: Vector
    intensity: Positive
    color: Color = "#ffffff"
    cutoff: float = Field(25.0, gt=0, lt=90)
    beam: float | None = Field(None, gt=0, lt=90)

    @field_validator("target")
    @classmethod
    def _elsewhere(cls, target: Vector, info: ValidationInfo) -> Vector:
        if target == info.data.get("position"):
            raise ValueError("is the lamp's own position; name a point that it shines at")
        return target


# Medium, lens, effects
# --------------------------------------------------------------------------------------------------


class BoundsSpec(Spec):
    """An axis-aligned box."""

    center: Vector
    size: tuple[Positive, Positive, Positive]


class MediumSpec(InteriorSpec):
    """Homogeneous fog in a ``box``, by default about all objects, lamps and cameras."""

    box: BoundsSpec | None = None


class LensSpec(Spec):
    """A thin lens. ``aperture`` is its radius; points at ``focus`` along the optical
    axis are sharp.

    ``focus`` defaults to the distance of ``cameras.look_at``, also in views that look elsewhere.
    """

    aperture: Positive
    focus: Positive | None = None


Effect = Literal[
    "geometry",
    "direct",
    "shadows",
    "interreflection",
    "glossy",
    "specular",
    "refraction",
    "medium",
    "subsurface",
    "caustics",
    "environment",
    "depth_of_field",
    "textures",
    "motion",
    "polarisation",
    "dispersion",
]
"""All light-transport effects that a scene may need, simulated or not."""

EFFECTS: tuple[Effect, ...] = get_args(Effect)

NOT_SIMULATED: tuple[Effect, ...] = ("motion", "polarisation", "dispersion")
"""Effects that are never simulated; a scene that needs one is reported."""


class EffectsSpec(Spec):
    """``pin``: effects that must occur and be simulated. ``forbid``: those that must not."""

    pin: tuple[Effect, ...] = ()
    forbid: tuple[Effect, ...] = ()


__all__ = [
    "EFFECTS",
    "NOT_SIMULATED",
    "TEXTURED",
    "BoundsSpec",
    "DiffuseMaterial",
    "Effect",
    "EffectsSpec",
    "EmissionSpec",
    "GlassMaterial",
    "InteriorSpec",
    "LensSpec",
    "Material",
    "MediumSpec",
    "MetalMaterial",
    "MirrorMaterial",
    "PlasticMaterial",
    "PointSpec",
    "SpotSpec",
]
