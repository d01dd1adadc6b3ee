"""A warp and its figures against truth; shared by the probes that judge warps."""

from __future__ import annotations

from typing import Any

import torch

from attnwarp.warp import Surface, WarpedView, WarpSettings, warp_surfaces
from attnwarp_eval import metrics
from attnwarp_eval.study.probe import Work
from attnwarp_eval.two_view import TwoView
from attnwarp_eval.world import World


def warp_truth(world: World, truth: TwoView, settings: WarpSettings, **images: Any) -> WarpedView:
    """Warp by the truth's own depth.

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
        work: the cell; its spec names the feature sizes, their channels and their seed.
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
