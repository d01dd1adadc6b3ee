"""Gaussian splats sampled on a scene's surfaces: a model with errors of known size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numba
import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError
from attnwarp.numba_cache import CACHE
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.truth.raycast import Geometry
from attnwarp_eval.truth.shading import buried, emitted, frames, irradiance, object_albedo

if TYPE_CHECKING:
    from attnwarp.gaussians import Gaussians
    from attnwarp_eval.scene.scene import Scene

Array = npt.NDArray[np.float64]

CANDIDATES = 4
"""Random points drawn for each sample that is kept. Yuksel 2015 recommends 3 to 5."""

PATCH = 1 / 4
"""Longest edge of a patch, which has one density, in units of the focus."""

FAR = 32.0
"""Beyond this distance, in units of the focus, a patch's edge is at most an eighth of its distance
instead, so that the density within it changes by a quarter: a plane out to 2,800 would have
4,600,000,000 patches of one size. The bundled scenes reach out to 12, except grazing."""

MOST_CELLS = 10_000_000
"""Cells of a sphere: about a gigabyte."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points spread evenly over surfaces.

    Attributes:
        point: (N, 3) world.
        normal: (N, 3) unit geometric normals, outward on closed shapes.
        primitive_id: (N,) int64.
        spacing: (N,) scene units: the square root of the area that each point represents.
    """

    point: Array
    normal: Array
    primitive_id: npt.NDArray[np.int64]
    spacing: Array


def surface_splats(
    scene: Scene,
    kind: Literal["2d", "3d"] = "2d",
    count: int = 50_000,
    *,
    position_noise: float = 0.0,
    normal_noise: float = 0.0,
    seed: int = 0,
    size: float = 0.6,
    thickness: float = 0.1,
    opacity: float = 0.99,
    focus: float | None = None,
    geometry: Geometry | None = None,
    samples: tuple[SurfaceSamples, Array] | None = None,
) -> Gaussians:
    """Splats that lie on the surfaces of a scene.

    They are spread as blue noise and lie in the tangent plane. Their colour is albedo times direct
    light, traced to each splat (:mod:`attnwarp_eval.truth.shading`). It excludes further
    bounces: if a scene's pictures have them, its splats are darker (docs/truth/scenes.md).
    Colours are not taken from rendered views. Those have noise, mix colours across outlines, and
    lack the surfaces that no view shows. A diffuse surface under direct light looks the same from
    everywhere.

    Args:
        kind: "2d" (discs) or "3d" (flat ellipsoids, ``thickness`` thick).
        position_noise: standard deviation of a displacement in every direction, in local spacings.
            The colour stays that of the undisturbed point.
        normal_noise: standard deviation of a tilt about each of the two tangents, in degrees.
        seed: seed of the sampling and the noise; the noise of one seed does not change the
            sampling.
        size: standard deviation of a splat in its plane, in local spacings. Larger splats close
            holes and reach further beyond outlines (reports/splats/surface.md).
        thickness: the third standard deviation of "3d" splats, in local spacings.
        focus: the radius about the scene's centre, in scene units, within which points are about
            equally dense; further out the density falls with the square of the distance. By
            default a third of the cameras' orbit.
        geometry: ``Geometry(scene)``, if there is one already.
        samples: samples of :func:`colored_samples` with this count, seed and focus, if there are
            some already: splats of every kind and noise share them.

    Returns:
        Gaussians in float32 relative to the float64 scene centre, SH degree 0.

    Raises:
        ValueError: a count below 1, a size, thickness or focus that is not positive, negative
            noise.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> splats = surface_splats(load_scene("spheres"), "2d", 20)
        >>> splats.kind, len(splats), splats.sh_degree
        ('2d', 20, 0)
    """
    import torch

    from attnwarp.gaussians import Gaussians

    for name, value in {
        "size": size,
        "thickness": thickness,
        "focus": 1.0 if focus is None else focus,
    }.items():
        if not value > 0:
            raise ValueError(f"{name}: got {value}, expected a positive number")
    for name, value in {"position_noise": position_noise, "normal_noise": normal_noise}.items():
        if not 0 <= value < np.inf:
            raise InputError(f"{name}: got {value}, expected a finite number >= 0")
    if samples is None:
        samples = colored_samples(scene, count, seed=seed, focus=focus, geometry=geometry)
    points, color = samples

    noise = np.random.default_rng([seed, 1])
    position, normal = points.point - scene.center, points.normal
    if position_noise:
        position = (
            position
            + noise.standard_normal(position.shape) * (position_noise * points.spacing)[:, None]
        )
    if normal_noise:
        tilt = np.tan(
            np.radians(np.clip(noise.standard_normal((len(normal), 2)) * normal_noise, -80, 80))
        )
        tangent, bitangent = frames(normal)
        normal = normal + tilt[:, :1] * tangent + tilt[:, 1:] * bitangent
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    scales = np.repeat((size * points.spacing)[:, None], 2 if kind == "2d" else 3, axis=1)
    if kind == "3d":
        scales[:, 2] = thickness * points.spacing

    def single(array: Array) -> torch.Tensor:
        return torch.from_numpy(array.astype(np.float32))

    return Gaussians(
        kind=kind,
        means=single(position),
        quats=single(quaternions_from_normals(normal)),
        scales=single(scales),
        opacities=torch.full((count,), float(opacity), dtype=torch.float32),
        sh=Gaussians.sh_from_rgb(single(to_srgb(color))),
        origin=scene.center,
    )


def colored_samples(
    scene: Scene,
    count: int,
    *,
    seed: int = 0,
    focus: float | None = None,
    geometry: Geometry | None = None,
) -> tuple[SurfaceSamples, Array]:
    """Points on a scene's surfaces, and (N, 3) linear RGB that the truth has there.
    Arguments are those of :func:`surface_splats`.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> samples, color = colored_samples(load_scene("spheres"), 20)
        >>> samples.point.shape, color.shape
        ((20, 3), (20, 3))
    """
    geometry = Geometry(scene) if geometry is None else geometry
    if focus is None:
        focus = scene.spec.cameras.radius / 3
    samples = sample_surface(geometry, count, center=scene.center, focus=focus, seed=seed)
    light = irradiance(scene, geometry, samples.point, samples.normal, samples.primitive_id)
    color = object_albedo(scene, geometry, samples.point, samples.primitive_id) / np.pi * light
    color += emitted(scene, geometry, samples.primitive_id)
    return samples, color


def quaternions_from_normals(normals: Array) -> Array:
    """(N, 4) unit quaternions wxyz that turn +z into each of (N, 3) unit ``normals``, by the
    shortest way.

    For normals that point down the way starts at -z, after half a turn about x, so that nothing is
    divided by a number near zero anywhere.

    Example:
        >>> up, right = quaternions_from_normals(np.array([[0.0, 0, 1], [1, 0, 0]]))
        >>> (up + 0.0).tolist(), (right + 0.0).round(6).tolist()  # a quarter turn about y
        ([1.0, 0.0, 0.0, 0.0], [0.707107, 0.0, 0.707107, 0.0])
    """
    x, y, z = normals.T
    down = z < 0
    zero = np.zeros_like(x)
    up = np.stack([1 + z, -y, x, zero], axis=-1)
    # Shortest arc from -z to n is (1 - z, y, -x, 0); times the half turn (0, 1, 0, 0).
    under = np.stack([-y, 1 - z, zero, x], axis=-1)
    q = np.where(down[:, None], under, up)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def sample_surface(
    geometry: Geometry, count: int, *, center: npt.ArrayLike, focus: float, seed: int
) -> SurfaceSamples:
    """Blue noise on all surfaces by sample elimination (Yuksel 2015), denser near ``center``.

    The density is proportional to 1 / (1 + (r / focus)^2), r the distance from ``center``. So the
    splats of a floor are about equally large in the pictures of cameras that orbit it.

    Args:
        count: number of points, exactly.
        center: (3,) world.
        focus: scene units.
        seed: any integer >= 0.

    Raises:
        ValueError: a count below 1.
        InputError: too little of the scene can be seen from outside it, as of a closed room, or a
            sphere is too large for the focus.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> geometry = Geometry(load_scene("spheres"))
        >>> samples = sample_surface(geometry, 20, center=geometry.center, focus=2.0, seed=0)
        >>> np.linalg.norm(samples.normal, axis=1).round(9).min().item()
        1.0
    """
    if count < 1:
        raise ValueError(f"count: got {count}, expected at least 1")
    random = np.random.default_rng([seed, 0])
    center = np.asarray(center, dtype=np.float64)

    def weight(points: Array) -> Array:
        return 1 / (1 + ((points - center) ** 2).sum(-1) / focus**2)

    corners, flat_id = _split(*geometry.flat_patches(), center, focus)
    edge_a, edge_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_a, edge_b)
    area = np.linalg.norm(normal, axis=-1) / 2
    normal /= 2 * np.maximum(area, 1e-300)[:, None]
    flat_mass = area * weight(corners.mean(axis=1))

    # Spheres in cells of equal area: z and longitude are independent and uniform on a sphere
    # (Archimedes).
    sphere_center, radius, sphere_id = geometry.spheres()
    cells = [_sphere_cells(r, focus * PATCH) for r in radius]
    cell_sphere = np.repeat(np.arange(len(cells)), [len(c[0]) for c in cells]).astype(np.int64)
    cell_low = np.concatenate([c[0] for c in cells] or [np.zeros((0, 2))])
    cell_size = np.concatenate([c[1] for c in cells] or [np.zeros((0, 2))])
    middle = _on_sphere(cell_low + cell_size / 2)
    ball_mass = (
        radius[cell_sphere] ** 2
        * cell_size.prod(axis=1)
        * weight(sphere_center[cell_sphere] + radius[cell_sphere, None] * middle)
    )

    mass = np.concatenate([flat_mass, ball_mass])
    total = float(mass.sum())
    drawn = CANDIDATES * count
    # Stratified over the patches: how many candidates a patch gets differs from its share by less
    # than one.
    ticket = (np.arange(drawn) + random.random(drawn)) / drawn * total
    patch = np.minimum(np.searchsorted(np.cumsum(mass), ticket, side="right"), len(mass) - 1)
    flat, ball = patch[patch < len(flat_mass)], patch[patch >= len(flat_mass)] - len(flat_mass)

    uv = random.random((len(flat), 2))
    uv = np.where(uv.sum(1, keepdims=True) > 1, 1 - uv, uv)
    flat_point = corners[flat, 0] + uv[:, :1] * edge_a[flat] + uv[:, 1:] * edge_b[flat]
    outward = _on_sphere(cell_low[ball] + random.random((len(ball), 2)) * cell_size[ball])
    ball_point = sphere_center[cell_sphere[ball]] + radius[cell_sphere[ball], None] * outward
    point = np.concatenate([flat_point, ball_point])
    normals = np.concatenate([normal[flat], outward])
    primitive = np.concatenate([flat_id[flat], sphere_id[cell_sphere[ball]]])

    # Surfaces inside other objects are invisible; splats there would only shine through.
    free = ~buried(geometry, point, normals, primitive)
    if free.sum() < count:
        raise InputError(
            f"count: got {count}, but too little of the surface can be seen from outside the scene;"
            " open what encloses it, such as a room's ceiling"
        )
    point, normals, primitive = point[free], normals[free], primitive[free]
    spacing = np.sqrt(total * free.mean() / (count * weight(point)))
    keep = _eliminate(point - center, normals, spacing, count)
    return SurfaceSamples(point[keep], normals[keep], primitive[keep], spacing[keep])


def _split(
    corners: Array, ids: npt.NDArray[np.int64], center: Array, focus: float
) -> tuple[Array, npt.NDArray[np.int64]]:
    """Triangles cut into four until they are small (:data:`PATCH`, :data:`FAR`), so that a patch
    has one density.
    """
    done, done_ids = [], []
    while len(corners):
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
        nearest = np.linalg.norm(corners.mean(axis=1) - center, axis=-1) - longest
        small = longest <= np.where(nearest < FAR * focus, PATCH * focus, nearest / 8)
        done.append(corners[small])
        done_ids.append(ids[small])
        a, b, c = (corners[~small, k] for k in range(3))
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        corners = np.concatenate([np.stack(q, axis=1) for q in quarters])
        ids = np.tile(ids[~small], 4)
    return np.concatenate(done or [corners]), np.concatenate(done_ids or [ids])


def _sphere_cells(radius: float, limit: float) -> tuple[Array, Array]:
    rows = max(4, int(np.ceil(np.pi * radius / limit)))
    columns = 2 * rows
    if rows * columns > MOST_CELLS:
        raise InputError(
            f"focus: got {limit / PATCH:g} for a sphere of radius {radius:g}, which makes"
            f" {rows * columns:,} cells of {limit:g}; expected at most {MOST_CELLS:,}: give a focus"
            f" of at least {np.pi * radius / PATCH / np.sqrt(MOST_CELLS / 2):.3g}, or bring the"
            " cameras further out"
        )
    z, phi = np.meshgrid(
        np.linspace(-1, 1, rows + 1)[:-1], np.linspace(0, 2 * np.pi, columns + 1)[:-1]
    )
    low = np.stack([z.ravel(), phi.ravel()], axis=-1)
    return low, np.tile([2 / rows, 2 * np.pi / columns], (len(low), 1))


def _on_sphere(z_phi: Array) -> Array:
    z, phi = np.clip(z_phi[:, 0], -1, 1), z_phi[:, 1]
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def _eliminate(points: Array, normals: Array, spacing: Array, count: int) -> npt.NDArray[np.int64]:
    """Indices of the ``count`` points that are left when the most crowded one is removed again and
    again; of equally crowded ones the first.

    Crowds are counted in integers: what is added and taken away again leaves no residue, whose
    rounding, other on every processor, would choose among points that nothing crowds.
    """
    from scipy.sparse import csr_matrix
    from scipy.spatial import cKDTree

    n = len(points)
    # Radius of the densest packing of discs that represent spacing^2 each (Yuksel 2015, eq. 2).
    radius = spacing / np.sqrt(2 * np.sqrt(3.0))
    k = min(n, 6 * CANDIDATES)
    distance, near = cKDTree(points).query(points, k=k, workers=-1)
    start, other, closeness = _crowds(distance.reshape(n, k), near.reshape(n, k), radius, normals)
    crowd = csr_matrix(((closeness**8 * 2**40).astype(np.int64), other, start), shape=(n, n))
    crowd.sort_indices()
    crowd = crowd.maximum(crowd.T).tocsr()
    alive = _remove(
        crowd.indptr.astype(np.int64), crowd.indices.astype(np.int64), crowd.data, n - count
    )
    return np.flatnonzero(alive)


@numba.njit(cache=CACHE)
def _crowds(distance, near, radius, normals):  # type: ignore[no-untyped-def]
    """Pairs of crowding points, as the rows of a sparse matrix: (n + 1,) starts, others, and
    closeness.

    1 minus the distance of two points over the sum of their radii, where that is positive. The two
    sides of a thin sheet do not crowd each other.
    """
    n, k = near.shape
    start = np.zeros(n + 1, np.int64)
    other, closeness = np.empty(n * k, np.int64), np.empty(n * k)
    count = 0
    for i in range(n):
        for c in range(k):
            j = near[i, c]
            close = 1 - distance[i, c] / (radius[i] + radius[j])
            along = 0.0
            for axis in range(3):
                along += normals[i, axis] * normals[j, axis]
            if j != i and close > 0 and along > 0:
                other[count], closeness[count] = j, close
                count += 1
        start[i + 1] = count
    return start, other[:count], closeness[:count]


@numba.njit(cache=CACHE)
def _before(weight, a, b):  # type: ignore[no-untyped-def]
    return weight[a] > weight[b] or (weight[a] == weight[b] and a < b)


@numba.njit(cache=CACHE)
def _sink(heap, place, weight, k, size):  # type: ignore[no-untyped-def]
    while True:
        child = 2 * k + 1
        if child >= size:
            return
        if child + 1 < size and _before(weight, heap[child + 1], heap[child]):
            child += 1
        if not _before(weight, heap[child], heap[k]):
            return
        heap[k], heap[child] = heap[child], heap[k]
        place[heap[k]], place[heap[child]] = k, child
        k = child


@numba.njit(cache=CACHE)
def _remove(start, other, closeness, removals):  # type: ignore[no-untyped-def]
    """Remove the heaviest node ``removals`` times, each time lightening its neighbours; a binary
    heap with places.
    """
    n = len(start) - 1
    weight = np.zeros(n, np.int64)
    for i in range(n):
        for e in range(start[i], start[i + 1]):
            weight[i] += closeness[e]
    heap = np.arange(n)
    place = np.arange(n)
    alive = np.ones(n, np.bool_)
    for k in range(n // 2 - 1, -1, -1):
        _sink(heap, place, weight, k, n)
    size = n
    for _ in range(removals):
        top = heap[0]
        alive[top] = False
        size -= 1
        heap[0] = heap[size]
        place[heap[0]] = 0
        _sink(heap, place, weight, 0, size)
        for e in range(start[top], start[top + 1]):
            j = other[e]
            if alive[j]:
                weight[j] -= closeness[e]
                _sink(heap, place, weight, place[j], size)
    return alive
