"""Do other processors' code paths give the same figures?

python -m scripts.processors [STUDY] [--scenes A,B] [--runs FOLDER] [attnwarp-eval run's options]

Runs a study (the gate by default) as this processor does by default, and as older ones would: with
numpy, numba, PyTorch, oneDNN and OpenBLAS held to their narrower instructions. Prints the largest
relative difference of any figure, by probe; exit code 1 where one exceeds 1e-6, or 1e-3 where
iterations or the 256 levels of an edited picture decide it. Mitsuba's scalar variant renders the
truth, since LLVM's takes the processor it finds.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
from pathlib import Path

from attnwarp_eval.report.results import read_results
from attnwarp_eval.study.store import Store

PATHS = {
    "as it is": {},
    "AVX2": {
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL",
        "NUMBA_CPU_NAME": "haswell",
        "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "OPENBLAS_CORETYPE": "Haswell",
    },
    "SSE4": {
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL",
        "NUMBA_CPU_NAME": "nehalem",
        "ATEN_CPU_CAPABILITY": "default",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "OPENBLAS_CORETYPE": "Nehalem",
    },
}
"""Environment of each path. Names of features that a version of numpy lacks are only warned of."""

TOLERANCE = 1e-6

LOOSE = dict.fromkeys(("fit", "ideal", "editing", "masks"), 1e-3)
"""Tolerances of probes with iterations or edited pictures."""

Figures = dict[tuple[str, ...], float]


def main() -> int:
    """Run the study by every path, and compare."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("study", nargs="?", default="gate")
    parser.add_argument("--runs", type=Path, default=Path("build/processors"))
    args, options = parser.parse_known_args()
    runs = {}
    for name, environment in PATHS.items():
        out = args.runs / name.replace(" ", "-")
        shared = {"ATTNWARP_CACHE": str(out / "derived"), "ATTNWARP_MITSUBA": "scalar_rgb"}
        command = [sys.executable, "-m", "attnwarp_eval", "run", args.study, "--out", str(out)]
        subprocess.run(
            [*command, *options], env={**os.environ, **shared, **environment}, check=True
        )
        runs[name] = figures(out)
    first = runs.pop("as it is")
    return max(report(name, first, other) for name, other in runs.items())


def figures(run: Path) -> Figures:
    """Every figure of a run."""
    return {
        (cell.probe, cell.scene, *cell.variants, view.name, key): value
        for cell in read_results(Store(run)).cells
        if cell.record is not None
        for view in cell.record.views
        for key, value in view.metrics.items()
    }


def report(name: str, first: Figures, other: Figures) -> int:
    """Print the largest difference of each probe; 1 if one exceeds the tolerance."""
    if first.keys() != other.keys():
        print(f"{name}: other figures are there")
        return 1
    worst: dict[str, tuple[float, tuple[str, ...]]] = {}
    for key, value in first.items():
        worst[key[0]] = max(worst.get(key[0], (0.0, key)), (apart(value, other[key]), key))
    for probe, (most, key) in sorted(worst.items()):
        print(f"{name}: {probe}: {most:.1e}", f"({' / '.join(key[1:])})" if most else "")
    return int(any(most > LOOSE.get(probe, TOLERANCE) for probe, (most, _) in worst.items()))


def apart(a: float, b: float) -> float:
    """Relative difference; absolute below 1."""
    if math.isnan(a) or math.isnan(b):
        return 0.0 if math.isnan(a) and math.isnan(b) else math.inf
    return 0.0 if a == b else abs(a - b) / max(1.0, abs(a), abs(b))


if __name__ == "__main__":
    sys.exit(main())
