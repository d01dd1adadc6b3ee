"""Warps of a variant's cell, view by view, and their figures against truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch

from attnwarp.warp import (
    Surface,
    WarpedView,
    WarpSettings,
    parts_read,
    render_surface,
    warp_surfaces,
    warp_view,
)
from attnwarp_eval import metrics
from attnwarp_eval.study.probe import Probe, Work
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared.splats import (
    splats_of,
    surface_meaning,
    surface_spec,
)
from attnwarp_eval.two_view import TwoView
from attnwarp_eval.world import World


class WarpProbe(Probe[NoExtra]):
    """Base of probes that judge a variant's warp."""

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Entries for depth and rules."""
        return {
            **surface_spec(study, variant, seed),
            "spp": study.spp,
            "settings": variant.settings().to_dict(),
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Key of the depth and the rules."""
        return surface_meaning(study, variant)


def warped_views(work: Work, grids: Sequence[int]) -> Iterator[tuple[str, TwoView, WarpedView]]:
    """Warp each target of a cell; yields its name, truth and warp, with the time measured.

    Args:
        work: work of the cell, whose spec has ``settings`` and the source of depth.
        grids: sides of the feature grids to warp.
    """
    spec, world, meter = work.spec, work.world, work.meter
    size, spp = spec["size"], spec["spp"]
    settings = WarpSettings.from_dict(spec["settings"])
    source_surface = model = None
    if spec.get("geometry") != "truth":
        with meter.stage("splats"):
            model = splats_of(work)
        # One source serves every target, so its render is not part of a target's cost.
        with meter.stage("source"):
            source_surface = render_surface(model, world.source, settings)
        meter.count(source_pairs=source_surface.counters["pairs"])
    for name in spec["views"]:
        with meter.stage("truth"):
            truth = world.pair(name, size)
            images: dict[str, Any] = {}
            if "source_image" in parts_read(settings):
                images = {
                    "source_image": world.image(world.source.name, spp),
                    "target_image": world.image(name, spp),
                }
        with meter.view():
            if model is None:
                view = warp_truth(world, truth, settings, **images)
            else:
                view = warp_view(
                    model,
                    world.source,
                    world.targets[name],
                    settings,
                    source_surface=source_surface,
                    **images,
                    warn_empty=False,
                )
            for grid in grids:
                view.at((grid, grid))
        meter.count(view_pairs=1, **view.target.counters)
        yield name, truth, view


def warp_truth(world: World, truth: TwoView, settings: WarpSettings, **images: Any) -> WarpedView:
    """Warp by the true depth.

    Args:
        truth: truth of the pair, (H, W).
        images: ``source_image`` and ``target_image``, (H, W, 3) sRGB in [0, 1], for photometric
            rules.
    """
    source = world.geometry.trace(truth.source)
    return warp_surfaces(
        truth.source,
        truth.target,
        Surface(truth.hits.depth, truth.hits.normal, image=images.get("target_image")),
        Surface(source.depth, source.normal, image=images.get("source_image")),
        settings,
        warn_empty=False,
    )


def warp_figures(work: Work, name: str, view: WarpedView) -> dict[str, float]:
    """Endpoint error, feature error and mask scores, at image size and at every feature size.

    Args:
        work: work of the cell, whose spec has the feature sizes, channels and seed.
    """
    spec, world, meter = work.spec, work.world, work.meter
    size = spec["size"]
    with meter.stage("checks"):
        truth = world.pair(name, size)
        figures = metrics.endpoint_error(
            view.correspondence.xy, truth.xy, truth.visible, truth.edge
        )
        figures |= metrics.mask_error(
            view.mask, truth.label, truth.hits.valid, truth.behind, truth.edge
        )
    channels, seed = spec["feature_channels"], spec["seed"]
    for layer in spec["feature_sizes"]:
        with meter.stage("truth"):
            truth = world.pair(name, layer)
            features = world.features(world.source.name, layer, channels, seed)
            exact = world.features(name, layer, channels, seed)
        with meter.stage("sample"):
            at_layer = view.at((layer, layer))
            warped = at_layer.warp(torch.from_numpy(features)).numpy()
        meter.count(taps=4 * features.size)
        with meter.stage("checks"):
            errors = metrics.feature_error(warped, exact, at_layer.mask, truth.visible, truth.edge)
            if layer != size:
                xy = at_layer.correspondence.xy
                errors |= metrics.endpoint_error(xy, truth.xy, truth.visible, image_px=size / layer)
                errors |= metrics.mask_error(
                    at_layer.mask, truth.label, truth.hits.valid, truth.behind
                )
            figures |= metrics.at_size(errors, layer)
    return figures
