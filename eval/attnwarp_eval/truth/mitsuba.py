"""Appearance: pictures of a scene by Mitsuba 3, variant scalar_rgb.

scalar_rgb is the variant that works everywhere; the llvm ones are faster where the machine's LLVM suits them and abort
the whole process where it does not.

Mitsuba computes in float32, so the scene is moved to the middle of its bounding box in float64 first. Its cameras look
along +z with +x to the left and +y up: OpenCV axes are turned by diag(-1, -1, 1).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval.cache import content_key, read_arrays, write_arrays
from attnwarp_eval.shapes import Box, Mesh, Rectangle, Sphere
from attnwarp_eval.textures import albedo, linear_rgb
from attnwarp_eval.truth.shading import sky_radiance, sun_direction

if TYPE_CHECKING:
    from attnwarp_eval.optics import PointSpec, SpotSpec
    from attnwarp_eval.scene import Scene, SkySpec, SunSpec

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

APPEARANCE_PROTOCOL = 1
"""Raised whenever the same scene, camera, plan and seed would give another picture."""

TEXELS = 2048
"""Most texels along the longer side of a baked texture."""

SKY_ROWS = 256
"""Rows of the map that carries the sky's ramp; the ramp is linear in the sine of the elevation, so few would do."""

TEXEL_SIZE = 0.5
"""Size of a texel as a share of a pixel's footprint at the distance that the cameras keep from the middle."""


@dataclass(frozen=True)
class Pass:
    """One rendering; the picture is the sum of the passes, since light adds up.

    Attributes:
        lights: indices of the scene's lights that shine in it.
        integrator: Mitsuba's plugin, "direct" or "path".
        max_depth: longest path in edges from the camera; 2 is direct light.
        emitter_samples, bsdf_samples: rays toward lights and along the material's lobe at each hit ("direct" only).
        spp: samples a pixel.
    """

    lights: tuple[int, ...]
    integrator: str
    max_depth: int
    emitter_samples: int
    bsdf_samples: int
    spp: int


@dataclass(frozen=True)
class Plan:
    """How a picture is made, and why that suffices."""

    passes: tuple[Pass, ...]
    reasons: tuple[str, ...]


def plan_rendering(scene: Scene, spp: int | None = None) -> Plan:
    """The cheapest rendering that shows what ``scene`` asks for.

    Args:
        spp: samples a pixel; the scene's own number if left out.
    """
    from attnwarp_eval.scene import SunSpec

    wanted = scene.spec.appearance
    if spp is not None and spp < 1:
        raise ValueError(f"spp: got {spp}, expected at least 1")
    spp = wanted.spp if spp is None else spp
    lights = scene.spec.lights
    reasons = ["every material is diffuse and opaque: no path passes through glass or a medium, and none is specular"]
    if wanted.bounces == "unlimited":
        return Plan((Pass(tuple(range(len(lights))), "path", -1, 1, 1, spp),), tuple(reasons))
    if wanted.bounces > 1:
        reasons.append(f"the scene asks for {wanted.bounces} bounces: paths of up to {wanted.bounces + 1} edges")
        depth = wanted.bounces + 1
        return Plan((Pass(tuple(range(len(lights))), "path", depth, 1, 1, spp),), tuple(reasons))
    reasons.append("the scene asks for one bounce: light sampled at each visible point is the whole sum")
    suns = tuple(k for k, light in enumerate(lights) if isinstance(light, SunSpec))
    skies = tuple(k for k in range(len(lights)) if k not in suns)
    passes = []
    if suns:
        passes.append(Pass(suns, "direct", 2, 1, 0, spp))
        reasons.append("the sun comes from one direction, so its own pass has no noise but that of the pixel's area")
    if skies:
        passes.append(Pass(skies, "direct", 2, 0, 1, spp))
        reasons.append("the sky is smooth, so rays spread by the cosine leave only the noise of what covers it")
    return Plan(tuple(passes), tuple(reasons))


def appearance(scene: Scene, camera: Camera, spp: int | None = None, seed: int = 0) -> Image:
    """What ``camera`` sees, in linear RGB.

    Args:
        camera: square pixels and no skew; any principal point.
        spp: samples a pixel; the scene's own number if left out.
        seed: the same seed gives the same bits.

    Returns:
        (H, W, 3) float32, not clipped; the sky where nothing is hit. Box-filtered over each pixel. Kept on disk, see
        :mod:`attnwarp_eval.cache`.

    Raises:
        ValueError: a camera that Mitsuba cannot express.
    """
    import mitsuba

    plan = plan_rendering(scene, spp)
    pose = {name: value for name, value in camera.to_dict().items() if name != "name"}
    key = content_key(
        "appearance",
        APPEARANCE_PROTOCOL,
        mitsuba.__version__,
        scene.world_hash,
        _texel(scene),
        pose,
        asdict(plan),
        int(seed),
    )
    stored = read_arrays("appearance", key)
    if stored is None:
        stored = {"image": _render(scene, camera, plan, seed)}
        write_arrays("appearance", key, stored)
    return stored["image"]


def _render(scene: Scene, camera: Camera, plan: Plan, seed: int) -> Image:
    mi = _mitsuba()
    total = np.zeros((camera.height, camera.width, 3), dtype=np.float32)
    for number, step in enumerate(plan.passes):
        options: dict[str, Any] = {"type": step.integrator}
        if step.integrator == "path":
            # Roulette would end paths at random: unbiased, but noise that so short a path is not worth.
            options |= {"max_depth": step.max_depth, "rr_depth": step.max_depth + 1 if step.max_depth > 0 else 5}
        else:
            options |= {"emitter_samples": step.emitter_samples, "bsdf_samples": step.bsdf_samples}
        world, center = _world(scene, step.lights)
        sensor = _sensor(camera, center, {"type": _sampler(step.spp), "sample_count": step.spp}, world)
        picture = mi.render(
            world, sensor=sensor, integrator=mi.load_dict(options), seed=len(plan.passes) * int(seed) + number
        )
        total += np.array(picture, dtype=np.float32)[..., :3]
    return total


def _sampler(spp: int) -> str:
    """Stratified samples where ``spp`` splits into a grid as Mitsuba wants it; elsewhere it would render more."""
    rows = math.isqrt(spp)
    return "multijitter" if rows * math.ceil(spp / rows) == spp else "independent"


def position_and_shape(scene: Scene, camera: Camera) -> tuple[Array, npt.NDArray[np.int64]]:
    """What Mitsuba's own ray tracer hits at the pixel centres, to hold the exact geometry against.

    Returns:
        position: (H, W, 3) world, float32 precision about the scene's middle; NaN where nothing is hit.
        object_id: (H, W) index of the object, -1 where nothing is hit.
    """
    mi = _mitsuba()
    world, center = _world(scene, ())
    integrator = mi.load_dict({"type": "aov", "aovs": "position:position,shape:shape_index"})
    # One sample in the middle of each pixel: stratified without jitter. Averaged positions would lie nowhere.
    sampler = {"type": "stratified", "sample_count": 1, "jitter": False}
    sensor = _sensor(camera, center, sampler, world)
    picture = np.array(mi.render(world, sensor=sensor, integrator=integrator, spp=1), dtype=np.float64)
    shape = np.round(picture[..., 3]).astype(np.int64)  # 1 + place among the shapes, 0 for none
    owners = np.array([-1, *_owners(scene)])
    position = np.where((shape > 0)[..., None], picture[..., :3] + center, np.nan)
    return position, owners[shape]


def _mitsuba() -> Any:
    import mitsuba as mi

    if mi.variant() != "scalar_rgb":
        mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Warn)
    return mi


def _world(scene: Scene, lights: tuple[int, ...]) -> tuple[Any, Array]:
    """The loaded Mitsuba scene with some of its lights, and the (3,) world position of its origin."""
    mi = _mitsuba()
    texel = _texel(scene)
    shapes, center = _kept((scene.world_hash, texel), lambda: _load_shapes(scene, texel))
    lamps = {f"light_{k}": _light(scene.spec.lights[k]) for k in lights}
    # optimize=False: the default merges shapes, after which their indices mean something else.
    return _kept(
        (scene.world_hash, texel, lights),
        lambda: (mi.load_dict({"type": "scene"} | shapes | lamps, optimize=False), center),
    )


_loaded: dict[Any, Any] = {}


def _kept(key: Any, make: Callable[[], Any]) -> Any:
    """The value of ``make``, kept with the last few others: a scene's views come one after the other."""
    if key not in _loaded:
        while len(_loaded) >= 6:
            _loaded.pop(next(iter(_loaded)))
        _loaded[key] = make()
    return _loaded[key]


def _load_shapes(scene: Scene, texel: float) -> tuple[dict[str, Any], Array]:
    mi = _mitsuba()
    bounds = np.stack([shape.bounds() for shape in scene.shapes()])
    center = (bounds[:, 0].min(0) + bounds[:, 1].max(0)) / 2
    with tempfile.TemporaryDirectory(prefix="attnwarp-") as folder:
        forms = _shapes(scene, center, texel, Path(folder))
        return {name: mi.load_dict(form, optimize=False) for name, form in forms}, center


def _faces(scene: Scene) -> Iterator[Sphere | Rectangle | Mesh]:
    for shape in scene.shapes():
        if isinstance(shape, Box):
            yield from shape.rectangles()
        else:
            yield shape


def _owners(scene: Scene) -> list[int]:
    return [shape.object_id for shape in _faces(scene)]


def _shapes(scene: Scene, center: Array, texel: float, folder: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    mi = _mitsuba()
    for index, shape in enumerate(_faces(scene)):
        texture = scene.spec.objects[shape.object_id].texture

        def bake(points: Array, texture: Any = texture) -> dict[str, Any]:
            color = albedo(texture, points.reshape(-1, 3)).reshape(points.shape).astype(np.float32)
            bitmap = mi.Bitmap(np.ascontiguousarray(color))
            return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}

        reflectance: dict[str, Any]
        if isinstance(shape, Sphere):
            columns = _texels(2 * math.pi * shape.radius, texel)
            rows = max(2, columns // 2)
            # Mitsuba's u is the longitude from +x, v the angle from +z; a bitmap in memory starts at v = 0.
            phi = (np.arange(columns) + 0.5) / columns * 2 * np.pi
            theta = ((np.arange(rows) + 0.5) / rows)[:, None] * np.pi
            outward = np.stack(
                [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=-1
            )
            reflectance = bake(shape.center + shape.radius * outward) | {"wrap_mode": "repeat"}
            form: dict[str, Any] = {
                "type": "sphere", "center": (shape.center - center).tolist(), "radius": shape.radius,
            }  # fmt: skip
        elif isinstance(shape, Rectangle):
            columns, rows = (_texels(2 * float(np.linalg.norm(edge)), texel) for edge in (shape.u, shape.v))
            a = ((np.arange(columns) + 0.5) / columns * 2 - 1)[None, :, None]
            b = ((np.arange(rows) + 0.5) / rows * 2 - 1)[:, None, None]
            reflectance = bake(shape.center + a * shape.u + b * shape.v)
            pose = np.eye(4)
            pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = shape.u, shape.v, shape.normal, shape.center - center
            form = {"type": "rectangle", "to_world": mi.ScalarTransform4f(pose)}
        else:
            file = folder / f"{index}.ply"
            color = albedo(texture, shape.vertices) * (1.0 if shape.tint is None else shape.tint)
            _write_ply(file, shape, center, color)
            form = {"type": "ply", "filename": str(file), "face_normals": shape.normals is None}
            reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
        # Two-sided, since splats and warps know no back faces either.
        yield (
            f"shape_{index:06d}",
            form | {"bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}},
        )


def _texel(scene: Scene) -> float:
    """Size of a baked texel in scene units, for pictures of 512 rows."""
    orbit = scene.spec.cameras
    return TEXEL_SIZE * orbit.radius * 2 * math.tan(math.radians(orbit.fov) / 2) / 512


def _texels(length: float, texel: float) -> int:
    return int(np.clip(math.ceil(length / texel), 2, TEXELS))


def _write_ply(path: Path, mesh: Mesh, center: Array, color: Array) -> None:
    """A binary PLY as Mitsuba reads it: r, g, b become the attribute vertex_color."""
    columns = [mesh.vertices - center]
    names = ["x", "y", "z"]
    if mesh.normals is not None:
        columns.append(mesh.normals)
        names += ["nx", "ny", "nz"]
    columns.append(color)
    names += ["r", "g", "b"]
    faces = np.zeros(len(mesh.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(np.concatenate(columns, axis=1).astype("<f4").tobytes())
        file.write(faces.tobytes())


def _light(light: SunSpec | SkySpec | PointSpec | SpotSpec) -> dict[str, Any]:
    from attnwarp_eval.optics import PointSpec, SpotSpec
    from attnwarp_eval.scene import SunSpec

    mi = _mitsuba()
    if isinstance(light, SunSpec):
        color = (light.irradiance * np.array(linear_rgb(light.color))).tolist()
        return {
            "type": "directional",
            "direction": (-sun_direction(light)).tolist(),
            "irradiance": {"type": "rgb", "value": color},
        }
    if isinstance(light, PointSpec | SpotSpec):
        raise ValueError(f"lights: a {light.type} light cannot be rendered yet")
    # The colour depends on the elevation only, so that the map's longitude does not matter.
    up = np.cos((np.arange(SKY_ROWS) + 0.5) / SKY_ROWS * np.pi)
    directions = np.stack([np.sqrt(1 - up**2), np.zeros(SKY_ROWS), up], axis=-1)
    colors = np.repeat(sky_radiance(light, directions)[:, None].astype(np.float32), 8, axis=1)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(colors)),
        # An envmap's pole is +y; scenes have z up.
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
    }


def _sensor(camera: Camera, center: Array, sampler: dict[str, Any], world: Any) -> Any:
    mi = _mitsuba()
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
    reach = size + float(np.linalg.norm(moved.position))
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(camera.width / 2 / fx)),
            "fov_axis": "x",
            "principal_point_offset_x": (camera.width / 2 - camera.K[0, 2]) / camera.width,
            "principal_point_offset_y": (camera.height / 2 - camera.K[1, 2]) / camera.height,
            "near_clip": 1e-4 * reach,
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
            "sampler": sampler,
        }
    )
