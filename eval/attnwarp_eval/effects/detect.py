"""Which light transport a scene needs, and what its plan costs against everything on.

:func:`detect` looks at the file, at the graph handed to Mitsuba (plugin names) and at what Mitsuba
made of it (BSDF flags, emitter flags, media, textures by class name), and refuses to go on where
they disagree. :mod:`attnwarp_eval.effects.proof` holds a plan against a rendering with everything
on. docs/effects.md has the reasons.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from attnwarp_eval.cost import AGAIN, in_turn
from attnwarp_eval.files import without_nan
from attnwarp_eval.scene import transport
from attnwarp_eval.scene.materials import EFFECTS, NOT_SIMULATED, Effect
from attnwarp_eval.scene.scene import Scene, SceneError
from attnwarp_eval.statistics.equivalence import welch_interval
from attnwarp_eval.statistics.intervals import time_ratio
from attnwarp_eval.truth.llvm import LLVM, variant
from attnwarp_eval.truth.mitsuba import graph, render_plan
from attnwarp_eval.truth.plan import Plan, convex, everything_on, plan, sampler, small_lights

Array = npt.NDArray[np.float64]

# Detection
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Finding:
    """Whether a scene calls for an effect.

    Attributes:
        needed: whether the scene calls for it.
        simulated: whether pictures show it.
        source: "detected", "pinned", "said" (the scene's own cap on bounces leaves it out) or
            "absent".
        evidence: what in the file, in Mitsuba's graph and in the loaded scene says so.
    """

    needed: bool
    simulated: bool
    source: Literal["detected", "pinned", "said", "absent"]
    evidence: tuple[str, ...]


def detect(scene: Scene) -> dict[Effect, Finding]:
    """Every effect, needed or not, with the evidence from the file, the parsed graph and the loaded
    scene.

    Raises:
        SceneError: they disagree, so that a plan made from the file would be wrong.
    """
    said = transport.called_for(scene.spec)
    plugins, objects = graph(scene)
    seen = _in_graphs(plugins, objects)
    for effect, evidence in seen.items():
        if effect not in said and not (effect == "textures" and not _checked_textures(scene)):
            raise SceneError(
                f"Mitsuba's scene shows {effect} ({'; '.join(evidence)}) that the file does not; a"
                " plan would be wrong",
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
    """Camera paths find the caustic of anything but a small light; ptracer knows neither media nor
    our lens.
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


def _checked_textures(scene: Scene) -> bool:
    """Meshes may bring vertex colours, of which the file says nothing."""
    return all(getattr(shape, "tint", None) is None for shape in scene.shapes())


def _in_graphs(
    plugins: list[tuple[str, str]], objects: list[tuple[str, Any]]
) -> dict[Effect, tuple[str, ...]]:
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
    for where, name in plugins:
        if name in by_plugin:
            note(by_plugin[name], f"plugin {name} at {where}")
        elif name in ("homogeneous", "heterogeneous"):
            note(
                "subsurface"
                if where.endswith("interior") and not where.startswith("medium")
                else "medium",
                f"plugin {name} at {where}",
            )
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
            if flags & (
                int(F.DeltaTransmission) | int(F.GlossyTransmission) | int(F.DiffuseTransmission)
            ):
                note("refraction", f"BSDF flag Transmission of {thing.class_name()} at {where}")
        elif isinstance(thing, mi.Emitter):
            note("direct", f"emitter {thing.class_name()} at {where}")
            note("shadows", f"emitter {thing.class_name()} at {where}")
            if thing.is_environment():
                note("environment", f"emitter {thing.class_name()} at {where}")
        elif (
            isinstance(thing, mi.Texture)
            and thing.class_name().startswith("Bitmap")
            and _varies(thing)
        ):
            # A mesh's attribute is not looked at: whether its colours vary the file and the mesh's
            # tint say.
            note("textures", f"texture {thing.class_name()} at {where} varies")
    return {
        effect: tuple(dict.fromkeys(evidence[:1] + evidence[-1:]))
        for effect, evidence in found.items()
    }


def _varies(texture: Any) -> bool:
    import mitsuba as mi

    data = np.array(mi.traverse(texture)["data"])
    return bool(np.ptp(data.reshape(-1, data.shape[-1]), axis=0).max() > 1e-6)


# Cost and words
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cap:
    """What a scene's own cap on bounces cuts off, and what everything on costs within it.

    Attributes:
        bounces: the cap.
        bias: mean light of the plan's pictures over that of everything on without a cap, less 1.
        bias_interval: its 95 %, by Welch's test on the logarithms of the rounds' means; both None
            for a black picture.
        seconds, variance: of everything on within the cap, as :class:`Cost` has them.
        faster: how many times longer it takes for the same samples.
        at_equal_error: how many times longer for the same noise, which is the same error, since its
            pictures have the plan's mean; infinite where the plan has no noise.
        interval: 95 % of that; None where the plan has no noise.
    """

    bounces: int
    bias: float | None
    bias_interval: tuple[float, float] | None
    seconds: float
    variance: float
    faster: float
    at_equal_error: float
    interval: tuple[float, float] | None


@dataclass(frozen=True)
class Cost:
    """What everything on would cost, against the plan, measured on one small picture of the source.

    Everything on follows light until roulette ends it. Where the scene caps its bounces that is
    light that the plan leaves out, so that the two pictures have other means: equal noise is not
    equal error there, and ``cap`` says what is.

    Attributes:
        size, spp: of the measurement.
        seconds: (plan, everything on) medians.
        faster: how many times longer everything on takes for the same samples: the median over
            rounds, in each of which both were rendered one after the other.
        variance: (plan, everything on), mean over pixels and channels, relative to the squared
            mean.
        rounds: pictures of each, taken in turn.
        interval: 95 % of :attr:`at_equal_noise`, by resampling the rounds; None where the plan has
            no noise.
        cap: None where the scene has no cap.
    """

    size: int
    spp: int
    rounds: int
    seconds: tuple[float, float]
    faster: float
    variance: tuple[float, float]
    interval: tuple[float, float] | None
    again: tuple[float, float]
    cap: Cap | None = None

    @property
    def at_equal_noise(self) -> float:
        """How many times longer everything on takes for the same noise; infinite where the plan has
        none.
        """
        return (
            self.faster * self.variance[1] / self.variance[0]
            if self.variance[0] > 0
            else float("inf")
        )

    def to_dict(self) -> dict[str, Any]:
        """As JSON, where infinity is null."""
        fields: dict[str, Any] = without_nan(asdict(self) | {"at_equal_noise": self.at_equal_noise})
        return fields


def measure(
    scene: Scene,
    *,
    size: int | None = None,
    spp: int | None = None,
    rounds: int = 7,
    seed: int = 7000,
) -> Cost:
    """Render plan and everything on in turn and time both, after one unmeasured picture each.

    Where the scene caps its bounces, everything on within the cap is a third.

    Args:
        size, spp: of the picture; if left out as large as needed for tracing, not starting, to take
            most of the time.
    """
    size, spp = size or (96 if variant() == LLVM else 48), spp or (64 if variant() == LLVM else 16)
    small = scene.with_size(size, size)
    contestants = [plan(small, spp), everything_on(small, spp, capped=False)]
    bounces = scene.spec.appearance.bounces
    if bounces != "unlimited":
        contestants.append(everything_on(small, spp))

    def rendered(made: Plan) -> Callable[[int], Any]:
        # Both runs of the plan in a round have one seed: only their seconds are compared.
        return lambda turn: render_plan(small, small.source, made, seed + turn % AGAIN)

    turns = in_turn([rendered(made) for made in contestants], rounds, seed=seed)
    pictures, seconds = turns.results, turns.seconds
    again = time_ratio([turns.again], [seconds[0]])
    scale = float(np.mean(pictures[1])) ** 2
    taken = [np.array(p, np.float64).reshape(rounds, -1) for p in pictures]
    variance = [float(p.var(0, ddof=1).mean()) / scale for p in taken]
    medians = [float(np.median(s)) for s in seconds]
    interval = _ratio_interval(taken[0], taken[1], seconds[0], seconds[1])
    cap = None
    if bounces != "unlimited":
        faster = _slower(seconds[0], seconds[2])
        bias, between = _cut(taken[0].mean(1), taken[1].mean(1))
        cap = Cap(
            bounces, bias, between, medians[2], variance[2], faster,
            faster * variance[2] / variance[0] if variance[0] > 0 else float("inf"),
            _ratio_interval(taken[0], taken[2], seconds[0], seconds[2]),
        )  # fmt: skip
    faster = _slower(seconds[0], seconds[1])
    return Cost(
        size,
        spp,
        rounds,
        (medians[0], medians[1]),
        faster,
        (variance[0], variance[1]),
        interval,
        (again.low, again.high),
        cap,
    )


def _slower(ours: list[float], other: list[float]) -> float:
    """Median of the ratios of rounds, as the interval of :func:`_ratio_interval` has it: two rounds
    are paired in time.
    """
    return float(np.median(np.array(other) / np.array(ours)))


def _cut(ours: Array, full: Array) -> tuple[float | None, tuple[float, float] | None]:
    """Relative difference of two means with its 95 % interval, from the means of independent
    pictures.
    """
    if min(ours.min(), full.min()) <= 0 or len(ours) < 2:
        return None, None
    # Logarithms, so that the noise of the reference counts as well.
    bias, low, high = np.expm1(welch_interval(np.log(full), np.log(ours))).tolist()
    return bias, (low, high)


def _ratio_interval(
    ours: Array, other: Array, ours_seconds: list[float], other_seconds: list[float]
) -> tuple[float, float] | None:
    """95 % of the ratio of variance times time, by resampling rounds; None where ``ours`` has no
    noise.
    """
    rounds = len(ours)
    if not ours.var(0).any():
        return None
    # What else the machine does slows both of a round.
    ratio = np.array(other_seconds) / np.array(ours_seconds)
    # Squared distances between rounds: the variance of a resample is the mean over its pairs of
    # different rounds.
    apart = [np.array([[((x - y) ** 2).mean() / 2 for y in p] for x in p]) for p in (ours, other)]
    draws = np.random.default_rng(0).integers(0, rounds, (1000, rounds))
    spread = [np.array([_between(a, d) for d in draws]) for a in apart]
    known = (spread[0] > 0) & (spread[1] > 0)
    if not known.any():
        return None
    low, high = np.percentile(
        np.median(ratio[draws], axis=1)[known] * spread[1][known] / spread[0][known], [2.5, 97.5]
    )
    return float(low), float(high)


def _between(apart: Array, drawn: npt.NDArray[np.int64]) -> float:
    """Mean of ``apart`` over the pairs of different rounds among those drawn."""
    different = drawn[:, None] != drawn[None]
    return float(apart[np.ix_(drawn, drawn)][different].mean()) if different.any() else 0.0


def report(scene: Scene, *, cost: Cost | None = None) -> dict[str, Any]:
    """Everything about a scene's effects as JSON: ``effects``, ``plan``, ``geometry``,
    ``everything_on``, ``cost``.
    """
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
    """The lines of :func:`report` for a person."""
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
    kind = "light paths" if step["integrator"] == "ptracer" else "samples"
    return (
        f"{step['integrator']}: {step['spp']} {kind} a pixel ({sampler(step['spp'])}), "
        f"light from {', '.join(shining)}, {depth}{roulette}{only}"
    )
