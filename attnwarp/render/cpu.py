"""The CPU backend: numba kernels over tiles of 16 x 16 pixels, float32 with a float64 set-up.

1. ``depths``, ``radix_order`` and :func:`attnwarp.render.order.break_ties`: front to back. From
   here on a splat is known by its place in this order.
2. ``project``: each splat's outline, depth and colour as seen by the camera, in float64. In deep
   scenes of the nearest ones only; the others follow if a tile is not opaque by then, and only
   those that can show in such a tile.
3. ``outline`` and ``scatter``: the splats of each tile, and of its squares of 4 x 4 pixels; exact
   outlines, no bounding circles. Lists that would be too long together are made for some of the
   tiles after the others.
4. ``forward``: composite tile by tile, square by square, until every pixel is opaque.
5. ``backward``: the same tiles back to front, a row of gradients for each splat of a tile;
   ``reduce_rows`` sums the rows of each splat, and ``project_backward`` takes them to the
   parameters and the pose.

Threads follow ``torch.set_num_threads``; the result has the same bits for any number of them.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np
import torch

from attnwarp.render import _pool, order
from attnwarp.render._kernels import backward, binning, layout, projection, rasterization
from attnwarp.render.reference import Inputs, Outputs
from attnwarp.render.threads import ranges, run_jobs, thread_count

PIECE = 4096
"""Splats in one job of what is done splat by splat."""
GROUP, GROUPS = 1024, 8
"""Splats that are set up and binned by one job: at least so many, and in about so many jobs."""
WIDEST = 4 * 32767 // layout.TILE * layout.TILE
"""Pixels: columns of squares are kept in 15 bits."""
ROWS = 3.0
"""Rows of tiles that a splat is expected to show in, to begin with."""
NEIGHBOURS = 4
"""Edge of a block of tiles that are visited together."""
FRONT = 512
"""Splats a tile to begin with in a deep scene: more than most pixels need to become opaque."""
ENTRIES = 4
"""Entries of tiles' lists held at once, for each pixel and splat; with their weights 12 bytes each.

"""
ROWS_AT_ONCE = 1 << 16
"""Rows of gradients held before they are summed: a few megabytes, which stay in the cache."""


def _array(tensor: torch.Tensor, dtype: type) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy(), dtype=dtype)


def _tensor(array: np.ndarray, shape: torch.Size, dtype: torch.dtype) -> torch.Tensor:
    """Converted by numpy: torch starts its thread pool for it, which on a busy machine takes longer
    than a picture.
    """
    wanted = np.float32 if dtype == torch.float32 else np.float64
    return torch.from_numpy(array.astype(wanted, copy=False).reshape(tuple(shape)))


def _aligned(size: int) -> np.ndarray:
    """Floats on a 64-byte boundary: a vector that straddles two cache lines costs twice."""
    raw = np.empty(size + 16, np.float32)
    skip = (-raw.ctypes.data & 63) // 4
    return raw[skip : skip + size]


def _join(parts: list[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


@functools.lru_cache(maxsize=64)
def _visit(tiles_x: int, tiles_y: int) -> np.ndarray:
    """All tiles, block by block: neighbours list the same splats, which then are still in the
    cache.
    """
    y, x = np.divmod(np.arange(tiles_x * tiles_y), tiles_x)
    return np.lexsort([x, y, x // NEIGHBOURS, y // NEIGHBOURS])


class _Scene:
    """One view's splats, ordered, projected and binned: what the forward pass leaves to the
    backward pass.

    Splats are known by their place in the order of depth; only as many of them are projected as may
    be seen.
    """

    def __init__(self, inputs: Inputs) -> None:
        parts = (inputs.means, inputs.quats, inputs.scales, inputs.opacities)
        # Kernels are compiled for both, but not for all mixtures.
        exact = np.float32 if all(part.dtype == torch.float32 for part in parts) else np.float64
        self.means, self.quats, self.scales, self.opacities = (
            _array(part, exact) for part in parts
        )
        self.values = _array(inputs.values.flatten(1), np.float32)
        self.background = _array(inputs.background, np.float32)
        self.channels = inputs.channels
        n = len(self.means)
        pose, K = _array(inputs.pose, np.float64), _array(inputs.K, np.float64)
        view = np.zeros(layout.VIEW)
        view[:9] = pose[:3, :3].reshape(-1)
        view[layout.TX : layout.TX + 3] = (
            pose[:3, :3] @ _array(inputs.origin, np.float64) + pose[:3, 3]
        )
        view[layout.FX :] = (
            K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2], inputs.width, inputs.height, inputs.near,
            inputs.kind == "2d", inputs.depth == "center", inputs.antialiased, inputs.harmonic,
        )  # fmt: skip
        self.view = view
        self.tiles_x = -(-inputs.width // layout.TILE)
        self.tiles_y = -(-inputs.height // layout.TILE)
        if self.tiles_x > WIDEST // layout.TILE:
            raise ValueError(
                f"camera: {inputs.width} pixels wide; the CPU backend draws up to {WIDEST}: render"
                " it in parts"
            )
        self.tiles = self.tiles_x * self.tiles_y
        self.visit = _visit(self.tiles_x, self.tiles_y)
        key = _pool.empty(n, np.float32)
        pieces = ranges(n, PIECE)
        listed = np.zeros((len(pieces), 1))
        run_jobs(
            projection.depths,
            [
                (*piece, view, self.means, self.quats, self.scales, self.opacities, key, listed[k])
                for k, piece in enumerate(pieces)
            ],
        )
        self.listed = float(listed.sum())
        self.order, ties = projection.radix_order(
            key, *(_pool.empty(n, kind) for kind in [np.int32] * 2 + [np.uint32] * 2)
        )
        if len(ties):
            order.break_ties(
                self.order,
                key,
                [self.means, self.scales, self.quats, self.opacities, self.values],
                ties,
            )
        m = len(self.order)
        self.thin = _pool.empty((m, 2 * layout.COLUMNS), np.float32)
        self.table = self.thin.view(np.float64)
        self.features = _pool.empty((m if self.channels > 3 else 0, self.channels), np.float32)
        self.counts = _pool.empty(m, np.int32)
        self.ready = 0
        self.rows = ROWS
        self.groups: list[tuple[int, int]] = []
        self.spans: list[np.ndarray] = []
        self.changes: list[np.ndarray] = []
        # Filled in the end, tile by tile of the lists that were used.
        self.starts = np.zeros(self.tiles, np.int64)
        self.entries = np.empty(0, np.int64)

    def front(self) -> int:
        """How many of the nearest splats to begin with: all, unless they would make lists far
        longer than needed.
        """
        length = self.listed / self.tiles
        return len(self.order) if length < 4 * FRONT else -(-len(self.order) * FRONT // int(length))

    def set_up(self, count: int, live: np.ndarray) -> None:
        """Project the nearest ``count`` splats, and find the tiles that they may show in: splats
        that were not set up before need only be right in those that are ``live``."""
        wanted = np.zeros((self.tiles_y + 1, self.tiles_x + 1), np.int32)
        wanted[1:, 1:] = live.reshape(self.tiles_y, self.tiles_x).cumsum(0).cumsum(1)
        before = np.concatenate([[0], np.cumsum(live)])
        groups = [
            (self.ready + first, self.ready + last)
            for first, last in ranges(
                count - self.ready, max(GROUP, -(-(count - self.ready) // GROUPS))
            )
        ]
        spans: list[np.ndarray] = [np.empty((0, layout.RUN), np.int32)] * len(groups)
        changes = _pool.zeros((len(groups), self.tiles + 1), np.int32)

        def work(index: int) -> None:
            begin, end = groups[index]
            shapes = _pool.empty((end - begin, 16), np.float32)
            projection.project(
                begin,
                end,
                self.order,
                self.view,
                self.means,
                self.quats,
                self.scales,
                self.opacities,
                self.values,
                self.channels,
                wanted,
                self.table,
                self.thin,
                self.features,
                shapes,
                _aligned(2 * projection.SETUP).view(np.float64),
                _aligned(projection.SETUP_NARROW),
                np.empty(16),
            )
            codes, pieces = (
                _aligned(48 * binning.NOTES).view(np.int32),
                _aligned(16 * binning.NOTES),
            )
            notes = np.empty((binning.NOTES, 3), np.int64)
            room = int(self.rows * (end - begin)) + 256
            while True:
                runs = _pool.empty((room, layout.RUN), np.int32)
                used = binning.outline(
                    begin,
                    end,
                    self.table,
                    self.thin,
                    self.view,
                    self.tiles_x,
                    self.tiles_y,
                    before,
                    shapes,
                    runs,
                    self.counts,
                    changes[index],
                    codes,
                    pieces,
                    notes,
                )
                if used <= room:
                    break
                room = used
                # Only for how much is set aside for the next ones.
                self.rows = 1.1 * used / (end - begin)
                changes[index] = 0
            spans[index] = runs[:used]

        run_jobs(work, [(k,) for k in range(len(groups))])
        self.ready = count
        self.groups += groups
        self.spans += spans
        self.changes.append(changes)

    def bands(self, live: np.ndarray) -> list[np.ndarray]:
        """The tiles that are ``live``, in parts whose lists are not longer together than the
        picture and the splats
        allow: memory stays proportional to these, whatever the splats cover."""
        if not self.changes:
            return []
        lengths = np.cumsum(
            sum(changes.sum(axis=0, dtype=np.int64) for changes in self.changes)[:-1]
        )
        upto = np.cumsum((lengths * live)[self.visit])
        most = ENTRIES * (self.tiles * layout.PIXELS + len(self.order))
        if upto[-1] <= most:
            return [live]
        band = np.empty(self.tiles, np.int64)
        band[self.visit] = np.maximum(upto - 1, 0) // most
        return [live & (band == k) for k in np.unique(band[live])]

    def bin(self, live: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lists of the splats that are set up, in the tiles that are ``live``: (tiles + 1) starts,
        and entries.
        """
        starts = np.zeros(self.tiles + 1, np.int64)
        changes = _join(self.changes) if self.changes else np.zeros((0, self.tiles + 1), np.int32)
        cursors = _pool.empty(changes.shape, np.int64)
        binning.place_cursors(changes, live, cursors, starts)
        entries = _pool.empty(int(starts[-1]), np.int64)
        before = np.concatenate([[0], np.cumsum(live)])
        run_jobs(
            binning.scatter,
            [
                (*group, spans, self.counts, live, before, cursors[k], entries)
                for k, (group, spans) in enumerate(zip(self.groups, self.spans, strict=True))
            ],
        )
        return starts, entries

    def visits(self, starts: np.ndarray) -> list[tuple[int, int]]:
        """Consecutive places in ``visit``, in pieces of about equal work."""
        pieces = 8 * thread_count()
        cost = np.cumsum(np.diff(starts)[self.visit] + 16)
        cuts = np.unique(np.searchsorted(cost, np.linspace(0, cost[-1], pieces + 1)[1:-1]))
        edges = [0, *(int(c) for c in cuts if 0 < c < self.tiles), self.tiles]
        return list(itertools.pairwise(edges))


class _Composite(torch.autograd.Function):
    """The kernels as one differentiable step: the tensors of ``Inputs`` in, those of ``Outputs``
    out.
    """

    @staticmethod
    def forward(
        ctx: Any, inputs: Inputs, counters: dict[str, int], *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        scene = _Scene(inputs)
        h, w = inputs.height, inputs.width
        near, far = inputs.ndc
        scale = (far * near / (far - near)) ** 2
        color = _pool.empty((h, w, scene.channels), np.float32)
        normal = _pool.empty((h, w, 3), np.float32)
        alpha, depth, median, l1, l2 = (_pool.empty((h, w), np.float32) for _ in range(5))
        state = _pool.empty((5, h if any(ctx.needs_input_grad) else 0, w), np.float32)
        done, tested, shaded, drawn = (np.zeros(scene.tiles, np.int64) for _ in range(4))
        full = np.zeros(scene.tiles, np.bool_)
        slots = rasterization.SLOTS + max(0, scene.channels - 3)
        live = np.ones(scene.tiles, np.bool_)
        count, worked_off, pairs, composited = scene.front(), 0, 0, 0
        lists: list[np.ndarray] = []
        weight_of = _pool.zeros(len(scene.order), np.int64)
        # In deep scenes most tiles are opaque long before the last splat; those that are not start
        # again with all.
        while True:
            scene.set_up(count, live)
            last = count == len(scene.order)
            for band in scene.bands(live):
                starts, entries = scene.bin(band)
                seen = _pool.empty(len(entries), np.float32)
                run_jobs(
                    rasterization.forward,
                    [
                        (
                            *job,
                            scene.visit,
                            scene.view,
                            scene.tiles_x,
                            band,
                            starts,
                            entries,
                            scene.table,
                            scene.thin,
                            scene.features,
                            scene.background,
                            scale,
                            color,
                            alpha,
                            depth,
                            median,
                            normal,
                            l1,
                            l2,
                            state,
                            done,
                            tested,
                            shaded,
                            drawn,
                            full,
                            seen,
                            _aligned(slots * layout.PIXELS),
                            _aligned(rasterization.WORK),
                            _aligned(2 * rasterization.BLOCK * layout.EXACT).view(np.float64),
                            *np.empty((2, rasterization.BLOCK), np.int64),
                            np.empty(rasterization.BLOCK, np.int32),
                        )
                        for job in scene.visits(starts)
                    ],
                )
                worked_off += int(done[band].sum())
                pairs += int(tested[band].sum())
                composited += int(shaded[band].sum())
                ended = band if last else band & full
                kept = _pool.empty(int(done[ended].sum()) if state.shape[1] else 0, np.int64)
                rasterization.settle(
                    ended,
                    starts,
                    done,
                    entries,
                    seen,
                    weight_of,
                    sum(map(len, lists)),
                    scene.starts,
                    kept,
                )
                lists.append(kept)
            live = live & ~full
            if last or not live.any():
                break
            count = len(scene.order)
        scene.entries = _join(lists)
        weight = _pool.zeros(len(scene.means), np.float32)
        rasterization.hand_out(scene.order, weight_of, weight)
        counters.update(
            splats=len(scene.means),
            visible=len(scene.order),
            tiles=scene.tiles,
            tile_pairs=worked_off,
            pairs=pairs,
            composited=composited,
            contributing=int(drawn.sum()),
        )
        ctx.scene, ctx.state, ctx.alpha, ctx.depth, ctx.done, ctx.scale = (
            scene,
            state,
            alpha,
            depth,
            done,
            scale,
        )
        ctx.origin = _array(inputs.origin, np.float64)
        ctx.shapes = [(t.shape, t.dtype) for t in tensors]
        # Kept so that torch notices when one of them is changed in place before the backward pass.
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        return tuple(
            torch.from_numpy(a) for a in (color, alpha, depth, median, normal, l1, l2, weight)
        )

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: torch.Tensor | None) -> tuple[Any, ...]:
        scene: _Scene = ctx.scene
        _ = ctx.saved_tensors
        h, w = ctx.alpha.shape
        n = len(scene.means)
        shapes = [(h, w, scene.channels), *[(h, w)] * 3, (h, w, 3), (h, w), (h, w), (n,)]
        g = [
            _pool.zeros(shape, np.float32) if grad is None else _array(grad, np.float32)
            for grad, shape in zip(upstream, shapes, strict=True)
        ]
        g_color, g_alpha, g_depth, g_median, g_normal, g_l1, g_l2, g_weight = g
        total = _gather_rows(
            scene,
            ctx,
            g_color,
            g_alpha,
            g_depth,
            g_median,
            g_normal,
            g_l1,
            g_l2,
            g_weight[scene.order],
        )
        parameters = (scene.means, scene.quats, scene.scales, scene.opacities, scene.values)
        gm, gq, gs, go, gv = (_pool.zeros(part.shape, part.dtype) for part in parameters)
        pieces = ranges(scene.ready, PIECE)
        g_view = np.zeros((len(pieces), 12))
        run_jobs(
            backward.project_backward,
            [
                (
                    *piece,
                    scene.order,
                    scene.view,
                    scene.means,
                    scene.quats,
                    scene.scales,
                    scene.opacities,
                    scene.values,
                    scene.channels,
                    scene.table,
                    total,
                    gm,
                    gq,
                    gs,
                    go,
                    gv,
                    g_view[k],
                )
                for k, piece in enumerate(pieces)
            ],
        )
        moved = g_view.sum(axis=0)
        g_pose = np.zeros((4, 4))
        g_pose[:3, :3] = moved[:9].reshape(3, 3) + np.outer(moved[9:], ctx.origin)
        g_pose[:3, 3] = moved[9:]
        g_background = np.zeros(scene.channels)
        if ctx.needs_input_grad[8]:
            g_background = np.einsum("hwc,hw->c", g_color, 1 - ctx.alpha, dtype=np.float64)
        grads = (gm, gq, gs, go, gv, g_pose, g_background)
        return (
            None,
            None,
            *(
                _tensor(grad, shape, dtype) if needed else None
                for grad, (shape, dtype), needed in zip(
                    grads, ctx.shapes, ctx.needs_input_grad[2:], strict=True
                )
            ),
        )


def _gather_rows(scene: _Scene, ctx: Any, *upstream: np.ndarray) -> np.ndarray:
    """(N, columns) gradients in the projected splats, summed over tiles in their order.

    One row for each splat of each tile would be more than should be held at once, so groups of
    tiles take turns.
    """
    n = scene.ready
    columns = layout.GRADIENTS + 3 + max(3, scene.channels)
    total = _pool.zeros((n, columns), np.float64)
    done, visit = ctx.done, scene.visit
    before = np.concatenate([[0], np.cumsum(done[visit])])
    room = ROWS_AT_ONCE
    buffer = np.empty((0, columns), np.float32)
    slots = backward.BACK_SLOTS + max(0, scene.channels - 3)
    first = 0
    while first < scene.tiles:
        last = max(first + 1, int(np.searchsorted(before, before[first] + room, side="right")) - 1)
        last = min(last, scene.tiles)
        count = int(before[last] - before[first])
        if len(buffer) < count:
            buffer = _pool.empty((max(count, min(room, int(before[-1]))), columns), np.float32)
        rows = buffer[:count]
        place = _pool.empty(scene.tiles, np.int64)
        place[visit] = before[:-1] - before[first]
        pieces = 8 * thread_count()
        cuts = np.searchsorted(before, np.linspace(before[first], before[last], pieces + 1)[1:-1])
        edges = sorted({first, *(int(c) for c in cuts if first < c < last), last})
        run_jobs(
            backward.backward,
            [
                (
                    begin,
                    end,
                    visit,
                    scene.view,
                    scene.tiles_x,
                    scene.starts,
                    done,
                    scene.entries,
                    scene.table,
                    scene.thin,
                    scene.features,
                    scene.background,
                    ctx.scale,
                    ctx.alpha,
                    ctx.depth,
                    ctx.state,
                    *upstream,
                    place,
                    rows,
                    _aligned(slots * layout.PIXELS),
                    _aligned(backward.BACK_WORK),
                    _aligned(2 * layout.EXACT).view(np.float64),
                )
                for begin, end in itertools.pairwise(edges)
            ],
        )
        # Each thread takes some of the splats and all of the rows: whoever adds, the order is that
        # of the tiles.
        share = -(-n // thread_count())
        run_jobs(
            backward.reduce_rows,
            [
                (
                    low,
                    high,
                    first,
                    last,
                    visit,
                    scene.starts,
                    done,
                    scene.entries,
                    place,
                    rows,
                    total,
                )
                for low, high in ranges(n, max(1, share))
            ],
        )
        first = last
    return total


def render(inputs: Inputs) -> Outputs:
    """Render on the CPU; see :func:`attnwarp.render.render`."""
    counters: dict[str, int] = {}
    tensors = _Composite.apply(
        inputs,
        counters,
        inputs.means,
        inputs.quats,
        inputs.scales,
        inputs.opacities,
        inputs.values,
        inputs.pose,
        inputs.background,
    )
    names = (
        "color",
        "alpha",
        "depth",
        "median_depth",
        "normal",
        "distortion_l1",
        "distortion_l2_ndc",
        "weight",
    )
    return Outputs(**dict(zip(names, tensors, strict=True)), counters=counters)
