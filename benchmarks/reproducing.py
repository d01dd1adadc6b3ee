"""Network rows that the paper's tables need, and what a row costs at 512 px.

Rows are those that the methods themselves plan, from the manifest that ships; a cell that several
rows of a table share counts once. Their cost is measured with random weights of Stable Diffusion
1.5's sizes, which cost what trained ones do: methods of Table 1 edit two views in one step, and
hooks time the networks. The same views are edited alone before and after them. IGS2GS edits views
alone, and has the figures of these. CPU seconds are of all threads of the process.

    python -m benchmarks.reproducing --out reports/editing/published.md
"""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch

from attnwarp.editing.small import thread_count
from attnwarp.methods import METHODS, Budget, Result, preset
from attnwarp.process import core_count
from attnwarp_eval.cost import peak_memory_mb, reset_peak_memory
from attnwarp_eval.study.shared.editing_methods import with_source_words
from attnwarp_lab.captures.manifest import Loaded, Row, load_manifest
from benchmarks import command
from benchmarks.gpu import TINY, Sizes, random_editor, ring
from benchmarks.render import scene

ALONE = "each view alone"
NETWORKS = ("unet", "controlnet", "vae.encoder", "vae.decoder")

MEASURED = {
    "pix2pix": ("attention warp, IP2P", "DGE"),
    "controlnet": ("attention warp, ControlNet random", "GaussCtrl"),
}
"""Rows of the manifest that are measured by its editors; the first is also edited view by view."""

SHORT: dict[str, dict[str, Any]] = {"attention_warping": {"stages": 1}, "dge": {"plain_below": 0}}
"""Further settings of a method's single step. That of DGE is else below ``plain_below``."""


@dataclass(frozen=True)
class Need:
    """Work of a row of the tables.

    Attributes:
        name: name of the row.
        cells: edits times seeds, without those of rows before it.
        rows, edits, iterations: rows, edits and iterations of a cell.
    """

    name: str
    cells: int
    rows: int
    edits: int
    iterations: int


@dataclass(frozen=True)
class Cost:
    """Measured cost of a method's edits.

    Attributes:
        name: name of the row.
        editor: editor of the manifest.
        edits: views that were edited.
        rows: through the UNet.
        widest: rows of the largest pass.
        seconds: CPU seconds by network.
        peak: GiB of the process at most.
    """

    name: str
    editor: str
    edits: int
    rows: int
    widest: int
    seconds: dict[str, float]
    peak: float

    @property
    def row(self) -> float:
        """CPU seconds of a row, through the ControlNet too where there is one."""
        return (self.seconds["unet"] + self.seconds["controlnet"]) / self.rows

    @property
    def coder(self) -> float:
        """CPU seconds of the autoencoder for an edited view."""
        return (self.seconds["vae.encoder"] + self.seconds["vae.decoder"]) / self.edits


def settings_of(row: Row, size: int, **changes: Any) -> Any:
    """Settings of a row. It tunes without a perceptual distance, on which no edit depends."""
    settings = preset(row.method, row.preset, **row.options, size=size, perceptual=0.0, **changes)
    return type(settings).from_dict(with_source_words(settings.to_dict(), "a bear"))


def run(
    row: Row, settings: Any, editor: Any, *, views: int, splats: int, budget: Budget | None = None
) -> Result:
    """Edit views around random splats by a row's method."""
    model = scene(row.splats, splats, 0.6 / splats ** (1 / 3))
    cameras = ring(views, settings.size)
    method = METHODS[row.method]
    return method(model, cameras, None, editor, "make it red", settings, budget=budget)


def needs(loaded: Loaded, views: int) -> list[Need]:
    """Work of every row of a manifest, on captures of so many views."""
    editors = {
        name: random_editor("cpu", TINY, torch.float32, depth="," in weights.folder)
        for name, weights in loaded.manifest.editors.items()
    }
    seen: set[str] = set()
    found = []
    for name, row in loaded.manifest.variants.items():
        settings = settings_of(row, TINY.edit_pixels)
        keys = {
            repr((row.method, replace(settings, seed=seed), row.editor, row.splats))
            for seed in loaded.seeds(row)
        }
        cells = len(keys - seen) * len([*loaded.edits()])
        seen |= keys
        planned = run(
            row, settings, editors[row.editor], views=views, splats=200,
            budget=Budget(network_rows=0),
        ).rounds  # fmt: skip
        found.append(
            Need(
                name,
                cells,
                sum(part.rows for part in planned),
                sum(len(part.views) for part in planned),
                sum(part.iterations for part in planned),
            )
        )
    return found


@contextmanager
def counted(editor: Any) -> Iterator[tuple[dict[str, float], dict[str, list[int]]]]:
    """CPU seconds and rows of each call of an editor's networks, while the block runs."""
    seconds = dict.fromkeys(NETWORKS, 0.0)
    rows: dict[str, list[int]] = {name: [] for name in NETWORKS}

    def hooks(name: str) -> tuple[Callable[..., None], Callable[..., None]]:
        def before(module: Any, inputs: tuple[torch.Tensor, ...]) -> None:
            rows[name].append(len(inputs[0]))
            seconds[name] -= time.process_time()

        def after(*_: Any) -> None:
            seconds[name] += time.process_time()

        return before, after

    with ExitStack() as stack:
        for name in NETWORKS:
            if name == "controlnet" and not hasattr(editor, name):
                continue
            network = editor
            for part in name.split("."):
                network = getattr(network, part)
            before, after = hooks(name)
            stack.callback(network.register_forward_pre_hook(before).remove)
            stack.callback(network.register_forward_hook(after).remove)
        yield seconds, rows


def measure(name: str, row: Row, editor: Any, sizes: Sizes, **changes: Any) -> Cost:
    """Edit two views by a method, in one step, and tune for one iteration.

    Args:
        name: name of the cost.
        row: row of the manifest.
        editor: with networks of ``sizes``.
        sizes: sizes of the views and the networks.
        changes: further ones of the method's settings.
    """
    short = {**SHORT.get(row.method, {}), **changes}
    settings = settings_of(row, sizes.edit_pixels, steps=1, iterations=1, **short)
    # What was freed is given back first: a run that used it again would not show in the peak.
    gc.collect()
    reset_peak_memory()
    with counted(editor) as (seconds, rows):
        result = run(row, settings, editor, views=2, splats=sizes.fit_splats)
    peak = peak_memory_mb() / 1024
    return Cost(
        name, row.editor, int(result.counters["edits"]), sum(rows["unet"]), max(rows["unet"]),
        seconds, peak,
    )  # fmt: skip


def costs(loaded: Loaded, sizes: Sizes, editors: Sequence[str] = (*MEASURED,)) -> Iterator[Cost]:
    """Cost of each measured row, and of views edited alone before and after those of its editor."""
    for guide in editors:
        names = MEASURED[guide]
        editor = random_editor("cpu", sizes, torch.float32, depth=guide == "controlnet")
        torch.set_num_threads(thread_count(editor))
        rows = loaded.manifest.variants
        for name in (ALONE, *names, ALONE):
            alone = {"a0": 0.0} if name == ALONE else {}
            yield measure(name, rows[names[0] if alone else name], editor, sizes, **alone)
        del editor


def table(needed: Sequence[Need], views: int, measured: Sequence[Cost], sizes: Sizes) -> str:
    """A Markdown page of the figures."""
    lines = [
        "# What do the paper's tables cost with networks of Stable Diffusion's size?",
        "",
        "Made by `python -m benchmarks.reproducing`. Weights are random, which costs what trained"
        f" ones do. {sizes.edit_pixels} px, float32, on a CPU. Two views, one step;"
        f" {sizes.fit_splats:,} splats. IGS2GS edits views alone.",
        "",
        f"| method | editor | network rows | in a pass | CPU s a row | against {ALONE} |"
        " autoencoder, CPU s a view | peak memory, GiB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for cost in measured:
        alone = [c.row for c in measured if c.editor == cost.editor and c.name == ALONE]
        ratio = cost.row / (sum(alone) / len(alone))
        lines.append(
            f"| {cost.name} | {cost.editor} | {cost.rows} | {cost.widest} | {cost.row:.1f} |"
            f" {ratio:.2f} | {cost.coder:.0f} | {cost.peak:.1f} |"
        )
    lines += [
        "",
        f"Views edited alone come before and after the others of their editor, in one process:"
        " how far the two are apart is noise. GaussCtrl's references are two here, not four. Other"
        f" work ran on the {core_count()} cores (load average {os.getloadavg()[0]:.1f} at the end),"
        " so seconds of the clock are left out.",
        "",
        f"What `paper.yaml` needs, with {views} views a capture:",
        "",
        "| row | cells that no row above has | network rows a cell | edits a cell |"
        " iterations a cell | network rows in all |",
        "|---|---|---|---|---|---|",
    ]
    for need in needed:
        lines.append(
            f"| {need.name} | {need.cells} | {need.rows:,} | {need.edits} | {need.iterations:,} |"
            f" {need.cells * need.rows:,} |"
        )
    total = sum(need.cells * need.rows for need in needed)
    lines.append(f"| **all** | {sum(n.cells for n in needed)} | | | | {total:,} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser("reproducing", "Cost of the paper's tables at 512 px on a CPU.")
    parser.add_argument("--views", type=int, default=120, help="of a capture")
    parser.add_argument("--editors", nargs="+", choices=[*MEASURED], default=[*MEASURED])
    parser.add_argument("--tiny", action="store_true", help="networks that take seconds")
    options = parser.parse_args(arguments)
    sizes = TINY if options.tiny else Sizes()
    loaded = load_manifest("paper")
    needed, measured = needs(loaded, options.views), []
    for cost in costs(loaded, sizes, options.editors):
        print(cost, file=sys.stderr)
        measured.append(cost)
        text = table(needed, options.views, measured, sizes)
        if options.out is not None:
            command.write_text(options.out, text)
    print(text)


if __name__ == "__main__":
    main()
