"""The command that sweeps the hard cases."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from attnwarp.cli.shell import log
from attnwarp.reporting import reporter
from attnwarp_eval.cli.shell import Regression, clear_errors

if TYPE_CHECKING:
    from attnwarp_eval.stability import Case


def stability(
    case: Annotated[
        list[str] | None, typer.Option(help="Print one case with its sweep, and write nothing.")
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="Name the cases, and run none.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Three levels of each case.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="The run's folder; runs/stability if left out.")
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", min=1, help="Worker processes; 1 stays in this one.")
    ] = 1,
) -> None:
    """Sweep numerically hard inputs until the numerics break. Exit code 1 if one breaks too early.

    Without options the study `stability` runs and writes its report.

    Killed half-way and started again, it goes on where it was.
    """
    from attnwarp.errors import InputError
    from attnwarp_eval import stability

    with clear_errors():
        if list_:
            for hard in stability.hard_cases().values():
                typer.echo(f"{hard.number:2}  {hard.name:24} {hard.title}")
            return
        chosen = [stability.hard_case(name) for name in case or ()]
        for option, given in (("--out", out is not None), ("--jobs", jobs > 1)):
            if chosen and given:
                raise InputError(f"{option}: --case prints here and writes nothing; leave it out")
    failed = _show(chosen, quick) if chosen else _study(quick, out, jobs)
    for line in failed:
        log(line)
    if failed:
        raise Regression


def _show(chosen: list[Case], quick: bool) -> list[str]:
    """Print the sweeps of these cases with their verdict; return what fails."""
    import textwrap

    from rich.console import Console

    from attnwarp_eval.document.write import terminal
    from attnwarp_eval.study.probes.stability.measure import Swept, must_hold
    from attnwarp_eval.study.probes.stability.report import case_table, verdict_lines

    console = Console()
    lines: list[str] = []
    for hard in chosen:
        levels = hard.quick if quick else hard.levels
        offered = [way for way in hard.ways if way.backend != "gpu" or has_gpu()]
        swept = []
        with reporter() as report:
            for done, way in enumerate(offered):
                report.step(done, len(offered), f"{hard.name} / {way.name}")
                swept.append(Swept(hard, way, tuple(hard.outcome(level, way) for level in levels)))
        about = case_table(swept).caption.replace("`", "")
        for line in textwrap.wrap(about, width=min(console.width, 100)):
            typer.echo(line)
        for direction in hard.bounds:
            part = [sweep for sweep in swept if sweep.way.direction == direction]
            table = case_table(part)
            table.caption = ""
            for number, row in enumerate(table.rows):
                if any(must_hold(sweep.outcomes[number]) for sweep in part):
                    row[0] += " *"
            console.print(terminal(table))
        for message in dict.fromkeys(o.refusal for s in swept for o in s.outcomes if o.refusal):
            typer.echo(f"refused: {message}")
        failed = verdict_lines(swept)
        typer.echo("* must hold, or be refused; ! does not though it must; ~ a harder level breaks")
        if not failed:
            typer.echo(f"{hard.name} holds at every required level that is shown")
        lines += failed
    return lines


def _study(quick: bool, out: Path | None, jobs: int) -> list[str]:
    """Run the study; return what fails."""
    from attnwarp_eval.cli.run import run_study
    from attnwarp_eval.study.probes.stability.measure import read_sweeps
    from attnwarp_eval.study.probes.stability.report import verdict_lines
    from attnwarp_eval.study.study import load_study

    changes: dict[str, Any] = {
        "stability": {"levels": "quick" if quick else "all", "gpu": has_gpu()}
    }
    if quick:
        changes["name"] = "stability-quick"
    results = run_study(lambda: load_study("stability", **changes), out, jobs)
    return verdict_lines(read_sweeps(results))


def has_gpu() -> bool:
    """Return True if backend gpu can run here: a GPU, and Warp for its kernels."""
    import importlib.util

    import torch

    return torch.cuda.is_available() and importlib.util.find_spec("warp") is not None
