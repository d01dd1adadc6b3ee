"""Light transport that a scene file needs, and contradictions in the file."""

from __future__ import annotations

from collections.abc import Iterator

from attnwarp_eval.scene.materials import (
    NOT_SIMULATED,
    TEXTURED,
    DiffuseMaterial,
    Effect,
    GlassMaterial,
    Material,
    MetalMaterial,
    MirrorMaterial,
    PlasticMaterial,
)
from attnwarp_eval.scene.spec import SceneSpec, SkySpec

VERTEX_COLORED = ("body", "mesh", "terrain", "scatter")
"""Shapes whose colours lie in the vertices of their mesh."""

OPEN = ("rectangle", "terrain")
"""Shapes that enclose nothing."""


def called_for(spec: SceneSpec) -> dict[Effect, str]:
    """Effects that a scene file needs, each with the responsible words.

    Only the file is read, without rendering or loading anything;
    :mod:`attnwarp_eval.effects.detect` also checks the loaded scene.
    """
    evidence_of: dict[Effect, str] = {"geometry": f"{len(spec.objects)} objects"}

    def note(effect: Effect, evidence: str) -> None:
        evidence_of.setdefault(effect, evidence)

    lamps = [f"lights[{k}] is a {light.type}" for k, light in enumerate(spec.lights)]
    lamps += [f"object {item.name!r} shines" for item in spec.objects if item.emission]
    if lamps:
        note("direct", lamps[0])
        note("shadows", lamps[0])
    small = [
        f"lights[{k}] is a {light.type}"
        for k, light in enumerate(spec.lights)
        if light.type != "sky"
    ]
    small += [f"object {item.name!r} shines" for item in spec.objects if item.emission]
    bent: list[str] = []
    polarising = False
    for item in spec.objects:
        if item.velocity is not None and any(item.velocity):
            note("motion", f"object {item.name!r} has a velocity")
        if item.emission:
            continue
        material, name = item.material, f"object {item.name!r} is {item.material.type}"
        if isinstance(material, TEXTURED) and (
            item.texture.type != "plain" or item.texture.variation
        ):
            note("textures", f"object {item.name!r} has the texture {item.texture.type}")
        if isinstance(material, DiffuseMaterial):
            continue
        rough = getattr(material, "roughness", 0.0)
        note("glossy" if rough else "specular", f"{name}, roughness {rough:g}")
        if not rough:
            bent.append(name)
            # A mirror here is ideal: it reflects both polarisations alike, so that only metal and
            # glass tell them apart.
            polarising |= not isinstance(material, MirrorMaterial)
        if isinstance(material, GlassMaterial):
            note("refraction", name)
            if material.interior:
                note(
                    "subsurface",
                    f"{name} with an interior of sigma_t {material.interior.sigma_t:g}",
                )
            if material.abbe is not None:
                note("dispersion", f"{name} of Abbe number {material.abbe:g}")
    if bent and small:
        note("caustics", f"{bent[0]}, and {small[0]}")
    if "refraction" in evidence_of or (len(bent) > 1 and polarising):
        note(
            "polarisation",
            "light meets specular surfaces more than once:"
            f" {bent[0] if bent else evidence_of['refraction']}",
        )
    for k, light in enumerate(spec.lights):
        if isinstance(light, SkySpec):
            note("environment", f"lights[{k}] is a sky")
    if spec.medium:
        note("medium", f"medium of sigma_t {spec.medium.sigma_t:g}")
    if spec.cameras.lens:
        note("depth_of_field", f"cameras.lens has an aperture of {spec.cameras.lens.aperture:g}")
    if spec.appearance.bounces != 1:
        number = spec.appearance.bounces or "left open"
        note("interreflection", f"appearance.bounces is {number}")
    return evidence_of


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
    """Contradictions in a scene file: a message, and the key in the file."""
    skies = [k for k, light in enumerate(spec.lights) if isinstance(light, SkySpec)]
    if len(skies) > 1:
        yield (
            f"lights[{skies[1]}]: a second sky; there is only one all-around light, keep one",
            ("lights", skies[1]),
        )
    if not spec.lights and not any(item.emission for item in spec.objects):
        yield (
            (
                "lights: there is none, and no object has an 'emission'; add a sun, a sky, a point"
                " or a spot"
            ),
            ("lights",),
        )
    present = called_for(spec)
    pinned, forbidden = spec.effects.pin, spec.effects.forbid
    for k, effect in enumerate(forbidden):
        key = ("effects", "forbid", k)
        if effect == "geometry":
            yield "effects.forbid: every picture needs the geometry; take it off the list", key
        elif effect in pinned:
            yield f"effects.forbid: {effect!r} is pinned as well; keep one of the two", key
        elif effect in present:
            yield (
                (
                    f"effects.forbid: {effect!r} is forbidden, but the scene calls for it"
                    f" ({present[effect]}); {_REMEDIES[effect]}, or take {effect!r} off the list"
                ),
                key,
            )
    for k, effect in enumerate(pinned):
        if effect in NOT_SIMULATED:
            yield (
                (
                    f"effects.pin: {effect!r} is not simulated, so it cannot be pinned; take it off"
                    " the list"
                ),
                ("effects", "pin", k),
            )
        elif effect not in present:
            yield (
                (
                    f"effects.pin: {effect!r} is pinned, but nothing here causes it;"
                    " docs/truth/truth.md says what does"
                ),
                ("effects", "pin", k),
            )
    bounces = spec.appearance.bounces
    for k, item in enumerate(spec.objects):
        if isinstance(item.material, PlasticMaterial) and item.shape.type in VERTEX_COLORED:
            # Mitsuba's roughplastic needs a texture's mean, which vertex colours do not
            # have.
            yield (
                (
                    f"objects: {item.name!r} is plastic and its shape a {item.shape.type}; plastic"
                    " can be a sphere, a box or a rectangle; say diffuse or metal, or another"
                    " shape"
                ),
                ("objects", k, "material"),
            )
        if (
            isinstance(item.material, GlassMaterial)
            and not item.material.thin
            and item.shape.type in OPEN
        ):
            yield (
                (
                    f"objects: {item.name!r} is glass and its shape a {item.shape.type}, which has"
                    " no inside: light would never leave the glass; say thin: true, or another"
                    " shape"
                ),
                ("objects", k, "material"),
            )
        needed, why = _bounces_needed(item.material)
        if not item.emission and isinstance(bounces, int) and bounces < needed:
            yield (
                (
                    f"appearance.bounces: got {bounces}, but object {item.name!r} is"
                    f" {item.material.type}: {why}; say at least {needed}, or unlimited"
                ),
                ("objects", k, "material"),
            )


def fewest_bounces(spec: SceneSpec) -> int:
    """The least number of bounces that shows every object's material."""
    materials = (item.material for item in spec.objects if not item.emission)
    return max((_bounces_needed(material)[0] for material in materials), default=1)


def _bounces_needed(material: Material) -> tuple[int, str]:
    match material:
        case GlassMaterial(thin=False):
            return 3, "light passes in, out and then meets what lies behind"
        case GlassMaterial():
            return 2, "light passes through and then meets what lies behind"
        case MirrorMaterial() | MetalMaterial(roughness=0.0):
            return 2, "what it shows is a bounce further on"
    return 1, ""


def likely_bounces(spec: SceneSpec) -> int:
    """A typical upper bound of the bounces for a scene's materials and lights.

    It follows from the file; :mod:`attnwarp_eval.truth.bounces` measures the number. Light between
    diffuse surfaces fades within three bounces, as their albedo is at most 0.9 and most of it
    leaves for the sky. Reflecting and refracting objects add the bounces that they need.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> likely_bounces(load_scene("spheres").spec), likely_bounces(load_scene("bear").spec)
        (3, 4)
    """
    more = {"glossy": 1, "specular": 1, "refraction": 1, "medium": 2, "subsurface": 6}
    present = called_for(spec)
    return 3 + sum(extra for effect, extra in more.items() if effect in present)
