"""Compile the kernels of the renderer and of the warp: numba caches them on disk, so that neither a
test nor a user's first call waits, and workers of the tests do not compile the same ones at once.
"""

from __future__ import annotations

from benchmarks import render, warp


def main() -> None:
    """Call every kernel once, on a small case."""
    for kind in ("2d", "3d"):
        render.time_once(render.scene(kind, 100, 0.1), render.camera(32))
    warp.pair_case(64).round()


if __name__ == "__main__":
    main()
