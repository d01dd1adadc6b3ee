"""Gain from half and twice the time of `attnwarp edit`: fit, editing and tuning of one scene.

Each plan is fitted on seven of eight views, which gives its held-out PSNR, and the edit then takes
all views. A plan's fit and edit are resumed in --work.

    python -m benchmarks.editing DATA --work FOLDER --out reports/editing/time.md

With --ratio, in its place: the seconds of propagation against those of the same views edited one by
one. Neither tunes. They take turns in one process.

    python -m benchmarks.editing --ratio --rounds 9
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import torch

from attnwarp.command.edit import FitPlan
from attnwarp.editing.small import load_editor, thread_count
from attnwarp.fit import FitSettings, fit, from_points, hold_out, load_views
from attnwarp.io import read_dataset
from attnwarp.methods import AttentionWarpingSettings, attention_warping, preset
from attnwarp.process import core_count
from attnwarp.render.threads import set_thread_count
from attnwarp_eval.cost import peak_memory_mb
from benchmarks import command

INSTRUCTION = "make it snow"

EDITING_PARTS = ("source", "warp", "edit")
"""Parts of an edit's seconds that are neither files nor tuning."""


RATIO_OPTIONS = (
    ("pixels", 256, "side of the views"),
    ("splats", 30_000, "of the scene"),
    ("views", 9, "that are edited, the source among them"),
    ("steps", 20, "of denoising"),
    ("rounds", 5, "each with both"),
)


@dataclass(frozen=True)
class Plan:
    """A share of the time.

    Args:
        name: name of the row.
        fit: iterations and splats.
        tuning: iterations a stage.
    """

    name: str
    fit: FitPlan
    tuning: int


def plans() -> list[Plan]:
    """The default of `attnwarp edit`, and about half and twice its time."""
    default, tuning = FitPlan(), preset("attention_warping").iterations
    return [
        Plan("default", default, tuning),
        Plan("half", FitPlan(default.iterations // 2, max_splats=15_000), tuning // 2),
        Plan("twice", FitPlan(5_500, max_splats=60_000), 2 * tuning),
    ]


def measure(
    plan: Plan, data: Path, work: Path, editor_name: str, *, fit_only: bool = False
) -> dict[str, Any]:
    """Fit and edit by a plan; figures as in :func:`table`, without the edit's if ``fit_only``."""
    stored = work / plan.name / "figures.json"
    if stored.exists():
        figures: dict[str, Any] = json.loads(stored.read_text())
        return figures
    dataset = read_dataset(data)
    train, test = hold_out(dataset)
    if test is None or dataset.points is None:
        raise ValueError(f"{data}: expected points and at least two views")
    settings = FitSettings(
        kind="2d", iterations=plan.fit.iterations, max_splats=plan.fit.max_splats
    )
    start = from_points(dataset.points, dataset.colors, kind="2d", sh_degree=settings.sh_degree)
    fitted = fit(
        start, load_views(train), settings, held_out=load_views(test), folder=work / plan.name
    )
    figures = {
        "name": plan.name,
        "iterations": plan.fit.iterations,
        "splats": len(fitted.gaussians),
        "tuning": plan.tuning,
        "held_out": fitted.history[-1].psnr,
        "fit": {"cpu": fitted.cpu_seconds, "wall": fitted.seconds},
        "curve": [[r.iteration, r.splats, r.cpu_seconds, r.psnr] for r in fitted.history[1:]],
    }
    if fit_only:
        return figures
    views = load_views(dataset)
    images = [views.target(k, torch.zeros(3)).numpy() for k in range(len(views))]
    editor = load_editor(editor_name)
    torch.set_num_threads(thread_count(editor))
    size = editor.own_size
    chosen = preset("attention_warping", iterations=plan.tuning, size=size)
    wall, cpu = time.perf_counter(), time.process_time()
    result = attention_warping(fitted.gaussians, views.cameras, images, editor, INSTRUCTION, chosen)
    figures["edit"] = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    figures["edit_psnr"] = result.edit_psnr["mean"]
    figures["views"] = [len(result.edited), *images[0].shape[1::-1]]
    figures["peak_mb"] = peak_memory_mb()
    command.write_figures(stored, figures)
    return figures


def table(rows: Sequence[dict[str, Any]], data: Path, load: float) -> str:
    """A Markdown page of the figures."""
    lines = [
        "# Time of an edit",
        "",
        f"`attnwarp edit` on `{data.name}` with its defaults, and about half and twice their time."
        " 2DGS, three stages, all views edited, every 8th held out of the fit. CPU seconds are of"
        " all threads. Memory is the process's highest so far.",
        "",
        "| time | fit: iterations, splats | tuning a stage | held-out PSNR, dB | Edit PSNR, dB |"
        " fit, CPU s | edit and tuning, CPU s | all, CPU s | all, s | views, px | memory, GiB |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        edit = row.get("edit")
        rest = " not run | | | | |"
        if edit is not None:
            cpu, wall = (row["fit"][unit] + edit[unit] for unit in ("cpu", "wall"))
            count, width, height = row["views"]
            rest = (
                f" {edit['cpu']:.0f} | {cpu:.0f} | {wall:.0f} | {count}, {width} x {height} |"
                f" {row['peak_mb'] / 1024:.2f} |"
            )
        psnr = f"{row['edit_psnr']:.2f}" if edit is not None else ""
        lines.append(
            f"| {row['name']} | {row['iterations']:,}, {row['splats']:,} | {row['tuning']} |"
            f" {row['held_out']:.2f} | {psnr} | {row['fit']['cpu']:.0f} |{rest}"
        )
    lines += [
        "",
        "What a longer fit buys, by the fit of the first row on its way:",
        "",
        "| iterations | splats | CPU s | held-out PSNR, dB |",
        "|---|---|---|---|",
        *(f"| {n:,} | {k:,} | {cpu:.0f} | {psnr:.2f} |" for n, k, cpu, psnr in rows[0]["curve"]),
        "",
        f"{core_count()} threads; load average of the machine at the end"
        f" {load:.1f}. Above the number of threads, all seconds are too long.",
    ]
    return "\n".join(lines)


def against_one_by_one(
    editor_name: str, *, pixels: int, count: int, views: int, steps: int, rounds: int
) -> dict[str, list[dict[str, float]]]:
    """Seconds by part and network rows of propagation and of each view edited alone.

    Both edit the same views in the same batches from the same noise, without tuning.

    Args:
        editor_name: name of the editor.
        pixels: side of the views.
        count: number of splats.
        views: the source and the views nearest to it.
        steps: number of steps of denoising.
        rounds: each runs propagation twice and one by one once, in an order drawn anew.

    Returns:
        "propagation", "again" (the same a second time) and "one by one": by round.
    """
    from attnwarp_eval.cost import AGAIN, in_turn
    from attnwarp_eval.world import splats, world

    scene = world("bear", pixels)
    nearest = sorted(scene.yaw, key=lambda name: scene.yaw[name])[: views - 1]
    cameras = [scene.source, *(scene.camera(name) for name in nearest)]
    model = splats("bear", pixels, 0, kind="2d", count=count, position_noise=0.1, normal_noise=3.0)
    editor = load_editor(editor_name)
    torch.set_num_threads(thread_count(editor))
    size = editor.own_size
    warped = preset("attention_warping", steps=steps, iterations=0, size=size)
    figures: dict[str, list[dict[str, float]]] = {"propagation": [], "again": [], "one by one": []}

    def run(name: str, settings: AttentionWarpingSettings, turn: int) -> None:
        result = attention_warping(model, cameras, None, editor, INSTRUCTION, settings)
        row = {**result.seconds, "network_rows": result.counters["network_rows"]}
        figures["again" if turn >= AGAIN else name].append(row)

    in_turn(
        [
            lambda turn: run("propagation", warped, turn),
            lambda turn: run("one by one", replace(warped, a0=0.0), turn),
        ],
        rounds,
    )
    # The first round compiles.
    return {name: rows[-rounds:] for name, rows in figures.items()}


def ratio_table(figures: dict[str, list[dict[str, float]]], load: float) -> str:
    """A Markdown table of :func:`against_one_by_one`: medians, and the ratio in each round."""
    sums = {"editing": EDITING_PARTS, "editing and files": (*EDITING_PARTS, "write")}
    taken = {
        name: {
            **{part: [row.get(part, 0.0) for row in rows] for part in (*EDITING_PARTS, "write")},
            **{
                s: [sum(row.get(p, 0.0) for p in parts) for row in rows]
                for s, parts in sums.items()
            },
        }
        for name, rows in figures.items()
    }

    def ratio(first: str, second: str, part: str) -> str:
        pairs = zip(taken[first][part], taken[second][part], strict=True)
        ratios = sorted(a / b for a, b in pairs)
        return f"{statistics.median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})"

    lines = [
        "| seconds | propagation | one by one | ratio: median of rounds (lowest, highest) |"
        " propagation to itself |",
        "|---|---|---|---|---|",
    ]
    for part in (*EDITING_PARTS, "write", *sums):
        both = [statistics.median(taken[name][part]) for name in ("propagation", "one by one")]
        ratios = ("", "")
        if part in sums:
            ratios = ratio("propagation", "one by one", part), ratio("again", "propagation", part)
        lines.append(f"| {part} | {both[0]:.3f} | {both[1]:.3f} | {ratios[0]} | {ratios[1]} |")
    rows = [figures[name][0]["network_rows"] for name in ("propagation", "one by one")]
    lines += [
        "",
        f"Rows through the network: {rows[0]:.0f} and {rows[1]:.0f}."
        f" {len(figures['propagation'])} rounds; {core_count()} threads; load"
        f" average of the machine at the end {load:.1f}. Above the number of threads, seconds are"
        " too long and ratios noisy.",
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.editing",
        description="Time attnwarp edit on DATA. Without DATA, on the scene bear, exported first.",
    )
    parser.add_argument("data", type=Path, nargs="?", help="as for attnwarp edit, with points")
    parser.add_argument("--work", type=Path, default=Path("build/editing"), help="of fits, edits")
    parser.add_argument("--editor", default="small-plain", help="name or folder")
    parser.add_argument("--plans", nargs="*", help="names of the rows; all if left out")
    parser.add_argument("--fit-only", action="store_true", help="leave the edits out")
    parser.add_argument("--out", type=Path, help="also write the table here")
    parser.add_argument(
        "--ratio", action="store_true", help="time propagation against views edited one by one"
    )
    for name, default, meaning in RATIO_OPTIONS:
        parser.add_argument(f"--{name}", type=int, default=default, help=f"of --ratio: {meaning}")
    options = parser.parse_args(arguments)
    if options.ratio:
        figures = against_one_by_one(
            options.editor,
            pixels=options.pixels,
            count=options.splats,
            views=options.views,
            steps=options.steps,
            rounds=options.rounds,
        )
        text = ratio_table(figures, os.getloadavg()[0])
        if options.out is not None:
            command.write_text(options.out, text)
        print(text)
        return
    data = options.data
    if data is None:
        from attnwarp_eval.cli.main import app

        data = options.work / "bear"
        if not (data / "transforms.json").exists():
            app(["scenes", "export", "bear", str(data)], standalone_mode=False)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    set_thread_count(core_count())
    rows = []
    for plan in plans():
        if not options.plans or plan.name in options.plans:
            rows.append(
                measure(plan, data, options.work, options.editor, fit_only=options.fit_only)
            )
            text = table(rows, data, os.getloadavg()[0])
            if options.out is not None:
                command.write_text(options.out, text)
    print(text)


if __name__ == "__main__":
    main()
