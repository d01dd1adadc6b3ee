"""Exact correspondences of two views: each target pixel's source position and visibility."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval.truth.raycast import Geometry, RayHits
from attnwarp_eval.two_view import AMBIGUOUS, HIDDEN, NONE, VISIBLE, TwoView

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

GRAZING_COSINE = 1e-3
"""Below this cosine of incidence, in either view, a pixel counts as ambiguous."""

EDGE_BAND = 2.0
"""Width in pixels, on each side, of the band around depth and object edges."""


def two_view(
    geometry: Geometry,
    source: Camera,
    target: Camera,
    *,
    bands: tuple[Mask, Mask] | None = None,
) -> TwoView:
    """Exact correspondence and visibility of every target pixel in the source view.

    No step uses an absolute length: scaling or moving the scene together with its cameras gives the
    same labels.

    Args:
        source, target: the cameras. The result has the target's (H, W).
        bands: :func:`edge_band` of the source and of the target, if already computed.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> from attnwarp_eval.truth import Geometry, two_view
        >>> scene = load_scene("spheres").with_size(16, 16)
        >>> pair = two_view(Geometry(scene), scene.source, scene.source)  # a view and itself
        >>> bool(np.nanmax(np.abs(pair.xy - scene.source.pixel_centers())) < 1e-9)
        True
    """
    hits = geometry.trace(target)
    points = hits.point.reshape(-1, 3)
    xy, z, inside = _project(source, points)
    status, cosine = _status(
        geometry,
        points,
        hits.normal.reshape(-1, 3),
        hits.primitive_id.ravel(),
        hits.valid.ravel(),
        inside,
        source,
    )
    shape = (target.height, target.width)
    status = status.reshape(shape)

    same = as_corners(status, _corner_status(geometry, source, target))
    with np.errstate(invalid="ignore"):
        grazing = (hits.cosine < GRAZING_COSINE) | (cosine.reshape(shape) < GRAZING_COSINE)
    label = np.where(status >= _OUTSIDE, NONE, status).astype(np.uint8)
    label[hits.valid & (~same | (grazing & (status != _OUTSIDE)))] = AMBIGUOUS

    source_edge, target_edge = bands or (edge_band(geometry, c) for c in (source, target))
    edge = target_edge.copy()
    inside = inside.reshape(shape)
    xy = xy.reshape(*shape, 2)
    column, row = (np.floor(xy[inside]).astype(np.int64)).T
    edge[inside] |= source_edge[
        np.clip(row, 0, source.height - 1), np.clip(column, 0, source.width - 1)
    ]
    return TwoView(source, target, hits, xy, z.reshape(shape), inside, label, edge)


_OUTSIDE, _EMPTY = (
    4,
    5,
)  # statuses that become NONE; distinct in comparisons of footprints


def _project(source: Camera, points: Array) -> tuple[Array, Array, Mask]:
    with np.errstate(invalid="ignore"):
        xy, z = source.project(points)
        inside = (
            (z > 0) & (xy >= 0).all(-1) & (xy[:, 0] <= source.width) & (xy[:, 1] <= source.height)
        )
    return xy, z, inside


def _status(
    geometry: Geometry,
    points: Array,
    normals: Array,
    primitive: npt.NDArray[np.int64],
    valid: Mask,
    inside: Mask,
    source: Camera,
) -> tuple[npt.NDArray[np.uint8], Array]:
    """(N,) status and (N,) cosine of incidence at the source (of either side; NaN outside its
    image).
    """
    status = np.full(len(points), _EMPTY, dtype=np.uint8)
    status[valid] = _OUTSIDE
    ask = np.flatnonzero(inside)
    seen = geometry.visible_from(points[ask], normals[ask], primitive[ask], source)
    status[ask] = np.where(seen, VISIBLE, HIDDEN)
    cosine = np.full(len(points), np.nan)
    to_source = source.position - points[ask]
    cosine[ask] = np.abs(np.einsum("ij,ij->i", normals[ask], to_source)) / np.linalg.norm(
        to_source, axis=-1
    )
    return status, cosine


def corner_hits(geometry: Geometry, camera: Camera) -> RayHits:
    """First hits at the (H + 1)(W + 1) corners of a camera's pixels, row by row."""
    grid = np.stack(
        np.meshgrid(np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)), axis=-1
    )
    directions = (camera.directions(grid) @ camera.rotation).reshape(-1, 3)
    return geometry.trace_rays(camera.position, directions)


def as_corners(center: npt.NDArray[Any], corner: npt.NDArray[Any]) -> Mask:
    """(H, W) bool: pixels whose four corners have the value of their centre.

    Args:
        center: (H, W).
        corner: (H + 1, W + 1).
    """
    h, w = center.shape
    same = np.ones((h, w), dtype=bool)
    for dy in (0, 1):
        for dx in (0, 1):
            same &= corner[dy : dy + h, dx : dx + w] == center
    return same


def _corner_status(geometry: Geometry, source: Camera, target: Camera) -> npt.NDArray[np.uint8]:
    """(H + 1, W + 1) status at the corners of the target's pixels."""
    hits = corner_hits(geometry, target)
    _, _, inside = _project(source, hits.point)
    status, _ = _status(
        geometry, hits.point, hits.normal, hits.primitive_id, hits.valid, inside, source
    )
    return status.reshape(target.height + 1, target.width + 1)


def edges(geometry: Geometry, camera: Camera) -> Mask:
    """(H, W) bool: pixels next to a depth or object edge.

    Two neighbours (left and right, above and below) have an edge between them if

    - they show different objects,
    - only one of them shows an object, or
    - neither tangent plane comes within one pixel's footprint (z / f) of the other's depth. So a
      slanted floor is no edge.
    """
    hits = geometry.trace(camera)
    directions = camera.directions() @ camera.rotation
    # Depth along any ray d of the plane through p with normal n: n.(p - eye) / n.d
    reach = np.einsum("hwi,hwi->hw", hits.normal, hits.point - camera.position)
    footprint = 1.0 / min(camera.K[0, 0], camera.K[1, 1])
    edge = np.zeros(hits.valid.shape, dtype=bool)
    for axis in (0, 1):
        a = (slice(None), slice(None, -1)) if axis else (slice(None, -1), slice(None))
        b = (slice(None), slice(1, None)) if axis else (slice(1, None), slice(None))
        with np.errstate(divide="ignore", invalid="ignore"):
            errors = [
                np.abs(
                    reach[p] / np.einsum("hwi,hwi->hw", hits.normal[p], directions[q])
                    - hits.depth[q]
                )
                for p, q in ((a, b), (b, a))
            ]
            tolerance = footprint * np.fmin(hits.depth[a], hits.depth[b])
            jump = ~((errors[0] <= tolerance) | (errors[1] <= tolerance))
        parted = (hits.object_id[a] != hits.object_id[b]) | (jump & hits.valid[a] & hits.valid[b])
        edge[a] |= parted
        edge[b] |= parted
    return edge


def edge_band(geometry: Geometry, camera: Camera, width: float = EDGE_BAND) -> Mask:
    """(H, W) bool: pixels within ``width`` pixels of an edge (see :func:`edges`), adjacent pixels
    included.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> from attnwarp_eval.truth import Geometry, edge_band
        >>> scene = load_scene("spheres").with_size(32, 32)
        >>> geometry = Geometry(scene)
        >>> thin, wide = (edge_band(geometry, scene.source, width) for width in (1, 3))
        >>> bool((wide >= thin).all()), bool(thin.sum() < wide.sum())
        (True, True)
    """
    from scipy.ndimage import distance_transform_edt

    edge = edges(geometry, camera)
    if not edge.any():
        return edge
    # The pixels next to an edge are half a pixel from it, so the band reaches width - 1 px beyond
    # them, rounded up.
    return distance_transform_edt(~edge) <= np.ceil(width) - 1
