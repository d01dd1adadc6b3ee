"""Graph of a scene as Mitsuba parsed and loaded it."""

from __future__ import annotations

import functools
from typing import Any

from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.truth.llvm import variant
from attnwarp_eval.truth.mitsuba import build
from attnwarp_eval.truth.mitsuba.build import (
    cached,
    interior,
    library,
    light_form,
    load_sensor,
    load_shapes,
    load_world,
    medium_form,
    plugin_names,
    texel_size,
)
from attnwarp_eval.truth.passes import plan_passes


def graph(scene: Scene) -> tuple[list[tuple[str, str]], list[tuple[str, Any]]]:
    """Mitsuba's graph of the scene: (path, plugin name) as parsed, (path, object) as loaded."""
    mi = library(variant())
    everything = tuple(range(len(scene.spec.lights)))
    world, center, fog = load_world(scene, everything, True, True)
    forms, _, plugins = cached(
        (mi.variant(), scene.world_hash, texel_size(scene), build.TEXELS),
        lambda: load_shapes(scene, texel_size(scene)),
    )
    names = {key: f"objects[{owner}]" for key, (_, owner, _) in forms.items()}
    parsed = [
        (path.replace(path.split(".")[0], names.get(path.split(".")[0], path), 1), n)
        for path, n in plugins
    ]
    for k in everything:
        parsed += plugin_names(f"lights[{k}]", light_form(scene.spec.lights[k], center))
    for k, item in enumerate(scene.spec.objects):
        inside = interior(item)
        if inside is not None:
            parsed += plugin_names(f"objects[{k}].interior", medium_form(inside))
    if scene.spec.medium is not None:
        parsed += plugin_names("medium.interior", medium_form(scene.spec.medium))
    middles = {"type": "stratified", "sample_count": 1, "jitter": False}
    # The sensor does not depend on the number of bounces.
    planned = plan_passes(scene, 1, 1)
    sensor = load_sensor(scene, scene.source, center, middles, world, planned, fog)
    parsed.append(
        ("cameras", {"ThinLensCamera": "thinlens"}.get(sensor.class_name(), "perspective"))
    )
    loaded = [
        (
            names.get(path.split(".")[0], path.split(".")[0]) + path[len(path.split(".")[0]) :],
            thing,
        )
        for path, thing in _walk(world)
    ]
    return parsed, loaded


def _walk(thing: Any, path: str = "") -> list[tuple[str, Any]]:
    """Every object below ``thing``, depth first, with the path from Mitsuba's traversal."""
    visit = _visitor(library().variant())(path)
    thing.traverse(visit)
    found: list[tuple[str, Any]] = visit.found
    return found


@functools.cache
def _visitor(variant_name: str) -> Any:
    """Class that collects the objects below a given one; a class created per object would be a
    cycle that keeps the objects alive.
    """
    mi = library(variant_name)

    class Visit(mi.TraversalCallback):  # type: ignore[name-defined]
        def __init__(self, path: str) -> None:
            super().__init__()
            self.path = path
            self.found: list[tuple[str, Any]] = []

        def put(self, name: str, value: Any, *_: Any) -> None:
            if isinstance(value, mi.Object):
                self.found.append((self.path + name, value))
                self.found.extend(_walk(value, f"{self.path}{name}."))

        put_object = put

        def put_value(self, name: str, value: Any, *_: Any) -> None:
            """Ignore numbers."""

    return Visit
