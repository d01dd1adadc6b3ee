"""Abilities of this machine, and the cost of each lack: the checks of ``attnwarp-eval doctor``.

Checks with a heavy import run in a child process, so that a library that aborts its process cannot
abort this one, and the checks run side by side.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib import metadata, util
from typing import Literal

from attnwarp.errors import EXTRAS, install_command
from attnwarp.process import core_count

State = Literal["ok", "lack", "broken"]

LONGEST = 120
"""Seconds after which a child process is given up."""


@dataclass(frozen=True)
class Check:
    """Check of one ability of the machine.

    Attributes:
        state: "lack": everything runs without it, at a cost; "broken": something needed fails.
        cost: cost of the lack, or the part that fails.
    """

    name: str
    state: State
    text: str
    cost: str = ""
    remedy: str = ""


def checks() -> Iterator[Check]:
    """Yield every check, instant ones first."""
    slow = (ray_casting, pictures, window, graphics_card, weights)
    with ThreadPoolExecutor(len(slow)) as pool:
        pending = [pool.submit(check) for check in slow]
        for check in (versions, extras, cache):
            yield check()
        for future in pending:
            yield future.result()


def versions() -> Check:
    """Python, this package and those that figures depend on; cores."""
    from attnwarp_eval.cost import environment

    here = environment()
    revision = here["git"]["sha"]
    code = f"revision {revision[:12]}" if revision else "installed copy"
    if here["git"]["dirty"]:
        code += " with local changes"
    names = ("numpy", "torch", "numba", "mitsuba", "open3d")
    packages = ", ".join(f"{name} {here['versions'].get(name, '')}" for name in names)
    return Check(
        "versions",
        "ok",
        f"attnwarp {metadata.version('attnwarp')} ({code}), Python {here['versions']['python']};"
        f" {packages}; {core_count()} cores",
    )


def extras() -> Check:
    """The optional packages."""
    missing = {
        name: [module for module in extra.modules if util.find_spec(module) is None]
        for name, extra in EXTRAS.items()
    }
    lacking = [extra for extra, modules in missing.items() if modules]
    if not lacking:
        return Check("packages", "ok", f"all extras: {', '.join(EXTRAS)}")
    named = "; ".join(f"{extra} (without {', '.join(missing[extra])})" for extra in lacking)
    return Check(
        "packages",
        "broken" if "eval" in lacking else "lack",
        f"extras that are not installed: {named}",
        "; ".join(f"{extra}: {EXTRAS[extra].lack}" for extra in lacking),
        install_command(*lacking),
    )


def cache() -> Check:
    """The folder of derived files."""
    from attnwarp.errors import InputError
    from attnwarp_eval import cache

    folder = cache.cache_dir()
    try:
        limit = cache.limit_bytes()
    except InputError as error:
        return Check("cache", "broken", str(folder), str(error), "unset ATTNWARP_CACHE_GB")
    size = sum(size for _, size in cache.usage().values())
    return Check("cache", "ok", f"{folder}: {size / 1e9:.2f} of {limit / 1e9:g} GB")


def _works(check: Check, program: str) -> Check:
    """The check of a program that fails, at its cost, or ends; the last line that it prints takes
    the place of ``text``.
    """
    printed, problem = _child(program)
    if problem:
        return replace(check, cost=f"{check.cost}: {problem}")
    return Check(check.name, "ok", printed)


def ray_casting() -> Check:
    """Open3D's ray casting, from which all truth comes."""
    program = """
import numpy as np
from attnwarp_eval._open3d import open3d
o3d = open3d()
scene = o3d.t.geometry.RaycastingScene()
scene.add_triangles(np.float32([[0, 0, 2], [9, 0, 2], [0, 9, 2]]), np.uint32([[0, 1, 2]]))
distance = float(scene.cast_rays(np.float32([[1, 1, 0, 0, 0, 1]]))["t_hit"].numpy()[0])
assert abs(distance - 2) < 1e-5, f"a distance of {distance}, expected 2"
print("Open3D casts rays")
"""
    cost = "no truth, so nothing can be measured"
    remedy = f"apt install libegl1 libgl1 libx11-6 libgomp1, or again {install_command('eval')}"
    failed = Check("exact geometry", "broken", "Open3D casts no rays", cost, remedy)
    return _works(failed, program)


def pictures() -> Check:
    """Mitsuba, and the variant that renders."""
    from attnwarp_eval.truth import llvm

    chosen = os.environ.get("ATTNWARP_MITSUBA")
    variant = llvm.variant()
    by = " by ATTNWARP_MITSUBA" if chosen else ""
    text, cost = f"Mitsuba does not start with {variant}", "no true picture can be made"
    remedy = f"apt install libatomic1, or again {install_command('eval')}"
    check = _works(
        Check("true pictures", "broken", text, cost, remedy),
        f"import mitsuba; mitsuba.set_variant({variant!r}); print('Mitsuba with {variant}{by}')",
    )
    if check.state == "broken" or variant == llvm.LLVM or chosen:
        return check
    return Check(
        "true pictures",
        "lack",
        f"Mitsuba with {variant}: no LLVM from {llvm.OLDEST} on works here",
        "true pictures take several times as long; their noise is another",
        "apt install libllvm19 (docs/truth/truth.md)",
    )


def window() -> Check:
    """PyVista, off screen."""
    program = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pyvista.Sphere(), color="red")
assert plotter.screenshot(return_img=True).std() > 5, "an empty picture"
print("PyVista draws off screen; a window needs a display")
"""
    cost = "attnwarp-eval inspect does not run"
    remedy = f"{install_command('inspect')}; apt install libegl1 libgl1"
    return _works(Check("3D window", "lack", "PyVista draws nothing", cost, remedy), program)


def graphics_card() -> Check:
    """A GPU that torch and Warp can use."""
    program = """
import json, torch
print(json.dumps([torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]))
"""
    printed, problem = _child(program)
    if problem:
        return Check("GPU", "broken", "torch does not start", problem, "install attnwarp again")
    names = json.loads(printed)
    if names and util.find_spec("warp") is not None:
        return Check("GPU", "ok", f"{', '.join(names)}: --device auto or cuda")
    return Check(
        "GPU",
        "lack",
        f"{', '.join(names)}, without Warp" if names else "none that torch can use",
        "splats are rendered on the processor; without a GPU large editors take minutes a view",
        install_command("gpu") if names else "none is needed for the studies that ship",
    )


def weights() -> Check:
    """The bundled encoders and editors, against their checksums."""
    program = """
from attnwarp.editing import small
from attnwarp_eval.encoders import BUNDLED, load_encoder
for name in small.bundled():
    small.check_sums(small.WEIGHTS / name)
for name in BUNDLED:
    load_encoder(name)
print(", ".join([*BUNDLED, *small.bundled()]) + ": every checksum fits")
"""
    cost, remedy = "what is bundled cannot be loaded", "install attnwarp again"
    return _works(Check("bundled weights", "broken", "damaged or missing", cost, remedy), program)


def _child(program: str) -> tuple[str, str]:
    """The last line of a program's output, and its error in one line."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", program],
            capture_output=True,
            text=True,
            timeout=LONGEST,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "", f"no answer in {LONGEST} s"
    printed = done.stdout.strip().splitlines()[-1:] or [""]
    if done.returncode == 0:
        return printed[0], ""
    ended = f"ended with code {done.returncode}"
    return "", (done.stderr.strip().splitlines()[-1:] or [ended])[0]
