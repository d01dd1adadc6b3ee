"""A scene: the content of its file as cameras, shapes and hashes."""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.errors import InputError, suggest
from attnwarp.io.file import named_file
from attnwarp_eval.cache import content_key
from attnwarp_eval.scene.base import FARTHEST, Vector
from attnwarp_eval.scene.bodies import BodySpec
from attnwarp_eval.scene.edits import apply, pick
from attnwarp_eval.scene.meshes import READER_PROTOCOL, read_mesh
from attnwarp_eval.scene.shapes import Box, Mesh, Rectangle, Shape, Sphere
from attnwarp_eval.scene.solids import MESHING_PROTOCOL
from attnwarp_eval.scene.spec import (
    BoxSpec,
    CamerasSpec,
    EditSpec,
    MeshSpec,
    ObjectSpec,
    RectangleSpec,
    SceneSpec,
    SphereSpec,
    ViewSpec,
)
from attnwarp_eval.scene.terrain import ScatterSpec, TerrainSpec

Array = npt.NDArray[np.float64]

SCENE_PROTOCOL = 1
"""Version, in every content hash; raised when the same file would mean another world."""


class SceneError(InputError):
    """A scene file that cannot be used: the message has the file, the line if known, the value, and
    the remedy.

    Example:
        >>> print(SceneError("objects: got none, expected at least one", "my.yaml", 3))
        my.yaml:3: objects: got none, expected at least one
    """

    def __init__(
        self, message: str, path: Path | str | None = None, line: int | None = None
    ) -> None:
        self.path = path
        self.line = line
        place = "" if path is None else f"{path}:{line}: " if line else f"{path}: "
        super().__init__(place + message)


class Scene:
    """A checked scene.

    Attributes:
        spec: contents of the file.
        path: the file, or None for a scene made in code; mesh paths are relative to its folder.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> scene = load_scene("spheres")
        >>> small = scene.with_size(32, 32)
        >>> small.source.width, len(small.targets) == len(small.cameras) - 1
        (32, True)
        >>> small.content_hash == scene.content_hash
        False
    """

    def __init__(self, spec: SceneSpec, path: Path | None = None) -> None:
        self.spec = spec
        self.path = path

    def __repr__(self) -> str:
        return (
            f"Scene({self.name!r}, {len(self.spec.objects)} objects, 1 +"
            f" {len(self.spec.cameras.targets)} cameras)"
        )

    @property
    def name(self) -> str:
        """Short name, equal to the file's."""
        return self.spec.name

    @property
    def title(self) -> str:
        """Title in one line."""
        return self.spec.title

    @property
    def description(self) -> str:
        """Purpose of the scene."""
        return self.spec.description

    @property
    def object_names(self) -> list[str]:
        """Names of the objects; the index is the object id."""
        return [item.name for item in self.spec.objects]

    @property
    def center(self) -> Array:
        """(3,) float64 the look-at point of the cameras."""
        return np.array(self.spec.cameras.look_at)

    @functools.cached_property
    def cameras(self) -> list[Camera]:
        """The source, then the targets."""
        orbit = self.spec.cameras
        return [
            orbit_camera(orbit, view, k) for k, view in enumerate([orbit.source, *orbit.targets])
        ]

    @property
    def source(self) -> Camera:
        """The source camera."""
        return self.cameras[0]

    @property
    def targets(self) -> list[Camera]:
        """The target cameras."""
        return self.cameras[1:]

    def camera(self, name: str) -> Camera:
        """Find a camera by name.

        Raises:
            SceneError: no such camera.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        there = [camera.name for camera in self.cameras]
        near = suggest(name, there) or f"; the scene has {', '.join(there)}"
        raise SceneError(f"no camera {name!r}{near}", self.path)

    @property
    def edits(self) -> tuple[EditSpec, ...]:
        """The edits whose results are known."""
        return self.spec.edits

    def edit(self, name: str) -> EditSpec:
        """Find an edit by name.

        Raises:
            SceneError: no such edit.
        """
        for edit in self.edits:
            if edit.name == name:
                return edit
        available = [edit.name for edit in self.edits]
        raise SceneError(
            f"no edit {name!r}{suggest(name, available)}; {self.name} has"
            f" {', '.join(available) or 'none'}",
            self.path,
        )

    def edited(self, name: str, answer: str | None = None) -> Scene:
        """The scene after an edit: the same cameras, other surfaces, shapes or lights.

        Args:
            name: an edit of :attr:`edits`.
            answer: answer of an ambiguous edit, by default the first.

        Raises:
            SceneError: no such edit or answer.
        """
        edit = self.edit(name)
        try:
            return Scene(apply(self.spec, edit, pick(edit, answer)), self.path)
        except ValueError as error:
            raise SceneError(str(error), self.path) from error

    def with_size(self, width: int, height: int) -> Scene:
        """Copy of the scene with images of another size; the vertical field of view stays."""
        cameras = self.spec.cameras.model_copy(update={"size": (int(width), int(height))})
        copy = Scene(self.spec.model_copy(update={"cameras": cameras}), self.path)
        if "_shapes" in self.__dict__:
            copy.__dict__["_shapes"] = self._shapes
        return copy

    def shapes(self) -> tuple[Shape, ...]:
        """All surfaces in world coordinates, each with its object's index as
        ``object_id``. Built at the first call; notices of meshes are given then.

        Raises:
            SceneError: an object exceeds the limit of coordinates, a mesh file is damaged, or a
                body cannot be meshed.
        """
        return self._shapes

    @functools.cached_property
    def _shapes(self) -> tuple[Shape, ...]:
        shapes: list[Shape] = []
        for k, item in enumerate(self.spec.objects):
            for shape in self._build(item, k):
                reach = float(np.abs(shape.bounds()).max())
                if not reach <= FARTHEST:
                    raise SceneError(
                        f"object {item.name!r} reaches {reach:.3g} from the origin, expected at"
                        f" most {FARTHEST:g}; make its scale or position smaller",
                        self.path,
                    )
                shapes.append(shape)
        return tuple(shapes)

    def _build(self, item: ObjectSpec, object_id: int) -> Iterator[Shape]:
        spec = item.shape
        match spec:
            case SphereSpec():
                yield Sphere(np.array(spec.center), spec.radius, object_id)
            case RectangleSpec():
                n = np.array(spec.facing) / np.linalg.norm(spec.facing)
                u = np.cross([0.0, 0.0, 1.0], n) if abs(n[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
                u = u - n * (u @ n)
                u /= np.linalg.norm(u)
                v = np.cross(n, u)
                yield Rectangle(
                    np.array(spec.center), u * spec.size[0] / 2, v * spec.size[1] / 2, object_id
                )
            case BoxSpec():
                axes = _turn_z(spec.yaw) @ _turn_y(spec.pitch)
                for k in range(spec.repeat.count if spec.repeat else 1):
                    step = np.array(spec.repeat.step) * k if spec.repeat else np.zeros(3)
                    yield Box(
                        np.array(spec.center) + step, np.array(spec.size) / 2, axes, object_id
                    )
            case BodySpec():
                try:
                    body = spec.mesh()
                except ValueError as error:
                    raise SceneError(f"object {item.name!r}: {error}", self.path) from error
                yield _placed(body, _turn_z(spec.yaw), spec.scale, spec.position, object_id)
            case MeshSpec():
                path = self.mesh_path(spec)
                try:
                    mesh = read_mesh(path)
                except ValueError as error:
                    raise SceneError(str(error), self.path) from error
                upright = (
                    np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if spec.up == "y" else np.eye(3)
                )
                turn = _turn_z(spec.yaw) @ upright
                placed = _placed(mesh, turn, spec.scale, spec.position, object_id)
                try:
                    yield placed.divided(spec.longest_edge) if spec.longest_edge else placed
                except ValueError as error:
                    raise SceneError(f"object {item.name!r}: longest_edge: {error}") from error
            case TerrainSpec():
                yield replace(spec.mesh(), object_id=object_id)
            case ScatterSpec():
                yield replace(spec.mesh(self._ground(spec)), object_id=object_id)

    def _ground(self, spec: ScatterSpec) -> Callable[[Array], Array]:
        """Height function of the ground under scattered things."""
        for item in self.spec.objects:
            if item.name == spec.on and isinstance(item.shape, TerrainSpec):
                return item.shape.height_at
            if item.name == spec.on and isinstance(item.shape, RectangleSpec):
                level = item.shape.center[2]
                return lambda xy: np.full(len(xy), level)
        return lambda xy: np.full(len(xy), spec.center[2])

    def mesh_path(self, spec: MeshSpec) -> Path:
        """Path of the mesh file of an object."""
        base = self.path.parent if self.path else Path()
        return named_file(base, str(Path(spec.file).expanduser()))

    @functools.cached_property
    def world_hash(self) -> str:
        """SHA-256 of all that cameras see: objects, mesh files, lights, fog, protocols."""
        files = {
            item.shape.file: hashlib.sha256(self.mesh_path(item.shape).read_bytes()).hexdigest()
            for item in self.spec.objects
            if isinstance(item.shape, MeshSpec)
        }
        protocols = (SCENE_PROTOCOL, MESHING_PROTOCOL, READER_PROTOCOL)
        return content_key("world", protocols, self._said("objects", "lights", "medium"), files)

    def _said(self, *keys: str) -> dict[str, Any]:
        """Entries of the file, as JSON, without default values: files with and without them are
        equal, and a new key of the format changes no scene's hash.
        """
        return self.spec.model_dump(mode="json", include={*keys}, exclude_defaults=True)

    @functools.cached_property
    def content_hash(self) -> str:
        """SHA-256 of the scene's content (canonical JSON), the mesh files' bytes and the
        protocol versions.

        Edits are left out: they are other scenes, with separate hashes.
        """
        own = type(self.spec).model_fields.keys() - {"edits"}
        return content_key("scene", self.world_hash, self._said(*own))


def _turn_z(degrees: float) -> Array:
    a = math.radians(degrees)
    return np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1.0]])


def _turn_y(degrees: float) -> Array:
    a = math.radians(degrees)
    return np.array([[math.cos(a), 0, math.sin(a)], [0, 1.0, 0], [-math.sin(a), 0, math.cos(a)]])


def _placed(mesh: Mesh, R: Array, scale: float, position: Vector, object_id: int) -> Mesh:
    moved = mesh.turned(R).moved(scale, position)
    return Mesh(moved.vertices, moved.faces, moved.normals, moved.tint, object_id)


def view_name(view: ViewSpec, index: int) -> str:
    """The camera's name: as given, else 'source' for the first and 'yaw030' for the others.

    Example:
        >>> from attnwarp_eval.scene.spec import ViewSpec
        >>> view = ViewSpec(yaw=30, height=1.9)
        >>> view_name(view, 0), view_name(view, 1)
        ('source', 'yaw030')
    """
    return view.name or (
        "source" if index == 0 else f"yaw{view.yaw:03g}".replace(".", "p").replace("-", "m")
    )


def orbit_camera(orbit: CamerasSpec, view: ViewSpec, index: int) -> Camera:
    """The camera of a view: the source has index 0, the targets those after it.

    Example:
        >>> from attnwarp_eval.scene.spec import CamerasSpec, ViewSpec
        >>> view = ViewSpec(yaw=0, height=0)
        >>> orbit = CamerasSpec(look_at=(0, 0, 0), radius=3, source=view, targets=(view,))
        >>> round(float(np.linalg.norm(orbit_camera(orbit, view, 0).position)), 9)
        3.0
    """
    look_at = view.look_at or orbit.look_at
    radius, yaw = view.radius or orbit.radius, math.radians(view.yaw)
    position = (
        orbit.look_at[0] + radius * math.cos(yaw),
        orbit.look_at[1] + radius * math.sin(yaw),
        view.height,
    )
    return Camera.look_at(
        position,
        look_at,
        width=orbit.size[0],
        height=orbit.size[1],
        fov_y=view.fov or orbit.fov,
        name=view_name(view, index),
    )


def inside(scene: Scene, item: ObjectSpec) -> Callable[[Array], bool]:
    """Predicate of points inside the object. A body uses its distance, which needs no
    meshing.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> scene = load_scene("spheres")
        >>> melon = next(item for item in scene.spec.objects if item.name == "melon")
        >>> contains = inside(scene, melon)  # center (0, 0, 0.8), radius 0.8
        >>> contains(np.array([0, 0, 0.8])), contains(np.array([0, 0, 1.7]))
        (True, False)
    """
    spec = item.shape
    if isinstance(spec, BodySpec):
        R, offset = _turn_z(spec.yaw), np.array(spec.position)
        return lambda point: spec.contains((point - offset) @ R / spec.scale)
    if isinstance(spec, TerrainSpec):
        return spec.below
    if isinstance(spec, ScatterSpec):
        return lambda point: False  # blades and leaves have no interior, and stones are small
    solids = list(scene._build(item, 0))
    return lambda point: any(solid.contains(point) for solid in solids)
