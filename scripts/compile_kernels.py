"""Compile the numba kernels, which numba caches on disk, so that neither a test nor a user's first
call waits, and workers of the tests do not compile the same ones at once.

python -m scripts.compile_kernels            all but the renderer's of float64 splats
python -m scripts.compile_kernels float64    those
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from llvmlite.binding import get_host_cpu_name

from attnwarp import numba_cache

if TYPE_CHECKING:
    from attnwarp.gaussians import Gaussians

STUDY = {
    "name": "kernels",
    "size": 16,
    "scenes": ["spheres"],
    "views": ["yaw030"],
    "feature_sizes": [16],
    "spp": 1,
    "splats": {"count": 200},
    "variants": {"corrected": {"preset": "corrected"}},
    "probes": {"depth": ["corrected"], "warp": ["corrected"]},
}


def main(float64: bool) -> None:
    """Call every kernel once, on a small case."""
    from benchmarks import render, warp

    for kind in ("2d", "3d"):
        splats = render.scene(kind, 100, 0.1)
        render.time_once(in_double(splats) if float64 else splats, render.camera(32))
        consistency_of_normals(in_double(splats) if float64 else splats)
    if float64:
        return
    for work in warp.pair_case(64).contestants.values():
        work()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ATTNWARP_CACHE"] = str(Path(folder) / "derived")
        scenes_and_truth(Path(folder))


def once_for_all_checkouts(float64: bool) -> None:
    """Do nothing where kernels are kept by their sources, and those of these sources are there.

    Kernels of sources that nobody called for in 30 days are removed.
    """
    kept = Path(os.environ["NUMBA_CACHE_DIR"])
    done = kept / numba_cache.KEY / f"{sys.version_info[:2]}-{get_host_cpu_name()}-{float64}"
    if not done.exists():
        main(float64)
    with suppress(OSError):  # unwritable, so kernels lie beside their modules
        done.parent.mkdir(parents=True, exist_ok=True)
        done.touch()
        os.utime(done.parent)
        for folder in kept.iterdir():
            if folder.stat().st_mtime < time.time() - 30 * 86400:
                shutil.rmtree(folder, ignore_errors=True)


def consistency_of_normals(splats: Gaussians) -> None:
    """The loss's kernels, forward and backward."""
    import attnwarp.render
    from attnwarp.losses import normal_consistency
    from benchmarks import render

    means = splats.means.clone().requires_grad_(True)
    view = attnwarp.render.render(
        dataclasses.replace(splats, means=means), render.camera(32), backend="cpu"
    )
    normal_consistency(view).backward()


def in_double(splats: Gaussians) -> Gaussians:
    """Convert splats to float64, which has kernels of its own."""
    names = ("means", "quats", "scales", "opacities", "sh")
    return dataclasses.replace(splats, **{name: getattr(splats, name).double() for name in names})


def scenes_and_truth(folder: Path) -> None:
    """Kernels of scenes and of the truth: a body, and a small study."""
    import yaml

    from attnwarp_eval.scene.solids import Ellipsoid, mesh_body
    from attnwarp_eval.study import Store, load_study
    from attnwarp_eval.study.run import execute, plan

    mesh_body([Ellipsoid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))], 0.1, 16)
    (folder / "study.yaml").write_text(yaml.safe_dump(STUDY))
    store = Store(folder / "run")
    execute(plan(load_study(str(folder / "study.yaml")), store), store)


if __name__ == "__main__":
    by_source = "NUMBA_CACHE_LOCATOR_CLASSES" in os.environ
    (once_for_all_checkouts if by_source else main)("float64" in sys.argv[1:])
