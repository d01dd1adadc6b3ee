"""Plan of a scene's pictures, with the number of bounces that its file names.

:func:`plan` needs no loading. docs/truth/truth.md has the reasons.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.truth.passes import (
    ROULETTE,
    Bounces,
    Pass,
    Plan,
    convex,
    plan_passes,
)


def plan(
    scene: Scene,
    spp: int | None = None,
    *,
    want: Literal["appearance", "geometry"] = "appearance",
    bounces: Bounces | None = None,
) -> Plan:
    """The cheapest rendering with all effects that ``scene`` needs.

    Args:
        spp: samples a pixel; by default the scene's number.
        want: "geometry" (depth, normals, ids, visibility) needs no rendering, only rays.
        bounces: replacement of the scene's number.

    Raises:
        ValueError: spp below 1.
        SceneError: the scene pins, forbids or caps an effect that it cannot.
    """
    if want == "geometry":
        return Plan(
            (),
            (
                (
                    "depth, normals, ids and visibility are cast with rays (Open3D, float64),"
                    " without light"
                ),
            ),
        )
    if bounces is not None:
        return plan_passes(scene, spp, bounces)
    return plan_passes(scene, spp, bounces_of(scene), tuple(open_bounces(scene)))


def bounces_of(scene: Scene) -> Bounces:
    """Bounces of a scene's pictures: the number in its file, else unlimited; 1 for a single convex
    surface, which never lights itself.
    """
    named = scene.spec.appearance.bounces
    if named is not None:
        return named
    return 1 if convex(scene) and scene.spec.medium is None else "unlimited"


def open_bounces(scene: Scene) -> list[str]:
    """One line if a scene's pictures have unlimited bounces, since its file names no number;
    else none.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> open_bounces(load_scene("spheres"))
        []
    """
    if scene.spec.appearance.bounces is not None or bounces_of(scene) == 1:
        return []
    return [
        "the file names no number of bounces, so light is followed until it is gone;"
        " `attnwarp-eval scenes calibrate FILE` measures how many are enough"
    ]


def everything_on(scene: Scene, spp: int | None = None, *, capped: bool = True) -> Plan:
    """Plan of a renderer without knowledge of the scene: volpath for all lights at once, with the
    scene's lens, if any.

    If a caustic is needed, ptracer is added: volpath alone would miss it, so "full" would not
    be the truth. Never volpathmis, which is biased under roulette.

    Args:
        spp: samples a pixel; by default the scene's number.
        capped: whether to keep the scene's cap on bounces, which is part of its truth. Without
            it light is followed until roulette ends it, which shows the cap's saving.
    """
    ours = plan(scene, spp)
    spp = spp or scene.spec.appearance.spp
    bounces = bounces_of(scene) if capped else "unlimited"
    depth = -1 if bounces == "unlimited" else bounces + 1
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
