"""What a scene file may say about light beyond sun, sky and diffuse surfaces: materials, lamps, fog, lens, effects.

All of it is a description; :mod:`attnwarp_eval.effects` decides from it, and from what Mitsuba made of it, which light
transport has to be simulated.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from pydantic import Field, field_validator, model_validator

from attnwarp_eval.textures import Color, Spec

if TYPE_CHECKING:
    from attnwarp_eval.scene import SceneSpec

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]

# Materials -----------------------------------------------------------------------------------------------------------


class DiffuseMaterial(Spec):
    """Scatters light evenly; its colour is the object's texture. What an object is unless it says otherwise."""

    type: Literal["diffuse"] = "diffuse"


class MirrorMaterial(Spec):
    """Reflects all light that meets it, times ``tint``."""

    type: Literal["mirror"]
    tint: Color = "#ffffff"


class MetalMaterial(Spec):
    """A conductor with measured indices of refraction; ``roughness`` 0 is polished, above that GGX."""

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

    A smooth coat would be diffuse and specular at once, and light through it could not be counted once: see
    docs/effects.md.
    """

    type: Literal["plastic"]
    ior: float = Field(1.49, gt=1, le=3)
    roughness: float = Field(0.1, ge=0.01, le=1)


class InteriorSpec(Spec):
    """What fills a glass object: light is scattered and absorbed inside (subsurface scattering).

    ``sigma_t`` is the extinction per scene unit, ``albedo`` times ``tint`` the share that is scattered, ``g`` the mean
    cosine of the scattering angle (Henyey-Greenstein).
    """

    sigma_t: Positive
    albedo: float = Field(0.9, ge=0, le=1)
    tint: Color = "#ffffff"
    g: float = Field(0.0, gt=-0.99, lt=0.99)


class GlassMaterial(Spec):
    """A dielectric. ``thin`` means a pane without thickness, which shifts nothing; ``roughness`` above 0 is frosted.

    ``abbe`` tells how strongly real glass of this kind disperses. Dispersion is not simulated; it is named.
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
            raise ValueError("got thin glass with roughness or an interior, but a thin pane has neither; drop 'thin'")
        return self


def _roughness(value: float) -> float:
    if 0 < value < 0.01:
        raise ValueError(
            f"got {value}, expected 0 (smooth) or at least 0.01: below that rendering only makes noise of it"
        )
    return value


Material = Annotated[
    DiffuseMaterial | MirrorMaterial | MetalMaterial | PlasticMaterial | GlassMaterial, Field(discriminator="type")
]

TEXTURED = (DiffuseMaterial, PlasticMaterial)

VERTEX_COLORED = ("body", "mesh", "terrain", "scatter")
"""Shapes whose colours lie in the vertices of their mesh."""
"""Materials whose colour is the object's texture; the others have a ``tint``."""


class EmissionSpec(Spec):
    """Light that a surface sends out evenly, in radiance. Rectangles shine where they face, closed shapes outward."""

    radiance: Positive
    color: Color = "#ffffff"


# Lights --------------------------------------------------------------------------------------------------------------


class PointSpec(Spec):
    """A lamp without size. ``intensity`` in power per solid angle: at distance d it gives intensity / d^2."""

    type: Literal["point"]
    position: Vector
    intensity: Positive
    color: Color = "#ffffff"


class SpotSpec(Spec):
    """A lamp without size that shines into a cone about ``target``, falling off from ``beam`` to ``cutoff`` degrees."""

    type: Literal["spot"]
    position: Vector
    target: Vector
    intensity: Positive
    color: Color = "#ffffff"
    cutoff: float = Field(25.0, gt=0, lt=90)
    beam: float | None = Field(None, gt=0, lt=90)


# Medium, lens, effects -----------------------------------------------------------------------------------------------


class BoundsSpec(Spec):
    """An upright box."""

    center: Vector
    size: tuple[Positive, Positive, Positive]


class MediumSpec(InteriorSpec):
    """Homogeneous fog in a ``box``; without one it fills the smallest box about all objects, lamps and cameras."""

    box: BoundsSpec | None = None


class LensSpec(Spec):
    """A thin lens. ``aperture`` is its radius; sharp is what lies ``focus`` away along the optical axis.

    Without ``focus`` that is the point the cameras look at.
    """

    aperture: Positive
    focus: Positive | None = None


Effect = Literal[
    "geometry", "direct", "shadows", "interreflection", "glossy", "specular", "refraction", "medium", "subsurface",
    "caustics", "environment", "depth_of_field", "textures", "motion", "polarisation", "dispersion",
]  # fmt: skip
"""Everything that light may do and a scene may call for, simulated or not."""

EFFECTS: tuple[Effect, ...] = get_args(Effect)

NOT_SIMULATED: tuple[Effect, ...] = ("motion", "polarisation", "dispersion")
"""Effects that pictures never show; a scene that calls for one is told so."""


class EffectsSpec(Spec):
    """``pin``: what the scene is about, so it must be there and is simulated. ``forbid``: what it must not need."""

    pin: tuple[Effect, ...] = ()
    forbid: tuple[Effect, ...] = ()


# What the file itself calls for --------------------------------------------------------------------------------------


def called_for(spec: SceneSpec) -> dict[Effect, str]:
    """The effects that the words of a scene file call for, each with the words.

    It reads the file alone, without rendering or loading anything; :mod:`attnwarp_eval.effects` looks closer.
    """
    from attnwarp_eval.scene import SkySpec

    found: dict[Effect, str] = {"geometry": f"{len(spec.objects)} objects"}

    def note(effect: Effect, evidence: str) -> None:
        found.setdefault(effect, evidence)

    lamps = [f"lights[{k}] is a {light.type}" for k, light in enumerate(spec.lights)]
    lamps += [f"object {item.name!r} shines" for item in spec.objects if item.emission]
    if lamps:
        note("direct", lamps[0])
        note("shadows", lamps[0])
    small = [f"lights[{k}] is a {light.type}" for k, light in enumerate(spec.lights) if light.type != "sky"]
    small += [f"object {item.name!r} shines" for item in spec.objects if item.emission]
    bent: list[str] = []
    for item in spec.objects:
        if item.velocity is not None and any(item.velocity):
            note("motion", f"object {item.name!r} has a velocity")
        if item.emission:
            continue
        material, name = item.material, f"object {item.name!r} is {item.material.type}"
        if isinstance(material, TEXTURED) and (item.texture.type != "plain" or item.texture.variation):
            note("textures", f"object {item.name!r} has the texture {item.texture.type}")
        if isinstance(material, DiffuseMaterial):
            continue
        rough = getattr(material, "roughness", 0.0)
        note("glossy" if rough else "specular", f"{name}, roughness {rough:g}")
        if not rough:
            bent.append(name)
        if isinstance(material, GlassMaterial):
            note("refraction", name)
            if material.interior:
                note("subsurface", f"{name} with an interior of sigma_t {material.interior.sigma_t:g}")
            if material.abbe is not None:
                note("dispersion", f"{name} of Abbe number {material.abbe:g}")
    if bent and small:
        note("caustics", f"{bent[0]}, and {small[0]}")
    if "refraction" in found or len(bent) > 1:
        note(
            "polarisation", f"light meets specular surfaces more than once: {bent[0] if bent else found['refraction']}"
        )
    for k, light in enumerate(spec.lights):
        if isinstance(light, SkySpec):
            note("environment", f"lights[{k}] is a sky")
    if spec.medium:
        note("medium", f"medium of sigma_t {spec.medium.sigma_t:g}")
    if spec.cameras.lens:
        note("depth_of_field", f"cameras.lens has an aperture of {spec.cameras.lens.aperture:g}")
    if spec.appearance.bounces != 1:
        note("interreflection", f"appearance.bounces is {spec.appearance.bounces}")
    return found


_REMEDIES: dict[Effect, str] = {
    "direct": "take away all lights",
    "shadows": "take away all lights",
    "interreflection": "say appearance.bounces: 1",
    "glossy": "make the object diffuse",
    "specular": "make the object diffuse",
    "refraction": "make the object diffuse",
    "medium": "take away 'medium'",
    "subsurface": "take away the material's 'interior'",
    "caustics": "take away the small light or the smooth object",
    "environment": "take away the sky",
    "depth_of_field": "take away cameras.lens",
    "textures": "use plain textures without variation",
    "motion": "take away the object's velocity",
    "polarisation": "leave at most one specular surface",
    "dispersion": "take away the material's 'abbe'",
}


def contradictions(spec: SceneSpec) -> Iterator[tuple[str, tuple[int | str, ...]]]:
    """What a scene file says that cannot all be true: message, and where in the file it stands."""
    found = called_for(spec)
    pinned, forbidden = spec.effects.pin, spec.effects.forbid
    for k, effect in enumerate(forbidden):
        where = ("effects", "forbid", k)
        if effect == "geometry":
            yield "effects.forbid: every picture needs the geometry; take it off the list", where
        elif effect in pinned:
            yield f"effects.forbid: {effect!r} is pinned as well; keep one of the two", where
        elif effect in found:
            yield (
                f"effects.forbid: {effect!r} is forbidden, but the scene calls for it ({found[effect]}); "
                f"{_REMEDIES[effect]}, or take {effect!r} off the list", where,
            )  # fmt: skip
    for k, effect in enumerate(pinned):
        if effect in NOT_SIMULATED:
            yield (f"effects.pin: {effect!r} is not simulated, so it cannot be pinned; take it off the list",
                   ("effects", "pin", k))  # fmt: skip
        elif effect not in found:
            yield (
                f"effects.pin: {effect!r} is pinned, but nothing here causes it; docs/effects.md says what does",
                ("effects", "pin", k),
            )
    bounces = spec.appearance.bounces
    for k, item in enumerate(spec.objects):
        if isinstance(item.material, PlasticMaterial) and item.shape.type in VERTEX_COLORED:
            # Mitsuba's roughplastic asks its texture for a mean, which colours of vertices have none of.
            yield (
                f"objects: {item.name!r} is plastic and its shape a {item.shape.type}; plastic can be a sphere, a box or a "
                "rectangle; say diffuse or metal, or another shape", ("objects", k, "material"),
            )  # fmt: skip
        needed, why = _bounces_needed(item.material)
        if not item.emission and bounces != "unlimited" and bounces < needed:
            yield (
                f"appearance.bounces: got {bounces}, but object {item.name!r} is {item.material.type}: {why}; "
                f"say at least {needed}, or unlimited", ("objects", k, "material"),
            )  # fmt: skip


def _bounces_needed(material: Material) -> tuple[int, str]:
    match material:
        case GlassMaterial(thin=False):
            return 3, "light passes in, out and then meets what lies behind"
        case GlassMaterial():
            return 2, "light passes through and then meets what lies behind"
        case MirrorMaterial() | MetalMaterial(roughness=0.0):
            return 2, "what it shows is a bounce further on"
    return 1, ""


__all__ = [
    "EFFECTS", "NOT_SIMULATED", "TEXTURED", "BoundsSpec", "DiffuseMaterial", "Effect", "EffectsSpec", "EmissionSpec",
    "GlassMaterial", "InteriorSpec", "LensSpec", "Material", "MediumSpec", "MetalMaterial", "MirrorMaterial",
    "PlasticMaterial", "PointSpec", "SpotSpec", "called_for", "contradictions",
]  # fmt: skip
