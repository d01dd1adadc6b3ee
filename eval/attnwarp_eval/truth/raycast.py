"""Exact geometry: hits of each pixel's central ray, and visibility of points from a camera.

Open3D (Embree, float32) finds the triangle of a ray, and the triangle's plane in float64 gives the
point. Spheres and rectangles are closed forms in float64. First the scene is moved to the middle of
its bounding box and scaled to unit size, in float64. So results depend neither on the scene's
position nor on its unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval._open3d import open3d
from attnwarp_eval.scene.extent import warn_of_strays
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import Box, Mesh, Rectangle, Shape, Sphere
from attnwarp_eval.truth.analytic import meet_triangles, nearest_hit
from attnwarp_eval.two_view import Hits

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

REACH_TOLERANCE = 1e-5
"""A ray from an eye to a point reaches it if its first hit is at 1 +- this of the way. Open3D's
hits are off by up to 1.6e-5 of the scene, after refinement by far less; surfaces closer
together than this along a ray count as one."""

REFINEMENT_LIMIT = 1e-3
"""Refinement may move a hit by this share of its distance. Larger moves happen only if the plane is
seen edge-on, where Open3D's hit is more accurate."""


@dataclass(frozen=True, eq=False)
class RayHits:
    """First hits of N rays.

    Attributes:
        t: (N,) position along the ray, in units of the direction's length; NaN on a miss.
        point: (N, 3) world; NaN on a miss.
        normal: (N, 3) unit geometric normal in world axes, turned against the ray; NaN on a miss.
        object_id: (N,) int32 index of the object in the scene, -1 on a miss.
        primitive_id: (N,) int64 triangle, sphere or rectangle within the geometry, -1 on a miss.
        valid: (N,) bool.
    """

    t: Array
    point: Array
    normal: Array
    object_id: npt.NDArray[np.int32]
    primitive_id: npt.NDArray[np.int64]
    valid: Mask


class Geometry:
    """The surfaces of a scene, or of a sequence of shapes, ready to be traced.

    Attributes:
        center: (3,) float64 middle of the bounding box.
        extent: longest side of the bounding box, in scene units.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> from attnwarp_eval.truth import Geometry
        >>> scene = load_scene("spheres").with_size(32, 32)
        >>> hits = Geometry(scene).trace(scene.source)
        >>> hits.depth.shape, scene.object_names[hits.object_id[31, 16]]
        ((32, 32), 'ground')
    """

    refinement_limit = REFINEMENT_LIMIT

    def __init__(self, scene: Scene | Sequence[Shape]) -> None:
        shapes = list(scene) if isinstance(scene, Sequence) else scene.shapes()
        if not shapes:
            raise ValueError("scene: got no shapes, expected at least one")
        if isinstance(scene, Scene):
            warn_of_strays(scene, shapes)
        bounds = np.stack([shape.bounds() for shape in shapes])
        low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
        self.center: Array = (low + high) / 2
        self.extent = float((high - low).max())

        spheres = [s for s in shapes if isinstance(s, Sphere)]
        rectangles = [s for s in shapes if isinstance(s, Rectangle)]
        meshes: list[Mesh] = [
            s.mesh() if isinstance(s, Box) else s for s in shapes if isinstance(s, Box | Mesh)
        ]
        self._spheres = np.array(
            [[*self._local(s.center), s.radius / self.extent] for s in spheres]
        ).reshape(-1, 4)
        self._rectangles = np.array(
            [
                [*self._local(s.center), *(s.u / self.extent), *(s.v / self.extent), *s.normal]
                for s in rectangles
            ]
        ).reshape(-1, 12)
        self._tint: Array | None = None
        if any(mesh.tint is not None for mesh in meshes):
            self._tint = np.concatenate(
                [np.ones_like(m.vertices) if m.tint is None else m.tint for m in meshes]
            )
        start, vertices, faces = 0, [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
        for mesh in meshes:
            vertices.append(self._local(mesh.vertices))
            faces.append(mesh.faces + start)
            start += len(mesh.vertices)
        self._vertices, self._faces = np.concatenate(vertices), np.concatenate(faces)
        corners = self._vertices[self._faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._face_normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        self._face_corner = np.ascontiguousarray(corners[:, 0])
        self._object = np.concatenate(
            [np.full(len(m.faces), m.object_id, np.int32) for m in meshes]
            + [
                np.array(
                    [s.object_id for s in spheres] + [s.object_id for s in rectangles],
                    dtype=np.int32,
                )
            ]
        )
        self._embree = None
        if len(self._faces):
            o3d = open3d()
            self._o3d = o3d
            self._embree = o3d.t.geometry.RaycastingScene(nthreads=0)
            self._embree.add_triangles(
                o3d.core.Tensor(self._vertices.astype(np.float32)),
                o3d.core.Tensor(self._faces.astype(np.uint32)),
            )
        self._traced: dict[bytes, Hits] = {}

    def flat_patches(self) -> tuple[Array, npt.NDArray[np.int64]]:
        """Flat surfaces as triangles, two a rectangle: (T, 3, 3) world corners, primitive ids."""
        q = self._rectangles
        c, u, v = q[:, None, 0:3], q[:, None, 3:6], q[:, None, 6:9]
        halves = np.concatenate(
            [np.concatenate([c - u - v, c + s * (u - v), c + u + v], axis=1) for s in (1, -1)]
        )
        # The second half winds the other way; reversed, its normal agrees with the rectangle's.
        halves[len(q) :] = halves[len(q) :, ::-1]
        first = len(self._faces) + len(self._spheres)
        corners = np.concatenate([self._vertices[self._faces], halves])
        ids = np.concatenate([np.arange(len(self._faces)), np.tile(first + np.arange(len(q)), 2)])
        return corners * self.extent + self.center, ids

    def spheres(self) -> tuple[Array, Array, npt.NDArray[np.int64]]:
        """The spheres: (S, 3) world centres, (S,) radii, (S,) primitive ids."""
        ids = len(self._faces) + np.arange(len(self._spheres))
        return (
            self._spheres[:, :3] * self.extent + self.center,
            self._spheres[:, 3] * self.extent,
            ids,
        )

    def object_of(self, primitive_id: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
        """(N,) index of the object of each primitive, -1 for -1."""
        return np.where(primitive_id >= 0, self._object[primitive_id], -1).astype(np.int32)

    def tint(self, points: Array, primitive_id: npt.NDArray[np.int64]) -> Array:
        """(N, 3) linear vertex colours of the meshes at surface points; 1 if absent."""
        tint = np.ones((len(points), 3))
        face = np.flatnonzero((primitive_id >= 0) & (primitive_id < len(self._faces)))
        if self._tint is None or not face.size:
            return tint
        corners = self._faces[primitive_id[face]]
        a, b, c = (self._vertices[corners[:, k]] for k in range(3))
        p = self._local(points[face])
        # Barycentric coordinates as areas over the triangle's normal.
        n = np.cross(b - a, c - a)
        nn = np.einsum("ij,ij->i", n, n)
        wb = np.einsum("ij,ij->i", np.cross(p - a, c - a), n) / nn
        wc = np.einsum("ij,ij->i", np.cross(b - a, p - a), n) / nn
        weights = np.stack([1 - wb - wc, wb, wc], axis=-1)
        tint[face] = np.einsum("ij,ijk->ik", weights, self._tint[corners])
        return tint

    def _local(self, points: Array) -> Array:
        return (np.asarray(points, dtype=np.float64) - self.center) / self.extent

    def trace(self, camera: Camera) -> Hits:
        """First hits of the rays through the pixel centres. The last few cameras' hits are
        cached."""
        key = np.concatenate(
            [camera.K.ravel(), camera.world_to_camera.ravel(), [camera.width, camera.height]]
        ).tobytes()
        if key not in self._traced:
            while len(self._traced) >= 4:
                self._traced.pop(next(iter(self._traced)))
            self._traced[key] = self._trace(camera)
        return self._traced[key]

    def forget(self) -> None:
        """Clear the cached hits."""
        self._traced.clear()

    def _trace(self, camera: Camera) -> Hits:
        directions = camera.directions() @ camera.rotation
        hits = self.trace_rays(camera.position, directions.reshape(-1, 3))
        shape = (camera.height, camera.width)
        unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        normal = hits.normal.reshape(*shape, 3)
        return Hits(
            depth=hits.t.reshape(
                shape
            ),  # the directions have z = 1 in the camera, so t is the depth
            point=hits.point.reshape(*shape, 3),
            normal=normal,
            cosine=-np.einsum("hwi,hwi->hw", normal, unit),
            object_id=hits.object_id.reshape(shape),
            primitive_id=hits.primitive_id.reshape(shape),
            valid=hits.valid.reshape(shape),
        )

    def ties(self, camera: Camera) -> tuple[Mask, npt.NDArray[np.int32]]:
        """Pixels whose first hit lies on surfaces of several objects at once, so that its object is
        ambiguous.

        Depth, points and correspondences of such pixels are exact; their ``object_id`` is
        that of one of the objects.

        Returns:
            tied: (H, W) bool: another object's surface lies within ``REACH_TOLERANCE`` of the way.
            lowest: (H, W) int32 the lowest object id at the hit, independent of the order in which
                objects are traced in; -1 on a miss.
        """
        hits = self.trace(camera)
        directions = (camera.directions() @ camera.rotation).reshape(-1, 3)
        origins = np.ascontiguousarray(
            np.broadcast_to(self._local(camera.position), directions.shape)
        )
        local = np.ascontiguousarray(directions / self.extent)
        first, owner = hits.depth.ravel(), hits.object_id.ravel()
        tied, lowest = np.zeros(len(first), dtype=bool), owner.copy()

        def meet(ray: npt.NDArray[np.int64], t: Array, objects: npt.NDArray[np.int32]) -> None:
            with np.errstate(invalid="ignore"):
                here = np.abs(t / first[ray] - 1) < REACH_TOLERANCE
            tied[ray[here & (objects != owner[ray])]] = True
            np.minimum.at(lowest, ray[here], objects[here])

        every = np.arange(len(first))
        closed = [
            (self._spheres[k : k + 1], self._rectangles[:0]) for k in range(len(self._spheres))
        ]
        closed += [
            (self._spheres[:0], self._rectangles[k : k + 1]) for k in range(len(self._rectangles))
        ]
        for k, (sphere, rectangle) in enumerate(closed):
            t, _ = nearest_hit(origins, local, sphere, rectangle)
            meet(every, t, np.full(len(t), self._object[len(self._faces) + k]))
        if self._embree is not None:
            rays = self._o3d.core.Tensor(np.concatenate([origins, local], axis=1, dtype=np.float32))
            crossings = self._embree.list_intersections(rays)
            ray = crossings["ray_ids"].numpy().astype(np.int64)
            face = crossings["primitive_ids"].numpy().astype(np.int64)
            normal = self._face_normal[face]
            with np.errstate(divide="ignore", invalid="ignore"):
                t = np.einsum(
                    "ij,ij->i", normal, self._face_corner[face] - origins[ray]
                ) / np.einsum("ij,ij->i", normal, local[ray])
            meet(ray, t, self._object[face])
        return tied.reshape(hits.depth.shape), lowest.reshape(hits.depth.shape)

    def trace_rays(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> RayHits:
        """First hits of rays.

        Args:
            origins: (N, 3) or (3,) world coordinates.
            directions: (N, 3) world axes, of any length; ``t`` counts in units of it.
        """
        directions = np.ascontiguousarray(directions, dtype=np.float64)
        if directions.ndim != 2 or directions.shape[1] != 3:
            raise ValueError(f"directions: got shape {directions.shape}, expected (N, 3)")
        world = np.broadcast_to(np.asarray(origins, dtype=np.float64), directions.shape)
        t, primitive = self._cast(self._local(world), directions / self.extent)
        valid = primitive >= 0
        t = np.where(valid, t, np.nan)
        point = world + t[:, None] * directions
        normal = self._normal(primitive, point)
        with np.errstate(invalid="ignore"):
            away = np.einsum("ij,ij->i", normal, directions) > 0
        normal[away] *= -1
        return RayHits(t, point, normal, self.object_of(primitive), primitive, valid)

    def _cast(self, origins: Array, directions: Array) -> tuple[Array, npt.NDArray[np.int64]]:
        """Nearest hits of rays in local coordinates: t (infinite on a miss) and primitive (-1)."""
        origins, directions = np.ascontiguousarray(origins), np.ascontiguousarray(directions)
        t, primitive = nearest_hit(origins, directions, self._spheres, self._rectangles)
        if self._embree is None:
            return t, primitive
        rays = np.concatenate([origins, directions], axis=1, dtype=np.float32)
        answer = self._embree.cast_rays(self._o3d.core.Tensor(rays))
        meet_triangles(
            t,
            primitive,
            answer["primitive_ids"].numpy(),
            answer["t_hit"].numpy(),
            origins,
            directions,
            self._face_normal,
            self._face_corner,
            self.refinement_limit,
        )
        return t, primitive

    def _normal(self, primitive: npt.NDArray[np.int64], points: Array) -> Array:
        """(N, 3) unit geometric normals of either sign at ``points`` on ``primitive``; NaN for
        -1."""
        n_faces, n_spheres = len(self._faces), len(self._spheres)
        normal = np.full((len(primitive), 3), np.nan)
        face = (primitive >= 0) & (primitive < n_faces)
        normal[face] = self._face_normal[primitive[face]]
        ball = (primitive >= n_faces) & (primitive < n_faces + n_spheres)
        sphere = self._spheres[primitive[ball] - n_faces]
        outward = self._local(points[ball]) - sphere[:, :3]
        normal[ball] = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
        flat = primitive >= n_faces + n_spheres
        normal[flat] = self._rectangles[primitive[flat] - n_faces - n_spheres, 9:]
        return normal

    def reached(
        self, eyes: npt.ArrayLike, points: npt.ArrayLike, primitive_id: npt.ArrayLike
    ) -> Mask:
        """(N,) mask of points, True where the way from an eye to a surface point is free.

        The ray is cast from the eye to the point, without any offset. The way is free if the first
        hit is on the point's primitive, or lies at 1 +- ``REACH_TOLERANCE`` of the way.
        A sphere's far side counts as reached, so test the facing side too.

        Args:
            eyes: (N, 3) or (3,) world coordinates.
            points: (N, 3) points on surfaces.
            primitive_id: (N,) the primitive of each point.
        """
        points = np.asarray(points, dtype=np.float64)
        eyes = np.broadcast_to(np.asarray(eyes, dtype=np.float64), points.shape)
        t, primitive = self._cast(self._local(eyes), (points - eyes) / self.extent)
        return (primitive == np.asarray(primitive_id)) | (np.abs(t - 1) < REACH_TOLERANCE)

    def visible_from(
        self,
        points: npt.ArrayLike,
        normals: npt.ArrayLike,
        primitive_id: npt.ArrayLike,
        eye: Camera | npt.ArrayLike,
    ) -> Mask:
        """(N,) mask of surface points that can be seen from ``eye``: reached, from the side that
        ``normals`` face.

        Args:
            points, normals: (N, 3) world; the normal selects the side of the surface.
            primitive_id: (N,) as in :class:`Hits`.
            eye: a camera (its position counts, not its image) or a (3,) point.
        """
        position = eye.position if isinstance(eye, Camera) else np.asarray(eye, dtype=np.float64)
        points = np.asarray(points, dtype=np.float64)
        facing = np.einsum("ij,ij->i", np.asarray(normals, dtype=np.float64), position - points) > 0
        seen = np.zeros(len(points), dtype=bool)
        ask = np.flatnonzero(facing)
        seen[ask] = self.reached(position, points[ask], np.asarray(primitive_id)[ask])
        return seen
