"""A pair of views as PyVista meshes: surfaces, splats as discs, frusta with their pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp import Camera, Gaussians
from attnwarp.gaussians import SH_C0
from attnwarp_eval.inspect.cell import CellReport
from attnwarp_eval.inspect.pair import Image, Pair, Seen
from attnwarp_eval.inspect.pixel import PixelReport
from attnwarp_eval.inspect.subject import Subject

if TYPE_CHECKING:
    import pyvista

    from attnwarp_eval.truth import Geometry

Array = npt.NDArray[np.float64]

SEAM = 0.05
"""Neighbouring pixels whose depths differ by more than this fraction are not joined by a face."""

MOVING = 20_000
"""Number of faces above which a surface or discs are simplified while the view moves."""

DISC_SIDES = ((20_000, 10), (60_000, 6))
"""(splats, corners): up to ``splats`` splats, a disc is a polygon with ``corners`` corners; beyond,
a square. Software rendering draws 200,000 ten-sided discs in a second, squares in a third of it."""


def seen_surface(seen: Seen, colors: Image, seam: float = SEAM) -> pyvista.PolyData:
    """The surface seen by a view: one vertex per pixel, faces between neighbours of one surface.

    Args:
        colors: (H, W, 3) sRGB in [0, 1].
        seam: pixels whose depths differ by more than this fraction are not joined.

    Returns:
        A mesh whose points carry ``colors`` (uint8) and ``pixel`` (row-major index).
    """
    import pyvista

    height, width = seen.valid.shape
    valid = seen.valid.ravel()
    index = np.cumsum(valid) - 1
    depths, owners = _squares(seen.depth), _squares(seen.owner)
    joined = np.logical_and.reduce(_squares(seen.valid))
    joined &= np.maximum.reduce(depths) <= (1 + seam) * np.minimum.reduce(depths)
    joined &= np.logical_and.reduce([owner == owners[0] for owner in owners[1:]])
    corners = [grid[joined] for grid in _squares(index.reshape(height, width))]
    points = seen.point.reshape(-1, 3)[valid]
    mesh = pyvista.PolyData.from_regular_faces(points, np.stack(corners, axis=-1))
    mesh.point_data["colors"] = as_bytes(colors).reshape(-1, 3)[valid]
    mesh.point_data["pixel"] = np.flatnonzero(valid)
    return mesh


def coarser_surface(seen: Seen, surface: pyvista.PolyData, faces: int) -> pyvista.PolyData:
    """:func:`seen_surface` with about ``faces`` faces, from every k-th pixel of every k-th row of
    the full one, which has the colours.
    """
    colors = np.zeros((*seen.valid.shape, 3))
    colors.reshape(-1, 3)[surface.point_data["pixel"]] = surface.point_data["colors"] / 255
    step = math.ceil(math.sqrt(seen.valid.size / faces))
    every = (slice(step // 2, None, step),) * 2
    grids = {f.name: getattr(seen, f.name)[every] for f in fields(seen)}
    # Between these pixels the depth of a slope changes k times as much.
    return seen_surface(replace(seen, **grids), colors[every], seam=step * SEAM)


def _squares(grid: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
    """Four (H - 1, W - 1) values at the corners of each square of neighbours, going around."""
    return [grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]]


def true_surface(geometry: Geometry) -> pyvista.PolyData:
    """All surfaces of a scene, triangles and spheres."""
    import pyvista

    corners, _ = geometry.flat_patches()
    faces: npt.NDArray[Any] = np.arange(3 * len(corners)).reshape(-1, 3)
    flat = pyvista.PolyData.from_regular_faces(corners.reshape(-1, 3), faces)
    spheres = [
        pyvista.Sphere(radius=radius, center=center, theta_resolution=48, phi_resolution=48)
        for center, radius, _ in zip(*geometry.spheres(), strict=True)
    ]
    return flat.append_polydata(*spheres) if spheres else flat


def discs(gaussians: Gaussians) -> pyvista.PolyData:
    """Splats as filled ellipses of one sigma in their two widest axes, oriented as they are."""
    import pyvista

    scales = gaussians.scales.detach().double()
    axes = gaussians.rotations().detach().double()
    if scales.shape[1] == 3:
        widest = scales.argsort(dim=1, descending=True)[:, :2]
        scales = scales.gather(1, widest)
        axes = axes.gather(2, widest[:, None, :].expand(-1, 3, 2))
    spans = (axes[:, :, :2] * scales[:, None, :2]).numpy()
    count = len(spans)
    sides = disc_sides(count)
    means = gaussians.world_means()
    points = np.empty((count, sides, 3))
    for number, angle in enumerate(2 * np.pi * np.arange(sides) / sides):
        points[:, number] = means + spans @ [np.cos(angle), np.sin(angle)]
    faces: npt.NDArray[Any] = np.arange(count * sides).reshape(count, sides)
    mesh = pyvista.PolyData.from_regular_faces(points.reshape(-1, 3), faces)
    # Degree 0 of the harmonics is the colour without its dependence on the viewer.
    flat = 0.5 + SH_C0 * gaussians.sh.detach()[:, 0].double().numpy()
    mesh.cell_data["colors"] = as_bytes(flat.astype(np.float32))
    return mesh


def disc_points(mesh: pyvista.PolyData) -> pyvista.PolyData:
    """A coloured point on each disc of :func:`discs`."""
    import pyvista

    points = pyvista.PolyData(np.asarray(mesh.points)[:: mesh.n_points // mesh.n_cells])
    points.point_data["colors"] = mesh.cell_data["colors"]
    return points


def disc_sides(count: int) -> int:
    """Corners of each disc for a number of splats."""
    return next((sides for most, sides in DISC_SIDES if count <= most), 4)


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


def frustum_depth(subject: Subject, source: Camera) -> float:
    """Depth at which frusta are drawn: a quarter of the way from the source to the scene."""
    return 0.25 * float(np.linalg.norm(source.position - subject.center))


def picture_plane(corners: Array) -> pyvista.PolyData:
    """A rectangle with texture coordinates, from its corners as :func:`frustum` gives them."""
    import pyvista

    plane = pyvista.PolyData(corners, faces=[4, 0, 1, 2, 3])
    plane.active_texture_coordinates = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    return plane


def rays(pair: Pair, report: PixelReport | CellReport) -> dict[str, pyvista.PolyData]:
    """A picked pixel's or cell's ray, the line to the source, and the source's line of sight.

    A cell also has its taps: the source's surface points at the cells read.
    """
    import pyvista

    if not np.isfinite(report.point).all():
        return {}
    source, target = (camera.position for camera in pair.cameras)
    parts = {
        "target ray": pyvista.Line(target, report.point),
        "to the source": pyvista.Line(report.point, source),
        "point": pyvista.PolyData(report.point[None]),
    }
    if isinstance(report, PixelReport):
        if report.seen_instead is not None:
            parts["blocker"] = pyvista.PolyData(report.seen_instead[None])
        return parts
    read = [tap.point for tap in report.taps if tap.weight > 0 and np.isfinite(tap.point).all()]
    if read:
        parts["taps"] = pyvista.PolyData(np.array(read))
        ends = np.insert(np.array(read), 0, source, axis=0)
        lines = np.array([[2, 0, number + 1] for number in range(len(read))])
        parts["tap rays"] = pyvista.PolyData(ends, lines=lines.ravel())
    return parts


def cell_outlines(
    camera: Camera, size: tuple[int, int], cells: Sequence[tuple[int, int]], reach: float
) -> pyvista.PolyData:
    """The edges of feature cells (column, row) on a camera's picture plane.

    Args:
        camera: at image size.
        size: (h, w) of the grid.
        cells: at least one.
        reach: depth of the picture plane.
    """
    import pyvista

    resized = camera.resize(size[1], size[0])
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    corners = (np.array(cells, dtype=np.float64)[:, None] + square).reshape(-1, 2)
    points = resized.unproject(corners, np.full(len(corners), reach))
    lines = [
        [2, 4 * cell + k, 4 * cell + (k + 1) % 4] for cell in range(len(cells)) for k in range(4)
    ]
    return pyvista.PolyData(points, lines=np.array(lines).ravel())


def fly(cameras: tuple[Camera, Camera], center: Array, steps: int) -> list[tuple[Array, Array]]:
    """(position, rotation) of cameras on an arc from one camera to another.

    The distance to the centre and the direction are interpolated, and the axes turn evenly.

    Args:
        cameras: first and last.
        center: (3,) centre of the arc.
        steps: number of poses, both ends among them.
    """
    from scipy.spatial.transform import Rotation, Slerp

    share = np.linspace(0, 1, steps)
    offsets = np.array([camera.position - center for camera in cameras])
    lengths = np.linalg.norm(offsets, axis=1)
    units = offsets / np.maximum(lengths, 1e-12)[:, None]
    angle = np.arccos(np.clip(units[0] @ units[1], -1, 1))
    if np.sin(angle) > 1e-6:
        near, far = np.sin((1 - share) * angle), np.sin(share * angle)
        weights = np.stack([near, far], axis=1) / np.sin(angle)
    else:
        weights = np.stack([1 - share, share], axis=1)
    radii = (1 - share) * lengths[0] + share * lengths[1]
    positions = center + radii[:, None] * (weights @ units)
    turns = Slerp([0, 1], Rotation.from_matrix([camera.rotation for camera in cameras]))(share)
    return list(zip(positions, turns.as_matrix(), strict=True))


@dataclass(frozen=True, eq=False)
class Part:
    """Something in the 3D view.

    Attributes:
        name: name of the part; a part of the same name is replaced.
        key: inputs of the part; a part with an unchanged key is not redrawn.
        color: "#rrggbb", or None for the mesh's own ``colors``.
        picture: function that makes the (H, W, 3) sRGB texture, if any.
        opacity: in [0, 1].
        moving: function from the mesh to its simplified version while the view moves, if the
            mesh has more than :data:`MOVING` faces; None to keep the mesh.
    """

    name: str
    key: tuple[Any, ...]
    mesh: Callable[[], pyvista.PolyData]
    color: str | None = None
    picture: Callable[[], Image] | None = None
    opacity: float = 1.0
    moving: Callable[[pyvista.PolyData], pyvista.PolyData] | None = None


@dataclass(frozen=True)
class State:
    """State of the window.

    Attributes:
        coloring: one of the pair's colorings.
        layer: (h, w) of a feature grid; None for the image's pixels.
        step: step of the edit, "" without one.
        splats: whether splats are drawn as discs.
        surface: whether the whole true surface is drawn, translucent.
    """

    variant: str
    target: str
    coloring: str = "mask"
    layer: tuple[int, int] | None = None
    step: str = ""
    splats: bool = False
    surface: bool = False


def title(subject: Subject, pair: Pair, state: State) -> str:
    """Title of a state, in a line: scene, variant, views, grid, step and colours."""
    layer = "" if state.layer is None else f", grid {state.layer[1]} x {state.layer[0]}"
    step = f", {state.step}" if pair.edit is not None else ""
    return (
        f"{Path(subject.scene).name}, {state.variant}, {pair.cameras[0].name} ->"
        f" {state.target}{layer}{step}; colours: {state.coloring}"
    )


SOURCE_COLOR, TARGET_COLOR, BLOCKER_COLOR = "#1f4e9c", "#b35a00", "#e31a1c"
PICKED_COLORS = {
    "target ray": TARGET_COLOR,
    "to the source": SOURCE_COLOR,
    "point": "#000000",
    "blocker": BLOCKER_COLOR,
    "taps": "#1f4e9c",
    "tap rays": "#7a9fd4",
}


def parts(
    subject: Subject, pair: Pair, state: State, picked: PixelReport | CellReport | None
) -> list[Part]:
    """Everything in the 3D view, in the order of drawing."""
    source, target = pair.cameras
    reach = frustum_depth(subject, source)

    result = [
        *_camera("source", source, reach, SOURCE_COLOR, lambda: pair.images[0]),
        *_camera(
            "target",
            target,
            reach,
            TARGET_COLOR,
            lambda: pair.picture(state.step),
            () if pair.edit is None else (state.variant, state.target, state.step),
        ),
        Part(
            "seen",
            (state.variant, state.target, state.coloring, state.layer, state.step),
            lambda: seen_surface(
                pair.seen, pair.colors(state.coloring, state.layer, state.step or None)
            ),
            moving=lambda mesh: coarser_surface(pair.seen, mesh, MOVING),
        ),
    ]
    if state.splats and pair.model is not None:
        result.append(
            Part(
                "discs",
                (id(pair.model), state.step),
                lambda: discs(pair.splats(state.step)),
                moving=disc_points,
            )
        )
    if state.surface and pair.world is not None:
        geometry = pair.world.geometry
        result.append(
            Part("whole surface", (), lambda: true_surface(geometry), "#c8c8c8", opacity=0.35)
        )
    if picked is None:
        return result
    key = (state.variant, state.target, picked.column, picked.row, state.layer)
    for name, mesh in rays(pair, picked).items():
        result.append(Part(name, key, _ready(mesh), PICKED_COLORS[name]))
    if isinstance(picked, CellReport):
        layer = pair.layer(picked.size).correspondence
        grids = {
            "cell": (target, picked.size, [(picked.column, picked.row)], TARGET_COLOR),
            "tap cells": (
                source,
                (layer.source.height, layer.source.width),
                [(tap.column, tap.row) for tap in picked.taps if tap.weight > 0],
                SOURCE_COLOR,
            ),
        }
        for name, (camera, size, cells, color) in grids.items():
            if cells:
                outline = cell_outlines(camera, size, cells, 0.99 * reach)
                result.append(Part(name, key, _ready(outline), color))
    return result


def _ready(mesh: pyvista.PolyData) -> Callable[[], pyvista.PolyData]:
    return lambda: mesh


def _camera(
    name: str,
    camera: Camera,
    reach: float,
    color: str,
    picture: Callable[[], Image],
    key: tuple[str, ...] = (),
) -> list[Part]:
    edges, corners = frustum(camera, reach)
    return [
        Part(f"{name} frustum", (camera.name,), lambda: edges, color),
        Part(
            f"{name} picture",
            (camera.name, *key),
            lambda: picture_plane(corners),
            picture=picture,
            opacity=0.9,
        ),
    ]


def as_bytes(colors: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """sRGB in [0, 1] as bytes."""
    return np.clip(np.rint(np.nan_to_num(colors) * 255), 0, 255).astype(np.uint8)
