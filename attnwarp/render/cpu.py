"""The CPU backend: numba kernels over tiles of 16 x 16 pixels, float32 with a float64 projection.

1. Ordering: front to back. From here on a splat is indexed by its position in this order.
2. Projection: each splat's outline, depth and colour as seen by the camera, in float64. Deep scenes
   start with the nearest splats; the others follow if a tile is not opaque by then, and only
   those that may cover such a tile.
3. Binning: the splats of each tile, and of its squares of 4 x 4 pixels; exact outlines, no bounding
   circles. Lists that would be too long together are made for some of the tiles after the others.
4. Rasterization: composite tile by tile, square by square, until every pixel is opaque.
5. Backward: the same tiles back to front, a row of gradients for each splat of a tile; each splat's
   rows are summed, and taken to the parameters and the pose.

Threads follow ``torch.set_num_threads``; the result has the same bits for any number of threads.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from attnwarp.process import keep_freed_memory
from attnwarp.render._kernels import (
    backward,
    evaluation,
    layout,
    projection_backward,
    rasterization,
)
from attnwarp.render.binned import (
    PIECE,
    BinnedSplats,
    aligned,
    aligned_doubles,
    as_array,
    join,
)
from attnwarp.render.dispatch import call, typed
from attnwarp.render.interface import OUTPUTS, PICTURES, Inputs, Outputs
from attnwarp.render.threads import ranges, run_jobs, thread_count

# Fresh pages would cost a tenth of a picture's time.
keep_freed_memory()

MAP_READERS = {
    "alpha": ("depth", "distortion_ordered", "background"),
    "depth": ("depth", "distortion_ordered"),
}
"""Outputs, and the background, whose gradients read a map held by the caller."""

GRADIENT_ROWS = 1 << 16
"""Rows of gradients held before summation: a few megabytes, which stay in the cache."""


def _as_tensor(array: np.ndarray, shape: torch.Size, dtype: torch.dtype) -> torch.Tensor:
    """Convert by numpy, since torch would start its thread pool, which on a busy machine takes
    longer than a picture.
    """
    wanted = np.float32 if dtype == torch.float32 else np.float64
    return torch.from_numpy(array.astype(wanted, copy=False).reshape(tuple(shape)))


@dataclass(frozen=True)
class _Drawn:
    """State passed from the forward pass to the backward pass."""

    binned: BinnedSplats
    pictures: layout.Pictures
    weight: np.ndarray  # (N,) float32
    counters: dict[str, int]


def _pictures(inputs: Inputs, *, with_state: bool) -> layout.Pictures:
    h, w = inputs.height, inputs.width
    color = np.empty((h, w, inputs.channels), np.float32)
    normal = np.empty((h, w, 3), np.float32)
    alpha, depth, median, ordered = (np.empty((h, w), np.float32) for _ in range(4))
    state = np.empty((len(layout.STATE), h if with_state else 0, w), np.float32)
    return layout.Pictures(color, alpha, depth, median, normal, ordered, state)


def _workspace(channels: int) -> rasterization.Workspace:
    picks, entries = np.empty((2, rasterization.BLOCK), np.int64)
    return rasterization.Workspace(
        aligned(rasterization.buffer_floats(channels)),
        aligned(rasterization.BLOCK_FLOATS),
        aligned_doubles(rasterization.BLOCK * evaluation.MOMENTS),
        picks,
        entries,
        np.empty(rasterization.BLOCK, np.int32),
    )


def _draw(inputs: Inputs, *, with_state: bool) -> _Drawn:
    """Run the forward pass; ``with_state`` keeps the state for a backward pass."""
    binned = BinnedSplats(inputs)
    tile_count = binned.tile_count
    pictures = _pictures(inputs, with_state=with_state)
    processed, tested, composited, contributing = np.zeros((4, tile_count), np.int64)
    opaque, live = np.zeros(tile_count, np.bool_), np.ones(tile_count, np.bool_)
    starts = np.zeros(tile_count, np.int64)
    totals = np.zeros(3, np.int64)
    cached: list[np.ndarray] = []
    sums = np.zeros(len(binned.order), np.int64)
    count = binned.front()
    # In deep scenes most tiles are opaque long before the last splat; the other tiles start
    # again with all splats.
    while True:
        binned.project(count, live)
        is_last = count == len(binned.order)
        for band in binned.bands(live):
            lists = binned.bin(band)
            weights = np.empty(len(lists.entries), np.float32)
            progress = layout.Progress(processed, tested, composited, contributing, opaque, weights)
            run_jobs(
                rasterization.rasterize,
                [
                    (
                        *piece,
                        binned.view,
                        binned.tiles,
                        band,
                        lists,
                        binned.table,
                        binned.background,
                        pictures,
                        progress,
                        _workspace(binned.channels),
                    )
                    for piece in binned.pieces(lists.counts)
                ],
            )
            totals += [part[band].sum() for part in (processed, tested, composited)]
            ended = band if is_last else band & opaque
            used = np.empty(int(processed[ended].sum()) if with_state else 0, np.int64)
            offset = sum(map(len, cached))
            call(rasterization.settle, ended, lists, progress, sums, offset, starts, used)
            cached.append(used)
        live = live & ~opaque
        if is_last or not live.any():
            break
        count = len(binned.order)
    binned.lists = layout.Lists(starts, processed, join(cached))
    weight = np.zeros(len(binned.splats.means), np.float32)
    call(rasterization.splat_weights, binned.order, sums, weight)
    counters = {
        "splats": len(binned.splats.means),
        "visible": len(binned.order),
        "tiles": tile_count,
        "tile_pairs": int(totals[0]),
        "pairs": int(totals[1]),
        "composited": int(totals[2]),
        "contributing": int(contributing.sum()),
    }
    return _Drawn(binned, pictures, weight, counters)


class _Composite(torch.autograd.Function):
    """All kernels as one differentiable step from the tensors of ``Inputs`` to those of
    ``Outputs``.
    """

    @staticmethod
    def forward(
        ctx: Any, inputs: Inputs, kept: list[_Drawn], *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        drawn = _draw(inputs, with_state=any(ctx.needs_input_grad))
        kept.append(drawn)
        ctx.drawn = drawn
        ctx.origin = as_array(inputs.origin, np.float64)
        ctx.shapes = [(t.shape, t.dtype) for t in tensors]
        ctx.set_materialize_grads(False)
        outputs = tuple(torch.from_numpy(array) for array in drawn.pictures[:-1])
        _, alpha, depth, *_ = outputs
        # Saved so that torch detects an in-place change before the backward pass.
        ctx.save_for_backward(*tensors)
        # Not saved, as most gradients read neither. Detached, they hold no graph, but they share
        # the caller's memory and its version counter.
        ctx.maps = {"alpha": alpha.detach(), "depth": depth.detach()}
        return *outputs, torch.from_numpy(drawn.weight)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: torch.Tensor | None) -> tuple[Any, ...]:
        _ = ctx.saved_tensors
        wanted = {name for name, grad in zip(OUTPUTS, upstream, strict=True) if grad is not None}
        if ctx.needs_input_grad[8] and "color" in wanted:
            wanted.add("background")
        drawn = _with_sound_maps(ctx.drawn, ctx.maps, wanted)
        shapes = [*(picture.shape for picture in drawn.pictures[:-1]), drawn.weight.shape]
        given = layout.Upstream(
            *(
                np.zeros(shape, np.float32) if grad is None else as_array(grad, np.float32)
                for grad, shape in zip(upstream, shapes, strict=True)
            )
        )
        binned = drawn.binned
        total = _table_gradients(drawn, given._replace(weight=given.weight[binned.order]))
        gradients = layout.Splats(*(np.zeros(part.shape, part.dtype) for part in binned.splats))
        pieces = ranges(binned.projected, PIECE)
        view = projection_backward.view_row(binned.view)
        d_view = np.zeros((len(pieces), 12))
        run_jobs(
            projection_backward.project_backward,
            [
                (
                    *piece,
                    view,
                    binned.splats,
                    binned.order,
                    binned.channels,
                    binned.table,
                    total,
                    gradients,
                    d_view[k],
                    projection_backward.workspace(),
                )
                for k, piece in enumerate(pieces)
            ],
        )
        moved = d_view.sum(axis=0)
        d_pose = np.zeros((4, 4))
        d_pose[:3, :3] = moved[:9].reshape(3, 3) + np.outer(moved[9:], ctx.origin)
        d_pose[:3, 3] = moved[9:]
        d_background = np.zeros(binned.channels)
        if ctx.needs_input_grad[8]:
            through = 1 - drawn.pictures.alpha
            d_background = np.einsum("hwc,hw->c", given.color, through, dtype=np.float64)
        grads = (*gradients, d_pose, d_background)
        return (
            None,
            None,
            *(
                _as_tensor(grad, shape, dtype) if needed else None
                for grad, (shape, dtype), needed in zip(
                    grads, ctx.shapes, ctx.needs_input_grad[2:], strict=True
                )
            ),
        )


def _with_sound_maps(drawn: _Drawn, maps: dict[str, torch.Tensor], wanted: set[str]) -> _Drawn:
    """Return the drawn picture, with ones for a changed map that no gradient reads.

    Zero times a changed value need not be zero.

    Args:
        maps: "alpha" and "depth" as held by the caller.
        wanted: names of the outputs with a gradient, and "background" if it needs one.

    Raises:
        RuntimeError: a gradient reads a map that was changed in place.
    """
    for name, tensor in maps.items():
        if tensor._version == 0:
            continue
        readers = [reader for reader in MAP_READERS[name] if reader in wanted]
        if readers:
            raise RuntimeError(
                f"{name}: this output of a render was modified by an inplace operation, and the"
                f" gradient of {', '.join(readers)} reads it; change a copy of it, {name}.clone()"
            )
        array = getattr(drawn.pictures, name)
        drawn = replace(drawn, pictures=drawn.pictures._replace(**{name: np.ones_like(array)}))
    return drawn


def _table_gradients(drawn: _Drawn, upstream: layout.Upstream) -> np.ndarray:
    """Sum gradients of the projected splats over tiles in order, (M, columns).

    One row for each splat of each tile would take too much memory, so groups of tiles are
    processed in turn.
    """
    binned = drawn.binned
    n, tile_count = binned.projected, binned.tile_count
    columns = layout.GRADIENTS + 3 + max(3, binned.channels)
    total = np.zeros((n, columns), np.float64)
    order, counts = binned.tiles.order, binned.lists.counts
    before = np.concatenate([[0], np.cumsum(counts[order])])
    buffer = np.empty((0, columns), np.float32)
    first, rasterize_backward = 0, typed(backward.rasterize_backward)
    while first < tile_count:
        end = before[first] + GRADIENT_ROWS
        last = max(first + 1, int(np.searchsorted(before, end, side="right")) - 1)
        last = min(last, tile_count)
        count = int(before[last] - before[first])
        if len(buffer) < count:
            size = max(count, min(GRADIENT_ROWS, int(before[-1])))
            buffer = np.empty((size, columns), np.float32)
        starts = np.empty(tile_count, np.int64)
        starts[order] = before[:-1] - before[first]
        rows = layout.Rows(starts, buffer[:count])
        pieces = 8 * thread_count()
        cuts = np.searchsorted(before, np.linspace(before[first], before[last], pieces + 1)[1:-1])
        edges = sorted({first, *(int(c) for c in cuts if first < c < last), last})

        def work(begin: int, end: int, rows: layout.Rows = rows) -> None:
            space = backward.Workspace(
                aligned(backward.buffer_floats(binned.channels)),
                aligned(backward.WORK_FLOATS),
                aligned_doubles(evaluation.MOMENTS),
            )
            rasterize_backward(
                begin, end, binned.view, binned.tiles, binned.lists, binned.table,
                binned.background, drawn.pictures, upstream, rows, space,
            )  # fmt: skip

        run_jobs(work, list(itertools.pairwise(edges)))
        # Threads partition splats, so each splat's rows are summed in tile order: same bits for any
        # thread count.
        run_jobs(
            backward.reduce_rows,
            [
                (low, high, first, last, binned.tiles, binned.lists, rows, total)
                for low, high in ranges(n, max(1, -(-n // thread_count())))
            ],
        )
        first = last
    return total


def render(inputs: Inputs) -> Outputs:
    """Render on the CPU; see :func:`attnwarp.render.render`."""
    kept: list[_Drawn] = []
    *pictures, weight = _Composite.apply(inputs, kept, *inputs.leaves)
    named = dict(zip(PICTURES, pictures, strict=True))
    return Outputs(**named, weight=weight, counters=kept[0].counters)
