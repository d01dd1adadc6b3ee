"""Scene files: finding, reading and checking them, with actionable messages."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

from pydantic import ValidationError

from attnwarp.camera import Camera
from attnwarp.errors import suggest
from attnwarp.io.text import read_text
from attnwarp_eval.scene import edits
from attnwarp_eval.scene.explain import explain
from attnwarp_eval.scene.meshes import MESH_SUFFIXES
from attnwarp_eval.scene.scene import Scene, SceneError, inside, orbit_camera, view_name
from attnwarp_eval.scene.spec import MeshSpec, RectangleSpec, SceneSpec
from attnwarp_eval.scene.terrain import ScatterSpec, TerrainSpec
from attnwarp_eval.scene.transport import contradictions
from attnwarp_eval.scene.yaml import Place, YamlError, line_of, read_yaml


def scene_folders() -> list[Path]:
    """Folders searched for scenes by name: ``./scenes``, then those of the package (in a
    checkout: its ``scenes``).

    Example:
        >>> [folder.name for folder in scene_folders()][-1]
        'scenes'
    """
    folders = [Path.cwd() / "scenes", (Path(__file__).parents[1] / "scenes").resolve()]
    return [f for k, f in enumerate(folders) if f.is_dir() and f not in folders[:k]]


def list_scenes() -> list[str]:
    """Names of the scenes that :func:`load_scene` finds by name, sorted.

    Example:
        >>> "spheres" in list_scenes()
        True
    """
    return sorted({path.stem for folder in scene_folders() for path in folder.glob("*.yaml")})


def is_scene_file(name: object) -> bool:
    """Return True if :func:`load_scene` treats this as a file, not as a name.

    Example:
        >>> is_scene_file("my/scene.yaml"), is_scene_file("bear")
        (True, False)
    """
    if not isinstance(name, str):
        return False
    return Path(name).suffix in (".yaml", ".yml") or len(Path(name).parts) != 1


def scene_name(name_or_path: str) -> str:
    """Name of a scene independent of its folder: the name, or the file's without a suffix.

    Example:
        >>> scene_name("my/room.yaml"), scene_name("bear")
        ('room', 'bear')
    """
    return Path(name_or_path).stem if is_scene_file(name_or_path) else name_or_path


def load_scene(name_or_path: str | os.PathLike[str]) -> Scene:
    """Load a scene by name (``"bear"``) or by file (``"my/scene.yaml"``).

    Args:
        name_or_path: a path, or a name, searched in ``./scenes``, then in the package.

    Raises:
        SceneError: the file is missing, or an entry cannot be used. The message names the file, the
            line if there is one, the value and the remedy.

    Example:
        >>> scene = load_scene("spheres")
        >>> scene.object_names[0], scene.source.width
        ('ground', 512)
        >>> load_scene("sphere")
        Traceback (most recent call last):
        attnwarp_eval.scene.scene.SceneError: ...
    """
    return _read(scene_file(name_or_path))


def scene_file(name_or_path: str | os.PathLike[str]) -> Path:
    """The file of a scene by name or by file.

    Raises:
        SceneError: no such scene.

    Example:
        >>> scene_file("spheres").name
        'spheres.yaml'
    """
    text = os.fspath(name_or_path)
    path = Path(text).expanduser()
    if is_scene_file(text):
        if not path.is_file():
            raise SceneError(f"no such scene file{suggest(path.name, _siblings(path))}", path)
        return path
    for folder in scene_folders():
        if (folder / f"{text}.yaml").is_file():
            return folder / f"{text}.yaml"
    if re.fullmatch(r"drawn-\d+", text):
        raise SceneError(
            f"{text!r} is of a population, which says what is drawn: in a study's file"
            " scenes: {drawn: 48, generator: 1, seed: 7}; attnwarp-eval scenes draw writes files"
        )
    available = list_scenes()
    raise SceneError(
        f"no scene named {text!r}{suggest(text, available)}; known scenes:"
        f" {', '.join(available) or 'none'}; a file of your own is named by its path, such as"
        " my/scene.yaml"
    )


def _siblings(path: Path) -> list[str]:
    return [p.name for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []


def _read(path: Path) -> Scene:
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"cannot be read: {error}", path) from error
    try:
        lines, data = read_yaml(text)
    except YamlError as error:
        hint = "" if error.line else "; docs/truth/scenes.md has an example to start from"
        raise SceneError(f"{error}{hint}", path, error.line) from error
    try:
        spec = SceneSpec.model_validate(data)
    except ValidationError as error:
        # Misspelt keys first: a missing key is often only misspelt.
        problems = sorted(
            error.errors(include_url=False), key=lambda p: p["type"] != "extra_forbidden"
        )
        first = problems[0]
        more = f" (and {len(problems) - 1} more below it)" if len(problems) > 1 else ""
        loc = (*first["loc"], "type") if first["type"] == "union_tag_invalid" else first["loc"]
        raise SceneError(
            explain(first, SceneSpec, "docs/truth/scenes.md") + more, path, line_of(lines, loc)
        ) from error
    scene = Scene(spec, path)
    _check(scene, lines)
    return scene


def _check(scene: Scene, lines: dict[Place, int]) -> None:
    """Check conditions across fields: clashing names, missing files, impossible cameras."""

    def refuse(message: str, *loc: int | str) -> None:
        raise SceneError(message, scene.path, line_of(lines, loc))

    names: dict[str, int] = {}
    for k, item in enumerate(scene.spec.objects):
        if item.name in names:
            refuse(
                f"objects[{k}].name: {item.name!r} is also the name of objects[{names[item.name]}];"
                " rename one",
                "objects",
                k,
                "name",
            )
        names[item.name] = k
        if isinstance(item.shape, ScatterSpec):
            on = item.shape.on
            grounds = [
                o.name
                for o in scene.spec.objects
                if isinstance(o.shape, TerrainSpec)
                or (isinstance(o.shape, RectangleSpec) and not any(o.shape.facing[:2]))
            ]
            here = ("objects", k, "shape")
            if on is not None and on not in grounds:
                refuse(
                    f"objects[{k}].shape.on: got {on!r}{suggest(on, grounds)}; expected the name of"
                    " a terrain or a level rectangle of this scene:"
                    f" {', '.join(grounds) or 'there is none'}",
                    *here,
                    "on",
                )
            if not len(item.shape.places()):
                refuse(
                    f"objects[{k}].shape.avoid: leaves no room for any of the {item.shape.count};"
                    " make it smaller or the radius larger",
                    *here,
                    "avoid",
                )
        if isinstance(item.shape, MeshSpec):
            path = scene.mesh_path(item.shape)
            key = ("objects", k, "shape", "file")
            if path.suffix.lower() not in MESH_SUFFIXES:
                near = suggest(path.suffix.lower(), MESH_SUFFIXES)
                refuse(
                    f"objects[{k}].shape.file: {item.shape.file!r} is not of a known mesh"
                    f" format{near}; one of {', '.join(MESH_SUFFIXES)}",
                    *key,
                )
            if not path.is_file():
                beside = path.parent.iterdir() if path.parent.is_dir() else ()
                there = [p.name for p in beside if p.suffix.lower() in MESH_SUFFIXES]
                refuse(
                    f"objects[{k}].shape.file: there is no file {path}{suggest(path.name, there)}; "
                    "the path counts from the folder of the scene file",
                    *key,
                )
    for message, at_fault in contradictions(scene.spec):
        refuse(message, *at_fault)
    for message, spot in edits.problems(scene.spec):
        refuse(message, *spot)
    cameras = _check_cameras(scene, refuse)
    for item in scene.spec.objects:
        holds = inside(scene, item)
        for camera, loc in cameras:
            if holds(camera.position):
                position = ", ".join(f"{x:.4g}" for x in camera.position)
                refuse(
                    f"{'.'.join(map(str, loc))}: the camera {camera.name!r} at ({position}) is"
                    f" inside the object {item.name!r}; change its yaw, height or radius, or move"
                    " the object",
                    *loc,
                )


def _check_cameras(
    scene: Scene, refuse: Callable[..., None]
) -> list[tuple[Camera, tuple[int | str, ...]]]:
    orbit = scene.spec.cameras
    if min(orbit.size) < 1:
        refuse(
            f"cameras.size: got {list(orbit.size)}, expected at least [1, 1] (width, height)",
            "cameras",
            "size",
        )
    seen: dict[str, str] = {}
    cameras = []
    for k, view in enumerate([orbit.source, *orbit.targets]):
        loc: tuple[int | str, ...] = ("cameras", "targets", k - 1) if k else ("cameras", "source")
        place = f"cameras.targets[{k - 1}]" if k else "cameras.source"
        name = view_name(view, k)
        if name in seen:
            refuse(
                f"{place}: the camera name {name!r} is also that of {seen[name]}; give one of them"
                " a 'name'",
                *loc,
            )
        seen[name] = place
        try:
            cameras.append((orbit_camera(orbit, view, k), loc))
        except ValueError as error:
            refuse(f"{place}: no such camera: {error}; change its height, radius or look_at", *loc)
    return cameras
