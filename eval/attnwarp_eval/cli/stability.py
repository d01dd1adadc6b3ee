"""The command that sweeps the hard cases."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from attnwarp.cli.options import option
from attnwarp.cli.shell import log
from attnwarp_eval.cli.shell import Regression


def stability(
    case: Annotated[
        list[str] | None, option("Sweep this case alone; may be repeated (default all).", "CASE")
    ] = None,
    list_: Annotated[
        bool, option("List the cases by number, and run none.", None, "--list")
    ] = False,
    quick: Annotated[
        bool, option("Take three levels of each case in place of all.", None, "--quick")
    ] = False,
    out: Annotated[
        Path | None,
        option(
            "Write the run to this folder, or go on with the run in it (default runs/stability,"
            " followed by the chosen cases and quick).",
            "FOLDER",
        ),
    ] = None,
    jobs: Annotated[
        int, option("Compute in so many processes, at most one a core.", "N", "--jobs", "-j", min=1)
    ] = 1,
) -> None:
    """Sweep numerically hard inputs until the numerics break. Exit code 1 if one breaks too early.

    The study `stability` runs and writes its report.

    Killed half-way and started again, it goes on where it was.
    """
    from attnwarp_eval.cli.run import run_study
    from attnwarp_eval.stability import hard_cases
    from attnwarp_eval.study.probes.stability.measure import read_sweeps
    from attnwarp_eval.study.probes.stability.report import verdict_lines
    from attnwarp_eval.study.study import load_study

    if list_:
        for hard in hard_cases().values():
            typer.echo(f"{hard.number:2}  {hard.name:24} {hard.title}")
        return
    cases, levels = list(case or ()), "quick" if quick else "all"
    changes: dict[str, Any] = {
        "name": "-".join(["stability", *cases, *["quick"] * quick]),
        "stability": {"cases": cases, "levels": levels, "gpu": has_gpu()},
    }
    results = run_study(lambda: load_study("stability", **changes), out, jobs)
    failed = verdict_lines(read_sweeps(results))
    for line in failed:
        log(line)
    if failed:
        raise Regression


def has_gpu() -> bool:
    """Return True if backend gpu can run here: a GPU, and Warp for its kernels."""
    import importlib.util

    import torch

    return torch.cuda.is_available() and importlib.util.find_spec("warp") is not None
