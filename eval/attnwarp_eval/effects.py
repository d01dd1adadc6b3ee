"""Which light transport a scene needs, and the cheapest rendering that is faithful to it.

:func:`plan` follows from what the scene file says, without loading anything. :func:`detect` looks at the file, at the
graph handed to Mitsuba (plugin names) and at what Mitsuba made of it (BSDF flags, emitter flags, media, textures by
class name), and refuses to go on where they disagree. :mod:`attnwarp_eval.proof` holds a plan against a rendering with
everything on. docs/effects.md has the reasons.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from attnwarp_eval import optics
from attnwarp_eval.optics import EFFECTS, NOT_SIMULATED, Effect
from attnwarp_eval.shapes import Box, Rectangle, Sphere

if TYPE_CHECKING:
    from attnwarp_eval.scene import Scene

Array = npt.NDArray[np.float64]
Integrator = Literal["direct", "path", "volpath", "ptracer"]

SMALL = 0.15
"""A lamp counts as small when its radius is below this share of its distance from the glass. Paths from the camera find
it by chance, about once in 4 / SMALL^2 = 180 tries, and the caustic comes out as single bright pixels."""

ROULETTE = 5
"""Paths without a cap are ended at random from this many edges on; Mitsuba's own default."""

LIGHT_PATHS = 4
"""Light paths for each camera sample: from the light, most paths end where no camera looks."""

DROPPABLE: tuple[Effect, ...] = (
    "interreflection", "specular", "refraction", "medium", "subsurface", "caustics", "environment", "depth_of_field",
)  # fmt: skip
"""Effects that a plan can leave out. The others come free with any picture: what shades a point has its texture."""


@dataclass(frozen=True)
class Pass:
    """One rendering; the picture is the sum of the passes, since light adds up.

    Attributes:
        integrator: Mitsuba's plugin.
        lights: indices of the scene's lights that shine in it.
        lamps: whether the objects with an ``emission`` shine in it.
        max_depth: longest path in edges from the camera; 2 is direct light, -1 has no end.
        rr_depth: edges after which paths are ended at random; above ``max_depth`` never.
        emitter_samples, bsdf_samples: rays toward lights and along the material's lobe at each hit ("direct" only).
        spp: samples a pixel; for "ptracer" light paths a pixel.
        first: which camera rays count. "any"; "smooth", those whose first surface is smooth glass, metal or a mirror, a
            lamp, or none at all; or "rough", the others, which are also those that a ptracer pass makes.
        beam: light only what lies in the direction of the smooth objects (a point light becomes a spot upon them).
        sign: -1 for a pass that is taken away.
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


@dataclass(frozen=True)
class Lens:
    """A thin lens: radius and focus distance in scene units; ``focus`` None means what the cameras look at."""

    aperture: float
    focus: float | None


@dataclass(frozen=True)
class Plan:
    """How a picture is made, and why that suffices.

    Attributes:
        passes: the renderings that are added up; none where ray casting alone gives what is wanted.
        media: whether fog and interiors are there.
        lens: None for a pinhole.
        reasons: for a person.
    """

    passes: tuple[Pass, ...]
    reasons: tuple[str, ...]
    media: bool = False
    lens: Lens | None = None

    @property
    def integrator(self) -> str:
        """The integrators in use, such as "direct" or "path + ptracer"; "raycast" where nothing is rendered."""
        return " + ".join(dict.fromkeys(step.integrator for step in self.passes)) or "raycast"

    @property
    def sensor(self) -> str:
        """Mitsuba's camera plugin."""
        return "thinlens" if self.lens else "perspective"

    def identity(self) -> dict[str, Any]:
        """What decides the picture, without the reasons; goes into cache keys."""
        return asdict(replace(self, reasons=()))

    def to_dict(self) -> dict[str, Any]:
        """As JSON, for ``scenes effects --json``."""
        return {
            "integrator": self.integrator,
            "sensor": {"type": self.sensor} | (asdict(self.lens) if self.lens else {}),
            "sampler": sorted({sampler(step.spp) for step in self.passes}),
            "filter": "box",
            "media": self.media,
            "passes": [asdict(step) for step in self.passes],
            "reasons": list(self.reasons),
        }


def sampler(spp: int) -> str:
    """Stratified samples where ``spp`` splits into a grid as Mitsuba wants it; elsewhere it would render more."""
    rows = int(np.sqrt(spp))
    return "multijitter" if spp > 0 and rows * -(-spp // rows) == spp else "independent"


# Planning ------------------------------------------------------------------------------------------------------------


def plan(scene: Scene, spp: int | None = None, *, want: Literal["appearance", "geometry"] = "appearance") -> Plan:
    """The cheapest rendering that shows what ``scene`` calls for.

    Args:
        spp: samples a pixel; the scene's own number if left out.
        want: "geometry" (depth, normals, ids, visibility) needs no rendering, only rays.

    Raises:
        ValueError: spp below 1.
        SceneError: the scene pins, forbids or caps what it cannot.
    """
    from attnwarp_eval.scene import SceneError, SkySpec

    if want == "geometry":
        return Plan((), ("depth, normals, ids and visibility are cast with rays (Open3D, float64), without light",))
    wanted = scene.spec.appearance
    if spp is not None and spp < 1:
        raise ValueError(f"spp: got {spp}, expected at least 1")
    spp = wanted.spp if spp is None else spp
    for message, _ in optics.contradictions(scene.spec):
        raise SceneError(message, scene.path)

    found = optics.called_for(scene.spec)
    lights = scene.spec.lights
    everything = tuple(range(len(lights)))
    lamps = any(item.emission for item in scene.spec.objects)
    media = "medium" in found or "subsurface" in found
    lens = scene.spec.cameras.lens
    reasons: list[str] = []
    optic = Lens(lens.aperture, lens.focus) if lens else None
    if optic:
        reasons.append("cameras.lens has an aperture: a thin lens instead of a pinhole")
    depth = -1 if wanted.bounces == "unlimited" else wanted.bounces + 1
    # Roulette would end paths at random: unbiased, but noise that a short path is not worth.
    roulette = ROULETTE if depth < 0 else depth + 1
    if depth != 2 and not media and _convex(scene):
        depth = 2
        reasons.append("a single convex surface never lights itself: one bounce is all there is")

    def finish(*passes: Pass) -> Plan:
        return Plan(passes, tuple(reasons), media, optic)

    if media:
        reasons.append(f"light passes through a medium ({found.get('medium') or found['subsurface']}): volpath")
        return finish(Pass(everything, "volpath", depth, 1, 1, spp, lamps, roulette))
    if not {"specular", "glossy", "refraction"} & set(found):
        reasons.append(
            "every material is diffuse and opaque: no path passes through glass or a medium, and none is specular"
        )
    if depth != 2:
        reasons.append(
            f"the scene asks for {wanted.bounces} bounces: paths "
            + ("until roulette ends them" if depth < 0 else f"of up to {depth} edges")
        )
        small = small_lights(scene) if "caustics" in found and optic is None else None
        if small is None:
            return finish(Pass(everything, "path", depth, 1, 1, spp, lamps, roulette))
        reasons.append(
            f"light of {small} is bent by {found['caustics'].split(',')[0]}: paths from the light find its caustic"
        )
        reasons.append("camera paths still make what is seen in mirrors and through glass, lamps, and the sky's light")
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
            # Outside the beam no light meets anything smooth first, so that camera paths find all of it; inside, paths
            # from the light do. Light adds up: all - beam (both by camera paths) + beam (by light paths).
            passes += [
                Pass((k,), "path", depth, 1, 1, spp, False, roulette),
                Pass((k,), "path", depth, 1, 1, spp, False, roulette, "rough", True, -1),
                Pass((k,), "ptracer", depth, 1, 1, LIGHT_PATHS * spp, False, roulette, "any", True),
            ]
        if points:
            reasons.append("of a point light only the beam upon the smooth objects is followed from the light")
        if skies:
            passes.append(Pass(skies, "path", depth, 1, 1, spp, False, roulette))
        return finish(*passes)

    reasons.append("the scene asks for one bounce: light sampled at each visible point is the whole sum")
    glossy = "glossy" in found
    passes = []
    # One direction or one point is one sample: its own pass has no noise but that of the pixel's area.
    exact = [k for k in everything if not isinstance(lights[k], SkySpec)]
    suns = [k for k in exact if lights[k].type == "sun"]
    for group in ([tuple(suns)] if suns else []) + [(k,) for k in exact if k not in suns]:
        passes.append(Pass(group, "direct", 2, 1, 0, spp))
        what = (
            "the sun comes from one direction" if group == tuple(suns) else f"the {lights[group[0]].type} has no size"
        )
        reasons.append(f"{what}, so its own pass has no noise but that of the pixel's area")
    skies = tuple(k for k in everything if k not in exact)
    if skies:
        passes.append(Pass(skies, "direct", 2, int(glossy), 1, spp))
        reasons.append("the sky is smooth, so rays spread by the material leave only the noise of what covers it")
    if lamps:
        passes.append(Pass((), "direct", 2, 1, 1, spp, True))
        reasons.append("lamps have a size: rays toward them and along the material, weighted against each other")
    return finish(*passes)


def everything_on(scene: Scene, spp: int | None = None, *, capped: bool = True) -> Plan:
    """What a renderer does that knows nothing of the scene: volpath for all lights at once, a lens where one is said.

    Where a caustic is called for ptracer is added: volpath alone would miss it, so "full" would not be the truth.
    Never volpathmis, which is biased under roulette.

    Args:
        spp: samples a pixel; the scene's own number if left out.
        capped: keep the scene's own cap on bounces, which is part of what its truth means. Without it light is followed
            until roulette ends it: what the cap saves.
    """
    ours = plan(scene, spp)
    spp = spp or scene.spec.appearance.spp
    bounces = scene.spec.appearance.bounces
    depth = -1 if bounces == "unlimited" or not capped else bounces + 1
    everything = tuple(range(len(scene.spec.lights)))
    lamps = any(item.emission for item in scene.spec.objects)
    if any(step.integrator == "ptracer" for step in ours.passes):
        passes = tuple(
            replace(
                step,
                integrator="ptracer" if step.integrator == "ptracer" else "volpath",
                rr_depth=ROULETTE,
                max_depth=depth,
            )
            for step in ours.passes
        )
    else:
        passes = (Pass(everything, "volpath", depth, 1, 1, spp, lamps),)
    return replace(ours, passes=passes, reasons=("everything on",), media=True)


def without(scene: Scene, ours: Plan, effect: Effect) -> Plan:
    """``ours`` with one effect left out: what a careless planner would do, for negative controls.

    Raises:
        ValueError: an effect that no plan can leave out, or that is not in this one.
    """
    from attnwarp_eval.scene import SkySpec

    if effect not in DROPPABLE:
        raise ValueError(f"effect: got {effect!r}, expected one that a plan can leave out: {', '.join(DROPPABLE)}")
    passes = ours.passes
    match effect:
        case "interreflection" | "specular" | "refraction":
            passes = tuple(replace(step, max_depth=2) for step in passes)
        case "medium" | "subsurface":
            passes = tuple(replace(s, integrator="path" if s.integrator == "volpath" else s.integrator) for s in passes)
            return replace(ours, passes=passes, media=False)
        case "caustics":
            kept = (step for step in passes if step.integrator != "ptracer" and step.sign > 0)
            passes = tuple(replace(step, first="any") for step in kept)
        case "environment":
            skies = [k for k, light in enumerate(scene.spec.lights) if isinstance(light, SkySpec)]
            passes = tuple(replace(step, lights=tuple(k for k in step.lights if k not in skies)) for step in passes)
            passes = tuple(step for step in passes if step.lights or step.lamps)
        case "depth_of_field":
            return replace(ours, lens=None)
    if passes == ours.passes:
        raise ValueError(f"effect: {effect!r} is not in this plan ({ours.integrator}), so it cannot be left out of it")
    return replace(ours, passes=passes)


def _convex(scene: Scene) -> bool:
    shapes = scene.shapes() if len(scene.spec.objects) == 1 else []
    return len(shapes) == 1 and isinstance(shapes[0], Box | Rectangle | Sphere)


def small_lights(scene: Scene) -> str | None:
    """Names the lights too small to be met by chance through smooth glass or a mirror; None where there are none."""
    names: list[str] = [light.type for light in scene.spec.lights if light.type != "sky"]
    lamps = [k for k, item in enumerate(scene.spec.objects) if item.emission]
    if lamps:
        bent = smooth_objects(scene)
        boxes: dict[int, list[Array]] = {}
        for shape in scene.shapes():
            if shape.object_id in bent or shape.object_id in lamps:
                boxes.setdefault(shape.object_id, []).append(shape.bounds())
        middle = {k: np.mean([b.mean(0) for b in found], axis=0) for k, found in boxes.items()}
        for k in lamps:
            low, high = np.min([b[0] for b in boxes[k]], axis=0), np.max([b[1] for b in boxes[k]], axis=0)
            away = min(float(np.linalg.norm(middle[k] - middle[j])) for j in bent) if bent else 0.0
            if float(np.linalg.norm(high - low)) / 2 < SMALL * away:
                names.append(f"object {scene.spec.objects[k].name!r}")
    return ", ".join(names) or None


BEAM_MARGIN = 1.05
"""How much wider than the sphere about the smooth objects a beam upon them is; Mitsuba's spots fall off at their rim."""


def beam(scene: Scene, light: int) -> tuple[Array, float] | None:
    """The cone in which a point light sees all smooth objects: its axis (not unit) and half angle in degrees.

    None for other lights, or where the cone would be wider than 60 degrees: then it saves little.
    """
    said = scene.spec.lights[light]
    smooth = smooth_objects(scene)
    if said.type != "point" or not smooth:
        return None
    bounds = [shape.bounds() for shape in scene.shapes() if shape.object_id in smooth]
    low, high = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
    axis = (low + high) / 2 - np.array(said.position)
    reach = BEAM_MARGIN * float(np.linalg.norm(high - low)) / 2 / float(np.linalg.norm(axis))
    if reach >= 1 or np.degrees(np.arcsin(reach)) > 60:
        return None
    return axis, float(np.degrees(np.arcsin(reach)))


def smooth_objects(scene: Scene) -> list[int]:
    """Indices of the objects that reflect or refract without scattering: mirrors, polished metal, clear glass."""
    kinds = optics.MirrorMaterial | optics.MetalMaterial | optics.GlassMaterial
    return [
        k
        for k, item in enumerate(scene.spec.objects)
        if not item.emission and isinstance(item.material, kinds) and not getattr(item.material, "roughness", 0.0)
    ]


# Detection -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Finding:
    """Whether a scene calls for an effect.

    Attributes:
        needed: whether the scene calls for it.
        simulated: whether pictures show it.
        source: "detected", "pinned", "said" (the scene's own cap on bounces leaves it out) or "absent".
        evidence: what in the file, in Mitsuba's graph and in the loaded scene says so.
    """

    needed: bool
    simulated: bool
    source: Literal["detected", "pinned", "said", "absent"]
    evidence: tuple[str, ...]


def detect(scene: Scene) -> dict[Effect, Finding]:
    """Every effect, needed or not, with the evidence from the file, the parsed graph and the loaded scene.

    Raises:
        SceneError: they disagree, so that a plan made from the file would be wrong.
    """
    from attnwarp_eval.scene import SceneError
    from attnwarp_eval.truth.mitsuba import graph

    said = optics.called_for(scene.spec)
    plugins, objects = graph(scene)
    seen = _in_graphs(plugins, objects)
    for effect, evidence in seen.items():
        if effect not in said and not (effect == "textures" and not _checked_textures(scene)):
            raise SceneError(
                f"Mitsuba's scene shows {effect} ({'; '.join(evidence)}) that the file does not; a plan would be wrong",
                scene.path,
            )
    bounces = scene.spec.appearance.bounces
    out: dict[Effect, Finding] = {}
    for effect in EFFECTS:
        if effect in said:
            evidence = (said[effect], *seen.get(effect, ()))
            pinned = effect in scene.spec.effects.pin
            caustic = effect == "caustics" and not _caustic_simulated(scene)
            out[effect] = Finding(
                True, effect not in NOT_SIMULATED and not caustic, "pinned" if pinned else "detected",
                evidence + (("a lens or a medium is in the way of paths from the light",) if caustic else ()),
            )  # fmt: skip
        elif effect == "interreflection" and bounces == 1 and not _convex(scene):
            out[effect] = Finding(False, False, "said", ("appearance.bounces is 1: the scene's truth is direct light",))
        else:
            out[effect] = Finding(False, False, "absent", (_ABSENT[effect],))
    if out["caustics"].needed and out["caustics"].simulated and small_lights(scene) is not None:
        blind = "caustics of small lights are shown on what is seen directly, not in mirrors nor through glass"
        out["caustics"] = replace(out["caustics"], evidence=(*out["caustics"].evidence, blind))
    return out


def _caustic_simulated(scene: Scene) -> bool:
    """Camera paths find the caustic of anything but a small light; ptracer knows neither media nor our lens."""
    if small_lights(scene) is None:
        return True
    return any(step.integrator == "ptracer" for step in plan(scene).passes)


_ABSENT: dict[Effect, str] = {
    "geometry": "no objects",
    "direct": "no light shines",
    "shadows": "no light shines",
    "interreflection": "no path meets a second surface",
    "glossy": "no rough metal, glass or plastic; no BSDF with a glossy lobe",
    "specular": "no mirror, polished metal or clear glass; no BSDF with a delta lobe",
    "refraction": "no glass; no BSDF that transmits",
    "medium": "no medium in the file; no medium in the loaded scene",
    "subsurface": "no glass with an interior",
    "caustics": "no small light together with smooth glass or metal",
    "environment": "no sky; no infinite emitter but the sun",
    "depth_of_field": "no lens; a pinhole has no aperture",
    "textures": "every texture is plain and without variation",
    "motion": "no object has a velocity",
    "polarisation": "no light meets two specular surfaces",
    "dispersion": "no glass has an Abbe number",
}


def _checked_textures(scene: Scene) -> bool:
    """Meshes may bring vertex colours, of which the file says nothing."""
    return all(getattr(shape, "tint", None) is None for shape in scene.shapes())


def _in_graphs(plugins: list[tuple[str, str]], objects: list[tuple[str, Any]]) -> dict[Effect, tuple[str, ...]]:
    """Effects that Mitsuba's own graphs show.

    Args:
        plugins: (where, plugin name) of the graph as parsed.
        objects: (where, object) of the scene as loaded.
    """
    import mitsuba as mi

    found: dict[Effect, list[str]] = {}

    def note(effect: Effect, evidence: str) -> None:
        found.setdefault(effect, []).append(evidence)

    by_plugin: dict[str, Effect] = {
        "envmap": "environment", "constant": "environment", "sunsky": "environment", "conductor": "specular",
        "dielectric": "refraction", "thindielectric": "refraction", "roughdielectric": "refraction",
        "roughconductor": "glossy", "roughplastic": "glossy", "thinlens": "depth_of_field", "polarizer": "polarisation",
        "retarder": "polarisation", "pplastic": "polarisation", "measured_polarized": "polarisation",
    }  # fmt: skip
    for where, name in plugins:
        if name in by_plugin:
            note(by_plugin[name], f"plugin {name} at {where}")
        elif name in ("homogeneous", "heterogeneous"):
            note("subsurface" if where.endswith("interior") and not where.startswith("medium") else "medium",
                 f"plugin {name} at {where}")  # fmt: skip
    F = mi.BSDFFlags
    for where, thing in objects:
        if isinstance(thing, mi.BSDF):
            if thing.class_name() == "Null":
                continue  # the walls of the fog
            flags = int(thing.flags())
            if flags & int(F.Delta):
                note("specular", f"BSDF flag Delta of {thing.class_name()} at {where}")
            if flags & int(F.Glossy):
                note("glossy", f"BSDF flag Glossy of {thing.class_name()} at {where}")
            if flags & (int(F.DeltaTransmission) | int(F.GlossyTransmission) | int(F.DiffuseTransmission)):
                note("refraction", f"BSDF flag Transmission of {thing.class_name()} at {where}")
        elif isinstance(thing, mi.Emitter):
            note("direct", f"emitter {thing.class_name()} at {where}")
            note("shadows", f"emitter {thing.class_name()} at {where}")
            if thing.is_environment():
                note("environment", f"emitter {thing.class_name()} at {where}")
        elif isinstance(thing, mi.Texture) and thing.class_name().startswith("Bitmap") and _varies(thing):
            # A mesh's attribute is not looked at: whether its colours vary the file and the mesh's tint say.
            note("textures", f"texture {thing.class_name()} at {where} varies")
    return {effect: tuple(dict.fromkeys(evidence[:1] + evidence[-1:])) for effect, evidence in found.items()}


def _varies(texture: Any) -> bool:
    import mitsuba as mi

    data = np.array(mi.traverse(texture)["data"])
    return bool(np.ptp(data.reshape(-1, data.shape[-1]), axis=0).max() > 1e-6)


# Cost and words ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cost:
    """What everything on would cost, against the plan, measured on one small picture of the source.

    Attributes:
        size, spp: of the measurement.
        seconds: (plan, everything on) medians.
        variance: (plan, everything on), mean over pixels and channels, relative to the squared mean.
        rounds: pictures of each, taken in turn.
        interval: 95 % of :attr:`at_equal_error`, by resampling the rounds; None where the plan has no noise.
    """

    size: int
    spp: int
    rounds: int
    seconds: tuple[float, float]
    variance: tuple[float, float]
    interval: tuple[float, float] | None

    @property
    def faster(self) -> float:
        """How many times longer everything on takes for the same samples."""
        return self.seconds[1] / self.seconds[0]

    @property
    def at_equal_error(self) -> float:
        """How many times longer everything on takes for the same noise; infinite where the plan has none."""
        return self.faster * self.variance[1] / self.variance[0] if self.variance[0] > 0 else float("inf")


def measure(
    scene: Scene, *, size: int | None = None, spp: int | None = None, rounds: int = 7, seed: int = 7000
) -> Cost:
    """Render plan and everything on in turn and time both, after one unmeasured picture each.

    Args:
        size, spp: of the picture; if left out as large as needed for tracing, not starting, to take most of the time.
    """
    import time

    from attnwarp_eval.truth.llvm import LLVM, variant
    from attnwarp_eval.truth.mitsuba import render_plan

    size, spp = size or (96 if variant() == LLVM else 48), spp or (64 if variant() == LLVM else 16)
    small = scene.with_size(size, size)
    contestants = (plan(small, spp), everything_on(small, spp, capped=False))
    pictures: tuple[list[Any], list[Any]] = ([], [])
    seconds: tuple[list[float], list[float]] = ([], [])
    for turn in range(rounds + 1):
        for k in (0, 1) if turn % 2 else (1, 0):
            start = time.perf_counter()
            picture = render_plan(small, small.source, contestants[k], seed + turn)
            if turn:
                seconds[k].append(time.perf_counter() - start)
                pictures[k].append(picture)
    scale = float(np.mean(pictures[1])) ** 2
    taken = [np.array(p, np.float64).reshape(rounds, -1) for p in pictures]
    variance = [float(p.var(0, ddof=1).mean()) / scale for p in taken]
    medians = [float(np.median(s)) for s in seconds]
    interval = None
    if variance[0] > 0:
        # Two rounds are paired in time, since what else the machine does slows both.
        ratio = np.array(seconds[1]) / np.array(seconds[0])
        # Squared distances between rounds: the variance of a resample is the mean over its pairs of different rounds.
        apart = [np.array([[((x - y) ** 2).mean() / 2 for y in p] for x in p]) for p in taken]
        draws = np.random.default_rng(0).integers(0, rounds, (1000, rounds))
        spread = [np.array([_between(a, d) for d in draws]) for a in apart]
        known = (spread[0] > 0) & (spread[1] > 0)
        values = np.median(ratio[draws], axis=1)[known] * spread[1][known] / spread[0][known]
        low, high = np.percentile(values, [2.5, 97.5])
        interval = (float(low), float(high))
    return Cost(size, spp, rounds, (medians[0], medians[1]), (variance[0], variance[1]), interval)


def _between(apart: Array, drawn: npt.NDArray[np.int64]) -> float:
    """Mean of ``apart`` over the pairs of different rounds among those drawn."""
    different = drawn[:, None] != drawn[None]
    return float(apart[np.ix_(drawn, drawn)][different].mean()) if different.any() else 0.0


def report(scene: Scene, *, cost: Cost | None = None) -> dict[str, Any]:
    """Everything about a scene's effects as JSON: ``effects``, ``plan``, ``geometry``, ``everything_on``, ``cost``."""
    out: dict[str, Any] = {
        "scene": scene.name,
        "content": scene.content_hash,
        "effects": {name: asdict(finding) for name, finding in detect(scene).items()},
        "plan": plan(scene).to_dict(),
        "geometry": plan(scene, want="geometry").to_dict(),
        "everything_on": everything_on(scene, capped=False).to_dict(),
    }
    if cost is not None:
        out["cost"] = asdict(cost) | {"faster": cost.faster, "at_equal_error": _finite(cost.at_equal_error)}
    return out


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def describe(scene: Scene, about: dict[str, Any]) -> Iterator[str]:
    """The lines of :func:`report` for a person."""
    yield f"{scene.name}: {scene.title}"
    yield ""
    for name, finding in about["effects"].items():
        if finding["needed"]:
            word = {"pinned": "pinned"}.get(finding["source"], "needed") if finding["simulated"] else "NOT SIMULATED"
        else:
            word = "left out" if finding["source"] == "said" else "no"
        yield f"  {name:16} {word:14} {'; '.join(finding['evidence'])}"
    for title, key in (("plan", "plan"), ("everything on", "everything_on")):
        yield ""
        made = about[key]
        yield f"{title}: {made['integrator']}, sensor {made['sensor']['type']}, filter {made['filter']}"
        for step in made["passes"]:
            yield f"  {_words(scene, step)}"
        for reason in made["reasons"] if key == "plan" else ():
            yield f"  because {reason}"
    yield ""
    yield f"geometry: {about['geometry']['reasons'][0]}"
    if "cost" in about:
        cost = about["cost"]
        equal = cost["at_equal_error"]
        yield (
            f"cost of a {cost['size']} x {cost['size']} picture, {cost['spp']} samples: "
            f"plan {cost['seconds'][0]:.3f} s, everything on {cost['seconds'][1]:.3f} s ({cost['faster']:.1f} times); "
            f"for the same noise "
            + (
                "the plan needs one sample, since it has none"
                if equal is None
                else f"{equal:.1f} times ({cost['interval'][0]:.1f} to {cost['interval'][1]:.1f})"
            )
        )


def _words(scene: Scene, step: dict[str, Any]) -> str:
    shining = [scene.spec.lights[k].type for k in step["lights"]] + (["lamps"] if step["lamps"] else [])
    depth = "no end" if step["max_depth"] < 0 else f"{step['max_depth']} edges"
    roulette = "" if 0 <= step["max_depth"] < step["rr_depth"] else f", roulette from {step['rr_depth']}"
    only = {"any": "", "smooth": "; where glass, mirror, lamp or nothing is seen first",
            "rough": "; where something else is seen first"}[step["first"]]  # fmt: skip
    only += "; only the beam upon what is smooth" if step["beam"] else ""
    only += "; taken away" if step["sign"] < 0 else ""
    kind = "light paths" if step["integrator"] == "ptracer" else "samples"
    return (
        f"{step['integrator']}: {step['spp']} {kind} a pixel ({sampler(step['spp'])}), "
        f"light from {', '.join(shining)}, {depth}{roulette}{only}"
    )
