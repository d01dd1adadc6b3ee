"""Choice of Mitsuba's variant on this machine: compiled by LLVM if it works, interpreted
elsewhere.

``llvm_ad_rgb`` compiles each scene's integrator to vector code and is several times faster
(docs/truth/truth.md), but some LLVMs (14 and 15) abort the whole process instead of raising. So a
child process tries it first.
"""

from __future__ import annotations

import functools
import glob
import os
import re
import subprocess
import sys
from pathlib import Path

LLVM, SCALAR = "llvm_ad_rgb", "scalar_rgb"

OLDEST = 16
"""LLVMs before this are not tried: 14 is refused by Dr.Jit and 15 aborts in its code generator."""

TRIES = 3
"""Most libraries that are tried, each at the cost of a process start."""

PLACES = (
    "{prefix}/lib/libLLVM*",  # conda
    "/usr/lib/*-linux-gnu/libLLVM*",
    "/usr/lib/llvm*/lib/libLLVM*",
    "/usr/lib64/libLLVM*",
    "/usr/lib64/llvm*/lib/libLLVM*",
    "/usr/local/lib/libLLVM*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*",
    "/usr/local/opt/llvm*/lib/libLLVM*",
)
"""Patterns of the paths at which distributions, conda and Homebrew put the library. Dr.Jit's
search takes the first name found, which may be an old version next to a newer one.
"""

PROBE = """
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except Exception:
    pass
import mitsuba
import numpy as np
mitsuba.set_variant("llvm_ad_rgb")
pose = mitsuba.ScalarTransform4f().look_at(origin=[0, 0, -4], target=[0, 0, 0], up=[0, 1, 0])
scene = mitsuba.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": 3},
    "ball": {"type": "sphere", "bsdf": {
        "type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}},
    "sky": {"type": "constant"}, "camera": {"type": "perspective", "fov": 10, "to_world": pose,
    "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}}})
mean = float(np.array(mitsuba.render(scene, spp=64))[..., :3].mean())
print("works" if 0.45 < mean < 0.55 else f"wrong picture: {mean}")
"""
"""A white-lit ball of albedo 0.5 fills the picture: its radiance is 0.5 everywhere."""


@functools.cache
def variant() -> str:
    """Variant that renders pictures: ``llvm_ad_rgb`` if it works, else ``scalar_rgb``.

    Decided once per process. ``ATTNWARP_MITSUBA`` names the variant and skips the test;
    ``DRJIT_LIBLLVM_PATH`` names the library, and then no other is tried. The result is written to
    these two variables, where Dr.Jit and child processes find it.
    """
    named = os.environ.get("ATTNWARP_MITSUBA")
    if named:
        return named
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    # Dr.Jit may still find a library outside the usual places.
    tried: list[str | None] = [chosen] if chosen else [*libraries()[:TRIES]] or [None]
    for library in tried:
        if works(library):
            if library:
                os.environ["DRJIT_LIBLLVM_PATH"] = library
            os.environ["ATTNWARP_MITSUBA"] = LLVM
            return LLVM
    os.environ["ATTNWARP_MITSUBA"] = SCALAR
    return SCALAR


def libraries() -> list[str]:
    """LLVM libraries in the usual places that may work: one path for each version, newest first."""
    newest: dict[tuple[int, ...], str] = {}
    for place in PLACES:
        for path in sorted(glob.glob(place.format(prefix=sys.prefix))):  # noqa: PTH207 - absolute patterns
            number = version(os.path.realpath(path)) or version(path)
            if number is not None and number[0] >= OLDEST and Path(path).is_file():
                newest.setdefault(number, os.path.realpath(path))
    return [newest[key] for key in sorted(newest, reverse=True)]


def version(path: str) -> tuple[int, ...] | None:
    """Version in a library's file name: ``libLLVM-19.so``, ``libLLVM.so.19.1``,
    ``llvm-19/lib/libLLVM.so``.

    None for a name that is not of a shared LLVM library, or has no number.
    """
    name = Path(path).name
    shared = re.fullmatch(
        r"libLLVM(?:-(\d+(?:\.\d+)*))?(?:\.so(?:\.(\d+(?:\.\d+)*))?|\.dylib)", name
    )
    if shared is None:
        return None
    # libLLVM-14.0.6.so.1 ends in the number of its interface, so the number before .so counts
    # first.
    folder = re.search(r"/llvm[-@]?(\d+)(?:\.\d+)*/", path)
    number = shared[1] or shared[2] or (folder[1] if folder else None)
    return tuple(int(part) for part in number.split(".")) if number else None


def works(library: str | None) -> bool:
    """Return True if a child renders with ``library`` (None: Dr.Jit's choice), not crashing."""
    environment = os.environ | ({"DRJIT_LIBLLVM_PATH": library} if library else {})
    try:
        tried = subprocess.run(
            [sys.executable, "-c", PROBE],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            env=environment,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return tried.returncode == 0 and tried.stdout.strip() == "works"
