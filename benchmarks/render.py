"""Speed at which this machine renders splats: ``python -m benchmarks.render`` (``make bench``).

One process. The cases run in turn (:func:`attnwarp_eval.cost.in_turn`), so that a slow moment of
the machine falls on all of them; the median over rounds is reported, with the fastest beside it.
Pairs evaluated are 16 for each splat whose intersection with a 4 x 4 square of pixels was computed.

Two models are fitted over the cases by least squares of the relative error, and reported with R^2
(of the plain residuals) and 95 % intervals: processor time of the forward pass = a pairs + b splats
+ c pixels (and, for comparison, = a + b pairs alone); and memory, the most bytes held beyond what
was held before the call, = a splats + b pixels. An interval holds if the cases were a random draw
of such scenes, which a grid of cases is not; it says how well the cases determine the number.
"""

from __future__ import annotations

import gc
import platform
import statistics
import time
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.render.api import render
from attnwarp.render.threads import thread_count
from attnwarp_eval.cost import in_turn, peak_memory_mb
from benchmarks import command


@dataclass
class Case:
    """One picture to be timed: kind, image size, number of splats, largest sigma; and what was
    measured.
    """

    kind: str
    size: int
    splats: int
    sigma: float
    forward: list[float] = field(default_factory=list)
    forward_cpu: list[float] = field(default_factory=list)
    both: list[float] = field(default_factory=list)
    both_cpu: list[float] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=dict)
    forward_bytes: int = 0
    both_bytes: int = 0

    @property
    def name(self) -> str:
        """Name for the table."""
        return f"{self.kind} {self.size} {self.splats // 1000}k {self.sigma:g}"


def scene(kind: str, count: int, sigma: float, seed: int = 0) -> Gaussians:
    """Random splats in a unit ball: sigmas uniform up to ``sigma``, opacities uniform in [0, 1],
    degree 0 colours.
    """
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=generator)
    means = (
        means
        / means.norm(dim=1, keepdim=True)
        * torch.rand(count, 1, generator=generator) ** (1 / 3)
    )
    scales = (
        torch.rand(count, 2 if kind == "2d" else 3, generator=generator) * 0.95 * sigma
        + 0.05 * sigma
    )
    return Gaussians(
        "2d" if kind == "2d" else "3d",
        means,
        torch.randn(count, 4, generator=generator),
        scales,
        torch.rand(count, generator=generator),
        torch.randn(count, 1, 3, generator=generator) * 0.3,
    )


def camera(size: int) -> Camera:
    """Camera at distance 3 from the ball's middle, which fills the picture."""
    return Camera.look_at([0, -3, 0], [0, 0, 0], width=size, height=size, fov_y=42)


def _differentiate(splats: Gaussians, view: Camera) -> None:
    """A forward and a backward pass. Upstream gradients of ones: the loss is not what is
    measured."""
    traced = render(splats, view, backend="cpu")
    outputs = [traced.color, traced.alpha, traced.normal, traced.distortion_ordered]
    ones = torch.ones(view.height, view.width)
    torch.autograd.backward(
        outputs, [ones[..., None].expand_as(o) if o.ndim == 3 else ones for o in outputs]
    )


def _with_leaves(splats: Gaussians) -> Gaussians:
    names = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(
        splats.kind, *(getattr(splats, name).clone().requires_grad_() for name in names)
    )


@dataclass(frozen=True)
class Round:
    """Seconds of one forward pass and of one forward and backward pass, on the wall and of the
    processor, and the renderer's counters.
    """

    forward: float
    forward_cpu: float
    both: float
    both_cpu: float
    counters: dict[str, int]


def time_once(splats: Gaussians, view: Camera) -> Round:
    """One forward, one forward with backward."""
    start, start_cpu = time.perf_counter(), time.process_time()
    result = render(splats, view, backend="cpu")
    forward, forward_cpu = time.perf_counter() - start, time.process_time() - start_cpu
    counters = result.counters
    del result
    again = _with_leaves(splats)
    start, start_cpu = time.perf_counter(), time.process_time()
    _differentiate(again, view)
    both, both_cpu = time.perf_counter() - start, time.process_time() - start_cpu
    return Round(forward, forward_cpu, both, both_cpu, counters)


def _contestant(splats: Gaussians, view: Camera) -> Callable[[int], Round]:
    return lambda _: time_once(splats, view)


def _collect_garbage(_: int) -> None:
    gc.collect()


def time_in_turn(built: Sequence[tuple[Case, Gaussians, Camera]], rounds: int) -> None:
    """Time the cases and write what they took into them."""
    contestants = [_contestant(splats, view) for _, splats, view in built]
    turns = in_turn(contestants, rounds, before=_collect_garbage)
    for (case, _, _), results in zip(built, turns.results, strict=True):
        case.forward = [r.forward for r in results]
        case.forward_cpu = [r.forward_cpu for r in results]
        case.both = [r.both for r in results]
        case.both_cpu = [r.both_cpu for r in results]
        case.counters = results[-1].counters


def measure_memory(case: Case, splats: Gaussians, view: Camera) -> None:
    """The most that one forward pass, and one with a backward pass, hold at once: results,
    gradients and all.
    """
    again = _with_leaves(splats)

    def most(work: Any) -> int:
        gc.collect()
        tracemalloc.start()
        work()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    case.forward_bytes = most(lambda: render(splats, view, backend="cpu"))
    case.both_bytes = most(lambda: _differentiate(again, view))


def fit(columns: Mapping[str, Sequence[float]], y: Sequence[float]) -> dict[str, Any] | None:
    """Least squares in relative error (each case weighs 1 / y^2) of ``y`` as a sum of multiples of
    ``columns``.

    Returns:
        For each column its factor and the ends of its 95 % interval (Student's t); "r2" of the
        plain residuals, and "typical_error", the median of the relative ones. None if there are too
        few cases, or columns that are multiples of one another.
    """
    b = np.asarray(y, float)
    design = np.stack([np.asarray(c, float) for c in columns.values()], axis=1) / b[:, None]
    freedom = len(b) - design.shape[1]
    if (
        freedom < 1
        or np.linalg.matrix_rank(design / np.linalg.norm(design, axis=0)) < design.shape[1]
    ):
        return None
    factors, *_ = np.linalg.lstsq(design, np.ones(len(b)), rcond=None)
    residual = 1 - design @ factors
    variance = residual @ residual / freedom * np.diag(np.linalg.inv(design.T @ design))
    reach = stats.t.ppf(0.975, freedom) * np.sqrt(variance)
    return {
        **{
            name: [float(f), float(f - r), float(f + r)]
            for name, f, r in zip(columns, factors, reach, strict=True)
        },
        "r2": float(1 - np.var(residual * b) / np.var(b)),
        "typical_error": float(np.median(np.abs(residual))),
    }


def fits(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The models of time (ns) and memory (bytes) over the rows of the table."""
    one, splats = [1.0] * len(rows), [r["splats"] for r in rows]
    pairs, pixels = [r["pairs"] for r in rows], [r["size"] ** 2 for r in rows]
    time_ns = [1e6 * r["forward_cpu_ms"] for r in rows]
    return {
        "time": fit({"pairs": pairs, "splats": splats, "pixels": pixels}, time_ns),
        "time_by_pairs_alone": fit({"call": one, "pairs": pairs}, time_ns),
        "memory_forward": fit(
            {"splats": splats, "pixels": pixels}, [r["forward_bytes"] for r in rows]
        ),
        "memory_both": fit(
            {"splats": splats, "pixels": pixels}, [r["forward_backward_bytes"] for r in rows]
        ),
    }


def run(cases: list[Case], rounds: int) -> dict[str, Any]:
    """Time ``cases``; all of the table, as JSON values."""
    start = time.perf_counter()
    for kind in sorted({case.kind for case in cases}):
        time_once(scene(kind, 100, 0.1), camera(32))
    warm_up = time.perf_counter() - start
    built = [(case, scene(case.kind, case.splats, case.sigma), camera(case.size)) for case in cases]
    time_in_turn(built, rounds)
    for case, splats, view in built:
        measure_memory(case, splats, view)
    memory = peak_memory_mb()
    rows = [row(case) for case in cases]
    return {
        "machine": _processor(),
        "threads": thread_count(),
        "rounds": rounds,
        "first_call_seconds": round(warm_up, 2),
        "peak_memory_mib": round(memory, 1),
        "fits": fits(rows),
        "cases": rows,
    }


def _processor() -> str:
    """Its name, as far as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def row(case: Case) -> dict[str, Any]:
    """One line of the table."""
    forward, both = statistics.median(case.forward), statistics.median(case.both)
    pairs = case.counters["pairs"]
    cpu, both_cpu = statistics.median(case.forward_cpu), statistics.median(case.both_cpu)
    return {
        "kind": case.kind,
        "size": case.size,
        "splats": case.splats,
        "max_sigma": case.sigma,
        "forward_ms": round(1e3 * forward, 2),
        "forward_best_ms": round(1e3 * min(case.forward), 2),
        "forward_cpu_ms": round(1e3 * cpu, 2),
        "forward_backward_ms": round(1e3 * both, 2),
        "forward_backward_cpu_ms": round(1e3 * both_cpu, 2),
        "backward_over_forward": round((both_cpu - cpu) / cpu, 2),
        "pairs": pairs,
        "contributing": case.counters["contributing"],
        "gigapairs_per_second": round(pairs / forward / 1e9, 3),
        "composited": case.counters["composited"],
        "forward_bytes": case.forward_bytes,
        "forward_backward_bytes": case.both_bytes,
    }


def table(result: dict[str, Any]) -> str:
    """The result for a person, as Markdown."""
    head = f"{result['threads']} threads, {result['rounds']} rounds, median; "
    head += f"peak memory {result['peak_memory_mib']:.0f} MiB, "
    head += f"first call {result['first_call_seconds']} s (compilation or its cache)"
    lines = [
        head,
        "",
        (
            "| kind | size | splats | max sigma | forward ms (best; cpu) | fwd + bwd ms (cpu) | bwd"
            " / fwd | Mpairs | Gpairs/s | MiB (fwd + bwd) |"
        ),
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in result["cases"]:
        cells = [
            r["kind"],
            r["size"],
            r["splats"],
            f"{r['max_sigma']:g}",
            f"{r['forward_ms']:.1f} ({r['forward_best_ms']:.1f}; {r['forward_cpu_ms']:.1f})",
            f"{r['forward_backward_ms']:.1f} ({r['forward_backward_cpu_ms']:.1f})",
            f"{r['backward_over_forward']:.2f}",
            f"{r['pairs'] / 1e6:.1f}",
            f"{r['gigapairs_per_second']:.2f}",
            f"{r['forward_bytes'] / 2**20:.0f} ({r['forward_backward_bytes'] / 2**20:.0f})",
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    lines += ["", *_sentences(result["fits"])]
    return "\n".join(lines)


def _sentences(models: Mapping[str, Any]) -> list[str]:
    def terms(model: Mapping[str, Any], unit: str) -> str:
        factors = [(name, value) for name, value in model.items() if isinstance(value, list)]
        costs = [
            f"{f:.3g} {unit} a {name.rstrip('s')} [{low:.3g}, {high:.3g}]"
            for name, (f, low, high) in factors
        ]
        fitted = (
            f"R^2 {model['r2']:.3f}, half of the cases within {100 * model['typical_error']:.0f} %"
        )
        return f"{' + '.join(costs)}; {fitted}"

    names = {
        "time": ("forward, processor time", "ns"),
        "time_by_pairs_alone": ("the same by pairs alone", "ns"),
        "memory_forward": ("memory, forward", "bytes"),
        "memory_both": ("memory, forward and backward", "bytes"),
    }
    return [
        f"- {title} = {terms(models[key], unit)}"
        for key, (title, unit) in names.items()
        if models[key]
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser("render", "Time the CPU renderer.")
    command.add_turns(parser, "256 x 256 with 10k and 50k splats only, 3 rounds", rounds=7)
    options = parser.parse_args(arguments)
    sizes, counts = (
        ([256], [10_000, 50_000]) if options.quick else ([256, 512], [10_000, 50_000, 200_000])
    )
    cases = [
        Case(kind, size, count, sigma)
        for size in sizes
        for count in counts
        for sigma in (0.03, 0.1)
        for kind in ("2d", "3d")
    ]
    result = run(cases, 3 if options.quick else options.rounds)
    print(table(result))
    command.write_figures(options.out, result)


if __name__ == "__main__":
    main()
