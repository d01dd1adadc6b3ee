"""Time and memory of recording and injecting attention in a UNet of Stable Diffusion 1.5's shape.

The weights are random: neither time nor memory depends on them. One view of 512 x 512 px has three
guidance branches, as InstructPix2Pix has, and eight steps: what they record is then far more than
what a pass holds for a moment. The layers are the paper's. Plain passes come first, then passes
that are recorded, then passes with the recorded features injected.

    python -m benchmarks.recording

Peak memory is that of the process during a run, with weights, imports and recording (Linux). The
plain passes' peak subtracted, it is to be what the plan announced. Large tensors get pages of their
own, which go back when they are freed. By default glibc later takes them from its heap, whose holes
between passes and features stay with the process: with a small UNet, 24 MiB of features then raised
the peak by 29 MiB instead of 25.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from attnwarp.editing.injection import inject
from attnwarp.editing.layers import PIX2PIX_BRANCHES, choose_layers
from attnwarp.editing.recording import Recording, RecordingPlan, record
from attnwarp_eval.cost import peak_memory_mb, reset_peak_memory
from benchmarks import command

LATENT_SIZE, TOKENS = 64, 77
MMAP_THRESHOLD, OWN_PAGES = -3, 2**17
"""mallopt's number for the threshold; bytes from which a tensor has pages of its own."""
TIMESTEPS = range(976, 0, -125)
"""Eight."""


@dataclass(frozen=True)
class Row:
    """A run: its name, CPU seconds of all threads, wall seconds, the process's peak memory, and how
    far that is above the plain run's.
    """

    run: str
    cpu_s: float
    wall_s: float
    peak_mib: float
    above_mib: float


def stable_diffusion_unet() -> torch.nn.Module:
    """A UNet of InstructPix2Pix, random weights. diffusers' defaults are Stable Diffusion 1.5's."""
    from diffusers import UNet2DConditionModel

    with torch.device("meta"):
        unet = UNet2DConditionModel(in_channels=8, cross_attention_dim=768, attention_head_dim=8)
    unet = unet.to_empty(device="cpu").eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    for parameter in unet.parameters():
        # Activations then keep about their size from layer to layer.
        bound = parameter[0].numel() ** -0.5
        parameter.uniform_(-bound, bound, generator=generator)
    return unet


def measure(
    unet: Any, size: int = LATENT_SIZE, timesteps: Sequence[int] = TIMESTEPS
) -> tuple[RecordingPlan, list[Row]]:
    """Run the UNet plainly, recorded and injected.

    Args:
        unet: of an InstructPix2Pix editor.
        size: side of the latents.
        timesteps: a pass for each.
    """
    rows = len(PIX2PIX_BRANCHES)
    plan = RecordingPlan(
        choose_layers(unet), (size, size), PIX2PIX_BRANCHES, ("text", "image"), len(timesteps)
    )
    generator = torch.Generator().manual_seed(1)
    latents = torch.randn(rows, unet.config.in_channels, size, size, generator=generator)
    texts = torch.randn(rows, TOKENS, unet.config.cross_attention_dim, generator=generator)
    recorded: list[Recording] = []

    def recording() -> AbstractContextManager[Recording]:
        return record(unet, plan)

    def injection() -> AbstractContextManager[None]:
        return inject(unet, recorded[0], branches=PIX2PIX_BRANCHES)

    results: list[Row] = []
    # What a first pass leaves behind, such as compiled kernels, is no part of any run.
    with torch.no_grad():
        unet(latents, timesteps[0], encoder_hidden_states=texts)
    runs: dict[str, Callable[[], AbstractContextManager[Any]]] = {
        "plain": contextlib.nullcontext,
        "recorded": recording,
        "injected": injection,
    }
    for name, around in runs.items():
        reset_peak()
        wall, cpu = time.perf_counter(), time.process_time()
        with around() as result, torch.no_grad():
            for timestep in timesteps:
                passed: Tensor = unet(latents, timestep, encoder_hidden_states=texts)[0]
        if not bool(torch.isfinite(passed).all()):
            raise SystemExit(f"{name}: the network's output is not finite")
        if isinstance(result, Recording):
            recorded.append(result)
        peak = peak_memory_mb()
        seconds = time.process_time() - cpu, time.perf_counter() - wall
        above = peak - results[0].peak_mib if results else 0.0
        results.append(Row(name, *seconds, peak, above))
    return plan, results


def reset_peak() -> None:
    """Count this process's peak memory from now on. Memory that was freed is given back first: a
    run that used it again would not show in the peak.
    """
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    reset_peak_memory()


def table(rows: Sequence[Row]) -> str:
    """The rows for a person, as Markdown."""
    lines = ["| run | CPU s | wall s | peak, MiB | above plain, MiB |", "|---|---|---|---|---|"]
    lines += [
        f"| {row.run} | {row.cpu_s:.1f} | {row.wall_s:.1f} | {row.peak_mib:.1f} |"
        f" {row.above_mib:.1f} |"
        for row in rows
    ]
    return "\n".join(lines)


def verdict(plan: RecordingPlan, rows: Sequence[Row]) -> str:
    """Line with the announced memory beside the rise of the peak."""
    announced, rose = plan.bytes / 2**20, {row.run: row.above_mib for row in rows}["recorded"]
    return (
        f"announced {announced:.1f} MiB; recorded, the peak rose by {rose:.1f} MiB,"
        f" {rose / announced:.3f} of it"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser("recording", "Time and memory of recording and injecting attention.")
    options = parser.parse_args(arguments)
    ctypes.CDLL(None).mallopt(MMAP_THRESHOLD, OWN_PAGES)  # naming it keeps glibc from raising it
    unet = stable_diffusion_unet()
    weights = sum(p.numel() * p.element_size() for p in unet.parameters()) / 2**30
    print(f"weights {weights:.2f} GiB, {torch.get_num_threads()} threads")
    plan, rows = measure(unet)
    print(plan)
    print(table(rows))
    print(verdict(plan, rows))
    write = {"weights_gib": weights, "recording_bytes": plan.bytes}
    command.write_figures(options.out, {**write, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
