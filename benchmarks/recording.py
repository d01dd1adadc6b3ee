"""Time and memory of recording and injecting attention in a UNet of Stable Diffusion 1.5's shape.

The weights are random: neither time nor memory depends on them. One view of 512 x 512 px has three
guidance branches, as InstructPix2Pix has, and two steps. The layers are the paper's. Plain passes
come first, then passes that are recorded, then passes with the recorded features injected.

    python -m benchmarks.recording

Peak memory is that of the process during a run, with weights, imports and recording (Linux).
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from attnwarp.editing.attention import (
    PIX2PIX_BRANCHES,
    Recording,
    RecordingPlan,
    choose_layers,
    inject,
    record,
)
from benchmarks import command

LATENT_SIZE, TIMESTEPS, TOKENS = 64, (981, 481), 77


@dataclass(frozen=True)
class Row:
    """A run: its name, CPU seconds of all threads, wall seconds, the process's peak memory."""

    run: str
    cpu_s: float
    wall_s: float
    peak_gib: float


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


def measure(unet: Any, size: int = LATENT_SIZE) -> tuple[RecordingPlan, list[Row]]:
    """Run the UNet plainly, recorded and injected.

    Args:
        unet: of an InstructPix2Pix editor.
        size: side of the latents.
    """
    rows = len(PIX2PIX_BRANCHES)
    plan = RecordingPlan(
        choose_layers(unet), (size, size), PIX2PIX_BRANCHES, ("text", "image"), len(TIMESTEPS)
    )
    generator = torch.Generator().manual_seed(1)
    latents = torch.randn(rows, unet.config.in_channels, size, size, generator=generator)
    texts = torch.randn(rows, TOKENS, unet.config.cross_attention_dim, generator=generator)
    recorded: list[Recording] = []

    def recording() -> AbstractContextManager[Recording]:
        return record(unet, plan, announce=lambda _: None)

    def injection() -> AbstractContextManager[None]:
        return inject(unet, recorded[0], branches=PIX2PIX_BRANCHES)

    results = []
    runs: dict[str, Callable[[], AbstractContextManager[Any]]] = {
        "plain": contextlib.nullcontext,
        "recorded": recording,
        "injected": injection,
    }
    for name, around in runs.items():
        reset_peak()
        wall, cpu = time.perf_counter(), time.process_time()
        with around() as result, torch.no_grad():
            for timestep in TIMESTEPS:
                passed: Tensor = unet(latents, timestep, encoder_hidden_states=texts)[0]
        if not bool(torch.isfinite(passed).all()):
            raise SystemExit(f"{name}: the network's output is not finite")
        if isinstance(result, Recording):
            recorded.append(result)
        results.append(
            Row(
                name,
                time.process_time() - cpu,
                time.perf_counter() - wall,
                peak_memory() / 2**30,
            )
        )
    return plan, results


def reset_peak() -> None:
    """Let the kernel count this process's peak memory from now on."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """Peak bytes of this process since :func:`reset_peak`."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def table(rows: Sequence[Row]) -> str:
    """The rows for a person, as Markdown."""
    lines = ["| run | CPU s | wall s | peak GiB |", "|---|---|---|---|"]
    lines += [
        f"| {row.run} | {row.cpu_s:.1f} | {row.wall_s:.1f} | {row.peak_gib:.2f} |" for row in rows
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser("recording", "Time and memory of recording and injecting attention.")
    options = parser.parse_args(arguments)
    unet = stable_diffusion_unet()
    weights = sum(p.numel() * p.element_size() for p in unet.parameters()) / 2**30
    print(f"weights {weights:.2f} GiB, {torch.get_num_threads()} threads")
    plan, rows = measure(unet)
    print(plan)
    print(table(rows))
    write = {"weights_gib": weights, "recording_bytes": plan.bytes}
    command.write_figures(options.out, {**write, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
