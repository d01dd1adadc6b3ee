"""What one cell computes. A probe is a function of the cell's spec and the world; the record is
what it returns.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attnwarp.errors import InputError
from attnwarp.fit import FitSettings
from attnwarp.render.threads import set_thread_count, thread_count
from attnwarp.warp.correspondence import TAP_SPREAD
from attnwarp.warp.settings import PRESETS, WarpSettings
from attnwarp.warp.view import (
    EXACT_DEPTH_TOLERANCE,
    Surface,
    WarpedView,
    render_surface,
    warp_surfaces,
    warp_view,
)
from attnwarp_eval import metrics
from attnwarp_eval.cost import Meter, environment, peak_memory_mb
from attnwarp_eval.effects.table import said_by
from attnwarp_eval.files import digest, write_atomic
from attnwarp_eval.splats import export, fitted
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.truth import TwoView
from attnwarp_eval.world import World, splats, world

Figures = dict[str, float]
View = tuple[str, Figures, dict[str, Any]]
"""A target's name, its figures, and what its pictures are drawn from."""

MITSUBA_TOLERANCE = 1e-4
"""Of the distance: Mitsuba's positions are float32, so a point 10 m away is known to about 1e-6 of
that.
"""

EXACT = dataclasses.replace(
    PRESETS["corrected"], depth_relative=EXACT_DEPTH_TOLERANCE, depth_spread=TAP_SPREAD
)
"""The corrected rules with the tolerances for exact depth: what the instrument is calibrated
with."""


def compute(cell: Cell, scene: str, root: Path, threads: int | None = None) -> dict[str, Any]:
    """Compute a cell.

    Args:
        cell: what to compute.
        scene: name or path of its scene.
        root: the run's folder; the cell's pictures go below it.
        threads: of the renderer; every core this process may use, if left out.

    Returns:
        The record for :meth:`attnwarp_eval.study.store.Store.write`.
    """
    # Image-sized tensor operations gain little from threads and lose much when other processes want
    # the cores; the renderer's own threads are counted apart.
    torch.set_num_threads(1)
    set_thread_count(threads or len(os.sched_getaffinity(0)))
    meter = Meter()
    spec = cell.spec
    with meter.stage("setup"):
        at = world(scene, spec["size"])
    if at.content_hash != spec["scene"]:
        raise InputError(
            f"scene {scene!r} has changed since the run was planned; start the run again"
        )
    views, pictures = [], []
    curve: list[dict[str, Any]] = []
    rounds: dict[str, Any] = {}
    found: Iterator[View]
    if cell.probe == "fit":
        found = _fit(at, spec, meter, root, curve)
    elif cell.probe == "timing":
        rounds = _timing(at, scene, spec, meter)
        found = iter(())
    elif cell.probe == "sensitivity":
        found = _sensitivity(at, cell, meter, rounds)
    else:
        found = {"calibration": _calibration, "depth": _depth, "warp": _warp}[cell.probe](
            at, scene, spec, meter
        )
    for name, figures, shown in found:
        views.append(
            {"view": name, "yaw": at.yaw[name.rpartition("/")[2]], "metrics": _plain(figures)}
        )
        if name in cell.pictures:
            with meter.stage("pictures"):
                pictures += _save_pictures(cell, name, at, shown, root)
    return {
        "id": cell.id,
        "spec": spec,
        "views": views,
        "pictures": pictures,
        **({"curve": curve} if curve else {}),
        **({"effects": said_by(at.scene)} if cell.probe == "calibration" else {}),
        "cost": {
            "seconds": meter.seconds(),
            "counters": dict(sorted(meter.counters.items())),
            "peak_memory_mb": peak_memory_mb(),
            "threads": thread_count(),
            **({"rounds": rounds} if rounds else {}),
        },
        "environment": environment(),
    }


def _plain(figures: Mapping[str, float]) -> dict[str, float | int | None]:
    """Numbers that JSON can hold: what is undefined becomes null."""
    return {
        name: value if isinstance(value, int) else (float(value) if math.isfinite(value) else None)
        for name, value in figures.items()
    }


def _calibration(at: World, scene: str, spec: dict[str, Any], meter: Meter) -> Iterator[View]:
    """The instrument judged by itself: the truth's own depth through the same warp, the exact mask
    against itself.
    """
    size = spec["size"]
    for name in spec["views"]:
        with meter.stage("truth"):
            truth = at.pair(name, size)
        with meter.view():
            view = _warp_truth(at, truth, EXACT)
        figures = _warp_figures(at, spec, name, view, meter)
        if name == spec["views"][0]:
            figures["calibration.mitsuba_agrees"] = _mitsuba_agrees(at, truth)
        own = metrics.mask_error(
            truth.visible, truth.label, truth.hits.valid, truth.behind, truth.edge
        )
        figures |= {f"{key}.exact": value for key, value in own.items()}
        meter.count(pixels=size * size)
        yield name, figures, {"truth": truth, "view": view, "spp": spec["spp"]}


def _mitsuba_agrees(at: World, truth: TwoView) -> float:
    """Share of a view's pixels where Mitsuba's own ray tracer finds the same surface point, or none
    where there is none.
    """
    from attnwarp_eval.truth.mitsuba import position_and_shape

    position, _ = position_and_shape(at.scene, truth.target)
    away = np.linalg.norm(position - truth.hits.point, axis=-1)
    far = np.linalg.norm(truth.hits.point - truth.target.position, axis=-1)
    empty = ~np.isfinite(position).all(axis=-1) & ~truth.hits.valid
    with np.errstate(invalid="ignore"):
        return float((empty | (away < MITSUBA_TOLERANCE * far)).mean())


def _depth(at: World, scene: str, spec: dict[str, Any], meter: Meter) -> Iterator[View]:
    """Depth and normals of splats against truth."""
    size = spec["size"]
    with meter.stage("splats"):
        model = splats(scene, size, spec["seed"], **spec["splats"])
    settings = WarpSettings(depth=spec["depth"], depth_statistic=spec["depth_statistic"])
    for name in spec["views"]:
        with meter.stage("truth"):
            truth = at.pair(name, size)
        with meter.view():
            surface = render_surface(model, at.targets[name], settings)
        meter.count(pixels=size * size, **surface.counters)
        with meter.stage("checks"):
            figures = metrics.depth_error(
                surface.depth,
                truth.hits.depth,
                normal=surface.normal,
                true_normal=truth.hits.normal,
                edge=at.edge(name),
            )
        yield name, figures, {"truth": truth, "surface": surface}


def _warp(at: World, scene: str, spec: dict[str, Any], meter: Meter) -> Iterator[View]:
    """Warp and mask of a variant against exact correspondences and visibility."""
    size, spp = spec["size"], spec["spp"]
    settings = WarpSettings.from_dict(spec["settings"])
    model = source_surface = None
    if "splats" in spec:
        with meter.stage("splats"):
            model = splats(scene, size, spec["seed"], **spec["splats"])
        # One source serves every target, so its render is no part of what a target costs.
        with meter.stage("source"):
            source_surface = render_surface(model, at.source, settings)
        meter.count(source_pairs=source_surface.counters["pairs"])
    for name in spec["views"]:
        target = at.targets[name]
        with meter.stage("truth"):
            truth = at.pair(name, size)
            images: dict[str, Any] = {}
            if settings.photometric is not None:
                images = {
                    "source_image": at.image(at.source.name, spp),
                    "target_image": at.image(name, spp),
                }
        with meter.view():
            if model is None:
                view = _warp_truth(at, truth, settings, **images)
            else:
                view = warp_view(
                    model, at.source, target, settings, source_surface=source_surface, **images
                )
            for layer in spec["feature_sizes"]:
                view.at((layer, layer))
        meter.count(**view.target.counters)
        figures = _warp_figures(at, spec, name, view, meter)
        yield name, figures, {"truth": truth, "view": view, "spp": spp}


def _fit(
    at: World, spec: dict[str, Any], meter: Meter, root: Path, curve: list[dict[str, Any]]
) -> Iterator[View]:
    """Splats fitted to true pictures, on views held out: pictures, depth and normals; and the curve
    of the fit.

    The fit lies below the run's folder, named by what decides it: cells that measure the same one
    in another way share it, and one that was cut short is gone on with.
    """
    how = spec["fit"]
    decisive = {
        **how,
        "scene": spec["scene"],
        "size": spec["size"],
        "spp": spec["spp"],
        "seed": spec["seed"],
    }
    with meter.stage("truth"):
        cameras = {
            c.name: c for c in export.orbit(at.scene, how["views"]) if c.name in spec["views"]
        }
    for camera in cameras.values():
        at.add(camera)
    # Its seconds go into the curve, which holds them for fits of earlier sittings as well.
    result = fitted.fit_scene(
        at.scene,
        FitSettings.from_dict(how["settings"]),
        root / "fits" / digest(decisive)[:16],
        views=how["views"],
        spp=spec["spp"],
        points=how["points"],
        noise=how["noise"],
        seed=spec["seed"],
        geometry=at.geometry,
    )
    for record in result.history:
        known = {"loss": record.loss, "psnr": record.psnr, "psnr_pooled": record.psnr_pooled}
        defined = _plain(
            {name: math.nan if value is None else value for name, value in known.items()}
        )
        curve.append({**dataclasses.asdict(record), **defined, "measures": _plain(record.measures)})
    meter.count(iterations=result.iteration, splats=len(result.gaussians))
    settings = WarpSettings(depth=spec["depth"], depth_statistic=spec["depth_statistic"])
    for name, camera in cameras.items():
        with meter.view():
            surface = render_surface(result.gaussians, camera, settings)
        with meter.stage("truth"):
            truth = at.geometry.trace(camera)
            image = export.picture(at.scene, camera, spec["spp"])
            edge = at.edge(name)
        meter.count(pixels=camera.width * camera.height, **surface.counters)
        with meter.stage("checks"):
            figures = fitted.picture_error(np.asarray(surface.image), image)
            figures |= metrics.depth_error(
                surface.depth,
                truth.depth,
                normal=surface.normal,
                true_normal=truth.normal,
                edge=edge,
            )
        yield name, figures, {"fitted": surface, "hits": truth, "image": image}


def _timing(
    at: World, scene: str, spec: dict[str, Any], meter: Meter
) -> dict[str, list[list[float]]]:
    """Seconds of every contestant in every round, taken in turn in one process, in an order drawn
    anew each round.

    The machine's speed drifts; contestants of one round see the same machine, so their ratio within
    a round can be trusted where two separate means cannot. The first contestant runs twice a round:
    the ratio of it to itself is what noise alone does here. A first round, which compiles and fills
    caches, is not kept.

    Returns:
        "render" (the target's surface) and "pair" (render, correspondence, mask, feature grids),
        each a list over contestants, the first one's second run last, of seconds a round.
    """
    target = at.targets[spec["views"][0]]
    contestants = [
        (
            splats(scene, spec["size"], spec["seed"], **contestant["splats"]),
            WarpSettings.from_dict(contestant["settings"]),
        )
        for contestant in spec["contestants"]
    ]
    contestants.append(contestants[0])
    sources = [render_surface(model, at.source, settings) for model, settings in contestants]
    rng = np.random.default_rng(spec["seed"])
    seconds: dict[str, list[list[float]]] = {
        stage: [[] for _ in contestants] for stage in ("render", "pair")
    }
    for turn in range(spec["rounds"] + 1):
        for index in rng.permutation(len(contestants)):
            model, settings = contestants[index]
            start = time.perf_counter()
            render_surface(model, target, settings)
            rendered = time.perf_counter()
            view = warp_view(model, at.source, target, settings, source_surface=sources[index])
            for layer in spec["feature_sizes"]:
                view.at((layer, layer))
            done = time.perf_counter()
            if turn:
                seconds["render"][index].append(rendered - start)
                seconds["pair"][index].append(done - rendered)
    meter.count(rounds=spec["rounds"], contestants=len(contestants))
    return seconds


def _sensitivity(
    at: World, cell: Cell, meter: Meter, seconds: dict[str, list[float]]
) -> Iterator[View]:
    """Every metric on right and on flawed results of the scene's edits. A view is named
    ``edit/view``.
    """
    from attnwarp_eval.study.probes import sensitivity

    with meter.stage("setup"):
        encoders = sensitivity.loaded(cell.encoders, cell.spec["encoders"])
    yield from sensitivity.measure(at, cell.spec, encoders, meter, seconds)


def _warp_truth(at: World, truth: TwoView, settings: WarpSettings, **images: Any) -> WarpedView:
    source = at.geometry.trace(truth.source)
    return warp_surfaces(
        truth.source,
        truth.target,
        Surface(truth.hits.depth, truth.hits.normal, image=images.get("target_image")),
        Surface(source.depth, source.normal, image=images.get("source_image")),
        settings,
    )


def _warp_figures(
    at: World, spec: dict[str, Any], name: str, view: WarpedView, meter: Meter
) -> Figures:
    """Endpoint error, feature error and mask scores of a warp, at image size and at every feature
    size.
    """
    size = spec["size"]
    with meter.stage("checks"):
        truth = at.pair(name, size)
        figures = metrics.endpoint_error(
            view.correspondence.xy, truth.xy, truth.visible, truth.edge
        )
        figures |= metrics.mask_error(
            view.mask, truth.label, truth.hits.valid, truth.behind, truth.edge
        )
    channels, seed = spec["feature_channels"], spec["seed"]
    for layer in spec["feature_sizes"]:
        with meter.stage("truth"):
            truth = at.pair(name, layer)
            features = at.features(at.source.name, layer, channels, seed)
            exact = at.features(name, layer, channels, seed)
        with meter.stage("sample"):
            at_layer = view.at((layer, layer))
            warped = at_layer.warp(torch.from_numpy(features)).numpy()
        meter.count(taps=4 * features.size)
        with meter.stage("checks"):
            found = metrics.feature_error(warped, exact, at_layer.mask, truth.visible, truth.edge)
            if layer != size:
                xy = at_layer.correspondence.xy
                found |= metrics.endpoint_error(xy, truth.xy, truth.visible, image_px=size / layer)
                found |= metrics.mask_error(
                    at_layer.mask, truth.label, truth.hits.valid, truth.behind
                )
            figures |= metrics.at_size(found, layer)
    return figures


def _save_pictures(
    cell: Cell, name: str, at: World, shown: dict[str, Any], root: Path
) -> list[dict[str, str]]:
    from attnwarp_eval.study import pictures

    found = pictures.of_fit(**shown) if "fitted" in shown else pictures.of(at, name, **shown)
    saved = []
    for what, data in found.items():
        path = Path("pictures") / cell.id[:16] / f"{name}-{what}.jpg"
        write_atomic(root / path, data)
        saved.append(
            {
                "view": name,
                "what": what,
                "path": str(path),
                "sha256": hashlib.sha256(data).hexdigest(),
            }
        )
    return saved
