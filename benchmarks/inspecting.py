"""Time until `attnwarp-eval inspect` draws a large scene: ``python -m benchmarks.inspecting``.

A hollow ball of 200,000 discs, seen from inside by two cameras of 592 x 592 px: the surface that
the target sees has 700,000 triangles. Each round runs the whole command, from the start of Python
to its end, with ``--splats --screenshot``. CPU seconds are those of all threads, user and system,
and vary less than wall seconds where other work shares the cores. The table has medians over
rounds.

``--against`` names another checkout, whose command then takes turns with this one's: ratios are
medians of the ratios within a round.

A second table has the milliseconds of a frame of this checkout's window with 100,000 discs, while
the view stands and while it moves; it needs a display.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.io import Dataset, write_ply, write_transforms
from benchmarks import command

SPLATS = 200_000
SIZE = 592

DISCS, FRAMES = 100_000, 15
"""Discs and frames of the window that is timed."""

OBSERVER = """
import json, resource, subprocess, sys
code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([code, usage.ru_utime + usage.ru_stime, usage.ru_maxrss]))
"""
"""Runs a command and prints its exit code, CPU seconds and peak memory. It is small itself: Linux
counts what a process held when it started another one as the other one's.
"""


def write_scene(folder: Path, splats: int, size: int) -> None:
    """A ball of radius 3 around two cameras, as a PLY file and a transforms.json."""
    random = torch.Generator().manual_seed(0)
    away = torch.nn.functional.normalize(torch.randn((splats, 3), generator=random), dim=1)
    up = torch.tensor([0.0, 0, 1]).expand(splats, 3)
    # The rotation that takes the z axis to the normal.
    turn = torch.cat([1 + (up * away).sum(1, keepdim=True), torch.cross(up, away, dim=1)], 1)
    # Discs whose areas add up to one and a half of the ball's.
    scale = 0.02 * (SPLATS / splats) ** 0.5
    model = Gaussians(
        "2d",
        3 * away,
        torch.nn.functional.normalize(turn, dim=1),
        torch.full((splats, 2), scale),
        torch.full((splats,), 0.95),
        Gaussians.sh_from_rgb(torch.rand((splats, 3), generator=random)),
    )
    view: dict[str, Any] = {"width": size, "height": size, "fov_y": 60}
    cameras = [
        Camera.look_at((0.3 * k, 0, 0), (0.3 * k, 3, 0.2), name=f"{k}.png", **view)
        for k in range(2)
    ]
    write_ply(folder / "scene.ply", model)
    write_transforms(folder / "transforms.json", Dataset(cameras, [None, None]))


def triangles(folder: Path, size: int) -> int:
    """Triangles of the surface that the target sees; two a face of four pixels."""
    from attnwarp_eval.inspect import scene, subject

    chosen = subject.of_capture(folder / "scene.ply", folder, size=size)
    pair = chosen.pair("corrected", chosen.targets[0])
    return 2 * int(scene.seen_surface(pair.seen, pair.colors("mask")).n_cells)


@dataclass
class Contestant:
    """A checkout, and what its command took in each round: seconds, and peak memory in GiB."""

    checkout: Path
    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    peak: list[float] = field(default_factory=list)

    def run(self, folder: Path, size: int) -> None:
        """Draw the scene once."""
        words = [sys.executable, "-m", "attnwarp_eval.cli.main", "inspect"]
        words += [str(folder / "scene.ply"), "--data", str(folder), "--size", str(size), "--splats"]
        path = os.pathsep.join([str(self.checkout), str(self.checkout / "eval")])
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", OBSERVER, *words, "--screenshot", str(folder / "first.png")],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.PIPE,
            check=True,
        )
        self.wall.append(time.perf_counter() - start)
        code, cpu, peak = json.loads(done.stdout)
        if code:
            raise SystemExit(f"{self.checkout}: inspect ended with {code}")
        self.cpu.append(cpu)
        # Linux counts KiB, macOS bytes.
        self.peak.append(peak / (2**30 if sys.platform == "darwin" else 2**20))


def measure(
    checkouts: Sequence[Path], rounds: int, splats: int = SPLATS, size: int = SIZE
) -> dict[str, Any]:
    """Draw the scene by each checkout in turn; all of the table, as JSON values.

    A first round, which compiles kernels and reads files into memory, is left out.
    """
    contestants = [Contestant(checkout) for checkout in checkouts]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_scene(folder, splats, size)
        count = triangles(folder, size)
        for each in contestants:
            Contestant(each.checkout).run(folder, size)
        for _ in range(rounds):
            for each in contestants:
                each.run(folder, size)
    own = contestants[0].cpu
    rows = [
        {
            "checkout": str(each.checkout),
            "wall_s": statistics.median(each.wall),
            "cpu_s": statistics.median(each.cpu),
            "cpu_best_s": min(each.cpu),
            "peak_gib": max(each.peak),
            "times_cpu": statistics.median(a / b for a, b in zip(each.cpu, own, strict=True)),
        }
        for each in contestants
    ]
    return {"splats": splats, "triangles": count, "rounds": rounds, "rows": rows}


def frames(splats: int = DISCS, size: int = SIZE, count: int = FRAMES) -> dict[str, Any]:
    """Milliseconds of the window's frames while the view stands and while it moves, medians.

    The two take turns, ``count`` frames at a time over three rounds, each from another side.
    """
    from attnwarp_eval.inspect import subject, window
    from attnwarp_eval.inspect.scene import State

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_scene(folder, splats, size)
        chosen = subject.of_capture(folder / "scene.ply", folder, size=size)
        state = State("corrected", chosen.targets[0], splats=True)
        opened = window.Window(chosen, state)
        plotter = opened.plotter
        plotter.show(auto_close=False, interactive=False)
        taken: dict[str, list[tuple[float, float]]] = {"standing": [], "moving": []}
        for _ in range(3):
            for name, event in (("standing", "End"), ("moving", "")):
                plotter.iren.style.InvokeEvent(f"{event}InteractionEvent")
                plotter.render_window.Render()  # uploads what was hidden
                for _ in range(count):
                    plotter.camera.Azimuth(2)
                    wall, cpu = time.perf_counter(), time.process_time()
                    plotter.render_window.Render()
                    taken[name].append((time.perf_counter() - wall, time.process_time() - cpu))
        renderer = next(
            (line for line in plotter.render_window.ReportCapabilities().splitlines()
             if line.startswith("OpenGL renderer")), "",
        ).partition(":")[2].strip()  # fmt: skip
        opened.close()
    rows = {
        name: {
            "wall_ms": 1000 * statistics.median(wall for wall, _ in values),
            "cpu_ms": 1000 * statistics.median(cpu for _, cpu in values),
        }
        for name, values in taken.items()
    }
    return {"splats": splats, "window": list(window.SIZE), "renderer": renderer, "rows": rows}


def frames_table(result: dict[str, Any]) -> str:
    """The frames for a person, as Markdown."""
    width, height = result["window"]
    lines = [
        f"{result['splats']:,} discs in a window of {width} x {height}, drawn by"
        f" {result['renderer'] or 'an unknown renderer'}",
        "",
        "| the view | wall ms a frame | cpu ms a frame |",
        "|---|---|---|",
    ]
    lines += [
        f"| {name} | {row['wall_ms']:.0f} | {row['cpu_ms']:.0f} |"
        for name, row in result["rows"].items()
    ]
    return "\n".join(lines)


def table(result: dict[str, Any]) -> str:
    """The result for a person, as Markdown."""
    lines = [
        f"{result['splats']:,} splats, {result['triangles']:,} triangles,"
        f" {result['rounds']} rounds",
        "",
        "| checkout | wall s | cpu s (best) | cpu, of the first | peak GiB |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['checkout']} | {row['wall_s']:.2f} | {row['cpu_s']:.2f} ({row['cpu_best_s']:.2f})"
        f" | {row['times_cpu']:.2f} | {row['peak_gib']:.2f} |"
        for row in result["rows"]
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser("inspecting", "Time inspect: its first picture, and frames.")
    parser.add_argument("--rounds", type=int, default=5, help="times it is drawn (default 5)")
    parser.add_argument(
        "--against", type=Path, action="append", default=[], help="another checkout to take turns"
    )
    options = parser.parse_args(arguments)
    here = Path(__file__).resolve().parent.parent
    result = measure([here, *(path.resolve() for path in options.against)], options.rounds)
    print(table(result))
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        result["frames"] = frames()
        print(f"\n{frames_table(result['frames'])}")
    else:
        print("\nFrames of the window are left out: no display; run it under xvfb-run.")
    command.write_figures(options.out, result)


if __name__ == "__main__":
    main()
