"""Seconds of a view's edit by a bundled editor, and what recording and injecting attention add.

An edit, an edit that is recorded, and edits with the recorded features injected, as they are and
along a warp, take turns in one process. CPU seconds are of all threads of the process, so another
process adds less to them than to seconds of the clock.

    python -m benchmarks.injection --editor small-plain --out reports/editing/cost.md
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.editing.editor import STEPS, edit
from attnwarp.editing.layers import choose_layers
from attnwarp.editing.recording import Recording, RecordingPlan, record
from attnwarp.editing.small import load_editor, thread_count
from attnwarp.methods.algorithms.attention_warping import inject
from attnwarp.process import core_count
from attnwarp.warp import (
    EXACT_DEPTH_TOLERANCE,
    Surface,
    WarpedView,
    WarpSettings,
    warp_surfaces,
)
from attnwarp_eval.cost import AGAIN, in_turn
from benchmarks import command

INSTRUCTION = "make it red"

PLAIN, RECORDED, INJECTED, WARPED = "plain", "recorded", "injected", "injected along a warp"
ITSELF = "plain again"


@dataclass(frozen=True)
class Seconds:
    """Seconds of one edit: CPU seconds of all threads, and of the clock."""

    cpu: float
    wall: float


Runs = dict[str, list[Seconds]]
"""Name of a run -> its seconds by round."""


@dataclass(frozen=True)
class Case:
    """An editor at a size.

    Attributes:
        editor: its name.
        size: size of the view in px.
        runs: measured runs.
    """

    editor: str
    size: int
    runs: Runs


def measure(editor: Any, size: int, *, steps: int = STEPS, rounds: int = 5) -> Runs:
    """Edit a view plainly, recorded and injected, in turn.

    Args:
        editor: that takes pictures.
        size: size of the view in px.
        steps: number of steps of denoising.
        rounds: that are kept; one more comes first.
    """
    view = np.random.default_rng(0).random((size, size, 3), dtype=np.float32)
    _, h, w = editor.noise_shape((size, size))
    keep = tuple(name for name in editor.branches if name in editor.carries)
    plan = RecordingPlan(choose_layers(editor.layers()), (h, w), keep, steps)
    warp = plane_warp(size)
    with record(editor, plan) as recording:
        edit(editor, [view], INSTRUCTION, steps=steps)
    runs: Runs = {name: [] for name in (PLAIN, RECORDED, INJECTED, WARPED, ITSELF)}

    def around(name: str) -> AbstractContextManager[Recording | None]:
        if name == RECORDED:
            return record(editor, plan)
        if name == PLAIN:
            return nullcontext()
        warps = [warp if name == WARPED else None]
        return inject(editor, recording, warps=warps)

    def run(name: str, turn: int) -> None:
        wall, cpu = time.perf_counter(), time.process_time()
        with around(name):
            edit(editor, [view], INSTRUCTION, steps=steps)
        taken = Seconds(time.process_time() - cpu, time.perf_counter() - wall)
        runs[ITSELF if turn >= AGAIN else name].append(taken)

    in_turn([partial(run, name) for name in (PLAIN, RECORDED, INJECTED, WARPED)], rounds)
    # The first round compiles.
    return {name: seconds[-rounds:] for name, seconds in runs.items()}


def plane_warp(size: int) -> WarpedView:
    """The exact warp between two views of a plane, displaced by a twentieth of the picture."""
    K = np.array([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    moved = np.eye(4)
    moved[0, 3] = 0.1
    surface = Surface(np.full((size, size), 2.0))
    settings = WarpSettings(opaque=None, normal_test="none", depth_relative=EXACT_DEPTH_TOLERANCE)
    cameras = [Camera(K, pose, size, size) for pose in (np.eye(4), moved)]
    return warp_surfaces(cameras[0], cameras[1], surface, surface, settings)


def table(cases: Sequence[Case], *, steps: int, load: float) -> str:
    """A Markdown page of the figures."""
    lines = [
        "# Time of recording and injection",
        "",
        f"One view, {steps} steps, one thread; medians of rounds. What a run adds is its CPU"
        " seconds against those of the plain edit of the same round, with the lowest and highest.",
        "",
        f"| editor | px | plain, CPU s | plain, s | {RECORDED} | {INJECTED} | {WARPED} |"
        f" {ITSELF} |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for case in cases:
        plain = case.runs[PLAIN]
        cpu, wall = (statistics.median(getattr(s, k) for s in plain) for k in ("cpu", "wall"))
        added = [_added(case.runs[name], plain) for name in (RECORDED, INJECTED, WARPED, ITSELF)]
        row = [case.editor, str(case.size), f"{cpu:.2f}", f"{wall:.2f}", *added]
        lines.append(f"| {' | '.join(row)} |")
    rounds = len(cases[0].runs[PLAIN])
    lines += [
        "",
        f"{rounds} rounds, runs in turn in one process; {core_count()} threads; load average of the"
        f" machine at the end {load:.1f}. Above the number of threads, seconds are too long and"
        " ratios noisy.",
    ]
    return "\n".join(lines)


def _added(run: Sequence[Seconds], plain: Sequence[Seconds]) -> str:
    shares = sorted(100 * (a.cpu / b.cpu - 1) for a, b in zip(run, plain, strict=True))
    return f"{statistics.median(shares):+.0f} % ({shares[0]:+.0f} to {shares[-1]:+.0f})"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser("injection", "Seconds that recording and injecting attention add.")
    parser.add_argument("--editor", nargs="+", default=["small-plain"], help="names or folders")
    parser.add_argument("--size", nargs="+", type=int, default=[64, 128], help="of the view in px")
    parser.add_argument("--steps", type=int, default=STEPS, help="of denoising")
    parser.add_argument("--rounds", type=int, default=5, help="times each run is measured")
    options = parser.parse_args(arguments)
    cases = []
    for name in options.editor:
        editor = load_editor(name)
        torch.set_num_threads(thread_count(editor))
        for size in options.size:
            runs = measure(editor, size, steps=options.steps, rounds=options.rounds)
            cases.append(Case(Path(name).name, size, runs))
    text = table(cases, steps=options.steps, load=os.getloadavg()[0])
    if options.out is not None:
        command.write_text(options.out, text)
    print(text)


if __name__ == "__main__":
    main()
