"""Abilities of this machine, and the cost of each lack: the checks of ``attnwarp-eval doctor``.

Checks with a heavy import run in a child process, so that a library that aborts its process cannot
abort this one, and the checks run side by side.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path
from typing import Literal

from attnwarp.errors import EXTRAS, install_command
from attnwarp.numba_cache import kernel_folder
from attnwarp.process import core_count

State = Literal["ok", "lack", "broken"]

LONGEST = 120
"""Seconds after which a child process is given up."""

WORKER_GB = 3
"""Memory that a worker of a run needs at most."""


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
        for check in (versions, extras, threads, kernels, cache):
            yield check()
        for future in pending:
            yield future.result()


def versions() -> Check:
    """Python and this package."""
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
        f" {packages}",
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


def threads() -> Check:
    """Cores and memory, and the workers that fit."""
    cores = core_count()
    free = _free_memory_gb()
    jobs = max(1, min(cores, int(free / WORKER_GB)))
    text = f"{cores} of {os.cpu_count()} cores, {free:.1f} GB of memory free"
    advice = f"a run on workers: --jobs {jobs}"
    if free < WORKER_GB:
        return Check(
            "threads and memory",
            "lack",
            text,
            f"a worker needs up to {WORKER_GB} GB; less may end a run",
            "close other programs, or lower the study's --size",
        )
    return Check("threads and memory", "ok", f"{text}; {advice}")


def _free_memory_gb() -> float:
    """Available memory, in GB."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    kilobytes = next(line.split()[1] for line in lines if line.startswith("MemAvailable"))
    return int(kilobytes) * 1024 / 1e9


def kernels() -> Check:
    """Check that the renderer's kernels are already compiled."""
    spec = util.find_spec("attnwarp")
    assert spec is not None and spec.submodule_search_locations
    folder = Path(next(iter(spec.submodule_search_locations))) / "render" / "_kernels"
    place = kernel_folder() or folder / "__pycache__"
    if next(place.rglob("*.nbi"), None) is not None:
        return Check("compiled kernels", "ok", f"in {place}")
    return Check(
        "compiled kernels",
        "lack",
        "none yet",
        "the first render compiles for about a minute, once",
        "none is needed",
    )


def cache() -> Check:
    """The folder of derived files, and the space on its disk."""
    from attnwarp.errors import InputError
    from attnwarp_eval import cache

    folder = cache.cache_dir()
    try:
        limit = cache.limit_bytes()
    except InputError as error:
        return Check("cache", "broken", str(folder), str(error), "unset ATTNWARP_CACHE_GB")
    size = sum(size for _, size in cache.usage().values())
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    text = f"{folder}: {size / 1e9:.2f} of {limit / 1e9:g} GB; {free / 1e9:.1f} GB free on its disk"
    if not os.access(existing, os.W_OK):
        return Check(
            "cache",
            "lack",
            f"{text}; cannot be written to",
            "every process makes meshes, splats and true pictures again",
            "name another folder in ATTNWARP_CACHE",
        )
    if free + size < limit:
        return Check(
            "cache",
            "lack",
            text,
            "the disk is full before the cache reaches its limit, and a run then stops",
            f"a lower limit: ATTNWARP_CACHE_GB={max(1, int((free + size) / 2e9))}",
        )
    return Check("cache", "ok", text)


def ray_casting() -> Check:
    """Open3D's ray casting, from which all truth comes."""
    program = """
import numpy as np
from attnwarp_eval._open3d import open3d
o3d = open3d()
scene = o3d.t.geometry.RaycastingScene()
scene.add_triangles(np.float32([[0, 0, 2], [9, 0, 2], [0, 9, 2]]), np.uint32([[0, 1, 2]]))
distance = float(scene.cast_rays(np.float32([[1, 1, 0, 0, 0, 1]]))["t_hit"].numpy()[0])
print("works" if abs(distance - 2) < 1e-5 else f"a distance of {distance}, expected 2")
"""
    printed, problem = _child(program)
    if printed == "works":
        return Check("exact geometry", "ok", f"Open3D {_version('open3d')} casts rays")
    return Check(
        "exact geometry",
        "broken",
        "Open3D casts no rays",
        f"no truth, so nothing can be measured: {problem or printed}",
        f"apt install libegl1 libgl1 libx11-6 libgomp1, or again {install_command('eval')}",
    )


def pictures() -> Check:
    """Mitsuba, and the variant that renders."""
    from attnwarp_eval.truth import llvm

    # llvm.variant() stores the working library in this variable.
    chosen = os.environ.get("ATTNWARP_MITSUBA")
    variant = llvm.variant()
    version = _version("mitsuba")
    if variant == llvm.LLVM:
        library = os.environ.get("DRJIT_LIBLLVM_PATH", "Dr.Jit's own choice")
        return Check("true pictures", "ok", f"Mitsuba {version}, {variant} with {library}")
    program = f"import mitsuba; mitsuba.set_variant({variant!r}); print(mitsuba.variant())"
    printed, problem = _child(program)
    if printed != variant:
        return Check(
            "true pictures",
            "broken",
            f"Mitsuba does not start with {variant}",
            f"no true picture can be made: {problem or printed}",
            f"apt install libatomic1, or again {install_command('eval')}",
        )
    if chosen:
        return Check("true pictures", "ok", f"Mitsuba {version}, {variant} by ATTNWARP_MITSUBA")
    return Check(
        "true pictures",
        "lack",
        f"Mitsuba {version}, {variant}: no LLVM from {llvm.OLDEST} on works here",
        "true pictures take several times as long; their noise is another",
        "apt install libllvm19 (docs/truth/truth.md)",
    )


def window() -> Check:
    """PyVista, off screen and on."""
    if util.find_spec("pyvista") is None:
        return Check(
            "3D window",
            "lack",
            "PyVista is not installed",
            "attnwarp-eval inspect does not run",
            install_command("inspect"),
        )
    program = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pyvista.Sphere(), color="red")
picture = plotter.screenshot(return_img=True)
print(plotter.render_window.GetClassName(), int(picture.std() > 5))
"""
    printed, problem = _child(program)
    kind, _, drawn = printed.partition(" ")
    if drawn != "1":
        return Check(
            "3D window",
            "lack",
            "PyVista draws nothing, even off screen",
            f"attnwarp-eval inspect does not run: {problem or printed}",
            "apt install libegl1 libgl1",
        )
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return Check("3D window", "ok", f"PyVista {_version('pyvista')} draws ({kind})")
    return Check(
        "3D window",
        "lack",
        f"PyVista {_version('pyvista')} draws off screen ({kind}); there is no display",
        "attnwarp-eval inspect opens no window, and writes pictures with --screenshot",
        "connect with ssh -X, or use a desktop",
    )


def graphics_card() -> Check:
    """A GPU that torch and Warp can use."""
    program = """
import json, torch
names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
print(json.dumps([torch.__version__, torch.version.cuda, names]))
"""
    printed, problem = _child(program)
    try:
        version, cuda, names = json.loads(printed)
    except ValueError:
        return Check(
            "GPU",
            "broken",
            "torch does not start",
            f"nothing runs: {problem or printed}",
            "install attnwarp again",
        )
    if names and util.find_spec("warp") is not None:
        found = f"{', '.join(names)}, CUDA {cuda}, Warp {_version('warp-lang')}"
        return Check("GPU", "ok", f"{found}: splats lie on it with --device auto or cuda")
    if names:
        return Check(
            "GPU",
            "lack",
            f"{', '.join(names)}, CUDA {cuda}, without Warp",
            "splats are rendered on the processor; editors use the GPU",
            install_command("gpu"),
        )
    driver = shutil.which("nvidia-smi") is not None
    return Check(
        "GPU",
        "lack",
        f"none that torch {version} can use" + ("; a driver is installed" if driver else ""),
        "studies run on the processor; large editors (Stable Diffusion) take minutes a view",
        "install a CUDA build of torch" if driver else "none is needed for the studies that ship",
    )


def weights() -> Check:
    """The bundled encoders and editors, against their checksums."""
    program = """
import json
from attnwarp.editing import small
from attnwarp.encoders import BUNDLED, load_encoder
for name in small.bundled():
    small.check_sums(small.WEIGHTS / name)
for name in BUNDLED:
    load_encoder(name)
print(json.dumps([*BUNDLED, *small.bundled()]))
"""
    printed, problem = _child(program)
    try:
        names = json.loads(printed)
    except ValueError:
        return Check(
            "bundled weights",
            "broken",
            "damaged or missing",
            problem or printed,
            "install attnwarp again",
        )
    return Check("bundled weights", "ok", f"{', '.join(names)}: every checksum fits")


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "(not installed)"


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
