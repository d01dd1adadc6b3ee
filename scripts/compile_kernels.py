"""Compile the numba kernels, which numba caches on disk, so that neither a test nor a user's first
call waits, and workers of the tests do not compile the same ones at once.

python -m scripts.compile_kernels            all but the renderer's of float64 splats
python -m scripts.compile_kernels float64    those
"""

from __future__ import annotations

import dataclasses
import os
import sys
import tempfile
from pathlib import Path

import yaml

import attnwarp.render
from attnwarp.gaussians import Gaussians
from attnwarp.losses import normal_consistency
from benchmarks import render, warp

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


def consistency_of_normals(splats: Gaussians) -> None:
    """The loss's kernels, forward and backward."""
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
    from attnwarp_eval.scene.solids import Ellipsoid, mesh_body
    from attnwarp_eval.study import Store, load_study
    from attnwarp_eval.study.run import execute, plan

    mesh_body([Ellipsoid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))], 0.1, 16)
    (folder / "study.yaml").write_text(yaml.safe_dump(STUDY))
    store = Store(folder / "run")
    execute(plan(load_study(str(folder / "study.yaml")), store), store)


if __name__ == "__main__":
    main("float64" in sys.argv[1:])
