"""Display of scenes: contents in words, and views of the cameras in pictures."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.errors import InputError
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.scene.extent import extent
from attnwarp_eval.scene.meshes import read_mesh_file
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import MeshNotice
from attnwarp_eval.scene.spec import MeshSpec
from attnwarp_eval.truth.plan import plan

Image = npt.NDArray[Any]


def contents(scene: Scene) -> str:
    """Contents of a scene, in words: objects, lights and cameras."""
    spec = scene.spec
    lines = [
        f"{scene.name}: {scene.title}",
        spec.description,
        f"file {scene.path}",
        f"content {scene.content_hash}",
        "",
    ]
    lines.append(f"objects ({len(spec.objects)})")
    for index, item in enumerate(spec.objects):
        lines.append(f"  {index:2} {item.name:16} {item.shape.type:10} {item.texture.type}")
    for item in spec.objects:
        if isinstance(item.shape, MeshSpec):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", MeshNotice)  # the line reports it
                lines.append(f"  {item.shape.file}: {read_mesh_file(scene.mesh_path(item.shape))}")
    reach = extent(scene)
    sides = " x ".join(f"{side:.4g}" for side in reach.high - reach.low)
    lines.append(f"extent: {sides} {spec.units}, made by {', '.join(reach.makers)}")
    if reach.notice:
        lines.append(f"  {reach.notice}")
    lines.append(f"lights: {', '.join(light.type for light in spec.lights)}")
    lines.append(
        f"cameras ({1 + len(scene.targets)}), {scene.source.width} x {scene.source.height} px,"
        f" units {spec.units}"
    )
    for camera in scene.cameras:
        x, y, z = camera.position
        lines.append(f"  {camera.name:12} at ({x:.2f}, {y:.2f}, {z:.2f})")
    return "\n".join(lines)


def pictures_made(scene: Scene) -> str:
    """Plan of a scene's pictures, in words."""
    spec = scene.spec
    lines = ["pictures are made by"]
    planned = plan(scene)
    for step in planned.passes:
        shining = ", ".join([spec.lights[k].type for k in step.lights] + ["lamps"] * step.lamps)
        lines.append(f"  {step.integrator}, {step.spp} samples a pixel, light from {shining}")
    lines += [f"  because {reason}" for reason in planned.reasons]
    return "\n".join(lines)


def render_views(
    scene: Scene, out: Path, *, views: list[str] | None = None, spp: int | None = None,
    report: Reporter = SILENT,
) -> Iterator[Path]:  # fmt: skip
    """Write each view's picture, depth and normals as PNG, and ``sheet.png`` of them all; yield
    each file.

    Args:
        scene: scene at the image size of the output.
        out: output folder, created if missing.
        views: names of cameras; by default all.
        spp: samples a pixel; by default the scene's number.

    Raises:
        InputError: ``views`` is empty, or names a camera unknown to the scene.
    """
    from attnwarp_eval.colors import to_srgb
    from attnwarp_eval.files import write_picture
    from attnwarp_eval.truth import Geometry, appearance

    cameras = scene.cameras if views is None else [scene.camera(name) for name in views]
    if not cameras:
        raise InputError("views: got none, expected names of cameras; leave it out for all of them")
    geometry = Geometry(scene)
    rows = []
    for number, camera in enumerate(cameras):
        report.step(number, len(cameras), camera.name)
        image = to_srgb(appearance(scene, camera, spp=spp))
        hits = geometry.trace(camera)
        pictures = {
            "image": image,
            "depth": depth_picture(hits.depth),
            "normal": normal_picture(hits.normal, camera),
        }
        for what, picture in pictures.items():
            yield write_picture(out / f"{camera.name}-{what}.png", picture)
        rows.append(np.concatenate(list(pictures.values()), axis=1))
    yield write_picture(out / "sheet.png", np.concatenate(rows))


def depth_picture(depth: npt.NDArray[np.float64]) -> Image:
    """Depth in colour, near bright, on a scale of 1 / z within the view; grey if undefined."""
    import matplotlib

    near = 1 / depth
    defined = np.isfinite(near)
    if not defined.any():
        return np.full((*depth.shape, 3), 0.5)
    low, high = near[defined].min(), near[defined].max()
    scaled = (np.nan_to_num(near) - low) / max(high - low, 1e-12 * high)
    return np.where(defined[..., None], matplotlib.colormaps["magma"](scaled)[..., :3], 0.5)


def normal_picture(normal: npt.NDArray[np.float64], camera: Camera) -> Image:
    """Normals (x right, y up, z toward the camera) as red, green, blue; grey if undefined."""
    local = normal @ camera.rotation.T * np.array([1, -1, -1])
    return np.where(np.isfinite(local), 0.5 + 0.5 * np.nan_to_num(local), 0.5)
