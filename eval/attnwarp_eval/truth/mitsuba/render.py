"""Pictures of a scene by Mitsuba 3, by the plans of :mod:`attnwarp_eval.truth.passes`.

Variant ``llvm_ad_rgb`` if a child process shows that it works on this machine, else
``scalar_rgb``, which works
everywhere: see :mod:`attnwarp_eval.truth.llvm`.

Mitsuba computes in float32, so the scene is moved to the middle of its bounding box in float64
first. Its cameras look along +z with +x to the left and +y up: OpenCV axes are turned by diag(-1,
-1, 1).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.truth.llvm import SCALAR, variant
from attnwarp_eval.truth.mitsuba.build import (
    library,
    load_sensor,
    load_world,
    owner_of_number,
)
from attnwarp_eval.truth.passes import Pass, Plan, sampler, smooth_objects
from attnwarp_eval.truth.raycast import Geometry

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]


APPEARANCE_PROTOCOL = 2
"""Version; raised when the same scene, camera, plan and seed would give another picture."""


def render_plan(
    scene: Scene, camera: Camera, plan: Plan, seed: int, *, made_by: str | None = None
) -> Image:
    """Render a plan: (H, W, 3) float32, linear RGB, every value finite. Not cached.

    Args:
        camera: camera of the view; (H, W) is its size.
        plan: plan of :func:`attnwarp_eval.truth.plan.plan`; which has the samples a pixel.
        seed: the same seed and variant give the same bits, except for light paths ("ptracer").
            Threads add light paths to pixels in any order, which changes the last bits.
        made_by: Mitsuba's variant, by default :func:`~attnwarp_eval.truth.llvm.variant`.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> from attnwarp_eval.truth import render_plan
        >>> from attnwarp_eval.truth.plan import plan
        >>> scene = load_scene("spheres").with_size(8, 8)
        >>> image = render_plan(scene, scene.source, plan(scene, spp=1), seed=0)
        >>> again = render_plan(scene, scene.source, plan(scene, spp=1), seed=0)
        >>> image.shape, bool((image == again).all())
        ((8, 8, 3), True)
    """
    library(made_by or variant())
    total = _render_passes(scene, camera, plan, seed)
    for again in range(1, ATTEMPTS):
        broken = ~np.isfinite(total).all(-1)
        if not broken.any():
            break
        total[broken] = _render_passes(scene, camera, plan, seed + again * OTHER_SEEDS)[broken]
    return total


ATTEMPTS, OTHER_SEEDS = 4, 1_000_003
"""Most attempts to render NaN pixels. A sample that float32 could not compute (such as a ray along
a surface) makes its pixel NaN; the pixel is rendered again with other seeds, with no bias beyond
that of a rejected sample."""


def _render_passes(scene: Scene, camera: Camera, plan: Plan, seed: int) -> Image:
    mi = library()
    total = np.zeros((camera.height, camera.width, 3), dtype=np.float32)
    for number, step in enumerate(plan.passes):
        options: dict[str, Any] = {"type": step.integrator}
        if step.integrator == "direct":
            options |= {"emitter_samples": step.emitter_samples, "bsdf_samples": step.bsdf_samples}
        else:
            # Unlimited paths still need a number; Mitsuba's is -1.
            options |= {"max_depth": step.max_depth, "rr_depth": step.rr_depth}
        if step.integrator == "ptracer":
            # Directly visible lamps belong to the other pass.
            options |= {"hide_emitters": True}
        world, center, fog = load_world(
            scene,
            step.lights,
            step.lamps,
            plan.media,
            step.beam,
            aims_at_sky=step.aims_at_sky,
            unseen=step.first != "any",
        )
        pass_seed = len(plan.passes) * int(seed) + number
        if step.first != "any":
            total += step.sign * _part(
                scene, camera, plan, step, options, pass_seed, (world, center, fog)
            )
            continue
        kind = sampler(step.integrator, step.spp)
        sensor = load_sensor(
            scene,
            camera,
            center,
            {"type": kind, "sample_count": step.spp},
            world,
            plan,
            fog if plan.media else None,
        )
        picture = mi.render(world, sensor=sensor, integrator=mi.load_dict(options), seed=pass_seed)
        total += step.sign * np.array(picture, dtype=np.float32)[..., :3]
    return total


def _part(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    step: Pass,
    options: dict[str, Any],
    seed: int,
    loaded: tuple[Any, Array, Any],
) -> Image:
    """Light of the camera rays that first meet something smooth, a lamp or nothing, or of the other
    rays; zero elsewhere.

    Each camera ray gets a separate pixel in a picture of k x k cells a pixel, so that the index of
    its first shape decides which of the two it belongs to.
    """
    mi = library()
    world, center, fog = loaded
    k = max(1, math.isqrt(step.spp))
    fine = camera.resize(camera.width * k, camera.height * k)
    lamps = [number for number, item in enumerate(scene.spec.objects) if item.emission]
    smooth = np.isin(owner_of_number(scene, world), [-1, *smooth_objects(scene), *lamps])
    if step.first == "rough":
        smooth = ~smooth
    integrator = mi.load_dict({"type": "aov", "aovs": "first:shape_index", "seen": options})
    total = np.zeros((fine.height, fine.width, 3), dtype=np.float64)
    each = math.ceil(step.spp / k**2)
    for number in range(each):
        sensor = load_sensor(
            scene, fine, center, {"type": "independent", "sample_count": 1}, world, plan, fog
        )
        picture = np.array(
            mi.render(world, sensor=sensor, integrator=integrator, seed=seed * 64 + number, spp=1)
        )
        keep = smooth[np.round(picture[..., 3]).astype(np.int64)]
        total += np.where(keep[..., None], picture[..., :3], 0.0)
    return (
        (total / each).reshape(camera.height, k, camera.width, k, 3).mean((1, 3)).astype(np.float32)
    )


def comparable(scene: Scene) -> str:
    """Variant in which renderings of the source by different integrators are comparable.

    For coincident surfaces the ray tracer decides which is visible. With ``llvm_ad_rgb`` that
    depends on how an integrator traces rays, in packets or singly; with ``scalar_rgb`` only on the
    scene.
    """
    if variant() == SCALAR:
        return SCALAR
    tied, _ = Geometry(scene).ties(scene.source)
    return SCALAR if tied.any() else variant()


def position_and_shape(scene: Scene, camera: Camera) -> tuple[Array, npt.NDArray[np.int64]]:
    """Hits of Mitsuba's ray tracer at the pixel centres, to compare with the exact geometry.

    Returns:
        position: (H, W, 3) world, float32 precision about the scene's middle; NaN on a
            miss.
        object_id: (H, W) index of the object, -1 on a miss.
    """
    mi = library(variant())
    # Textures do not affect positions: bake the fewest texels.
    world, center, _ = load_world(scene, (), False, False, texel=math.inf, unseen=True)
    integrator = mi.load_dict({"type": "aov", "aovs": "position:position,shape:shape_index"})
    # One sample in the middle of each pixel: stratified without jitter. Averaged positions would be
    # on no surface.
    middles = {"type": "stratified", "sample_count": 1, "jitter": False}
    sensor = load_sensor(scene, camera, center, middles, world, Plan((), ()), None)
    picture = np.array(
        mi.render(world, sensor=sensor, integrator=integrator, spp=1), dtype=np.float64
    )
    shape = np.round(picture[..., 3]).astype(np.int64)
    position = np.where((shape > 0)[..., None], picture[..., :3] + center, np.nan)
    return position, owner_of_number(scene, world)[shape]
