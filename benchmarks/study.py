"""Seconds of a study, by part: ``python -m benchmarks.study [quick] [--scenes bear]``.

The study runs in this process, in a new folder with an empty cache of derived files. A thread looks
every 20 ms what the main thread is at, and gives that part the CPU seconds of all threads since the
last look. CPU seconds depend less on what else a machine does than wall seconds. Each further
worker imports the packages anew. Kernels that numba has on disk already are not compiled:
``NUMBA_CACHE_DIR`` names an empty folder to include compilation.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType

from rich.console import Console

from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.write import markdown, terminal
from attnwarp_eval.files import write_atomic

INTERVAL = 0.02
"""Seconds between two looks."""

PARTS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("compilation of kernels", ("numba.core.dispatcher:compile",)),
    ("compiled kernels read from disk", ("numba.core.caching:", "numba.core.serialize:")),
    ("imports", ("importlib._bootstrap:_find_and_load",)),
    ("pictures: textures and scenes", ("attnwarp_eval.truth.mitsuba.build:load_world",)),
    ("pictures: light", ("attnwarp_eval.truth.mitsuba.", "attnwarp_eval.truth.pictures:")),
    ("splats on surfaces", ("attnwarp_eval.world:splats",)),
    ("truth: rays and correspondences", ("attnwarp_eval.truth.", "attnwarp_eval.world:")),
    ("timing in turn", ("attnwarp_eval.cost:in_turn",)),
    ("metrics", ("attnwarp_eval.metrics.",)),
    ("pictures for people", ("attnwarp_eval.study.pictures:",)),
    ("features warped", ("attnwarp.warp.features:",)),
    ("positions and masks", ("attnwarp.warp.cpu:",)),
    ("splats rendered", ("attnwarp.render.",)),
    ("positions and masks", ("attnwarp.warp.",)),
    ("report", ("attnwarp_eval.report.",)),
)
"""Parts, and the functions that belong to them, as module:function or the beginning of that. The
first part that any function of the stack belongs to counts."""


def part_of(frame: FrameType | None) -> str:
    """The part that a stack belongs to."""
    names = []
    while frame is not None:
        names.append(f"{frame.f_globals.get('__name__', '')}:{frame.f_code.co_name}")
        frame = frame.f_back
    for part, beginnings in PARTS:
        if any(name.startswith(beginnings) for name in names):
            return part
    return "the rest"


def sampled(main: int, seconds: dict[str, float], stop: threading.Event) -> None:
    """Add this process's CPU seconds to the parts that thread ``main`` is at, until ``stop``."""
    last = time.process_time()
    while not stop.wait(INTERVAL):
        part = part_of(sys._current_frames().get(main))
        now = time.process_time()
        seconds[part] = seconds.get(part, 0.0) + now - last
        last = now


def table(seconds: Mapping[str, float]) -> Table:
    """Parts by their CPU seconds."""
    total = sum(seconds.values())
    ordered = sorted(seconds.items(), key=lambda item: -item[1])
    rows = [[part, f"{used:.1f}", f"{100 * used / total:.0f} %"] for part, used in ordered]
    rows.append(["all", f"{total:.1f}", "100 %"])
    return Table(["part", "CPU seconds", "share"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a study and print where its seconds went."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", nargs="?", default="quick", help="a study's name or YAML")
    parser.add_argument("--scenes", help="only these, separated by commas")
    parser.add_argument("--out", type=Path, help="write the table to this Markdown file too")
    options = parser.parse_args(arguments)
    seconds: dict[str, float] = {}
    stop = threading.Event()
    watcher = threading.Thread(
        target=sampled, args=(threading.get_ident(), seconds, stop), daemon=True
    )
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ATTNWARP_CACHE"] = str(Path(folder) / "derived")
        watcher.start()
        from attnwarp_eval.cli.run import run_study
        from attnwarp_eval.study.study import load_study

        scenes = options.scenes.split(",") if options.scenes else None
        run_study(lambda: load_study(options.study, scenes=scenes), Path(folder) / "run")
        stop.set()
        watcher.join()
    result = table(seconds)
    Console().print(terminal(result))
    if options.out:
        command = " ".join(["python -m benchmarks.study", *(sys.argv[1:])])
        lead = [f"CPU seconds of all threads of one process, an empty cache. Made by `{command}`."]
        page = Report(f"Seconds of {options.study}", lead, [Section("By part", tables=[result])])
        write_atomic(options.out, markdown(page).encode())


if __name__ == "__main__":
    main()
