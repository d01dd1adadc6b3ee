"""Surfaces of splats: a mesh fused of their depth against the true surface, and by the same splats
depth and pictures of held-out views, warps and carried labels.

One cell has all figures of a variant, so that a report can ask which of them ranks variants as the
error of the warp does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from attnwarp import Gaussians
from attnwarp.camera import Camera
from attnwarp.warp import Surface, WarpSettings, render_surface
from attnwarp_eval import metrics
from attnwarp_eval.ideal.editor import FACTOR
from attnwarp_eval.ideal.thing import labels_of
from attnwarp_eval.splats import export, fitted, mesh
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared import fits
from attnwarp_eval.study.shared.splats import is_fitted, splats_of
from attnwarp_eval.study.shared.warps import ThingWarpProbe, label_figures, warped_views
from attnwarp_eval.study.warping import warp_figures

PARTS = 12
"""Parts of the thing whose labels are carried, on tokens of 4 px, as in the probe ``labels``."""

VOXEL = 1.0
"""Edge of a voxel, in widths of a pixel at the point that the cameras look at."""

THRESHOLD = 0.01
"""Distance within which a point is right for the F-score, in distances of the cameras from what
they look at."""

CUT = 0.03
"""Distance from which on DTU's means leave points out, likewise: 20 mm at some 0.6 m."""

FINER = 2
"""Points of both surfaces lie this much closer than voxels; true ones are traced in pictures this
much larger.
"""

MESH = "mesh"
"""Place of the mesh's figures among a record's views: this, a slash, and the last target."""


@register
class SurfaceProbe(ThingWarpProbe):
    """Every figure of a variant's geometry, and the errors of its warps."""

    name = "surfaces"
    metrics = metrics_of("surface.", "depth.", "fit.", "warp.", "occlusion.", "labels.")

    def check(self, study: Study) -> None:
        """Tokens have whole pixels."""
        if self.name in study.probes and study.size % FACTOR:
            raise ValueError(f"size: got {study.size}, expected a multiple of {FACTOR}")

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Depth, rules, feature grids, and the views around the scene."""
        return {
            **super().variant_spec(study, variant, seed),
            "feature_sizes": study.feature_sizes,
            "feature_channels": study.feature_channels,
            "around": study.part(fits.StudyPart).fit.views,
        }

    def compute(self, work: Work) -> NoExtra:
        """Fuse and measure the mesh, then held-out views, then warps.

        Seconds: ``fit`` are CPU seconds of the fit's iterations, in whatever sitting.
        """
        spec, world, meter = work.spec, work.world, work.meter
        settings = WarpSettings.from_dict(spec["settings"])
        model = None
        if is_fitted(spec):
            fit = fits.fit_of(work)
            model = fit.gaussians
            meter.add("fit", fit.history[-1].cpu_seconds)
            meter.count(iterations=fit.iteration)
        elif spec.get("geometry") != "truth":
            model = splats_of(work)
        cameras = export.orbit(world.scene, spec["around"])
        for camera in cameras:
            world.add(camera)
        held = set(export.held_out_names(spec["around"]))
        fused = [camera for camera in cameras if camera.name not in held]
        work.add(f"{MESH}/{spec['views'][-1]}", _mesh_figures(work, model, settings, fused))
        for camera in cameras:
            if camera.name in held:
                work.add(camera.name, _view_figures(work, model, settings, camera))
        with meter.stage("truth"):
            views = [world.source, *(world.targets[name] for name in spec["views"])]
            labels = labels_of(world.scene, world.geometry, views, spec["thing"], PARTS)
        grids = spec["feature_sizes"]
        grid = spec["size"] // FACTOR
        for name, truth, view in warped_views(work, grids, model):
            figures = warp_figures(work, name, view)
            pair = labels[world.source.name], labels[name]
            work.add(name, figures | label_figures(work, truth, view, pair, grid))
        return NoExtra()


def _surface(
    work: Work, model: Gaussians | None, settings: WarpSettings, camera: Camera
) -> Surface:
    """Surface that a view shows: of the splats, or of the truth where there are none."""
    if model is not None:
        return render_surface(model, camera, settings)
    hits = work.world.geometry.trace(camera)
    return Surface(hits.depth, hits.normal)


def _mesh_figures(
    work: Work, model: Gaussians | None, settings: WarpSettings, cameras: Sequence[Camera]
) -> dict[str, float]:
    """Figures of the mesh that is fused of the depth in views, within the ball that the cameras
    stand on, against the true surface that some of them sees.
    """
    world, meter = work.world, work.meter
    center = np.asarray(world.scene.spec.cameras.look_at, dtype=np.float64)
    source = world.source
    reach = float(np.linalg.norm(source.position - center))
    voxel = VOXEL * reach / float(source.K[1, 1])

    def inside(points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(points - center, axis=-1) < reach)  # NaN is outside

    with meter.stage("fuse"):
        depths = []
        for camera in cameras:
            z = np.asarray(_surface(work, model, settings, camera).depth, dtype=np.float64)
            points = camera.unproject(camera.pixel_centers(), z)
            depths.append(np.where(inside(points), z, np.nan))
        fused = mesh.fused_mesh(depths, cameras, voxel=voxel)
        points, normals = mesh.mesh_points(fused, voxel / FINER)
        kept = inside(points)
    with meter.stage("truth"):
        finer = [camera.resize(FINER * camera.width, FINER * camera.height) for camera in cameras]
        hits = [world.geometry.trace(camera) for camera in finer]
        true = np.concatenate([hit.point[inside(hit.point)] for hit in hits])
        true_normals = np.concatenate([hit.normal[inside(hit.point)] for hit in hits])
        thin = mesh.thinned(true, voxel / FINER)
    with meter.stage("nearest"):
        return metrics.surface_error(
            points[kept],
            true[thin],
            threshold=THRESHOLD * reach,
            cut=CUT * reach,
            normal=normals[kept],
            true_normal=true_normals[thin],
        )


def _view_figures(
    work: Work, model: Gaussians | None, settings: WarpSettings, camera: Camera
) -> dict[str, float]:
    """Errors of depth, normals and picture in a view that no fit has seen."""
    world, meter, spec = work.world, work.meter, work.spec
    with meter.stage("truth"):
        hits = world.geometry.trace(camera)
        image = None if model is None else export.picture(world.scene, camera, spec["spp"])
    with meter.stage("held out"):
        surface = _surface(work, model, settings, camera)
        figures = metrics.depth_error(
            surface.depth, hits.depth, normal=surface.normal, true_normal=hits.normal
        )
        if image is not None:
            figures |= fitted.picture_error(np.asarray(surface.image), image)
    return figures
