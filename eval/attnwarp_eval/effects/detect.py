"""Light transport that a scene needs.

:func:`detect` compares the file with the graph handed to Mitsuba (plugin names) and with Mitsuba's
scene (BSDF flags, emitter flags, media, textures by class name). An effect present in one that
another lacks is an error. :mod:`attnwarp_eval.effects.proof` compares a plan with a rendering with
everything on. docs/truth/truth.md has the reasons.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from attnwarp_eval.effects.saving import Cost
from attnwarp_eval.scene import transport
from attnwarp_eval.scene.materials import EFFECTS, NOT_SIMULATED, Effect
from attnwarp_eval.scene.scene import Scene, SceneError
from attnwarp_eval.truth.mitsuba import graph
from attnwarp_eval.truth.passes import convex, sampler, small_lights
from attnwarp_eval.truth.plan import bounces_of, everything_on, plan


@dataclass(frozen=True)
class Finding:
    """Need of a scene for an effect.

    Attributes:
        needed: whether the scene needs the effect.
        simulated: whether pictures show the effect.
        source: "detected", "pinned", "said" (excluded by the scene's cap on bounces) or
            "absent".
        evidence: signs in the file, in Mitsuba's graph and in the loaded scene.
    """

    needed: bool
    simulated: bool
    source: Literal["detected", "pinned", "said", "absent"]
    evidence: tuple[str, ...]


def detect(scene: Scene) -> dict[Effect, Finding]:
    """Classify every effect, with the evidence from the file, the parsed graph and the loaded
    scene.

    Raises:
        SceneError: the sources disagree, so a plan from the file would be wrong.
    """
    spec_effects = transport.called_for(scene.spec)
    plugins, objects = graph(scene)
    by_graph = _in_graphs(plugins, objects)
    # The scene's file does not name vertex colours of a mesh.
    tinted = any(getattr(shape, "tint", None) is not None for shape in scene.shapes())
    for effect, evidence in by_graph.items():
        if effect not in spec_effects and not (effect == "textures" and tinted):
            raise SceneError(
                f"Mitsuba's scene shows {effect} ({'; '.join(evidence)}) that the file does not; a"
                " plan would be wrong",
                scene.path,
            )
    bounces = scene.spec.appearance.bounces
    out: dict[Effect, Finding] = {}
    for effect in EFFECTS:
        if effect == "interreflection" and bounces is None and bounces_of(scene) == 1:
            out[effect] = Finding(False, False, "absent", (_ABSENT[effect],))
        elif effect in spec_effects:
            evidence = (spec_effects[effect], *by_graph.get(effect, ()))
            pinned = effect in scene.spec.effects.pin
            caustic = effect == "caustics" and not _caustic_simulated(scene)
            out[effect] = Finding(
                True,
                effect not in NOT_SIMULATED and not caustic,
                "pinned" if pinned else "detected",
                evidence
                + (
                    ("a lens or a medium is in the way of paths from the light",) if caustic else ()
                ),
            )
        elif effect == "interreflection" and bounces == 1 and not convex(scene):
            out[effect] = Finding(
                False,
                False,
                "said",
                ("appearance.bounces is 1: the scene's truth is direct light",),
            )
        else:
            out[effect] = Finding(False, False, "absent", (_ABSENT[effect],))
    if out["caustics"].needed and out["caustics"].simulated and small_lights(scene) is not None:
        blind = (
            "caustics of small lights are shown on what is seen directly, not in mirrors nor"
            " through glass"
        )
        out["caustics"] = replace(out["caustics"], evidence=(*out["caustics"].evidence, blind))
    return out


def _caustic_simulated(scene: Scene) -> bool:
    """Return True if the plan renders the caustic. Camera paths miss it for small lights, and
    ptracer supports neither media nor the lens.
    """
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


def _in_graphs(
    plugins: list[tuple[str, str]], objects: list[tuple[str, Any]]
) -> dict[Effect, tuple[str, ...]]:
    """Effects in Mitsuba's graphs, with the evidence.

    Args:
        plugins: (path, plugin name) of the graph as parsed.
        objects: (path, object) of the scene as loaded.
    """
    import mitsuba

    evidence_of: dict[Effect, list[str]] = {}

    def note(effect: Effect, evidence: str) -> None:
        evidence_of.setdefault(effect, []).append(evidence)

    by_plugin: dict[str, Effect] = {
        "envmap": "environment",
        "constant": "environment",
        "sunsky": "environment",
        "conductor": "specular",
        "dielectric": "refraction",
        "thindielectric": "refraction",
        "roughdielectric": "refraction",
        "roughconductor": "glossy",
        "roughplastic": "glossy",
        "thinlens": "depth_of_field",
        "polarizer": "polarisation",
        "retarder": "polarisation",
        "pplastic": "polarisation",
        "measured_polarized": "polarisation",
    }
    for path, name in plugins:
        if name in by_plugin:
            note(by_plugin[name], f"plugin {name} at {path}")
        elif name in ("homogeneous", "heterogeneous"):
            note(
                "subsurface"
                if path.endswith("interior") and not path.startswith("medium")
                else "medium",
                f"plugin {name} at {path}",
            )
    F = mitsuba.BSDFFlags
    for path, thing in objects:
        if isinstance(thing, mitsuba.BSDF):
            if thing.class_name() == "Null":
                continue  # the boundary of the fog
            flags = int(thing.flags())
            if flags & int(F.Delta):
                note("specular", f"BSDF flag Delta of {thing.class_name()} at {path}")
            if flags & int(F.Glossy):
                note("glossy", f"BSDF flag Glossy of {thing.class_name()} at {path}")
            if flags & (
                int(F.DeltaTransmission) | int(F.GlossyTransmission) | int(F.DiffuseTransmission)
            ):
                note("refraction", f"BSDF flag Transmission of {thing.class_name()} at {path}")
        elif isinstance(thing, mitsuba.Emitter):
            note("direct", f"emitter {thing.class_name()} at {path}")
            note("shadows", f"emitter {thing.class_name()} at {path}")
            if thing.is_environment():
                note("environment", f"emitter {thing.class_name()} at {path}")
        elif (
            isinstance(thing, mitsuba.Texture)
            and thing.class_name().startswith("Bitmap")
            and _varies(thing)
        ):
            # Skip a mesh's attributes: the file and its tint show whether they vary.
            note("textures", f"texture {thing.class_name()} at {path} varies")
    return {
        effect: tuple(dict.fromkeys(evidence[:1] + evidence[-1:]))
        for effect, evidence in evidence_of.items()
    }


def _varies(texture: Any) -> bool:
    import mitsuba

    data = np.array(mitsuba.traverse(texture)["data"])
    # Reduce contiguous rows first: 10 times as fast as over all texels of a channel.
    low, high = data.min(axis=0).min(axis=0), data.max(axis=0).max(axis=0)
    return bool((high - low).max() > 1e-6)


# Words
# --------------------------------------------------------------------------------------------------


def report(scene: Scene, *, cost: Cost | None = None) -> dict[str, Any]:
    """Effects of a scene as JSON, with the plans and, if given, their cost."""
    out: dict[str, Any] = {
        "scene": scene.name,
        "content": scene.content_hash,
        "effects": {name: asdict(finding) for name, finding in detect(scene).items()},
        "plan": plan(scene).to_dict(),
        "geometry": plan(scene, want="geometry").to_dict(),
        "everything_on": everything_on(scene, capped=False).to_dict(),
    }
    if cost is not None:
        out["cost"] = cost.to_dict()
    return out


def describe(scene: Scene, about: dict[str, Any]) -> Iterator[str]:
    """Text lines of :func:`report`."""
    yield f"{scene.name}: {scene.title}"
    yield ""
    for name, finding in about["effects"].items():
        if finding["needed"]:
            word = (
                {"pinned": "pinned"}.get(finding["source"], "needed")
                if finding["simulated"]
                else "NOT SIMULATED"
            )
        else:
            word = "left out" if finding["source"] == "said" else "no"
        yield f"  {name:16} {word:14} {'; '.join(finding['evidence'])}"
    for title, key in (("plan", "plan"), ("everything on", "everything_on")):
        yield ""
        made = about[key]
        yield (
            f"{title}: {made['integrator']}, sensor {made['sensor']['type']}, filter"
            f" {made['filter']}"
        )
        for step in made["passes"]:
            yield f"  {_words(scene, step)}"
        for reason in made["reasons"] if key == "plan" else ():
            yield f"  because {reason}"
    yield ""
    yield f"geometry: {about['geometry']['reasons'][0]}"
    if "cost" in about:
        cost = about["cost"]
        equal = cost["at_equal_noise"]
        yield (
            f"cost of a {cost['size']} x {cost['size']} picture, {cost['spp']} samples: plan"
            f" {cost['seconds'][0]:.3f} s, everything on {cost['seconds'][1]:.3f} s"
            f" ({cost['faster']:.1f} times); for the same noise "
            + (
                "the plan needs one sample, since it has none"
                if equal is None
                else f"{equal:.1f} times{_span(cost['interval'])}"
            )
        )
        if cost["again"] is not None:
            low, high = cost["again"]
            yield f"  the plan's time against itself: {low:.2f} to {high:.2f}"
        if cap := cost["cap"]:
            if cap["bias"] is not None:
                low, high = cap["bias_interval"]
                yield (
                    f"  not for the same error: the scene's cap of {cap['bounces']} bounces changes"
                    f" the picture's light by {cap['bias']:+.1%} ({low:+.1%} to {high:+.1%})"
                    " against light without a cap"
                )
            equal = cap["at_equal_error"]
            yield (
                f"  everything on within the cap {cap['seconds']:.3f} s ({cap['faster']:.1f} times)"
                + (
                    ""
                    if equal is None
                    else f"; for the same error {equal:.1f} times{_span(cap['interval'])}"
                )
            )


def _span(interval: tuple[float, float] | None) -> str:
    return f" ({interval[0]:.1f} to {interval[1]:.1f})" if interval else ""


def _words(scene: Scene, step: dict[str, Any]) -> str:
    shining = [scene.spec.lights[k].type for k in step["lights"]] + (
        ["lamps"] if step["lamps"] else []
    )
    depth = "no end" if step["max_depth"] < 0 else f"{step['max_depth']} edges"
    roulette = (
        "" if 0 <= step["max_depth"] < step["rr_depth"] else f", roulette from {step['rr_depth']}"
    )
    only = {"any": "", "smooth": "; where glass, mirror, lamp or nothing is seen first",
            "rough": "; where something else is seen first"}[step["first"]]  # fmt: skip
    only += "; only the beam upon what is smooth" if step["beam"] else ""
    only += "; taken away" if step["sign"] < 0 else ""
    only += "" if step["aims_at_sky"] else "; no rays toward the sky but those of the materials"
    kind = "light paths" if step["integrator"] == "ptracer" else "samples"
    drawn = sampler(step["integrator"], step["spp"])
    return (
        f"{step['integrator']}: {step['spp']} {kind} a pixel ({drawn}), "
        f"light from {', '.join(shining)}, {depth}{roulette}{only}"
    )
