"""What the truth of the scenes costs from nothing: meshes, geometry and pictures, timed with an
empty cache.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from attnwarp_eval.scene.file import load_scene

STAGES = ("meshes", "geometry", "first picture", "other pictures")


@dataclass(frozen=True)
class SceneTime:
    """Seconds that one scene's truth took, by stage.

    Attributes:
        scene: its name.
        views: how many cameras were traced and rendered.
        wall, cpu: stage -> seconds; "meshes" reads the file and meshes its bodies, "first picture"
            also loads the scene into Mitsuba and compiles its integrators.
        variant: Mitsuba's.
    """

    scene: str
    views: int
    wall: dict[str, float]
    cpu: dict[str, float]
    variant: str


@contextmanager
def empty_cache() -> Iterator[None]:
    """Derived files go to a folder that is new and gone afterwards, here and in child processes."""
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
    progress: Callable[[str], None] = lambda _: None,
) -> Iterator[SceneTime]:
    """Make each scene's truth from nothing, one after the other, and say what it took.

    Args:
        names: scenes' names or paths.
        views: the source and the targets that come first in the file, fewer where a scene has
            fewer.
        geometry_size, size: of the square images of depth and ids, and of the pictures.
        spp: samples a pixel of the pictures.
        progress: told what is at work.
    """
    from attnwarp_eval.truth import Geometry, appearance
    from attnwarp_eval.truth.llvm import variant
    from attnwarp_eval.truth.mitsuba import forget

    # What a process pays once (imports, the probe, compiled numba kernels) belongs to no scene.
    warm = load_scene("spheres").with_size(16, 16)
    Geometry(warm).trace(warm.source)
    appearance(warm, warm.source, spp=1)
    for name in names:
        wall, cpu = dict.fromkeys(STAGES, 0.0), dict.fromkeys(STAGES, 0.0)

        @contextmanager
        def stage(
            key: str, wall: dict[str, float] = wall, cpu: dict[str, float] = cpu
        ) -> Iterator[None]:
            start, start_cpu = time.perf_counter(), time.process_time()
            yield
            wall[key] += time.perf_counter() - start
            cpu[key] += time.process_time() - start_cpu

        progress(f"{name}: meshes")
        with empty_cache():
            with stage("meshes"):
                scene = load_scene(name)
                scene.shapes()
            cameras = scene.with_size(geometry_size, geometry_size).cameras[:views]
            progress(f"{name}: geometry of {len(cameras)} views")
            with stage("geometry"):
                geometry = Geometry(scene)
                for camera in cameras:
                    geometry.trace(camera)
            del geometry
            small = scene.with_size(size, size)
            for number, camera in enumerate(small.cameras[:views]):
                progress(f"{name}: picture {number + 1} of {len(cameras)}")
                with stage("other pictures" if number else "first picture"):
                    appearance(small, camera, spp=spp)
        forget()
        yield SceneTime(scene.name, len(cameras), wall, cpu, variant())


def to_dict(times: Sequence[SceneTime]) -> dict[str, Any]:
    """As JSON: every scene, and the sums over scenes."""
    total = {
        kind: {stage: sum(getattr(t, kind)[stage] for t in times) for stage in STAGES}
        for kind in ("wall", "cpu")
    }
    return {"scenes": [asdict(t) for t in times], "total": total}


def columns_and_rows(times: Sequence[SceneTime]) -> tuple[list[str], list[list[str]]]:
    """A table of seconds: wall, with CPU in brackets."""
    columns = ["scene", "views", *(f"{stage}, s" for stage in STAGES), "variant"]
    rows = [
        [t.scene, str(t.views), *(f"{t.wall[s]:.1f} ({t.cpu[s]:.1f})" for s in STAGES), t.variant]
        for t in times
    ]
    total = to_dict(times)["total"]
    sums = [f"{total['wall'][s]:.1f} ({total['cpu'][s]:.1f})" for s in STAGES]
    return columns, [*rows, ["all", str(sum(t.views for t in times)), *sums, ""]]
