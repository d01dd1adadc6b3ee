"""Proof that a plan omits nothing visible: a ladder of tests that refuse or certify it.

1. Structural: omitted effects are absent from the file, Mitsuba's parsed graph and the
   loaded scene.
2. The same seed gives the same picture, bit for bit, if both trace the same paths: certified, no
   statistics needed.
3. Paired bias: the same seeds at one sample a pixel, a t-test on the differences of their means.
4. Fresh seeds: Welch's test with Satterthwaite's degrees of freedom on every pixel, every 8 x 8
   block and the whole picture, with Sidak's correction over all of them, AND equivalence of the
   whole (two one-sided tests within 1 %).

An insignificant difference does not show equality: the equivalence test must hold, which
noise prevents. An effect that neither side simulates is invisible to every comparison, so a scene
that needs one is never certified. The tests are in :mod:`attnwarp_eval.statistics.equivalence`.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from attnwarp_eval.effects.detect import detect
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.transport import called_for
from attnwarp_eval.statistics.equivalence import (
    ONE_SIDED,
    equivalence,
    paired_test,
    sidak,
    welch,
)
from attnwarp_eval.truth.mitsuba import comparable, render_plan
from attnwarp_eval.truth.passes import Lens, Pass, Plan, convex, small_lamps, small_lights
from attnwarp_eval.truth.plan import bounces_of, everything_on, plan

Array = npt.NDArray[np.float64]
Verdict = Literal["certified", "refused", "can't tell"]

MARGIN = 0.01
"""Two pictures count as equal when their means differ by less than this share of the mean."""

ALPHA = 0.01
"""Probability that the ladder refuses a complete plan, split among the rungs."""

BLOCK = 8


# Statistics of pictures
# --------------------------------------------------------------------------------------------------


def blocks(pictures: npt.ArrayLike, size: int = BLOCK) -> Array:
    """Means over blocks of ``size`` x ``size`` pixels, smaller at the border, of (n, H, W, C)."""
    data = np.asarray(pictures, np.float64)
    rows, columns = (np.arange(0, n, size) for n in data.shape[1:3])
    sums = np.add.reduceat(np.add.reduceat(data, rows, axis=1), columns, axis=2)
    tall, wide = (
        np.diff([*start, n]) for start, n in zip((rows, columns), data.shape[1:3], strict=True)
    )
    return sums / (tall[:, None] * wide[None, :])[None, :, :, None]


@dataclass(frozen=True)
class Level:
    """One level of the comparison.

    Attributes:
        name: "pixel", "block" or "picture".
        tests: number of values compared.
        least: the smallest p.
        threshold: lower bound for p, after Sidak's correction over the values and the three
            levels.
        worst: the largest difference in standard errors, as a share of the picture's mean.
        detectable: the difference, as a share of the picture's mean, that a value of median noise
            would have been detected with a power of 80 %.
    """

    name: str
    tests: int
    least: float
    threshold: float
    worst: float
    detectable: float

    @property
    def differs(self) -> bool:
        """True if this level refuses equality."""
        return self.least < self.threshold


def levels(a: npt.ArrayLike, b: npt.ArrayLike, *, alpha: float = ALPHA) -> list[Level]:
    """Welch's test on pixels, blocks and the whole picture, with a false refusal rate of
    ``alpha`` overall.

    Args:
        a, b: (n, H, W, C) and (m, H, W, C) pictures of independent seeds. Channels, which share
            noise, are averaged.
    """
    from scipy import stats

    first, second = (np.asarray(x, np.float64).mean(-1, keepdims=True) for x in (a, b))
    scale = max(abs(float(first.mean())), abs(float(second.mean())), 1e-300)
    out = []
    for name, x, y in (
        ("pixel", first, second),
        ("block", blocks(first), blocks(second)),
        ("picture", first.mean((1, 2, 3))[:, None], second.mean((1, 2, 3))[:, None]),
    ):
        result = welch(x, y)
        tests = int(result.p.size)
        threshold = sidak(sidak(alpha, 3), tests)
        freedom = np.minimum(result.freedom, 1e9)
        reach = result.error * (stats.t.isf(threshold / 2, freedom) + stats.t.ppf(0.8, freedom))
        index = int(np.argmin(result.p))
        out.append(
            Level(
                name,
                tests,
                float(result.p.min()),
                threshold,
                float(result.difference.ravel()[index]) / scale,
                float(np.median(reach)) / scale,
            )
        )
    return out


# The ladder
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rung:
    """One test of the ladder: its outcome in words and numbers."""

    name: str
    passed: bool | None
    words: str
    numbers: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Proof:
    """The outcome of the ladder for a plan.

    Attributes:
        verdict: "certified" only if bits are equal or the equivalence test holds, nothing else
            refused, and all needed effects are simulated; "refused" if a difference was
            found; "can't tell" otherwise.
        of_simulated: the verdict of the comparison alone; it differs from ``verdict`` only if an
            effect is not simulated.
        not_simulated: effects that the scene needs and that neither side simulates.
        rungs: the tests, in order.
        detectable: the smallest detectable difference, as a share of the mean, by level.
    """

    verdict: Verdict
    rungs: tuple[Rung, ...]
    detectable: dict[str, float]
    seconds: float
    of_simulated: Verdict
    not_simulated: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The verdict, with the reason if it differs from the comparison's."""
        if self.verdict == self.of_simulated:
            return self.verdict
        return (
            f"{self.verdict}: not simulated: {', '.join(self.not_simulated)}; {self.of_simulated}"
            " but for that"
        )

    def to_dict(self) -> dict[str, Any]:
        """Fields as JSON."""
        return asdict(self)

    def lines(self) -> Iterator[str]:
        """Text lines of the proof."""
        yield f"proof: {self.words} ({self.seconds:.1f} s)"
        for rung in self.rungs:
            word = {None: "-", True: "ok", False: "REFUSED"}[rung.passed]
            yield f"  {rung.name:20} {word:8} {rung.words}"
        if self.detectable:
            shares = ", ".join(f"{name} {share:.2%}" for name, share in self.detectable.items())
            yield f"  smallest difference that could have been seen, of the mean: {shares}"


def prove(
    scene: Scene,
    ours: Plan | None = None,
    against: Plan | None = None,
    *,
    size: int = 32,
    seeds: int = 12,
    seconds: float = 60.0,
    seed: int = 1000,
    structure: bool = True,
) -> Proof:
    """Compare ``ours`` (by default the scene's plan) with a rendering with everything on.

    Args:
        size: size of the square picture of the source view.
        seeds: number of pictures per side for the last rung, at least 10.
        seconds: time limit of rendering. Samples a pixel are chosen from a few trial
            pictures so that the equivalence test can succeed within it; if they do not fit, the
            verdict is "can't tell".
        seed: the first seed.
        structure: whether to run the first rung; False leaves only the statistics (to
            test them).

    Raises:
        ValueError: fewer than 10 seeds a side.
        SceneError: file and loaded scene disagree about the effects.
    """
    if seeds < 10:
        raise ValueError(f"seeds: got {seeds}, expected at least 10 a side")
    start = time.perf_counter()
    scene = scene.with_size(size, size)
    ours = plan(scene) if ours is None else ours
    against = everything_on(scene) if against is None else against
    rungs = [_structural(scene, ours)] if structure else []
    blind = tuple(rungs[0].numbers["not_simulated"]) if rungs else ()
    made_by = comparable(scene)

    def pictures(made: Plan, spp: int, first: int, count: int) -> Array:
        steps = _with_spp(made, spp)
        return np.stack(
            [
                render_plan(scene, scene.source, steps, first + k, made_by=made_by)
                for k in range(count)
            ]
        ).astype(np.float64)

    def finish(verdict: Verdict, detectable: dict[str, float] | None = None) -> Proof:
        # Neither side has effects that are not simulated: equal pictures do not certify them, and
        # unequal ones still refuse.
        capped: Verdict = "can't tell" if blind and verdict == "certified" else verdict
        return Proof(
            capped, tuple(rungs), detectable or {}, time.perf_counter() - start, verdict, blind
        )

    if rungs and rungs[0].passed is False:
        return finish("refused")
    ladder = climb(
        lambda side, spp, first, count: pictures((ours, against)[side], spp, first, count),
        seeds=seeds, seconds=seconds - (time.perf_counter() - start), seed=seed,
    )  # fmt: skip
    rungs.extend(ladder.rungs)
    return finish(ladder.verdict, ladder.detectable)


Pictures = Callable[[int, int, int, int], Array]
"""Pictures (count, H, W, C) of a side (0 plan, 1 everything on), spp, first seed, count."""


@dataclass(frozen=True)
class Climb:
    """The outcome of the rungs that compare pictures."""

    verdict: Verdict
    rungs: tuple[Rung, ...]
    detectable: dict[str, float]


def climb(
    pictures: Pictures,
    *,
    seeds: int = 12,
    seconds: float = 60.0,
    seed: int = 1000,
    alpha: float = ALPHA,
) -> Climb:
    """Run the rungs that compare pictures; together they refuse two equal sides with probability
    ``alpha``.

    Two of them can refuse: paired bias and Welch's test. Their pictures have different seeds, so
    each has Sidak's share of ``alpha``.

    Args:
        pictures: renderer of a side's stacks; see :data:`Pictures`.
        seeds: seeds of each side in Welch's test.
        seconds: time limit of Welch's pictures, which limits the samples a pixel.
        seed: the first seed; the rungs use the next ones.
        alpha: probability that two equal sides are refused.
    """
    from scipy import stats

    start = time.perf_counter()
    rungs: list[Rung] = []
    share = sidak(alpha, 2)
    pairs = 24
    a, b = pictures(0, 1, seed, pairs), pictures(1, 1, seed, pairs)
    if np.array_equal(a, b):
        rungs.append(
            Rung("same seed", True, f"{pairs} pictures equal bit for bit: the paths are the same")
        )
        return Climb("certified", tuple(rungs), {"any": 0.0})
    rungs.append(Rung("same seed", None, "the pictures differ, as those of different paths do"))
    common = paired_test(a, b)
    bad = common.p < share
    rungs.append(
        Rung(
            "paired bias, 1 spp",
            not bad,
            f"everything on is {abs(common.difference):.2%} +- {common.error:.2%}"
            f" {'darker' if common.difference < 0 else 'brighter'} over {pairs} common seeds"
            f" (p = {common.p:.2g}, refused below {share:.2g})",
            asdict(common),
        )
    )
    if bad:
        reach = float(stats.t.isf(share / 2, pairs - 1) + stats.t.ppf(0.8, pairs - 1))
        return Climb("refused", tuple(rungs), {"picture": reach * common.error})

    spp = _samples(pictures, seed + pairs, seeds, seconds - (time.perf_counter() - start))
    a = pictures(0, spp, seed + 1000, seeds)
    b = pictures(1, spp, seed + 2000, seeds)
    compared = levels(a, b, alpha=share)
    detectable = {level.name: level.detectable for level in compared}
    for level in compared:
        rungs.append(
            Rung(
                f"Welch, {level.name}",
                not level.differs,
                f"least p {level.least:.2g} of {level.tests} (refused below {level.threshold:.2g}),"
                f" there {level.worst:+.2%} of the mean",
                asdict(level),
            )
        )
    same = equivalence(a, b, margin=MARGIN)
    rungs.append(
        Rung(
            "equivalence", True if same.equal else None,
            f"|d| + 2.33 SE = {same.bound:.2%} of the mean at {spp} samples, {seeds} seeds a side; "
            + (f"below {same.margin:.0%}" if same.equal else f"not below {same.margin:.0%}"),
            asdict(same) | {"spp": spp, "seeds": seeds},
        )
    )  # fmt: skip
    if any(level.differs for level in compared):
        return Climb("refused", tuple(rungs), detectable)
    return Climb("certified" if same.equal else "can't tell", tuple(rungs), detectable)


def _with_spp(made: Plan, spp: int) -> Plan:
    from dataclasses import replace

    least = min(step.spp for step in made.passes)
    return replace(
        made, passes=tuple(replace(step, spp=spp * step.spp // least) for step in made.passes)
    )


def _samples(pictures: Pictures, seed: int, seeds: int, seconds: float) -> int:
    """Samples a pixel at which 2.33 standard errors are half the margin, as time allows."""
    trial, count = 4, 6
    start = time.perf_counter()
    means = [pictures(side, trial, seed + 100 * side, count).mean((1, 2, 3)) for side in (0, 1)]
    each = (time.perf_counter() - start) / count / trial
    scale = max(abs(float(means[1].mean())), 1e-300)
    variance = (
        sum(float(m.var(ddof=1)) for m in means) / scale**2 * trial
    )  # of one sample, both sides together
    needed = variance / seeds / (MARGIN / 2 / ONE_SIDED) ** 2
    affordable = max(0.0, seconds - (time.perf_counter() - start)) / (each * seeds)
    spp = max(16.0, min(needed, affordable, 4096.0))
    if affordable < 16:
        return max(1, int(affordable))
    grid = 4 ** math.ceil(math.log(spp, 4))  # a power of 4 is a grid, which stratifies
    return grid if grid <= affordable else grid // 4


def _structural(scene: Scene, ours: Plan) -> Rung:
    """Check that the file and Mitsuba's graphs lack the effects that the plan omits."""
    findings = detect(scene)
    blind: list[str] = [
        name for name in findings if findings[name].needed and not findings[name].simulated
    ]
    if findings["caustics"].simulated and small_lights(scene) is not None:
        blind.append("caustics seen in mirrors and through glass")
    lacks = list(
        _lacks(scene, ours, caustic=findings["caustics"].needed and findings["caustics"].simulated)
    )
    cap = bounces_of(scene)
    words = "what is left out is in neither the file nor Mitsuba's graphs"
    if cap != "unlimited" and not convex(scene):
        words += (
            f"; bounces beyond {cap} are left out by the scene's own word and not part of this"
            " proof"
        )
    if blind:
        words += f"; not simulated and so not proved: {', '.join(blind)}"
    return Rung(
        "structure", not lacks, "; ".join(lacks) or words, {"lacks": lacks, "not_simulated": blind}
    )


def _lacks(scene: Scene, ours: Plan, *, caustic: bool) -> Iterator[str]:
    """Effects that the scene needs and the plan's passes do not render, one sentence each.

    Args:
        caustic: whether the scene has a caustic that can be simulated.
    """
    spec = scene.spec
    called = called_for(spec)
    cameras = [step for step in ours.passes if step.integrator != "ptracer"]
    if ("medium" in called or "subsurface" in called) and (
        not ours.media or any(step.integrator not in ("volpath", "ptracer") for step in ours.passes)
    ):
        yield "a medium needs volpath, in every pass"
    lens = spec.cameras.lens
    if lens is not None and ours.lens is None:
        yield "depth of field needs a lens"
    elif lens is not None and ours.lens != Lens(lens.aperture, lens.focus):
        yield f"the lens is another: aperture {lens.aperture:g} and focus {lens.focus} are said"
    elif lens is None and ours.lens is not None:
        yield "the scene says no lens, but the plan has one"

    # A light needs passes for both kinds of first surface: rough, or smooth, a lamp or nothing.
    both = {"smooth", "rough"}
    for name, shines in _shining(scene):
        covered: set[str] = set()
        for step in ours.passes:
            if step.sign > 0 and not step.beam and shines(step):
                covered |= (
                    {"rough"}
                    if step.integrator == "ptracer"
                    else both
                    if step.first == "any"
                    else {step.first}
                )
        missing = sorted(both - covered)
        if missing:
            condition = "" if len(missing) == 2 else f" where what is seen first is {missing[0]}"
            yield f"{name} shines in no pass{condition}"
        taken = sum(step.beam and step.sign < 0 and shines(step) for step in cameras)
        given = sum(step.beam and step.sign > 0 and shines(step) for step in ours.passes)
        if taken > given:
            yield f"the beam of {name} is taken away and no paths from the light put it back"

    # A surface that no other surface faces is lit once; elsewhere any bounce below the scene's cap
    # may be visible.
    cap = 1 if convex(scene) and not ours.media else bounces_of(scene)
    depth = -1 if cap == "unlimited" else cap + 1
    longer = [
        name
        for name in ("refraction", "specular", "subsurface", "medium", "interreflection")
        if name in called
    ]
    for step in ours.passes:
        reach = 2 if step.integrator == "direct" else step.max_depth
        if reach >= 0 and (depth < 0 or reach < depth):
            expected = "no end" if depth < 0 else f"{depth} edges"
            yield (
                f"paths of the pass {step.integrator} have {reach} edges, but"
                f" {', '.join(longer) or 'the scene'} needs {expected}"
            )

    if caustic:
        small = set(small_lamps(scene))
        for k, light in enumerate(spec.lights):
            if light.type != "sky" and not any(
                s.integrator == "ptracer" and k in s.lights for s in ours.passes
            ):
                yield (
                    f"the caustic of lights[{k}], a {light.type}, needs paths from the light"
                    " (ptracer)"
                )
        if small and not any(step.integrator == "ptracer" and step.lamps for step in ours.passes):
            yield (
                f"the caustic of object {spec.objects[min(small)].name!r} needs paths from the"
                " light (ptracer)"
            )


def _shining(scene: Scene) -> Iterator[tuple[str, Callable[[Pass], bool]]]:
    """Name of each light, and of the lamps together, with whether it shines in a pass."""
    for k, light in enumerate(scene.spec.lights):
        yield f"lights[{k}], a {light.type},", functools.partial(_shines, k)
    lamps = [item.name for item in scene.spec.objects if item.emission]
    if lamps:
        yield f"object {lamps[0]!r}, a lamp,", lambda step: step.lamps


def _shines(light: int, step: Pass) -> bool:
    return light in step.lights
