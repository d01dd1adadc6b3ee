"""Passes whose sum is a picture of a scene: the cheapest faithful renderings.

:func:`plan_passes` depends only on the scene file, without loading anything, for a number of
bounces; :mod:`attnwarp_eval.truth.plan` adds the scene's number. docs/truth/truth.md has the
reasons.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from attnwarp_eval.scene import materials, transport
from attnwarp_eval.scene.scene import Scene, SceneError
from attnwarp_eval.scene.shapes import Box, Rectangle, Sphere
from attnwarp_eval.scene.spec import SkySpec

Array = npt.NDArray[np.float64]
Integrator = Literal["direct", "path", "volpath", "ptracer"]
Bounces = int | Literal["unlimited"]

SMALL = 0.15
"""A lamp counts as small when its radius is below this share of its distance from the glass. Paths
from the camera find it by chance, about once in 4 / SMALL^2 = 180 tries, and the caustic comes out
as isolated bright pixels."""

ROULETTE = 5
"""Paths without a cap are ended at random from this many edges on; Mitsuba's default."""

LIGHT_PATHS = 4
"""Light paths for each camera sample: most paths from the light end outside the cameras' views."""


@dataclass(frozen=True)
class Pass:
    """One rendering; the picture is the sum of the passes, since light adds up.

    Attributes:
        integrator: Mitsuba's plugin.
        lights: indices of the scene's lights used in the pass.
        lamps: whether objects with an ``emission`` shine in the pass.
        max_depth: longest path in edges from the camera; 2 is direct light, -1 has no end.
        rr_depth: edges after which paths are ended at random; above ``max_depth`` never.
        emitter_samples, bsdf_samples: rays toward lights and along the material's lobe at each hit
            ("direct" only).
        spp: samples a pixel; for "ptracer" light paths a pixel.
        first: camera rays that count: "any"; "smooth", those whose first surface is smooth glass,
            metal or a mirror, a lamp, or none at all; or "rough", the others, which also include
            those that a ptracer pass makes.
        beam: light only the directions of the smooth objects (a point light becomes a
            spot on them).
        sign: -1 for a subtracted pass.
        aims_at_sky: whether points are connected to the sky as to other lights; without it only
            rays spread by the materials find the sky.
    """

    lights: tuple[int, ...]
    integrator: Integrator
    max_depth: int
    emitter_samples: int
    bsdf_samples: int
    spp: int
    lamps: bool = False
    rr_depth: int = ROULETTE
    first: Literal["any", "smooth", "rough"] = "any"
    beam: bool = False
    sign: Literal[1, -1] = 1
    aims_at_sky: bool = True


@dataclass(frozen=True)
class Lens:
    """A thin lens in scene units; ``focus`` None means the depth of ``cameras.look_at``."""

    aperture: float
    focus: float | None


@dataclass(frozen=True)
class Plan:
    """Plan of a picture, with reasons.

    Attributes:
        passes: the renderings to add up; none if ray casting suffices.
        media: whether fog and interiors are rendered.
        lens: None for a pinhole.
    """

    passes: tuple[Pass, ...]
    reasons: tuple[str, ...]
    media: bool = False
    lens: Lens | None = None

    @property
    def integrator(self) -> str:
        """The integrators, such as "direct" or "path + ptracer"; "raycast" if none renders."""
        return " + ".join(dict.fromkeys(step.integrator for step in self.passes)) or "raycast"

    @property
    def sensor(self) -> str:
        """Mitsuba's camera plugin."""
        return "thinlens" if self.lens else "perspective"

    def identity(self) -> dict[str, Any]:
        """Entries that decide the picture, without the reasons; part of cache keys."""
        data = asdict(replace(self, reasons=()))
        # Pictures of such passes used to be stratified.
        few = any(p.integrator == "volpath" and p.spp < FEWEST_STRATIFIED for p in self.passes)
        return {**data, "sampler": "independent"} if few else data

    def to_dict(self) -> dict[str, Any]:
        """Plan as JSON, for ``scenes effects --json``."""
        return {
            "integrator": self.integrator,
            "sensor": {"type": self.sensor} | (asdict(self.lens) if self.lens else {}),
            "sampler": sorted({sampler(step.integrator, step.spp) for step in self.passes}),
            "filter": "box",
            "media": self.media,
            "passes": [asdict(step) for step in self.passes],
            "reasons": list(self.reasons),
        }


FEWEST_STRATIFIED = 6
"""Samples of a path through fog from which on they are stratified. With 4, multijittered samples
made fog too bright by 1.2 % ± 0.1, independent ones did not; 6 and more agree with these."""


def sampler(integrator: Integrator, spp: int) -> str:
    """Stratified samples if ``spp`` fits Mitsuba's grid; otherwise it would render more."""
    # Light paths land in pixels at random, so there is nothing to
    # stratify.
    if integrator == "ptracer" or (integrator == "volpath" and spp < FEWEST_STRATIFIED):
        return "independent"
    rows = int(np.sqrt(spp))
    return "multijitter" if spp > 0 and rows * -(-spp // rows) == spp else "independent"


# Planning
# --------------------------------------------------------------------------------------------------


def plan_passes(
    scene: Scene, spp: int | None, bounces: Bounces, first_reasons: tuple[str, ...] = ()
) -> Plan:
    """The cheapest rendering with all effects that ``scene`` needs, for a number of bounces.

    Args:
        spp: samples a pixel; by default the scene's number.
        bounces: replacement of the scene's number.
        first_reasons: reasons to list before the plan's.

    Raises:
        ValueError: spp below 1.
        SceneError: the scene pins, forbids or caps an effect that it cannot.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> plan_passes(load_scene("spheres"), 16, 1).integrator
        'direct'
    """
    if spp is not None and spp < 1:
        raise ValueError(f"spp: got {spp}, expected at least 1")
    for message, _ in transport.contradictions(scene.spec):
        raise SceneError(message, scene.path)
    spp = scene.spec.appearance.spp if spp is None else spp
    reasons = list(first_reasons)
    needed = transport.called_for(scene.spec)
    lights = scene.spec.lights
    everything = tuple(range(len(lights)))
    lamps = any(item.emission for item in scene.spec.objects)
    media = "medium" in needed or "subsurface" in needed
    lens = scene.spec.cameras.lens
    optic = Lens(lens.aperture, lens.focus) if lens else None
    if optic:
        reasons.append("cameras.lens has an aperture: a thin lens instead of a pinhole")
    depth = -1 if bounces == "unlimited" else bounces + 1
    # Roulette would end paths at random: unbiased, but too noisy for short paths.
    roulette = ROULETTE if depth < 0 else depth + 1
    if depth != 2 and not media and convex(scene):
        depth = 2
        reasons.append("a single convex surface never lights itself: one bounce is all there is")

    def finish(*passes: Pass) -> Plan:
        return Plan(passes, tuple(reasons), media, optic)

    if media:
        reasons.append(
            "light passes through a medium"
            f" ({needed.get('medium') or needed['subsurface']}): volpath"
        )
        # Scattered light takes many short steps, of which roulette saves more than its noise costs.
        return finish(Pass(everything, "volpath", depth, 1, 1, spp, lamps, ROULETTE))
    if not {"specular", "glossy", "refraction"} & set(needed):
        reasons.append(
            "every material is diffuse and opaque: no path passes through glass or a medium, and"
            " none is specular"
        )
    if depth != 2:
        reasons.append(
            f"{bounces} bounces: paths "
            + ("until roulette ends them" if depth < 0 else f"of up to {depth} edges")
        )
        small = small_lights(scene) if "caustics" in needed and optic is None else None
        if small is None:
            only = Pass(everything, "path", depth, 1, 1, spp, lamps, roulette)
            others = lamps or any(not isinstance(light, SkySpec) for light in lights)
            sky = any(isinstance(light, SkySpec) for light in lights)
            if sky and others and not {"specular", "refraction"} & set(needed):
                only = replace(only, aims_at_sky=False)
                reasons.append(
                    "the sky is smooth: rays spread by the materials find it with less noise than"
                    " rays toward it, which are left to the other lights"
                )
            return finish(only)
        reasons.append(
            f"light of {small} is bent by {needed['caustics'].split(',')[0]}: paths from the light"
            " find its caustic"
        )
        reasons.append(
            "camera paths still make what is seen in mirrors and through glass, lamps, and the"
            " sky's light"
        )
        skies = tuple(k for k in everything if isinstance(lights[k], SkySpec))
        points = tuple(k for k in everything if beam(scene, k) is not None)
        rest = tuple(k for k in everything if k not in skies and k not in points)
        passes = []
        if rest or lamps:
            passes += [
                Pass(rest, "path", depth, 1, 1, spp, lamps, roulette, "smooth"),
                Pass(rest, "ptracer", depth, 1, 1, LIGHT_PATHS * spp, lamps, roulette),
            ]
        for k in points:
            # Outside the beam no light first meets a smooth surface, so camera paths find all of
            # it; inside, paths from the light do. Light adds up: all - beam (both by camera
            # paths) + beam (by light paths).
            passes += [
                Pass((k,), "path", depth, 1, 1, spp, False, roulette),
                Pass((k,), "path", depth, 1, 1, spp, False, roulette, "rough", True, -1),
                Pass((k,), "ptracer", depth, 1, 1, LIGHT_PATHS * spp, False, roulette, "any", True),
            ]
        if points:
            reasons.append(
                "of a point light only the beam upon the smooth objects is followed from the light"
            )
        if skies:
            passes.append(Pass(skies, "path", depth, 1, 1, spp, False, roulette))
        return finish(*passes)

    reasons.append("one bounce: light sampled at each visible point is the whole sum")
    glossy = "glossy" in needed
    passes = []
    # One direction or one point is one sample: a separate pass has only the noise of the pixel's
    # area.
    exact = [k for k in everything if not isinstance(lights[k], SkySpec)]
    suns = [k for k in exact if lights[k].type == "sun"]
    for group in ([tuple(suns)] if suns else []) + [(k,) for k in exact if k not in suns]:
        passes.append(Pass(group, "direct", 2, 1, 0, spp))
        what = (
            "the sun comes from one direction"
            if group == tuple(suns)
            else f"the {lights[group[0]].type} has no size"
        )
        reasons.append(f"{what}, so its own pass has no noise but that of the pixel's area")
    skies = tuple(k for k in everything if k not in exact)
    if skies:
        passes.append(Pass(skies, "direct", 2, int(glossy), 1, spp))
        reasons.append(
            "the sky is smooth, so rays spread by the material leave only the noise of what"
            " covers it"
        )
    if lamps:
        passes.append(Pass((), "direct", 2, 1, 1, spp, True))
        reasons.append(
            "lamps have a size: rays toward them and along the material, weighted against each"
            " other"
        )
    return finish(*passes)


def convex(scene: Scene) -> bool:
    """Return True if a scene is one convex surface other than glass: it never lights itself."""
    alone = len(scene.spec.objects) == 1 and not isinstance(
        scene.spec.objects[0].material, materials.GlassMaterial
    )
    shapes = scene.shapes() if alone else []
    return len(shapes) == 1 and isinstance(shapes[0], Box | Rectangle | Sphere)


def small_lights(scene: Scene) -> str | None:
    """Names of lights too small to be hit by chance through glass or a mirror; None if none."""
    names: list[str] = [light.type for light in scene.spec.lights if light.type != "sky"]
    names += [f"object {scene.spec.objects[k].name!r}" for k in small_lamps(scene)]
    return ", ".join(names) or None


def small_lamps(scene: Scene) -> list[int]:
    """Indices of lamps too small to be hit by chance through smooth glass or a mirror."""
    small: list[int] = []
    lamps = [k for k, item in enumerate(scene.spec.objects) if item.emission]
    if lamps:
        bent = smooth_objects(scene)
        boxes: dict[int, list[Array]] = {}
        for shape in scene.shapes():
            if shape.object_id in bent or shape.object_id in lamps:
                boxes.setdefault(shape.object_id, []).append(shape.bounds())
        middle = {k: np.mean([b.mean(0) for b in corners], axis=0) for k, corners in boxes.items()}
        for k in lamps:
            low, high = (
                np.min([b[0] for b in boxes[k]], axis=0),
                np.max([b[1] for b in boxes[k]], axis=0),
            )
            away = min(float(np.linalg.norm(middle[k] - middle[j])) for j in bent) if bent else 0.0
            if float(np.linalg.norm(high - low)) / 2 < SMALL * away:
                small.append(k)
    return small


BEAM_MARGIN = 1.05
"""Factor by which a beam exceeds the smooth objects' sphere: spots fade at their rim."""


def beam(scene: Scene, light: int) -> tuple[Array, float] | None:
    """Cone from a point light around all smooth objects: its axis (not unit) and half angle
    in degrees.

    None for other lights, or if the cone would be wider than 60 degrees and save little.
    """
    spec = scene.spec.lights[light]
    smooth = smooth_objects(scene)
    if spec.type != "point" or not smooth:
        return None
    bounds = [shape.bounds() for shape in scene.shapes() if shape.object_id in smooth]
    low, high = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
    axis = (low + high) / 2 - np.array(spec.position)
    radius = BEAM_MARGIN * float(np.linalg.norm(high - low)) / 2
    distance = float(np.linalg.norm(axis))
    if radius >= distance or np.degrees(np.arcsin(radius / distance)) > 60:
        return None
    return axis, float(np.degrees(np.arcsin(radius / distance)))


def smooth_objects(scene: Scene) -> list[int]:
    """Indices of objects that bend light sharply: mirrors, polished metal, clear glass."""
    kinds = materials.MirrorMaterial | materials.MetalMaterial | materials.GlassMaterial
    return [
        k
        for k, item in enumerate(scene.spec.objects)
        if not item.emission
        and isinstance(item.material, kinds)
        and not getattr(item.material, "roughness", 0.0)
    ]
