"""Signed-distance bodies: their parts, distance and mesh.

A body's mesh, not its distance function, is the ground truth.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numba
import numpy as np
import numpy.typing as npt

from attnwarp.numba_cache import CACHE
from attnwarp_eval.cache import content_key, read_arrays, write_arrays
from attnwarp_eval.scene.shapes import Mesh, MeshNotice
from attnwarp_eval.scene.textures import fractal_noise

Array = npt.NDArray[np.float64]
Point = tuple[float, float, float]

MESHING_PROTOCOL = 2
"""Version, in every cache key; raised when a body's description gives other vertices."""

MOST_POINTS = 10**9
"""Points of a lattice, 8 GB; a cube at the highest resolution has 140 million."""

BLOCK = 8
"""Lattice points along the side of the blocks that are sampled, or left out, together."""


@dataclass(frozen=True)
class _Part:
    """Fields that every part of a body has.

    Attributes:
        color: linear RGB.
        blend: True to join it to the parts before it with the body's width, False for a sharp
            joint, or a width.
        carve: whether it is subtracted from the blended parts before it.
    """

    color: tuple[float, float, float] = field(default=(1.0, 1.0, 1.0), kw_only=True)
    blend: bool | float = field(default=True, kw_only=True)
    carve: bool = field(default=False, kw_only=True)


@dataclass(frozen=True)
class Capsule(_Part):
    """A rod from ``start`` to ``end`` whose radius goes from ``radii[0]`` to ``radii[1]``."""

    start: Point
    end: Point
    radii: tuple[float, float]


@dataclass(frozen=True)
class _Turned(_Part):
    """A part with local axes: rolled about x, pitched about y, then turned about z."""

    center: Point
    pitch: float = field(default=0.0, kw_only=True)
    yaw: float = field(default=0.0, kw_only=True)
    roll: float = field(default=0.0, kw_only=True)


@dataclass(frozen=True)
class Ellipsoid(_Turned):
    """An ellipsoid with its ``radii`` along its local x, y, z."""

    radii: tuple[float, float, float]


@dataclass(frozen=True)
class Torus(_Turned):
    """A ring of radius ``radii[0]``, ``radii[1]`` thick, about its local z."""

    radii: tuple[float, float]


@dataclass(frozen=True)
class Block(_Turned):
    """A box of ``size`` along its local x, y, z with edges rounded by ``round``."""

    size: tuple[float, float, float]
    round: float = 0.0


@dataclass(frozen=True)
class Disc(_Turned):
    """A cylinder of ``radius`` and ``height`` along its local z, edges rounded by ``round``."""

    radius: float
    height: float
    round: float = 0.0


Part = Ellipsoid | Capsule | Torus | Block | Disc


def _measured(part: Part) -> tuple[float, list[Point], float, list[float]]:
    """Kind of a part, its skeleton points, its largest distance from them, its shape."""
    match part:
        case Capsule(start=start, end=end, radii=ends):
            return 1.0, [start, end], max(ends), [*start, *end, *ends]
        case Ellipsoid(radii=radii):
            kind, far, sizes, edge = 0.0, max(radii), radii, 0.0
        case Torus(radii=(ring, rod)):
            kind, far, sizes, edge = 2.0, ring + rod, (ring, rod, 0.0), 0.0
        case Block(size=(x, y, z), round=edge):
            kind, far = 3.0, float(np.linalg.norm(part.size)) / 2
            sizes = (x / 2 - edge, y / 2 - edge, z / 2 - edge)
        case Disc(radius=radius, height=height, round=edge):
            kind, far = 4.0, math.hypot(radius, height / 2)
            sizes = (radius - edge, height / 2 - edge, 0.0)
    angles = np.radians([part.pitch, part.yaw, part.roll])
    turn = [float(f(a)) for a in angles for f in (np.cos, np.sin)]
    return kind, [part.center], far, [*part.center, *sizes, *turn, edge]


def reach(part: Part) -> Array:
    """(2, 3) bounding box of a part."""
    _, points, far, _ = _measured(part)
    return np.stack([np.min(points, 0) - far, np.max(points, 0) + far])


def _row(part: Part) -> list[float]:
    """Row for kernels: kind, mode (sharp, blended, carved), width (-1: the body's), shape."""
    kind, _, _, shape = _measured(part)
    mode = 2.0 if part.carve else float(bool(part.blend))
    width = -1.0 if isinstance(part.blend, bool) else float(part.blend)
    return [kind, mode, width, *shape, *[0.0] * (13 - len(shape))]


@dataclass(frozen=True)
class Relief:
    """Noise that moves a body's surface out and in by up to ``depth``, with features of
    ``size``."""

    depth: float
    size: float
    octaves: int = 3
    seed: int = 0


@numba.njit(cache=CACHE, nogil=True)
def _part_distance(x: float, y: float, z: float, part: Array) -> float:
    x, y, z = x - part[3], y - part[4], z - part[5]
    if part[0] == 1.0:
        # Capsule: distance from the segment, less the radius there.
        bx, by, bz = part[6] - part[3], part[7] - part[4], part[8] - part[5]
        length = bx * bx + by * by + bz * bz
        along = min(max((x * bx + y * by + z * bz) / length, 0.0), 1.0) if length > 0 else 0.0
        gap = math.sqrt((x - along * bx) ** 2 + (y - along * by) ** 2 + (z - along * bz) ** 2)
        return gap - (part[9] + along * (part[10] - part[9]))
    # Into the part's local axes: inverse yaw, pitch and roll.
    x, y = part[11] * x + part[12] * y, part[11] * y - part[12] * x
    x, z = part[9] * x - part[10] * z, part[10] * x + part[9] * z
    y, z = part[13] * y + part[14] * z, part[13] * z - part[14] * y
    if part[0] == 0.0:
        # Ellipsoid: |q|(|q| - 1) / |q / r| with q = p / r, a bound of the distance (Quilez,
        # "ellipsoid - distance").
        qx, qy, qz = x / part[6], y / part[7], z / part[8]
        k0 = math.sqrt(qx * qx + qy * qy + qz * qz)
        k1 = math.sqrt((qx / part[6]) ** 2 + (qy / part[7]) ** 2 + (qz / part[8]) ** 2)
        return k0 * (k0 - 1) / k1 if k1 > 0 else -min(part[6], part[7], part[8])
    if part[0] == 2.0:
        return math.sqrt((math.sqrt(x * x + y * y) - part[6]) ** 2 + z * z) - part[7]
    if part[0] == 3.0:
        dx, dy, dz = abs(x) - part[6], abs(y) - part[7], abs(z) - part[8]
        out = math.sqrt(max(dx, 0.0) ** 2 + max(dy, 0.0) ** 2 + max(dz, 0.0) ** 2)
        return out + min(max(dx, dy, dz), 0.0) - part[15]
    dr, dz = math.sqrt(x * x + y * y) - part[6], abs(z) - part[7]
    return math.sqrt(max(dr, 0.0) ** 2 + max(dz, 0.0) ** 2) + min(max(dr, dz), 0.0) - part[15]


@numba.njit(cache=CACHE, nogil=True)
def _body_distance(points: Array, parts: Array, blend: float) -> Array:
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        soft, hard = np.inf, np.inf
        for k in range(parts.shape[0]):
            d = _part_distance(points[i, 0], points[i, 1], points[i, 2], parts[k])
            width = blend if parts[k, 2] < 0 else parts[k, 2]
            if parts[k, 1] == 0.0:
                hard = min(hard, d)
            elif parts[k, 1] == 2.0:
                # Carving is the smooth maximum with the negated part.
                if width > 0 and soft < np.inf:
                    h = min(max(0.5 + 0.5 * (-soft - d) / width, 0.0), 1.0)
                    soft = -(-soft + h * (d + soft) - width * h * (1 - h))
                else:
                    soft = max(soft, -d)
            elif width > 0 and soft < np.inf:
                h = min(max(0.5 + 0.5 * (soft - d) / width, 0.0), 1.0)
                soft = soft + h * (d - soft) - width * h * (1 - h)
            else:
                soft = min(soft, d)
        out[i] = min(soft, hard)
    return out


@numba.njit(cache=CACHE, nogil=True)
def _part_distances(points: Array, parts: Array) -> Array:
    out = np.empty((parts.shape[0], points.shape[0]))
    for k in range(parts.shape[0]):
        for i in range(points.shape[0]):
            out[k, i] = _part_distance(points[i, 0], points[i, 1], points[i, 2], parts[k])
    return out


def _table(parts: Sequence[Part]) -> Array:
    if not parts:
        raise ValueError("parts: got an empty list, expected at least one part")
    return np.array([_row(part) for part in parts], dtype=np.float64)


def body_distance(
    parts: Sequence[Part], blend: float, points: npt.ArrayLike, relief: Relief | None = None
) -> Array:
    """Signed distance bound of a body, negative inside.

    Parts with ``blend`` are joined by Quilez' polynomial smooth minimum of width ``blend`` or their
    part's width; others (eyes, a nose) are joined sharply. A carving part is subtracted from the
    blended ones before it.

    Args:
        parts: at least one.
        blend: width of the joints in scene units, 0 for sharp ones.
        points: (N, 3).
        relief: noise added to the distance.

    Returns:
        (N,) float64.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    distance = _body_distance(points, _table(parts), float(blend))
    if relief is not None:
        near = np.flatnonzero(np.abs(distance) < 4 * relief.depth)
        noise = fractal_noise(points[near] / relief.size, relief.octaves, relief.seed)
        distance[near] += relief.depth * (1 - 2 * noise)
    return distance


def _part_colors(parts: Sequence[Part], width: float, points: Array) -> Array:
    distances = _part_distances(points, _table(parts))
    # A sharp part colours its whole surface; blended parts share their colours across the joint.
    solid = [not part.carve for part in parts]
    nearest = distances[solid].min(0)
    weights = np.exp(-np.clip(distances - nearest, 0, None) / max(width, 1e-12))
    for k, part in enumerate(parts):
        if part.carve:
            weights[k] = 0
        # A cut without a colour shows the colour of the part that was cut.
        if not part.blend or (part.carve and part.color != (1.0, 1.0, 1.0)):
            inside = (np.abs(distances[k]) if part.carve else distances[k]) < 1e-3 * width + 1e-9
            weights[:, inside] = 0
            weights[k, inside] = 1
    colors = np.array([part.color for part in parts])
    return (weights.T @ colors) / weights.sum(0)[:, None]


def mesh_body(
    parts: Sequence[Part], blend: float, resolution: int, relief: Relief | None = None
) -> Mesh:
    """The body's surface as triangles: marching cubes, then Newton steps onto the zero of the
    distance.

    Args:
        parts, blend, relief: as for :func:`body_distance`.
        resolution: cells along the longest side of the bounding box.

    Returns:
        A mesh facing outward with vertex normals and the parts' colours as tint. It is cached by
        content.

    Raises:
        ValueError: the parts are too thin for the resolution, or blend or relief so wide compared
            with the parts that the lattice would not fit into memory.
    """
    # repr of frozen dataclasses of floats is exact and readable, hence a good key. Colours are left
    # out: a body in other colours has the same mesh.
    bare = [replace(part, color=(1.0, 1.0, 1.0)) for part in parts]
    key = content_key(
        "body", MESHING_PROTOCOL, [repr(part) for part in bare], blend, resolution, repr(relief)
    )
    stored = read_arrays("meshes", key)
    if stored is None:
        stored = _march(parts, blend, resolution, relief)
        write_arrays("meshes", key, stored)
    step = _lattice_of(parts, resolution)[2]
    tint = _part_colors(parts, max(blend, step) / 3, stored["vertices"])
    return Mesh(stored["vertices"], stored["faces"], stored["normals"], tint)


def _lattice_of(parts: Sequence[Part], resolution: int) -> tuple[Array, Array, float]:
    boxes = np.stack([reach(part) for part in parts if not part.carve])
    low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
    return low, high, float((high - low).max() / resolution)


def _march(
    parts: Sequence[Part], blend: float, resolution: int, relief: Relief | None
) -> dict[str, npt.NDArray]:
    from skimage.measure import marching_cubes

    low, high, step = _lattice_of(parts, resolution)
    depth = relief.depth if relief else 0.0
    low, high = low - 2 * step - blend / 4 - depth, high + 2 * step + blend / 4 + depth

    def distance(points: Array) -> Array:
        return body_distance(parts, blend, points, relief)

    sides = np.ceil((high - low) / step) + 1
    if sides.prod() > MOST_POINTS:
        raise ValueError(
            f"body: blend {blend:g} and relief {depth:g} deep about parts {step * resolution:.3g}"
            f" wide make {sides.prod():.2g} lattice points, more than {MOST_POINTS:,}; make blend"
            " and relief smaller, or lower the resolution"
        )
    counts = sides.astype(int)
    axes = [low[k] + step * np.arange(counts[k]) for k in range(3)]
    volume = _sample(axes, distance, depth)
    if volume.min() >= 0:
        raise ValueError(
            f"body: no part is thick enough to be seen at resolution {resolution}; raise it"
        )
    vertices, faces, _, _ = marching_cubes(
        volume, 0.0, spacing=(step,) * 3, gradient_direction="ascent"
    )
    vertices = vertices.astype(np.float64) + low

    def gradient(points: Array) -> Array:
        e = 1e-4 * step
        shifts = np.eye(3) * e
        return np.stack(
            [(distance(points + s) - distance(points - s)) / (2 * e) for s in shifts], axis=-1
        )

    for _ in range(2):
        g = gradient(vertices)
        move = distance(vertices) / np.maximum((g**2).sum(-1), 1e-12)
        # Half a cell at most, so that creases, where the gradient jumps, cannot fold the mesh.
        vertices = vertices - g * np.clip(move, -0.5 * step, 0.5 * step)[:, None]
    normals = gradient(vertices)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    mesh = Mesh(vertices, faces[:, ::-1].astype(np.int64))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), normals[mesh.faces[:, 0]])
    if np.median(outward) < 0:
        mesh = replace(mesh, faces=mesh.faces[:, ::-1].copy())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MeshNotice)  # marching cubes makes slivers by design
        mesh = mesh.cleaned("body")
    return {
        "vertices": mesh.vertices,
        "faces": np.ascontiguousarray(mesh.faces),
        "normals": normals,
    }


def _sample(axes: list[Array], distance: Callable[[Array], Array], depth: float) -> Array:
    """The distance at every point of a lattice near its zero; farther off, the right sign.

    Blocks whose middle is farther from the surface than their radius, with half as much margin
    since the distance is only a bound, take the middle's value: no triangle comes from them.
    """
    step = float(axes[0][1] - axes[0][0])
    volume = np.empty([len(axis) for axis in axes])
    starts = [np.arange(0, len(axis), BLOCK) for axis in axes]
    middles = np.meshgrid(
        *(axis[0] + step * (s + (BLOCK - 1) / 2) for axis, s in zip(axes, starts, strict=True)),
        indexing="ij",
    )
    coarse = distance(np.stack(middles, -1).reshape(-1, 3)).reshape(middles[0].shape)
    reach = 1.5 * step * BLOCK * math.sqrt(3) / 2 + depth
    for i, x0 in enumerate(starts[0]):
        xs = slice(x0, x0 + BLOCK)
        for j, y0 in enumerate(starts[1]):
            ys = slice(y0, y0 + BLOCK)
            row = np.repeat(coarse[i, j], BLOCK)[: len(axes[2])]
            volume[xs, ys] = row
            near = np.flatnonzero(np.repeat(np.abs(coarse[i, j]) <= reach, BLOCK)[: len(axes[2])])
            if near.size:
                points = np.stack(
                    np.meshgrid(axes[0][xs], axes[1][ys], axes[2][near], indexing="ij"), -1
                )
                volume[xs, ys, near] = distance(points.reshape(-1, 3)).reshape(points.shape[:-1])
    return volume
