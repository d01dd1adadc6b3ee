"""Cost of a study of many cells beside the cells themselves: planning, storing, verifying,
reporting, comparing.

The cells compute nothing, so that only this is measured. Every step runs in a process of its own,
whose seconds and peak memory are read at its end.

    python -m benchmarks.scale --cells 1000 10000 100000 --out reports/scale/report.md
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from attnwarp_eval.canonical_json import digest
from attnwarp_eval.cost import peak_memory_mb
from attnwarp_eval.files import write_atomic
from attnwarp_eval.metrics.registry import METRICS, Registry
from attnwarp_eval.study.probe import Probe, Work, register
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Part, Study, Variant
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.study import parse_study

SCENES = ["spheres", "opposed", "fence", "mirror", "glass", "lens", "stack", "slats"]
FIGURES = ("depth.abs_rel", "depth.bias_relative", "depth.coverage")


class VariantPart(Part):
    """Key that tells the variants apart."""

    level: int = 0


class Free(Probe[NoExtra]):
    """Figures that follow from the cell's id and cost nothing."""

    name = "free"
    variant_part = VariantPart
    metrics = Registry({name: METRICS[name] for name in FIGURES})
    columns: ClassVar[Mapping[str, str]] = {name: name for name in FIGURES}
    contrasts = FIGURES

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """The variant's level."""
        return {"level": variant.part(VariantPart).level}

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """The variant's level."""
        return (variant.part(VariantPart).level,)

    def compute(self, work: Work) -> NoExtra:
        """Figures in [0, 1) out of the hash of the cell and the view."""
        for view in work.spec["views"]:
            with work.meter.view():
                digits = digest([work.cell.id, view])
                values = [int(digits[8 * i : 8 * i + 8], 16) / 2**32 for i in range(len(FIGURES))]
            work.meter.count(pixels=256)
            work.add(view, dict(zip(FIGURES, values, strict=True)))
        return NoExtra()


def study_of(cells: int) -> Study:
    """A study of about so many cells: variants and seeds grow alike."""
    side = max(2, round((cells / len(SCENES)) ** 0.5))
    names = [f"level {level}" for level in range(side)]
    return parse_study(
        {
            "name": "scale",
            "size": 16,
            "feature_sizes": [16],
            "spp": 1,
            "scenes": SCENES,
            "views": [],
            "seeds": list(range(max(1, round(cells / len(SCENES) / side)))),
            "variants": {name: {"level": level} for level, name in enumerate(names)},
            "probes": {"free": names},
            "ablations": [
                {"title": "Levels", "probe": "free", "baseline": names[0], "variants": names[1:]}
            ],
        }
    )


def step_plan(cells: int, root: Path) -> int:
    """List the cells and look which of them there are."""
    from attnwarp_eval.study.run import plan

    return len(plan(study_of(cells), Store(root)).cells)


def step_store(cells: int, root: Path) -> int:
    """Compute and store every cell."""
    from attnwarp_eval.study.run import execute, plan

    store = Store(root)
    with store.lock():
        summary = execute(plan(study_of(cells), store), store)
    assert summary.complete, summary.failures[:1]
    return summary.computed


def step_verify(cells: int, root: Path) -> int:
    """Compute every hash again."""
    from attnwarp_eval.study.run import verify

    problems = verify(Store(root))
    assert problems.ok, problems
    return problems.checked


def step_report(cells: int, root: Path) -> int:
    """Write the report and results.jsonl."""
    from attnwarp_eval.report import write_report

    write_report(Store(root))
    return (root / "report.html").stat().st_size


def step_compare(cells: int, root: Path) -> int:
    """Compare the run with itself, read twice, as the command does for two runs."""
    from attnwarp_eval.canonical_json import write_json
    from attnwarp_eval.compare import compare, read_snapshot
    from attnwarp_eval.compare.write import as_json

    comparison = compare(read_snapshot(Store(root)), read_snapshot(Store(root)))
    assert not comparison.regressed, comparison.faults[:1]
    result = root / "compare.json"
    write_json(result, as_json(comparison))
    return result.stat().st_size


STEPS: dict[str, Callable[[int, Path], int]] = {
    "plan": step_plan,
    "store": step_store,
    "plan again": step_plan,
    "verify": step_verify,
    "report": step_report,
    "compare": step_compare,
}


def one_step(name: str, cells: int, root: Path) -> dict[str, float]:
    """Run a step in this process; its seconds are those of the step, without the imports."""
    import attnwarp_eval.compare
    import attnwarp_eval.report  # noqa: F401

    study_of(32)
    wall, cpu = time.perf_counter(), time.process_time()
    STEPS[name](cells, root)
    return {
        "wall": time.perf_counter() - wall,
        "cpu": time.process_time() - cpu,
        "mb": peak_memory_mb(),
    }


Row = tuple[int, str, dict[str, float] | None]
"""Cells, a step, and what it took; None where it failed."""


def measure(counts: Sequence[int], folder: Path) -> Iterator[Row]:
    """Every step at every count, each in a process of its own. One that fails ends none of the
    others, and its error is on the terminal.
    """
    for cells in counts:
        root = folder / f"run{cells}"
        for name in STEPS:
            command = [sys.executable, "-m", "benchmarks.scale", "--step", name]
            done = subprocess.run(
                [*command, "--cells", str(cells), "--folder", str(root)],
                stdout=subprocess.PIPE,
                text=True,
            )
            values = None if done.returncode else json.loads(done.stdout.splitlines()[-1])
            yield cells, name, values
        shutil.rmtree(root, ignore_errors=True)  # no folder where the first step failed


def table(rows: Sequence[Row]) -> str:
    """A row a step; CPU seconds, wall seconds and MiB at each count."""
    counts = sorted({cells for cells, _, _ in rows})
    by_key = {(cells, name): values for cells, name, values in rows}
    lines = [
        "| step | " + " | ".join(f"{cells:,} cells" for cells in counts) + " |",
        "|---" * (1 + len(counts)) + "|",
    ]
    for name in dict.fromkeys(name for _, name, _ in rows):
        entries = [
            "failed"
            if (values := by_key[cells, name]) is None
            else "{cpu:.1f} s, {wall:.1f} s, {mb:.0f} MiB".format(**values)
            for cells in counts
        ]
        lines.append(f"| {name} | " + " | ".join(entries) + " |")
    return "\n".join(lines)


def main() -> None:
    """Measure, print, and write where ``--out`` says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, nargs="+", default=[1000])
    parser.add_argument("--out", type=Path, help="Markdown file of the table")
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    parser.add_argument(
        "--folder", type=Path, help="where the runs are made; a new one if left out"
    )
    arguments = parser.parse_args()
    register(Free)
    if arguments.step:
        print(json.dumps(one_step(arguments.step, arguments.cells[0], arguments.folder)))
        return
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        rows: list[Row] = []
        for row in measure(arguments.cells, Path(folder)):
            print(*row, flush=True)
            rows.append(row)
    text = table(rows)
    print(text)
    if arguments.out:
        write_atomic(arguments.out, (text + "\n").encode())
    failed = [f"{name} at {cells:,} cells" for cells, name, values in rows if values is None]
    if failed:
        sys.exit(f"benchmarks.scale: failed: {', '.join(failed)}; the errors stand above")


if __name__ == "__main__":
    main()
