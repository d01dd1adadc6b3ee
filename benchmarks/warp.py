"""Speed at which views and attention features are warped: ``python -m benchmarks.warp``.

One process. All contestants run in turn (:func:`attnwarp_eval.cost.in_turn`), so that a slow moment
of the machine falls on all of them. The table has the median over rounds. A ratio is the median of
the wall seconds' ratios within a round, with its 95 % interval (by order statistics, see
:func:`attnwarp_eval.statistics.intervals.time_ratio`). What a ratio is taken to runs twice a round:
its ratio to itself is what the machine's noise alone does.

- A pair: the correspondence, every rule and the mask at image size, and feature grids of 1/8 and
  1/16; beside it the definition in torch, and the render of the target that it starts from.
- Tokens (2, h*w, C): the warp; beside it torch's ``grid_sample`` and kornia's
  ``warp_frame_depth`` (which reprojects) on the same features as (2, C, h, w), the definition in
  torch, and one addition of the warped tokens.

The yardstick of memory is a copy of the bytes that a warp must move, the source's tokens once and
the result's once, by the same threads in the same rounds. A warp's share of the bandwidth is the
copy's time over its own. Taps counted are those of weight above 0, times channels. Processor time
is that of all threads; torch's spin while they wait.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.render._kernels.compilation import exact
from attnwarp.render.api import render
from attnwarp.render.threads import ranges, run_jobs, thread_count
from attnwarp.warp import FeatureWarp, WarpedView, render_surface, warp_surfaces
from attnwarp_eval.cost import in_turn
from attnwarp_eval.statistics.intervals import time_ratio
from benchmarks import command

SPLATS = 40_000
YAW = 20.0
BATCH = 2


@exact
def copy_rows(begin: int, end: int, source: Any, result: Any) -> None:
    """Tokens ``begin`` to ``end`` of ``source`` to ``result``, both (B, N, C)."""
    for b in range(source.shape[0]):
        for n in range(begin, end):
            for c in range(source.shape[2]):
                result[b, n, c] = source[b, n, c]


@dataclass
class Case:
    """Contestants that take turns, and their wall and processor times in seconds, a row a round."""

    name: str
    contestants: dict[str, Callable[[], object]]
    yardstick: str
    counters: dict[str, int] = field(default_factory=dict)
    wall: dict[str, list[float]] = field(default_factory=dict)
    cpu: dict[str, list[float]] = field(default_factory=dict)

    @property
    def runs(self) -> dict[str, Callable[[], object]]:
        """All that takes turns: the contestants, and the yardstick once more."""
        return {**self.contestants, f"{self.yardstick}, again": self.contestants[self.yardstick]}

    def rows(self) -> list[dict[str, Any]]:
        """One line of the table for each contestant, and for the yardstick against itself."""
        base = self.wall[self.yardstick]
        rows = []
        for name in self.runs:
            ratio = time_ratio([self.wall[name]], [base])
            known = not math.isnan(ratio.low)
            rows.append(
                {
                    "case": self.name,
                    "contestant": name,
                    "wall_ms": 1e3 * statistics.median(self.wall[name]),
                    "wall_best_ms": 1e3 * min(self.wall[name]),
                    "cpu_ms": 1e3 * statistics.median(self.cpu[name]),
                    f"times_{self.yardstick}": ratio.ratio,
                    "interval": [ratio.low, ratio.high] if known else None,
                    **self.counters,
                }
            )
        return rows


def shell(count: int = SPLATS) -> Gaussians:
    """A unit sphere of flat splats on a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * k / count), np.pi * (1 + math.sqrt(5)) * k
    x, y = np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar)
    z = np.cos(polar)
    # The rotation that takes the z axis to the normal.
    quats = np.stack([1 + z, -y, x, np.zeros(count)], axis=-1)
    means = torch.from_numpy(np.stack([x, y, z], axis=-1)).float()
    return Gaussians(
        "2d",
        means,
        torch.from_numpy(quats).float(),
        torch.full((count, 2), 0.6 * math.sqrt(4 * math.pi / count)),
        torch.full((count,), 0.99),
        Gaussians.sh_from_rgb(0.5 + 0.4 * means),
    )


def views(size: int) -> tuple[Camera, Camera]:
    """Source and target, 20 degrees apart, at 3 radii from the sphere, which fills the picture."""
    cameras = []
    for yaw in (0.0, math.radians(YAW)):
        position = (3 * math.sin(yaw), -3 * math.cos(yaw), 0.5)
        cameras.append(Camera.look_at(position, (0, 0, 0), width=size, height=size, fov_y=42))
    return cameras[0], cameras[1]


def grids(view: WarpedView, size: int) -> tuple[FeatureWarp, FeatureWarp]:
    """The two feature grids of a latent model: 1/8 and 1/16 of the image."""
    return view.at((size // 8, size // 8)), view.at((size // 16, size // 16))


def pair_case(size: int) -> Case:
    """A pair of views from rendered surfaces, with its grids."""
    splats, (source, target) = shell(), views(size)
    seen, other = (render_surface(splats, camera) for camera in (target, source))
    return Case(
        f"pair {size}",
        {
            "warp": lambda: grids(warp_surfaces(source, target, seen, other), size),
            "definition": lambda: grids(
                warp_surfaces(source, target, seen, other, backend="reference"), size
            ),
            "render": lambda: render(splats, target, backend="cpu"),
        },
        "render",
        {"pixels": size * size},
    )


def tokens_case(grid: int, channels: int, dtype: torch.dtype, *, others: bool) -> Case:
    """Tokens of one layer; ``others``: with contestants from outside, which take float32 maps."""
    size = 8 * grid
    splats, (source, target) = shell(), views(size)
    seen, other = (render_surface(splats, camera) for camera in (target, source))
    layer = warp_surfaces(source, target, seen, other).at((grid, grid))
    generator = torch.Generator().manual_seed(0)
    tokens = torch.randn(BATCH, grid * grid, channels, generator=generator).to(dtype)
    new, result = torch.randn(tokens.shape, generator=generator).to(dtype), tokens.clone()
    maps = tokens.transpose(1, 2).reshape(BATCH, channels, grid, grid).contiguous()
    raw = torch.int16 if dtype.itemsize == 2 else dtype
    begin, end = (t.view(raw).numpy() for t in (tokens, result))
    pieces = ranges(grid * grid, max(1, grid * grid // (4 * thread_count())))
    contestants: dict[str, Callable[[], object]] = {
        "copy": lambda: run_jobs(copy_rows, [(*p, begin, end) for p in pieces]),
        "tokens": lambda: layer.warp_tokens(tokens),
        "tokens + addition": lambda: layer.warp_tokens(tokens) + new,
        "maps": lambda: layer.warp(maps),
    }
    if others:
        contestants |= _others(layer, maps)
    with torch.no_grad():
        taps = int((layer._tokens_taps(tokens).weight > 0).sum()) * BATCH * channels
    moved = 2 * tokens.numel() * tokens.element_size()
    counters = {"taps": taps, "bytes": moved}
    name = f"tokens ({BATCH}, {grid * grid}, {channels}) {str(dtype).removeprefix('torch.')}"
    return Case(name, contestants, "copy", counters)


def _others(layer: FeatureWarp, maps: Tensor) -> dict[str, Callable[[], object]]:
    from kornia.geometry.depth import warp_frame_depth

    definition = FeatureWarp(layer.correspondence, layer.mask, "reference")
    tokens = maps.flatten(2).transpose(1, 2).contiguous()
    c = layer.correspondence
    size = torch.tensor([c.source.width, c.source.height])
    grid = torch.where(c.defined[..., None], 2 * c.xy / size - 1, 0).float()
    grid = grid[None].expand(len(maps), -1, -1, -1).contiguous()
    depth = torch.nan_to_num(c.target_depth).float().expand(len(maps), 1, -1, -1)
    pose = torch.from_numpy(c.source.relative_to(c.target)).float().expand(len(maps), -1, -1)
    K = torch.from_numpy(c.source.K.copy()).float().expand(len(maps), -1, -1)
    return {
        "definition": lambda: definition.warp_tokens(tokens),
        "grid_sample": lambda: torch.nn.functional.grid_sample(
            maps, grid, padding_mode="border", align_corners=False
        ),
        "kornia": lambda: warp_frame_depth(maps, depth, pose, K),
    }


def _dropping(work: Callable[[], object]) -> Callable[[int], None]:
    """``work`` without its result, which would fill the memory round by round."""

    def run(_: int) -> None:
        work()

    return run


def run(cases: Sequence[Case], rounds: int) -> dict[str, Any]:
    """Time the cases; all of the table, as JSON values."""
    entries = [(case, name, work) for case in cases for name, work in case.runs.items()]
    with torch.no_grad():
        turns = in_turn([_dropping(work) for *_, work in entries], rounds)
    for (case, name, _), wall, cpu in zip(entries, turns.seconds, turns.cpu, strict=True):
        case.wall[name], case.cpu[name] = wall, cpu
    rows = [row for case in cases for row in case.rows()]
    for row in rows:
        if row["contestant"] in ("copy", "tokens", "maps"):
            row["bandwidth_share"] = 1 / row["times_copy"]
    return {"threads": thread_count(), "rounds": rounds, "rows": rows}


def table(result: dict[str, Any]) -> str:
    """The result for a person, as Markdown."""
    lines = [
        f"{result['threads']} threads, {result['rounds']} rounds, medians; ratios of wall time,"
        " [95 %]",
        "",
        "| case | contestant | wall ms (best) | cpu ms | of the render | of a copy | of bandwidth"
        " | Mtaps |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        cells = [
            row["case"],
            row["contestant"],
            f"{row['wall_ms']:.2f} ({row['wall_best_ms']:.2f})",
            f"{row['cpu_ms']:.2f}",
            _ratio(row, "times_render"),
            _ratio(row, "times_copy"),
            f"{100 * row['bandwidth_share']:.0f} %" if "bandwidth_share" in row else "",
            f"{row['taps'] / 1e6:.1f}" if "taps" in row else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _ratio(row: dict[str, Any], key: str) -> str:
    if key not in row:
        return ""
    bounds = "" if row["interval"] is None else " [{:.2f}, {:.2f}]".format(*row["interval"])
    return f"{row[key]:.2f}{bounds}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser("warp", "Time the warp of views and features.")
    command.add_turns(parser, "a pair at 256 and tokens (2, 1024, 320), 3 rounds", rounds=15)
    options = parser.parse_args(arguments)
    if options.quick:
        cases = [pair_case(256), tokens_case(32, 320, torch.float32, others=True)]
    else:
        cases = [pair_case(size) for size in (256, 512, 1024)]
        for grid in (64, 32):
            for channels in (320, 640, 1280):
                cases.append(tokens_case(grid, channels, torch.float32, others=True))
            cases.append(tokens_case(grid, 320, torch.float16, others=False))
            cases.append(tokens_case(grid, 320, torch.bfloat16, others=False))
    result = run(cases, 3 if options.quick else options.rounds)
    print(table(result))
    command.write_figures(options.out, result)


if __name__ == "__main__":
    main()
