"""Cost of the scenes' truth from an empty cache: meshes, geometry and pictures."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from attnwarp.reporting import SILENT, Part, Reporter
from attnwarp_eval.cost import Meter
from attnwarp_eval.document.model import Table
from attnwarp_eval.experiments.distinct_scenes import distinct_scenes
from attnwarp_eval.scene.file import load_scene

STAGES = ("meshes", "geometry", "first picture", "other pictures")


@dataclass(frozen=True)
class SceneTime:
    """Seconds of one scene's truth, by stage.

    Attributes:
        scene: name of the scene.
        views: number of cameras traced and rendered.
        wall, cpu: stage -> seconds; "meshes" reads the file and meshes its bodies, "first picture"
            also loads the scene into Mitsuba and compiles its integrators.
        variant: Mitsuba's variant.
    """

    scene: str
    views: int
    wall: dict[str, float]
    cpu: dict[str, float]
    variant: str


@contextmanager
def empty_cache() -> Iterator[None]:
    """Use a temporary folder for derived files, here and in child processes."""
    before = os.environ.get("ATTNWARP_CACHE")
    with tempfile.TemporaryDirectory(prefix="attnwarp-") as folder:
        os.environ["ATTNWARP_CACHE"] = folder
        try:
            yield
        finally:
            if before is None:
                del os.environ["ATTNWARP_CACHE"]
            else:
                os.environ["ATTNWARP_CACHE"] = before


def measure(
    names: Sequence[str],
    *,
    views: int = 8,
    geometry_size: int = 512,
    size: int = 256,
    spp: int = 64,
    report: Reporter = SILENT,
) -> Iterator[SceneTime]:
    """Compute each scene's truth from an empty cache, one after the other, and time it.

    Args:
        names: scenes' names or paths.
        views: number of views: the source and the first targets of the file, fewer if a scene
            has fewer.
        geometry_size, size: sizes of the square images of depth and ids, and of
            the pictures.

    Raises:
        InputError: a scene that cannot be used, or two scenes with the same name.
    """
    from attnwarp_eval.truth import Geometry, appearance
    from attnwarp_eval.truth.llvm import variant
    from attnwarp_eval.truth.mitsuba import forget

    distinct_scenes(names)  # refuse before the first is timed
    # One-time costs of a process (imports, the probe, compiled numba kernels) belong to no scene.
    warm = load_scene("spheres").with_size(16, 16)
    Geometry(warm).trace(warm.source)
    appearance(warm, warm.source, spp=1)
    for number, name in enumerate(names):
        meter = Meter()
        part = Part(report, number, len(names))
        part.step(0, 0, f"{name}: meshes")
        with empty_cache():
            with meter.stage("meshes"):
                scene = load_scene(name)
                scene.shapes()
            cameras = scene.with_size(geometry_size, geometry_size).cameras[:views]
            part.step(0, 0, f"{name}: geometry of {len(cameras)} views")
            with meter.stage("geometry"):
                geometry = Geometry(scene)
                for camera in cameras:
                    geometry.trace(camera)
            del geometry
            small = scene.with_size(size, size)
            for k, camera in enumerate(small.cameras[:views]):
                part.step(0, 0, f"{name}: picture {k + 1} of {len(cameras)}")
                with meter.stage("other pictures" if k else "first picture"):
                    appearance(small, camera, spp=spp)
        forget()
        wall, cpu = (
            {stage: seconds.get(stage, 0.0) for stage in STAGES}
            for seconds in (meter.wall, meter.cpu)
        )
        yield SceneTime(scene.name, len(cameras), wall, cpu, variant())


def to_dict(times: Sequence[SceneTime]) -> dict[str, Any]:
    """Times as JSON: every scene, and the sums over scenes."""
    total = {
        kind: {stage: sum(getattr(t, kind)[stage] for t in times) for stage in STAGES}
        for kind in ("wall", "cpu")
    }
    return {"scenes": [asdict(t) for t in times], "total": total}


def table(times: Sequence[SceneTime]) -> Table:
    """Seconds by scene and stage: wall, with CPU in brackets."""
    columns = ["scene", "views", *(f"{stage}, s" for stage in STAGES), "variant"]
    rows = [
        [t.scene, str(t.views), *(f"{t.wall[s]:.1f} ({t.cpu[s]:.1f})" for s in STAGES), t.variant]
        for t in times
    ]
    total = to_dict(times)["total"]
    sums = [f"{total['wall'][s]:.1f} ({total['cpu'][s]:.1f})" for s in STAGES]
    rows.append(["all", str(sum(t.views for t in times)), *sums, ""])
    return Table(columns, rows, "wall, with CPU in brackets")
