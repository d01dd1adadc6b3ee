"""Conversion of a scene to Mitsuba: shapes, materials, lights, fog, cameras, loaded and cached."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import math
import pickle
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.errors import InputError
from attnwarp_eval.cache import content_key
from attnwarp_eval.scene.base import linear_rgb
from attnwarp_eval.scene.extent import warn_of_strays
from attnwarp_eval.scene.materials import (
    GlassMaterial,
    InteriorSpec,
    MetalMaterial,
    MirrorMaterial,
    PlasticMaterial,
    PointSpec,
    SpotSpec,
)
from attnwarp_eval.scene.notices import warn_of_lost_texture
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import Box, Mesh, Rectangle, Shape, Sphere
from attnwarp_eval.scene.spec import MeshSpec, ObjectSpec, SkySpec, SunSpec
from attnwarp_eval.scene.textures import Plain, albedo
from attnwarp_eval.truth.llvm import SCALAR, variant
from attnwarp_eval.truth.passes import Plan, beam
from attnwarp_eval.truth.shading import sky_radiance, sun_direction

Array = npt.NDArray[np.float64]

TEXELS = 2048
"""Most texels along the longer side of a baked texture."""

AT_ONCE = 1 << 14
"""Texels baked at a time, so that intermediate results stay in a core's cache."""

SKY_ROWS = 256
"""Rows of the sky's environment map; few suffice, linear in the sine of the elevation."""

TEXEL_SIZE = 0.5
"""Size of a texel as a share of a pixel's footprint at the distance of the scene's middle."""


@contextlib.contextmanager
def at_most_texels(number: int) -> Iterator[None]:
    """Bake textures of at most ``number`` texels along the longer side, for small pictures."""
    global TEXELS
    former, TEXELS = TEXELS, min(number, TEXELS)
    try:
        yield
    finally:
        TEXELS = former


def owner_of_number(scene: Scene, world: Any) -> npt.NDArray[np.int64]:
    """Object index by the number of a shape in the AOV shape_index; -1 for 0, which is no shape.

    The number is 1 + the shape's index in scalar_rgb, and an index in a process-wide registry in
    the other variants.
    """
    mi = library()
    owners = _owners(scene)
    # A fog's box, which comes last, belongs to no object.
    numbers = list(range(1, len(owners) + 2))
    if mi.variant() != SCALAR:  # its shapes must stay unseen, see load_world
        import drjit

        numbers = [
            int(np.array(drjit.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0])
            for shape in world.shapes()
        ]
    table = np.full(max(numbers) + 1, -1, dtype=np.int64)
    table[numbers[: len(owners)]] = owners
    return table


def use(name: str) -> None:
    """Load or select a variant now, outside any timer."""
    library(name)


def library(name: str | None = None) -> Any:
    """Mitsuba with the variant ``name``, by default with the current one.

    Raises:
        InputError: Mitsuba has no such variant.
    """
    import mitsuba

    mi: Any = mitsuba
    wanted = name or mi.variant() or variant()
    if wanted not in mi.variants():
        raise InputError(
            f"ATTNWARP_MITSUBA: got {wanted!r}, expected one of {', '.join(mi.variants())}; unset"
            " it to have one chosen"
        )
    if mi.variant() != wanted:
        mi.set_variant(wanted)
        mi.set_log_level(mi.LogLevel.Warn)
        # ptracer draws its progress bar at any level; errors are raised, not logged.
        mi.logger().clear_appenders()
    return mi


def load_world(
    scene: Scene,
    lights: tuple[int, ...],
    lamps: bool,
    media: bool,
    narrow: bool = False,
    texel: float | None = None,
    *,
    aims_at_sky: bool = True,
    unseen: bool = False,
) -> tuple[Any, Array, Any]:
    """The loaded Mitsuba scene with some of its lights, the (3,) world position of its origin, and
    the fog or None.

    Args:
        texel: size of a baked texel in scene units; :func:`texel_size` if left out.
        aims_at_sky: see :class:`~attnwarp_eval.truth.passes.Pass`.
        unseen: load shapes invisible to Python, for the integrator aov. It counts references to
            every shape at every sample; for a shape known to Python each count takes the
            interpreter lock, and a picture of positions takes six to eight times as long.
    """
    mi = library()
    texel = texel_size(scene) if texel is None else texel
    base = (mi.variant(), scene.world_hash, texel, TEXELS)
    # Requested or not: absent lights do not change the cache key.
    lamps = lamps and any(item.emission for item in scene.spec.objects)
    media = media and (
        scene.spec.medium is not None or any(interior(item) for item in scene.spec.objects)
    )

    def make() -> tuple[Any, Array, Any]:
        if not unseen:
            forms, center, _ = cached(base, lambda: load_shapes(scene, texel))
            return assembled(forms, center)
        center = _middle(scene.shapes())
        with tempfile.TemporaryDirectory(prefix="attnwarp-") as folder:
            named = zip(_shapes(scene, center, texel, Path(folder)), _owners(scene), strict=True)
            made = [(name, make(), owner) for (name, _, make), owner in named]
            return assembled(
                {name: (form, owner, functools.partial(dict, form)) for name, form, owner in made},
                center,
            )

    def assembled(forms: dict[str, Form], center: Array) -> tuple[Any, Array, Any]:
        shone = {
            f"light_{k}": _beam(scene, k, center)
            if narrow
            else light_form(scene.spec.lights[k], center)
            for k in lights
        }
        if not aims_at_sky:
            for k in lights:
                if isinstance(scene.spec.lights[k], SkySpec):
                    shone[f"light_{k}"] |= {"sampling_weight": 0.0}
        shapes: dict[str, Any] = {}
        fog = None
        around: tuple[Array, Array] | None = None
        if media and scene.spec.medium is not None:
            fog = mi.load_dict(medium_form(scene.spec.medium))
            around = fog_box(scene)
        for key, (shape, owner, form) in forms.items():
            item = scene.spec.objects[owner]
            extra: dict[str, Any] = {}
            if lamps and item.emission:
                extra["emitter"] = {
                    "type": "area",
                    "radiance": _rgb(item.emission.radiance, item.emission.color),
                }
            inside = interior(item)
            if media and inside:
                extra["interior"] = medium_form(inside)
            if (
                fog is not None
                and isinstance(item.material, GlassMaterial)
                and _within(scene, owner, around)
            ):
                # Light that leaves the glass is in the fog again, and a pane has fog on both sides.
                extra["exterior"] = fog
                if item.material.thin:
                    extra["interior"] = fog
            shapes[key] = form() | extra if extra else shape
        if fog is not None and around is not None:
            # Last, so that the other shapes keep the indices of :func:`_owners`.
            pose = np.diag([*((around[1] - around[0]) / 2), 1.0])
            pose[:3, 3] = (around[0] + around[1]) / 2 - center
            shapes["medium"] = {
                "type": "cube",
                "to_world": mi.ScalarTransform4f(pose),
                "bsdf": {"type": "null"},
                "interior": fog,
            }
        # optimize=False: the default merges shapes, which changes their indices.
        return mi.load_dict({"type": "scene"} | shapes | shone, optimize=False), center, fog

    cameras = scene.spec.cameras.model_dump_json(exclude={"size"}) if media else ""
    return cached((*base, lights, lamps, media, narrow, cameras, aims_at_sky, unseen), make)


def interior(item: ObjectSpec) -> InteriorSpec | None:
    """Filling of a glass object, None for any other object."""
    return item.material.interior if isinstance(item.material, GlassMaterial) else None


def fog_box(scene: Scene) -> tuple[Array, Array]:
    """(3,) lowest and highest corner of the scene's medium."""
    medium = scene.spec.medium
    if medium is not None and medium.box is not None:
        middle, half = np.array(medium.box.center), np.array(medium.box.size) / 2
        return middle - half, middle + half
    points = [corner for shape in scene.shapes() for corner in shape.bounds()]
    points += [camera.position for camera in scene.cameras]
    points += [
        np.array(light.position)
        for light in scene.spec.lights
        if isinstance(light, PointSpec | SpotSpec)
    ]
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    # A fog boundary in the plane of a floor would be hit before or after it by chance.
    return low - 0.01 * np.max(high - low), high + 0.01 * np.max(high - low)


def _within(scene: Scene, owner: int, box: tuple[Array, Array] | None) -> bool:
    if box is None:
        return False
    bounds = [shape.bounds() for shape in scene.shapes() if shape.object_id == owner]
    middle = np.mean([b.mean(0) for b in bounds], axis=0)
    return bool(((middle > box[0]) & (middle < box[1])).all())


def medium_form(spec: InteriorSpec) -> dict[str, Any]:
    """Mitsuba dictionary of a homogeneous medium."""
    return {
        "type": "homogeneous",
        "sigma_t": spec.sigma_t,
        "albedo": _rgb(spec.albedo, spec.tint),
        "phase": {"type": "hg", "g": spec.g},
    }


def _rgb(scale: float, color: str) -> dict[str, Any]:
    return {"type": "rgb", "value": (scale * np.array(linear_rgb(color))).tolist()}


_loaded: dict[Any, Any] = {}

CACHED = 12
"""Loaded scenes and shapes in the cache: enough for a plan with a caustic and a rendering with
everything on, in two variants.
"""


def cached(key: Any, make: Callable[[], Any]) -> Any:
    """Cached result of ``make``, with the last few others, for the views of a scene."""
    if key not in _loaded:
        while len(_loaded) >= CACHED:
            _loaded.pop(next(iter(_loaded)))
        _loaded[key] = make()
    return _loaded[key]


def forget() -> None:
    """Drop the loaded scenes, which are cached for the next picture, and the memory of pictures.

    Dr.Jit keeps every freed array for the next array of its size, and pictures differ in size.
    """
    _loaded.clear()
    _kept.clear()
    _baked.clear()
    if "drjit" in sys.modules:
        sys.modules["drjit"].flush_malloc_cache()


Form = tuple[Any, int, Callable[[], dict[str, Any]]]
"""A shape, its object's index, and the source of the shape."""


def load_shapes(scene: Scene, texel: float) -> tuple[dict[str, Form], Array, list[tuple[str, str]]]:
    """Shapes that neither shine nor hold a medium, by name; origin; plugins."""
    mi = library()
    center = _middle(scene.shapes())
    kept: dict[Any, tuple[Form, list[tuple[str, str]]]] = {}
    with tempfile.TemporaryDirectory(prefix="attnwarp-") as folder:
        for (name, content, make), owner in zip(
            _shapes(scene, center, texel, Path(folder)), _owners(scene), strict=True
        ):
            key = (mi.variant(), name, content)
            if key in _kept:
                kept[key] = _kept[key]
                continue
            form = make()
            item = scene.spec.objects[owner]
            again: Callable[[], dict[str, Any]] = dict
            if item.emission or isinstance(item.material, GlassMaterial):
                again = functools.partial(dict, form)
            if again is not dict and form["type"] == "ply":
                # The file is deleted before a lamp or a filled glass is built from it.
                data = Path(form["filename"]).read_bytes()
                again = functools.partial(_from_memory, dict(form), data)
            shape = mi.load_dict(form, optimize=False)
            kept[key] = (shape, owner, again), plugin_names(name, form)
    _kept.clear()
    _kept.update(kept)
    out = {name: form for (_, name, _), (form, _) in kept.items()}
    return out, center, [each for _, plugins in kept.values() for each in plugins]


_kept: dict[Any, tuple[Form, list[tuple[str, str]]]] = {}
"""Shapes of the last scene, with their plugins: its edits and their answers share nearly all."""


def _middle(shapes: Sequence[Shape]) -> Array:
    """(3,) middle of the bounding box, in world coordinates; the origin of the loaded scene."""
    bounds = np.stack([shape.bounds() for shape in shapes])
    middle: Array = (bounds[:, 0].min(0) + bounds[:, 1].max(0)) / 2
    return middle


def _faces(scene: Scene) -> Iterator[Sphere | Rectangle | Mesh]:
    for shape in scene.shapes():
        if isinstance(shape, Box):
            yield from shape.rectangles()
        else:
            yield shape


def _owners(scene: Scene) -> list[int]:
    return [shape.object_id for shape in _faces(scene)]


def _shapes(
    scene: Scene, center: Array, texel: float, folder: Path
) -> Iterator[tuple[str, bytes, Callable[[], dict[str, Any]]]]:
    """Name, hash and maker of each shape's Mitsuba dictionary; equal hashes, equal shapes."""
    baked: dict[Any, npt.NDArray[np.float32]] = {}
    warn_of_strays(scene, scene.shapes())
    for index, shape in enumerate(_faces(scene)):
        item = scene.spec.objects[shape.object_id]
        if isinstance(item.shape, MeshSpec) and isinstance(shape, Mesh):
            warn_of_lost_texture(item, shape)
        place = hashlib.sha256(pickle.dumps((shape, texel, TEXELS))).digest()
        texels = (item.texture.model_dump_json(), place)
        if texels in _baked:
            baked[texels] = _baked[texels]
        content = hashlib.sha256(place + center.tobytes() + item.model_dump_json().encode())
        file = folder / f"{index}.ply"
        make = functools.partial(_form, shape, item, center, texel, file, baked, texels)
        yield f"shape_{index:06d}", content.digest(), make
    _baked.clear()
    _baked.update(baked)


def _form(
    shape: Sphere | Rectangle | Mesh,
    item: ObjectSpec,
    center: Array,
    texel: float,
    file: Path,
    baked: dict[Any, npt.NDArray[np.float32]],
    key: Any,
) -> dict[str, Any]:
    """Mitsuba dictionary of a shape; its texels are kept under ``key`` in ``baked``."""
    mi = library()
    texture = item.texture

    def bake(size: tuple[int, int], points: Callable[[], Array]) -> dict[str, Any]:
        if isinstance(texture, Plain) and not texture.variation:
            color = np.empty((*size, 3), dtype=np.float32)
            color[:] = albedo(texture, np.zeros((1, 3)))  # one colour for millions of texels
        else:
            if key not in baked:
                baked[key] = _colors(texture, points())
            color = baked[key]
        return {
            "type": "bitmap",
            "bitmap": mi.Bitmap(color),
            "raw": True,
            "filter_type": "bilinear",
            "wrap_mode": "clamp",
        }

    reflectance: dict[str, Any]
    if isinstance(shape, Sphere):
        columns = _texels(2 * math.pi * shape.radius, texel)
        rows = max(2, columns // 2)

        def on_sphere() -> Array:
            # Mitsuba's u is the longitude from +x, v the angle from +z; a bitmap in memory starts
            # at v = 0.
            phi = (np.arange(columns) + 0.5) / columns * 2 * np.pi
            theta = ((np.arange(rows) + 0.5) / rows)[:, None] * np.pi
            outward = np.stack(
                [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi],
                axis=-1,
            )
            return shape.center + shape.radius * outward

        reflectance = bake((rows, columns), on_sphere) | {"wrap_mode": "repeat"}
        form: dict[str, Any] = {
            "type": "sphere",
            "center": (shape.center - center).tolist(),
            "radius": shape.radius,
        }
    elif isinstance(shape, Rectangle):
        columns, rows = (
            _texels(2 * float(np.linalg.norm(edge)), texel) for edge in (shape.u, shape.v)
        )

        def on_rectangle() -> Array:
            a = ((np.arange(columns) + 0.5) / columns * 2 - 1)[None, :, None]
            b = ((np.arange(rows) + 0.5) / rows * 2 - 1)[:, None, None]
            return shape.center + a * shape.u + b * shape.v

        reflectance = bake((rows, columns), on_rectangle)
        pose = np.eye(4)
        pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = (
            shape.u,
            shape.v,
            shape.normal,
            shape.center - center,
        )
        form = {"type": "rectangle", "to_world": mi.ScalarTransform4f(pose)}
    else:
        color = albedo(texture, shape.vertices) * (1.0 if shape.tint is None else shape.tint)
        _write_ply(file, shape, center, color)
        form = {"type": "ply", "filename": str(file), "face_normals": shape.normals is None}
        reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
    return form | {"bsdf": _bsdf(item, reflectance)}


_baked: dict[Any, npt.NDArray[np.float32]] = {}
"""Texels of the last scene: its edits and their answers share nearly all of them."""


def _colors(texture: Any, points: Array) -> npt.NDArray[np.float32]:
    """Albedo of a texture at (H, W, 3) points, a part at a time."""
    color = np.empty(points.shape, dtype=np.float32)
    texels, colors = points.reshape(-1, 3), color.reshape(-1, 3)
    for some in range(0, len(texels), AT_ONCE):
        colors[some : some + AT_ONCE] = albedo(texture, texels[some : some + AT_ONCE])
    return color


def _bsdf(item: ObjectSpec, reflectance: dict[str, Any]) -> dict[str, Any]:
    material = item.material
    inner: dict[str, Any]
    match material:
        case GlassMaterial():
            kind = (
                "thindielectric"
                if material.thin
                else "roughdielectric"
                if material.roughness
                else "dielectric"
            )
            rough = (
                {"alpha": material.roughness, "distribution": "ggx"} if material.roughness else {}
            )
            tint = {"specular_transmittance": _rgb(1.0, material.tint)}
            return {"type": kind, "int_ior": material.ior, "ext_ior": 1.0} | tint | rough
        case MirrorMaterial():
            inner = {
                "type": "conductor",
                "material": "none",
                "specular_reflectance": _rgb(1.0, material.tint),
            }
        case MetalMaterial():
            inner = {
                "type": "conductor",
                "material": material.metal,
                "specular_reflectance": _rgb(1.0, material.tint),
            }
            if material.roughness:
                inner |= {
                    "type": "roughconductor",
                    "alpha": material.roughness,
                    "distribution": "ggx",
                }
        case PlasticMaterial():
            inner = {
                "type": "roughplastic",
                "int_ior": material.ior,
                "ext_ior": 1.0,
                "alpha": material.roughness,
                "distribution": "ggx",
                "diffuse_reflectance": reflectance,
            }
        case _:
            inner = {
                "type": "diffuse",
                "reflectance": {"type": "rgb", "value": 0.0} if item.emission else reflectance,
            }
    # Two-sided, since splats and warps have no back faces either.
    return {"type": "twosided", "bsdf": inner}


def texel_size(scene: Scene) -> float:
    """Size of a baked texel in scene units, for pictures of 512 rows."""
    orbit = scene.spec.cameras
    return TEXEL_SIZE * orbit.radius * 2 * math.tan(math.radians(orbit.fov) / 2) / 512


def _texels(length: float, texel: float) -> int:
    return int(np.clip(math.ceil(length / texel), 2, TEXELS))


def _from_memory(form: dict[str, Any], data: bytes) -> dict[str, Any]:
    """A mesh's dictionary with its file rewritten; the file stays until the process ends."""
    folder = _files()
    path = Path(folder.name) / f"{content_key(data.hex())}.ply"
    path.write_bytes(data)
    return form | {"filename": str(path)}


@functools.cache
def _files() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="attnwarp-")


NEEDLE = 2e-3
"""Ratio of a triangle's shortest to its longest edge below which it is a needle. Mitsuba
interpolates vertex colours with barycentric coordinates recomputed in float32, whose denominator
falls with the square of this ratio: 3 % wrong here, and NaN or any number at 3e-4."""


def without_needles(vertices: Array, faces: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Faces with the short edge of every needle collapsed to one vertex, and without degenerate
    faces.

    Args:
        vertices: (V, 3).
        faces: (F, 3).

    Returns:
        (G, 3), G <= F. Surfaces stay closed and move by at most the lengths of the collapsed
        edges.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1)
    length = np.linalg.norm(vertices[edges[..., 0]] - vertices[edges[..., 1]], axis=-1)
    short = length < NEEDLE * length.max(axis=1, keepdims=True)
    if not short.any():
        return faces
    ends = edges[short]
    joined = coo_array(
        (np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(vertices), len(vertices))
    )
    _, group = connected_components(joined, directed=False)
    first = np.full(group.max() + 1, len(vertices), dtype=np.int64)
    np.minimum.at(first, group, np.arange(len(vertices)))
    out = first[group][faces]
    whole = (out[:, 0] != out[:, 1]) & (out[:, 1] != out[:, 2]) & (out[:, 2] != out[:, 0])
    return out[whole]


def _write_ply(path: Path, mesh: Mesh, center: Array, color: Array) -> None:
    """Write a binary PLY for Mitsuba: r, g, b become the attribute vertex_color."""
    columns = [mesh.vertices - center]
    names = ["x", "y", "z"]
    if mesh.normals is not None:
        columns.append(mesh.normals)
        names += ["nx", "ny", "nz"]
    columns.append(color)
    names += ["r", "g", "b"]
    triangles = without_needles(mesh.vertices, mesh.faces)
    faces = np.zeros(len(triangles), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(np.concatenate(columns, axis=1).astype("<f4").tobytes())
        file.write(faces.tobytes())


def light_form(light: SunSpec | SkySpec | PointSpec | SpotSpec, center: Array) -> dict[str, Any]:
    """Mitsuba dictionary of a light, relative to ``center``."""
    mi = library()
    if isinstance(light, SunSpec):
        color = (light.irradiance * np.array(linear_rgb(light.color))).tolist()
        return {
            "type": "directional",
            "direction": (-sun_direction(light)).tolist(),
            "irradiance": {"type": "rgb", "value": color},
        }
    if isinstance(light, PointSpec | SpotSpec):
        position = (np.array(light.position) - center).tolist()
        strength = _rgb(light.intensity, light.color)
        if isinstance(light, PointSpec):
            return {"type": "point", "position": position, "intensity": strength}
        toward = (np.array(light.target) - center).tolist()
        upright = np.cross(np.array(light.target) - np.array(light.position), [0, 0, 1.0])
        up = [0, 0, 1] if np.linalg.norm(upright) > 1e-6 else [1, 0, 0]
        return {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at(origin=position, target=toward, up=up),
            "intensity": strength,
            "cutoff_angle": light.cutoff,
            "beam_width": 0.75 * light.cutoff if light.beam is None else light.beam,
        }
    # The colour depends on the elevation only, so that the map's longitude does not matter.
    height = np.cos((np.arange(SKY_ROWS) + 0.5) / SKY_ROWS * np.pi)
    directions = np.stack([np.sqrt(1 - height**2), np.zeros(SKY_ROWS), height], axis=-1)
    colors = np.repeat(sky_radiance(light, directions)[:, None].astype(np.float32), 8, axis=1)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(colors)),
        # An envmap's pole is +y; scenes have z up.
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
    }


def _beam(scene: Scene, light: int, center: Array) -> dict[str, Any]:
    """Point light as a spot on the smooth objects: equal light within the cone, none outside."""
    cone, spec = beam(scene, light), scene.spec.lights[light]
    if cone is None or not isinstance(spec, PointSpec):
        raise ValueError(f"lights[{light}]: got a {spec.type} without a beam upon smooth objects")
    axis, angle = cone
    spot = SpotSpec(
        type="spot",
        position=spec.position,
        target=tuple(np.array(spec.position) + axis),
        intensity=spec.intensity,
        color=spec.color,
        cutoff=angle,
        beam=0.999 * angle,
    )
    return light_form(spot, center)


def load_sensor(
    scene: Scene,
    camera: Camera,
    center: Array,
    sampling: dict[str, Any],
    world: Any,
    plan: Plan,
    fog: Any,
) -> Any:
    """Mitsuba sensor of a camera.

    Raises:
        ValueError: a camera that Mitsuba cannot express.
    """
    mi = library()
    fx, fy, skew = camera.K[0, 0], camera.K[1, 1], camera.K[0, 1]
    if abs(fx / fy - 1) > 1e-6 or skew != 0:
        raise ValueError(
            f"camera: got fx={fx:.6g}, fy={fy:.6g}, skew={skew:.6g}; Mitsuba has square pixels and "
            "no skew, so use fx = fy and skew = 0"
        )
    moved = camera.moved((-center).tolist())
    pose = np.linalg.inv(moved.world_to_camera) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    box = world.bbox()
    size = float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
    # A power of 2: this constant of the compiled code should be the same for all views.
    reach = 2.0 ** math.ceil(math.log2(size + float(np.linalg.norm(moved.position))))
    form: dict[str, Any] = {
        "type": "perspective",
        "fov": math.degrees(2 * math.atan(camera.width / 2 / fx)),
        "fov_axis": "x",
        "principal_point_offset_x": (camera.width / 2 - camera.K[0, 2]) / camera.width,
        "principal_point_offset_y": (camera.height / 2 - camera.K[1, 2]) / camera.height,
        "near_clip": 5e-5 * reach,
        "far_clip": 10 * reach,
        "to_world": mi.ScalarTransform4f(pose),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": sampling,
    }
    if plan.lens is not None:
        off = max(
            abs(form.pop("principal_point_offset_x")), abs(form.pop("principal_point_offset_y"))
        )
        if off > 1e-9:
            raise ValueError(
                f"camera: got a principal point {off:.3g} image sizes off the middle, but a lens"
                " needs it there; take away cameras.lens or centre the image"
            )
        form |= {"type": "thinlens", "aperture_radius": plan.lens.aperture,
                 "focus_distance": plan.lens.focus or focus_distance(scene, camera)}  # fmt: skip
    if fog is not None:
        low, high = fog_box(scene)
        if ((camera.position > low) & (camera.position < high)).all():
            form["medium"] = fog
    return mi.load_dict(form)


def focus_distance(scene: Scene, camera: Camera) -> float:
    """Depth of the cameras' look-at point, or the orbit's radius if it is behind."""
    depth = float((camera.world_to_camera @ np.array([*scene.center, 1.0]))[2])
    return depth if depth > 0 else scene.spec.cameras.radius


def plugin_names(path: str, form: Any) -> list[tuple[str, str]]:
    """(place, plugin name) of a dictionary and of all nested ones."""
    if not isinstance(form, dict):
        return []
    out = [(path, str(form["type"]))] if "type" in form else []
    for key, value in form.items():
        out += plugin_names(f"{path}.{key}", value)
    return out
