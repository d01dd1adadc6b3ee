"""Seconds of a start, of edits, of tuning and of a fit, as ratios against an earlier commit.

    python -m benchmarks.before                    # against the commit before
    python -m benchmarks.before 1.0 --rounds 5     # against a tag
    python -m benchmarks.before --figures start fit

Commands of the earlier commit, of this tree, and of the earlier commit again run in turn. The last
ratio tells what a ratio of equal code is here. CPU seconds say what work costs, also on a busy
machine; wall seconds say how it fills the cores, on a quiet one alone. Starting is included.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import command

HERE = Path(__file__).parents[1]
WHOLE = ("edit", "bear", "--instruction", "make the bear red")
EDIT = (*WHOLE, "--stages", "1")
COMMANDS = {
    "start": ("edit", "--help"),
    "whole edit": WHOLE,
    "dinosaur": ("edit", "dinosaur", "--instruction", "make the dinosaur blue"),
    "edit": (*EDIT, "--steps", "4", "--iterations", "0"),
    "tune": (*EDIT, "--steps", "1", "--iterations", "200"),
    "fit": ("fit", "{scene}", "--iterations", "300"),
}
"""Arguments of ``attnwarp``, by figure."""


def seconds(tree: Path, arguments: list[str], threads: int) -> tuple[float, float]:
    """CPU and wall seconds of ``attnwarp`` with the package of a source tree."""
    own = {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": str(threads)}
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with tempfile.TemporaryDirectory() as place:
        subprocess.run(
            [sys.executable, "-m", "attnwarp", *arguments, "--out", f"{place}/out"],
            env=os.environ | own, cwd=place, check=True, capture_output=True,
        )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, time.perf_counter() - begin


def compare(
    before: Path, now: Path, commands: dict[str, list[str]], rounds: int, threads: int
) -> dict[str, list[list[tuple[float, float]]]]:
    """CPU and wall seconds by figure: of ``before``, of ``now`` and of ``before`` again, each
    round. The first round, which compiles, is left out."""
    return {
        name: [
            [seconds(tree, arguments, threads) for tree in (before, now, before)]
            for _ in range(rounds + 1)
        ][1:]
        for name, arguments in commands.items()
    }


def table(figures: dict[str, list[list[tuple[float, float]]]]) -> str:
    """Markdown table of medians over the rounds, and of the lowest and highest ratio."""
    heads = "figure", "CPU s", "wall s", "CPU, ratio", "wall, ratio", "cores", "CPU, equal code"
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name, rounds in figures.items():
        cpu, wall, same = (
            [one[which][k] / one[0][k] for one in rounds] for which, k in ((1, 0), (1, 1), (2, 0))
        )
        spent = [f"{statistics.median(now[k] for _, now, _ in rounds):.1f}" for k in range(2)]
        cores = statistics.median(now[0] / now[1] for _, now, _ in rounds)
        ratios = [
            f"{statistics.median(x):.2f} ({min(x):.2f} to {max(x):.2f})" for x in (cpu, wall, same)
        ]
        cells = (name, *spent, *ratios[:2], f"{cores:.2f}", ratios[2])
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run the command line."""
    parser = command.parser("before", "Time what commands cost against an earlier commit.")
    parser.add_argument("commit", nargs="?", default="HEAD~1", help="the earlier one (HEAD~1)")
    parser.add_argument("--rounds", type=int, default=3, help="times each is measured (3)")
    parser.add_argument(
        "--figures", nargs="+", choices=COMMANDS, default=[*COMMANDS], help="what is timed (all)"
    )
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        old, scene = Path(place, "before"), Path(place, "made/scene")
        old.mkdir()
        archive = subprocess.run(
            ["git", "archive", options.commit, "attnwarp"], cwd=HERE, check=True, stdout=-1
        ).stdout
        subprocess.run(["tar", "-x", "-C", str(old)], input=archive, check=True)
        made = [*EDIT, "--steps", "1", "--iterations", "0", "--out", str(scene.parent)]
        subprocess.run(
            [sys.executable, "-m", "attnwarp", *made], cwd=HERE, check=True, capture_output=True
        )
        commands = {k: [a.format(scene=scene) for a in COMMANDS[k]] for k in options.figures}
        figures = compare(old, HERE, commands, options.rounds, options.threads)
    command.write_figures(options.out, figures)
    print(table(figures))


if __name__ == "__main__":
    main()
