"""A pair of views as PyVista meshes: surfaces, splats as discs, frusta with their pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from attnwarp import Camera, Gaussians
from attnwarp_eval.inspect.pair import Image, Pair
from attnwarp_eval.inspect.pixel import PixelReport
from attnwarp_eval.truth import Geometry
from attnwarp_eval.twoview import Hits

if TYPE_CHECKING:
    import pyvista

Array = npt.NDArray[np.float64]

SEAM = 0.05
"""Neighbouring pixels whose depths differ by more than this fraction are not joined by a face."""

DISC_SIDES = 10
"""Corners of the polygon that stands for a splat, drawn at one sigma."""


def seen_surface(hits: Hits, colors: Image) -> pyvista.PolyData:
    """The surface that a view sees: a vertex a pixel, faces between neighbours of one surface.

    Args:
        hits: of the view, H x W.
        colors: (H, W, 3) sRGB in [0, 1].

    Returns:
        A mesh whose points carry ``colors`` (uint8) and ``pixel`` (row-major index).
    """
    import pyvista

    height, width = hits.valid.shape
    index = np.full(height * width, -1)
    valid = hits.valid.ravel()
    index[valid] = np.arange(valid.sum())
    grid = index.reshape(height, width)
    corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=-1)
    depth = hits.depth
    around = np.stack([depth[:-1, :-1], depth[:-1, 1:], depth[1:, 1:], depth[1:, :-1]], axis=-1)
    owner = hits.object_id
    owners = np.stack([owner[:-1, :-1], owner[:-1, 1:], owner[1:, 1:], owner[1:, :-1]], axis=-1)
    with np.errstate(invalid="ignore"):
        joined = (corners >= 0).all(-1) & (around.max(-1) <= (1 + SEAM) * around.min(-1))
    joined &= (owners == owners[..., :1]).all(-1)
    faces = np.insert(corners[joined], 0, 4, axis=1)
    mesh = pyvista.PolyData(hits.point.reshape(-1, 3)[valid], faces=faces.ravel())
    mesh.point_data["colors"] = as_bytes(colors).reshape(-1, 3)[valid]
    mesh.point_data["pixel"] = np.flatnonzero(valid)
    return mesh


def true_surface(geometry: Geometry) -> pyvista.PolyData:
    """All surfaces of a scene, triangles and spheres."""
    import pyvista

    corners, _ = geometry.flat_patches()
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    mesh = pyvista.PolyData(corners.reshape(-1, 3), faces=np.insert(faces, 0, 3, axis=1).ravel())
    for center, radius, _ in zip(*geometry.spheres(), strict=True):
        mesh = mesh.append_polydata(
            pyvista.Sphere(radius=radius, center=center, theta_resolution=48, phi_resolution=48)
        )
    return mesh


def discs(gaussians: Gaussians) -> pyvista.PolyData:
    """Splats as filled ellipses of one sigma in their two widest axes, oriented as they are."""
    import pyvista

    from attnwarp.render.reference import rotation_matrices

    scales = gaussians.scales.detach().double()
    axes = rotation_matrices(gaussians.quats.detach().double())
    if scales.shape[1] == 3:
        widest = scales.argsort(dim=1, descending=True)[:, :2]
        scales = scales.gather(1, widest)
        axes = axes.gather(2, widest[:, None, :].expand(-1, 3, 2))
    spans = (axes[:, :, :2] * scales[:, None, :2]).numpy()
    angle = 2 * np.pi * np.arange(DISC_SIDES) / DISC_SIDES
    circle = np.stack([np.cos(angle), np.sin(angle)])
    points = gaussians.world_means()[:, None] + np.swapaxes(spans @ circle, 1, 2)
    count = len(points)
    faces = np.arange(count * DISC_SIDES).reshape(count, DISC_SIDES)
    mesh = pyvista.PolyData(
        points.reshape(-1, 3), faces=np.insert(faces, 0, DISC_SIDES, axis=1).ravel()
    )
    # Degree 0 of the harmonics is the colour without its dependence on the viewer.
    flat = 0.5 + 0.28209479177387814 * gaussians.sh.detach()[:, 0].double().numpy()
    mesh.cell_data["colors"] = as_bytes(flat.astype(np.float32))
    return mesh


def frustum(camera: Camera, reach: float) -> tuple[pyvista.PolyData, Array]:
    """Edges of a camera's frustum, and the (4, 3) corners of its picture at depth ``reach``.

    The corners go around from the picture's upper left: (0, 0), (W, 0), (W, H), (0, H).
    """
    import pyvista

    width, height = camera.width, camera.height
    pixels = np.array([[0.0, 0], [width, 0], [width, height], [0, height]])
    corners = camera.position + reach * (camera.directions(pixels) @ camera.rotation)
    points = np.vstack([camera.position, corners])
    lines = [[2, 0, k] for k in range(1, 5)] + [[2, k, k % 4 + 1] for k in range(1, 5)]
    return pyvista.PolyData(points, lines=np.array(lines).ravel()), corners


def picture_plane(corners: Array) -> pyvista.PolyData:
    """A rectangle with texture coordinates, from its corners as :func:`frustum` gives them."""
    import pyvista

    plane = pyvista.PolyData(corners, faces=[4, 0, 1, 2, 3])
    plane.active_texture_coordinates = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    return plane


def rays(pair: Pair, report: PixelReport) -> dict[str, pyvista.PolyData]:
    """A picked pixel's ray, its way to the source, and what the source really sees."""
    import pyvista

    if not np.isfinite(report.point).all():
        return {}
    source, target = pair.world.source.position, pair.world.targets[pair.target].position
    parts = {
        "target ray": pyvista.Line(target, report.point),
        "to the source": pyvista.Line(report.point, source),
        "point": pyvista.PolyData(report.point[None]),
    }
    if report.blocked_by:
        parts["blocker"] = pyvista.PolyData(report.blocker[None])
    return parts


def as_bytes(colors: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """sRGB in [0, 1] as bytes."""
    return np.clip(np.rint(np.nan_to_num(colors) * 255), 0, 255).astype(np.uint8)
