"""Scenes: what a file of scenes/ says, checked, with messages a person can act on.

docs/scenes.md describes the format. Positions are in scene units (metres in the scenes that come with the package),
angles in degrees, colours sRGB '#rrggbb', z up.
"""

from __future__ import annotations

import difflib
import functools
import hashlib
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import yaml
from pydantic import BaseModel, Field, ValidationError, model_validator

from attnwarp.camera import Camera
from attnwarp_eval import shapes
from attnwarp_eval.bodies import BodySpec
from attnwarp_eval.cache import content_key
from attnwarp_eval.errors import InputError
from attnwarp_eval.nature import ScatterSpec, TerrainSpec
from attnwarp_eval.optics import (
    TEXTURED,
    DiffuseMaterial,
    EffectsSpec,
    EmissionSpec,
    LensSpec,
    Material,
    MediumSpec,
    PointSpec,
    SpotSpec,
    contradictions,
)
from attnwarp_eval.shapes import MESHING_PROTOCOL, Box, Mesh, Rectangle, Shape, Sphere
from attnwarp_eval.textures import LATER, Color, Direction, Plain, Spec, Texture

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]

SCENE_PROTOCOL = 1
"""Raised whenever the same file would mean another world (shapes, textures, lights); part of every content hash."""


class SceneError(InputError):
    """A scene file that cannot be used: names the file, the line where it can, what came, and the remedy."""

    def __init__(self, message: str, path: Path | str | None = None, line: int | None = None) -> None:
        self.path = path
        self.line = line
        place = "" if path is None else f"{path}:{line}: " if line else f"{path}: "
        super().__init__(place + message)


# What may stand in a file --------------------------------------------------------------------------------------------


class SphereSpec(Spec):
    """A sphere, exact."""

    type: Literal["sphere"]
    center: Vector
    radius: Positive


class RectangleSpec(Spec):
    """A flat rectangle, exact. ``size`` is width and height; a level one has its width along x."""

    type: Literal["rectangle"]
    center: Vector
    size: tuple[Positive, Positive]
    facing: Direction = (0.0, 0.0, 1.0)


class Repeat(Spec):
    """``count`` copies, each ``step`` further on."""

    count: int = Field(ge=1, le=1000)
    step: Vector


class BoxSpec(Spec):
    """A box of ``size`` (x, y, z), turned by ``yaw`` about the upright and tilted by ``pitch`` about its own y."""

    type: Literal["box"]
    center: Vector
    size: tuple[Positive, Positive, Positive]
    yaw: float = 0.0
    pitch: float = 0.0
    repeat: Repeat | None = None


class MeshSpec(Spec):
    """A mesh from a file, its path relative to the scene file. ``up`` names the file's upright axis."""

    type: Literal["mesh"]
    file: str
    position: Vector = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    scale: Positive = 1.0
    up: Literal["y", "z"] = "z"


ShapeSpec = Annotated[
    SphereSpec | RectangleSpec | BoxSpec | BodySpec | MeshSpec | TerrainSpec | ScatterSpec, Field(discriminator="type")
]


class ObjectSpec(Spec):
    """One object: its index in the list is its object id.

    ``texture`` colours diffuse and plastic things; mirrors, metal and glass have a ``tint``, and what shines is black.
    """

    name: str = Field(min_length=1)
    shape: ShapeSpec
    texture: Texture = Plain(type="plain", color="#ffffff", variation=0.0, grain=0.1)
    material: Material = Field(DiffuseMaterial(), json_schema_extra=LATER)
    emission: EmissionSpec | None = Field(None, json_schema_extra=LATER)
    velocity: Vector | None = Field(None, json_schema_extra=LATER)

    @model_validator(mode="after")
    def _a_texture_where_it_shows(self) -> ObjectSpec:
        shows = isinstance(self.material, TEXTURED) and self.emission is None
        said = "texture" in self.model_fields_set
        if shows and not said:
            raise ValueError(f"got no texture, but {self.material.type} things need one; add 'texture: {{type: ...}}'")
        if said and not isinstance(self.material, TEXTURED):
            raise ValueError(f"got a texture, but {self.material.type} shows none; use the material's 'tint' instead")
        if self.emission is not None and not isinstance(self.material, DiffuseMaterial):
            raise ValueError(f"got emission and the material {self.material.type}; what shines has no other material")
        return self


class SunSpec(Spec):
    """Parallel light. ``irradiance`` on a surface that faces it; a white one then shows irradiance / pi."""

    type: Literal["sun"]
    elevation: float = Field(gt=0, le=90)
    azimuth: float
    irradiance: float = Field(gt=0)
    color: Color = "#ffffff"


class SkySpec(Spec):
    """Light from all around, and what a camera sees where it hits nothing: a ramp from ``horizon`` to ``zenith``."""

    type: Literal["sky"]
    horizon: Color
    zenith: Color
    radiance: float = Field(1.0, gt=0)


LightSpec = Annotated[SunSpec | SkySpec | PointSpec | SpotSpec, Field(discriminator="type")]


class ViewSpec(Spec):
    """One camera on the orbit; what it leaves out comes from ``cameras``."""

    name: str | None = Field(None, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")  # it becomes part of file names
    yaw: float
    height: float
    radius: Positive | None = None
    fov: float | None = Field(None, gt=0, lt=180)
    look_at: Vector | None = None


class CamerasSpec(Spec):
    """An orbit about the upright through ``look_at``: horizontal ``radius``, vertical ``fov``, one source, targets."""

    look_at: Vector
    radius: Positive
    fov: float = Field(45.0, gt=0, lt=180)
    size: tuple[int, int] = (512, 512)
    source: ViewSpec
    targets: tuple[ViewSpec, ...] = Field(min_length=1)
    lens: LensSpec | None = Field(None, json_schema_extra=LATER)


class AppearanceSpec(Spec):
    """How pictures are made: light bounces (1 is direct light only) and samples a pixel.

    ``bounces: unlimited`` follows light until it is gone; every surface and every scattering counts as a bounce.
    """

    bounces: Annotated[int, Field(ge=1, le=64)] | Literal["unlimited"] = 1
    spp: int = Field(default=16, ge=1, le=65536)


class ObjectChange(Spec):
    """What an edit does to one object. Its shape stays.

    ``recolor`` replaces colours by others wherever the object says them; ``paint`` makes all its colours shades of
    one, but for those of its parts that ``keep`` lists.
    """

    object: str
    texture: Texture | None = None
    material: Material | None = None
    recolor: dict[Color, Color] = Field(default_factory=dict)
    paint: Color | None = None
    keep: tuple[Color, ...] = ()

    @model_validator(mode="after")
    def _one_way_of_colouring(self) -> ObjectChange:
        said = [name for name in ("texture", "material", "recolor", "paint") if getattr(self, name)]
        if not said:
            raise ValueError("got a change that changes nothing; add a texture, a material, recolor or paint")
        if self.paint and (self.recolor or self.texture):
            raise ValueError("got paint beside recolor or texture; keep one of them")
        return self


class AnswerSpec(Spec):
    """One right answer to an ambiguous instruction."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")
    target: str
    changes: tuple[ObjectChange, ...] = ()
    lights: tuple[LightSpec, ...] | None = None


class EditSpec(Spec):
    """An edit whose result is known: what is asked for, the prompts, and what it does to the scene.

    An ambiguous instruction has several ``answers``, each as right as the others.
    """

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")
    instruction: str
    source: str
    target: str
    changes: tuple[ObjectChange, ...] = ()
    lights: tuple[LightSpec, ...] | None = None
    answers: tuple[AnswerSpec, ...] = ()

    @model_validator(mode="after")
    def _does_something(self) -> EditSpec:
        own = bool(self.changes) or self.lights is not None
        if own == bool(self.answers):
            raise ValueError("got an edit with both or neither of its own changes (or lights) and answers; keep one")
        return self

    @property
    def ambiguous(self) -> bool:
        """Whether more than one result is right."""
        return bool(self.answers)


class SceneSpec(Spec):
    """A whole file."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")
    title: str
    description: str = ""
    units: str = "metres"
    objects: tuple[ObjectSpec, ...] = Field(min_length=1)
    lights: tuple[LightSpec, ...]
    cameras: CamerasSpec
    appearance: AppearanceSpec = Field(default_factory=AppearanceSpec)
    medium: MediumSpec | None = Field(None, json_schema_extra=LATER)
    effects: EffectsSpec = Field(EffectsSpec(), json_schema_extra=LATER)
    edits: tuple[EditSpec, ...] = ()


# The scene -----------------------------------------------------------------------------------------------------------


class Scene:
    """A checked scene.

    Attributes:
        spec: what the file says.
        path: the file, or None for one made in code; mesh files are relative to its folder.
    """

    def __init__(self, spec: SceneSpec, path: Path | None = None) -> None:
        self.spec = spec
        self.path = path

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, {len(self.spec.objects)} objects, 1 + {len(self.spec.cameras.targets)} cameras)"

    @property
    def name(self) -> str:
        """Short name, also the file's."""
        return self.spec.name

    @property
    def title(self) -> str:
        """A line for people."""
        return self.spec.title

    @property
    def description(self) -> str:
        """What the scene is for."""
        return self.spec.description

    @property
    def object_names(self) -> list[str]:
        """Names of the objects; the index is the object id."""
        return [item.name for item in self.spec.objects]

    @property
    def center(self) -> Array:
        """(3,) float64 the point that the cameras look at."""
        return np.array(self.spec.cameras.look_at)

    @functools.cached_property
    def cameras(self) -> list[Camera]:
        """The source, then the targets."""
        orbit = self.spec.cameras
        return [_orbit_camera(orbit, view, k) for k, view in enumerate([orbit.source, *orbit.targets])]

    @property
    def source(self) -> Camera:
        """The source camera."""
        return self.cameras[0]

    @property
    def targets(self) -> list[Camera]:
        """The target cameras."""
        return self.cameras[1:]

    def camera(self, name: str) -> Camera:
        """The camera of that name.

        Raises:
            SceneError: there is none.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise SceneError(f"no camera {name!r}{_suggest(name, [c.name for c in self.cameras])}", self.path)

    @property
    def edits(self) -> tuple[EditSpec, ...]:
        """The edits whose results are known."""
        return self.spec.edits

    def edit(self, name: str) -> EditSpec:
        """The edit of that name.

        Raises:
            SceneError: there is none.
        """
        for edit in self.edits:
            if edit.name == name:
                return edit
        known = [edit.name for edit in self.edits]
        raise SceneError(
            f"no edit {name!r}{_suggest(name, known)}; {self.name} has {', '.join(known) or 'none'}", self.path
        )

    def edited(self, name: str, answer: str | None = None) -> Scene:
        """The scene after an edit: the same shapes and cameras, other surfaces or lights.

        Args:
            name: an edit of :attr:`edits`.
            answer: which of an ambiguous edit's answers; its first if left out.

        Raises:
            SceneError: there is no such edit or answer.
        """
        from attnwarp_eval.edits import apply, pick

        edit = self.edit(name)
        try:
            return Scene(apply(self.spec, edit, pick(edit, answer)), self.path)
        except ValueError as error:
            raise SceneError(str(error), self.path) from error

    def with_size(self, width: int, height: int) -> Scene:
        """The same scene with images of ``width`` x ``height``; the vertical field of view stays."""
        cameras = self.spec.cameras.model_copy(update={"size": (int(width), int(height))})
        return Scene(self.spec.model_copy(update={"cameras": cameras}), self.path)

    def shapes(self) -> list[Shape]:
        """Everything that has a surface, in world coordinates, each with its object's index as ``object_id``."""
        return [shape for k, item in enumerate(self.spec.objects) for shape in self._build(item, k)]

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
                yield Rectangle(np.array(spec.center), u * spec.size[0] / 2, v * spec.size[1] / 2, object_id)
            case BoxSpec():
                axes = _turn_z(spec.yaw) @ _turn_y(spec.pitch)
                for k in range(spec.repeat.count if spec.repeat else 1):
                    step = np.array(spec.repeat.step) * k if spec.repeat else np.zeros(3)
                    yield Box(np.array(spec.center) + step, np.array(spec.size) / 2, axes, object_id)
            case BodySpec():
                yield _placed(spec.mesh(), _turn_z(spec.yaw), spec.scale, spec.position, object_id)
            case MeshSpec():
                path = self.mesh_path(spec)
                try:
                    mesh = shapes.read_mesh(path)
                except ValueError as error:
                    raise SceneError(str(error), self.path) from error
                upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if spec.up == "y" else np.eye(3)
                yield _placed(mesh, _turn_z(spec.yaw) @ upright, spec.scale, spec.position, object_id)
            case TerrainSpec():
                yield replace(spec.mesh(), object_id=object_id)
            case ScatterSpec():
                yield replace(spec.mesh(self._ground(spec)), object_id=object_id)

    def _ground(self, spec: ScatterSpec) -> Callable[[Array], Array]:
        """Height of what things are strewn on."""
        for item in self.spec.objects:
            if item.name == spec.on and isinstance(item.shape, TerrainSpec):
                return item.shape.height_at
            if item.name == spec.on and isinstance(item.shape, RectangleSpec):
                level = item.shape.center[2]
                return lambda xy: np.full(len(xy), level)
        return lambda xy: np.full(len(xy), spec.center[2])

    def mesh_path(self, spec: MeshSpec) -> Path:
        """Where the mesh file of an object lies."""
        base = self.path.parent if self.path else Path()
        return base / Path(spec.file).expanduser()

    @functools.cached_property
    def world_hash(self) -> str:
        """SHA-256 of all that decides what a camera would see: objects, mesh files, lights, fog, protocol versions."""
        files = {
            item.shape.file: hashlib.sha256(self.mesh_path(item.shape).read_bytes()).hexdigest()
            for item in self.spec.objects
            if isinstance(item.shape, MeshSpec)
        }
        said = self.spec.model_dump(mode="json", include={"objects", "lights", "medium"})
        return content_key("world", SCENE_PROTOCOL, MESHING_PROTOCOL, said, files)

    @functools.cached_property
    def content_hash(self) -> str:
        """SHA-256 of everything the scene says (canonical JSON), the mesh files' bytes and the protocol versions.

        Edits are left out: they are other scenes, with hashes of their own.
        """
        return content_key("scene", self.world_hash, self.spec.model_dump(mode="json", exclude={"edits"}))


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
    """The camera's name: its own, else 'source' for the first and 'yaw030' for the others."""
    return view.name or ("source" if index == 0 else f"yaw{view.yaw:03g}".replace(".", "p").replace("-", "m"))


def _orbit_camera(orbit: CamerasSpec, view: ViewSpec, index: int) -> Camera:
    look_at = view.look_at or orbit.look_at
    radius, yaw = view.radius or orbit.radius, math.radians(view.yaw)
    position = (orbit.look_at[0] + radius * math.cos(yaw), orbit.look_at[1] + radius * math.sin(yaw), view.height)
    return Camera.look_at(
        position,
        look_at,
        width=orbit.size[0],
        height=orbit.size[1],
        fov_y=view.fov or orbit.fov,
        name=view_name(view, index),
    )


# Loading -------------------------------------------------------------------------------------------------------------


def scene_folders() -> list[Path]:
    """Where scenes are looked for by name: ``./scenes``, then those of the package (in a checkout: its ``scenes``)."""
    folders = [Path.cwd() / "scenes", (Path(__file__).parent / "scenes").resolve()]
    return [f for k, f in enumerate(folders) if f.is_dir() and f not in folders[:k]]


def list_scenes() -> list[str]:
    """Names of the scenes that :func:`load_scene` finds by name, sorted."""
    return sorted({path.stem for folder in scene_folders() for path in folder.glob("*.yaml")})


def load_scene(name_or_path: str | os.PathLike[str]) -> Scene:
    """A scene by name (``"bear"``) or by file (``"my/scene.yaml"``).

    Raises:
        SceneError: the file is missing or says something that cannot be used; the message names the file, the line
            where it can, what came and the remedy.
    """
    text = os.fspath(name_or_path)
    path = Path(text).expanduser()
    if path.suffix in (".yaml", ".yml") or len(path.parts) != 1:
        if not path.is_file():
            raise SceneError(f"no such scene file{_suggest(path.name, _siblings(path))}", path)
        return _read(path)
    for folder in scene_folders():
        if (folder / f"{text}.yaml").is_file():
            return _read(folder / f"{text}.yaml")
    known = list_scenes()
    raise SceneError(
        f"no scene named {text!r}{_suggest(text, known)}; known scenes: {', '.join(known) or 'none'}; "
        "a file of your own is named by its path, such as my/scene.yaml"
    )


def _siblings(path: Path) -> list[str]:
    return [p.name for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []


def _suggest(word: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def _read(path: Path) -> Scene:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"cannot be read: {error}", path) from error
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        if root is None:
            raise SceneError("the file is empty; docs/scenes.md has an example to start from", path)
        _refuse_duplicate_keys(root, path)
        data = yaml.safe_load(text)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else None
        raise SceneError(
            f"not valid YAML: {error.problem or error}; check indentation and quotes", path, line
        ) from error
    except yaml.YAMLError as error:
        raise SceneError(f"not valid YAML: {error}", path) from error
    try:
        spec = SceneSpec.model_validate(data)
    except ValidationError as error:
        # A misspelt key comes first: what is missing then is often only its right spelling.
        problems = sorted(error.errors(include_url=False), key=lambda p: p["type"] != "extra_forbidden")
        first = problems[0]
        more = f" (and {len(problems) - 1} more below it)" if len(problems) > 1 else ""
        loc = (*first["loc"], "type") if first["type"] == "union_tag_invalid" else first["loc"]
        raise SceneError(_explain(first) + more, path, _line(root, loc)) from error
    scene = Scene(spec, path)
    _check(scene, root)
    return scene


def _refuse_duplicate_keys(node: yaml.Node, path: Path) -> None:
    """YAML itself lets the last of two equal keys win, silently."""
    if isinstance(node, yaml.MappingNode):
        seen: dict[str, int] = {}
        for key, value in node.value:
            line = key.start_mark.line + 1
            if key.value in seen:
                raise SceneError(
                    f"the key {key.value!r} stands here and on line {seen[key.value]}; keep one", path, line
                )
            seen[key.value] = line
            _refuse_duplicate_keys(value, path)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _refuse_duplicate_keys(item, path)


def _line(node: yaml.Node, loc: Sequence[int | str]) -> int:
    """Line (from 1) of the deepest node that ``loc`` leads to; the tags that unions put into a loc lead nowhere."""
    line = node.start_mark.line + 1
    for step in loc:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                if key.value == step:
                    line, node = key.start_mark.line + 1, value
                    break
        elif isinstance(node, yaml.SequenceNode) and isinstance(step, int) and step < len(node.value):
            node = node.value[step]
            line = node.start_mark.line + 1
    return line


def _explain(problem: Any) -> str:
    place, _ = _follow(problem["loc"])
    kind, came = problem["type"], problem.get("input")
    if kind == "extra_forbidden":
        _, owner = _follow(problem["loc"][:-1])
        allowed = list(owner.model_fields) if owner else []
        key = str(problem["loc"][-1])
        return f"{place}: unknown key {key!r}{_suggest(key, allowed)}; allowed here: {', '.join(allowed)}"
    if kind == "missing":
        return f"{place}: is missing; add it (docs/scenes.md says what each key means)"
    if kind == "union_tag_invalid":
        came, allowed = problem["ctx"]["tag"], [tag.strip("' ") for tag in problem["ctx"]["expected_tags"].split(",")]
        return f"{place}.type: got {came!r}{_suggest(came, allowed)}; expected one of {', '.join(allowed)}"
    if kind == "union_tag_not_found":
        return f"{place}: says no type; add 'type: ...' (docs/scenes.md lists the types)"
    message = problem["msg"].removeprefix("Value error, ")
    if not message.startswith("got "):
        message = f"got {came!r}, but {message[0].lower() + message[1:]}"
    return f"{place or 'the file'}: {message}"


def _follow(loc: Sequence[int | str]) -> tuple[str, type[BaseModel] | None]:
    """A pydantic location as a person would write it, and the model at its end.

    Unions put the tag of the member they chose into the location; it picks the model and is left out of the path.
    """
    place = ""
    annotation: Any = SceneSpec
    for step in loc:
        if isinstance(step, int):
            place += f"[{step}]"
            continue
        models = _models(annotation)
        tagged = [m for m in models if len(models) > 1 and step in get_args(m.model_fields["type"].annotation)]
        if tagged:
            annotation = tagged[0]
            continue
        place += f".{step}" if place else step
        annotation = next((m.model_fields[step].annotation for m in models if step in m.model_fields), None)
    models = _models(annotation)
    return place, models[0] if len(models) == 1 else None


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def _check(scene: Scene, root: yaml.Node) -> None:
    """What no single field can say: names that clash, files that are missing, cameras that cannot be."""
    from attnwarp_eval import edits

    def refuse(message: str, *loc: int | str) -> None:
        raise SceneError(message, scene.path, _line(root, loc))

    names: dict[str, int] = {}
    for k, item in enumerate(scene.spec.objects):
        if item.name in names:
            refuse(f"objects[{k}].name: {item.name!r} is also the name of objects[{names[item.name]}]; rename one",
                   "objects", k, "name")  # fmt: skip
        names[item.name] = k
        if isinstance(item.shape, ScatterSpec):
            on = item.shape.on
            grounds = [o.name for o in scene.spec.objects if isinstance(o.shape, TerrainSpec | RectangleSpec)]
            here = ("objects", k, "shape")
            if on is not None and on not in grounds:
                refuse(f"objects[{k}].shape.on: got {on!r}{_suggest(on, grounds)}; expected the name of a terrain or "
                       f"a rectangle of this scene: {', '.join(grounds) or 'there is none'}", *here, "on")  # fmt: skip
            if not len(item.shape.places()):
                refuse(f"objects[{k}].shape.avoid: leaves no room for any of the {item.shape.count}; make it smaller "
                       "or the radius larger", *here, "avoid")  # fmt: skip
        if isinstance(item.shape, MeshSpec):
            path = scene.mesh_path(item.shape)
            where = ("objects", k, "shape", "file")
            if path.suffix.lower() not in shapes.MESH_SUFFIXES:
                near = _suggest(path.suffix.lower(), shapes.MESH_SUFFIXES)
                refuse(f"objects[{k}].shape.file: {item.shape.file!r} is not of a known mesh format{near}; "
                       f"one of {', '.join(shapes.MESH_SUFFIXES)}", *where)  # fmt: skip
            if not path.is_file():
                there = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
                refuse(f"objects[{k}].shape.file: there is no file {path}{_suggest(path.name, there)}; "
                       "the path counts from the folder of the scene file", *where)  # fmt: skip
    skies = [k for k, light in enumerate(scene.spec.lights) if isinstance(light, SkySpec)]
    if len(skies) > 1:
        refuse(f"lights[{skies[1]}]: a second sky; there is only one all-around light, keep one", "lights", skies[1])
    if not scene.spec.lights and not any(item.emission for item in scene.spec.objects):
        refuse("lights: there is none, and no object has an 'emission'; add a sun, a sky, a point or a spot", "lights")
    for message, at_fault in contradictions(scene.spec):
        refuse(message, *at_fault)
    for message, spot in edits.problems(scene.spec):
        refuse(message, *spot)
    cameras = _check_cameras(scene, refuse)
    for item in scene.spec.objects:
        inside = _inside(scene, item)
        for camera, loc in cameras:
            if inside(camera.position):
                at = ", ".join(f"{x:.4g}" for x in camera.position)
                refuse(f"{'.'.join(map(str, loc))}: the camera {camera.name!r} at ({at}) is inside the object "
                       f"{item.name!r}; change its yaw, height or radius, or move the object", *loc)  # fmt: skip


def _check_cameras(scene: Scene, refuse: Callable[..., None]) -> list[tuple[Camera, tuple[int | str, ...]]]:
    orbit = scene.spec.cameras
    if min(orbit.size) < 1:
        refuse(f"cameras.size: got {list(orbit.size)}, expected at least [1, 1] (width, height)", "cameras", "size")
    seen: dict[str, str] = {}
    cameras = []
    for k, view in enumerate([orbit.source, *orbit.targets]):
        loc: tuple[int | str, ...] = ("cameras", "targets", k - 1) if k else ("cameras", "source")
        place = f"cameras.targets[{k - 1}]" if k else "cameras.source"
        name = view_name(view, k)
        if name in seen:
            refuse(f"{place}: the camera name {name!r} is also that of {seen[name]}; give one of them a 'name'", *loc)
        seen[name] = place
        try:
            cameras.append((_orbit_camera(orbit, view, k), loc))
        except ValueError as error:
            refuse(f"{place}: no such camera: {error}; change its height, radius or look_at", *loc)
    return cameras


def _inside(scene: Scene, item: ObjectSpec) -> Callable[[Array], bool]:
    """A test whether a point is inside the object. A body is asked by its distance, which needs no meshing."""
    spec = item.shape
    if isinstance(spec, BodySpec):
        R, offset = _turn_z(spec.yaw), np.array(spec.position)
        return lambda point: spec.contains((point - offset) @ R / spec.scale)
    if isinstance(spec, TerrainSpec):
        return spec.below
    if isinstance(spec, ScatterSpec):
        return lambda point: False  # blades and leaves have no inside, and stones are small
    solids = list(scene._build(item, 0))
    return lambda point: any(solid.contains(point) for solid in solids)
