"""Splats fitted to a scene's true pictures, and their errors against exact truth."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval import metrics
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.splats.export import first_points, held_out, orbit, picture
from attnwarp_eval.truth import Geometry

if TYPE_CHECKING:
    from attnwarp.fit import Fit, FitSettings
    from attnwarp.gaussians import Gaussians
    from attnwarp_eval.two_view import Hits


def fit_scene(
    scene: Scene,
    settings: FitSettings,
    folder: str | os.PathLike[str],
    *,
    views: int = 64,
    spp: int = 16,
    points: int = 5000,
    noise: float = 0.5,
    seed: int = 0,
    geometry: Geometry | None = None,
    report: Reporter = SILENT,
) -> Fit:
    """Fit splats to a scene's true pictures; the curve of the fit has the errors of depth and
    normals in it.

    Both kinds begin with the same points. The errors of the curve are means over the held-out views
    of ``depth.abs_rel`` and ``depth.normal_median`` of the median depth, by intersection for 2D
    splats and at the ray's peak for 3D ones.

    Args:
        scene: scene at the image size of the fit.
        folder: path of the fit's files; an interrupted fit there is resumed.
        views, spp, points, noise, seed: as for :func:`attnwarp_eval.splats.export.export`.
        geometry: ``Geometry(scene)``, if already available.
        report: as in :func:`attnwarp.fit.fit`.

    Example:
        >>> from attnwarp.fit import FitSettings
        >>> from attnwarp_eval.scene.file import load_scene
        >>> scene = load_scene("opposed").with_size(16, 16)
        >>> settings = FitSettings(kind="2d", iterations=2, sh_degree=0)
        >>> fitted = fit_scene(scene, settings, "fit", views=9, spp=1, points=50)
        >>> fitted.gaussians.kind
        '2d'
    """
    from attnwarp.fit import Views, fit, from_points

    geometry = Geometry(scene) if geometry is None else geometry
    cloud = first_points(scene, points, noise=noise, seed=seed, geometry=geometry)
    start = from_points(
        cloud.points, cloud.colors, kind=settings.kind, sh_degree=settings.sh_degree, seed=seed
    )
    cameras = orbit(scene, views)
    images = [picture(scene, camera, spp) for camera in cameras]
    out = held_out(views)
    parts = [
        Views(
            [c for c, o in zip(cameras, out, strict=True) if o == side],
            [i for i, o in zip(images, out, strict=True) if o == side],
        )
        for side in (False, True)
    ]
    truth = [geometry.trace(camera) for camera in parts[1].cameras]

    def errors(splats: Gaussians) -> dict[str, float]:
        figures = [
            rendered_error(splats, camera, hits)
            for camera, hits in zip(parts[1].cameras, truth, strict=True)
        ]
        return {
            name: float(np.mean([each[name] for each in figures]))
            for name in ("depth.abs_rel", "depth.normal_median")
        }

    return fit(
        start, parts[0], settings, held_out=parts[1], folder=folder, measure=errors, report=report
    )


def rendered_error(splats: Gaussians, camera: Camera, truth: Hits) -> dict[str, float]:
    """Errors of the median depth and of the normals that splats have in a view.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> from attnwarp_eval.splats.surface import surface_splats
        >>> from attnwarp_eval.truth import Geometry
        >>> scene = load_scene("spheres").with_size(16, 16)
        >>> truth = Geometry(scene).trace(scene.source)
        >>> error = rendered_error(surface_splats(scene, count=2000), scene.source, truth)
        >>> error["depth.abs_rel"] < 0.2
        True
    """
    from attnwarp.warp import WarpSettings, render_surface

    surface = render_surface(splats, camera, WarpSettings(depth_statistic="median"))
    return metrics.depth_error(
        surface.depth, truth.depth, normal=surface.normal, true_normal=truth.normal
    )


def picture_error(image: npt.NDArray[Any], true_image: npt.NDArray[np.uint8]) -> dict[str, float]:
    """``fit.psnr``, ``fit.mse`` and ``fit.ssim`` of a (H, W, 3) sRGB picture in [0, 1] against its
    8-bit truth.

    SSIM is NaN below 11 x 11 px.

    Example:
        >>> black = np.zeros((16, 16, 3))
        >>> error = picture_error(black + 0.1, black.astype(np.uint8))
        >>> round(error["fit.mse"], 9), round(error["fit.psnr"], 9)
        (0.01, 20.0)
    """
    estimate = np.clip(np.asarray(image, dtype=np.float64), 0, 1)
    truth = true_image.astype(np.float64) / 255
    return {
        "fit.psnr": metrics.psnr(estimate, truth),
        "fit.mse": metrics.mse(estimate, truth),
        "fit.ssim": metrics.ssim(estimate, truth),
    }
