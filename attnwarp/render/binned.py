"""One view's splats for the CPU backend: ordered, projected and binned."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import torch

from attnwarp.render import order
from attnwarp.render._kernels import binning, layout, ordering, projection
from attnwarp.render.dispatch import call, typed
from attnwarp.render.interface import Inputs
from attnwarp.render.threads import ranges, run_jobs, thread_count

PIECE = 4096
"""Number of splats in one job of per-splat work."""
GROUP, GROUPS = 1024, 8
"""Least number of splats projected and binned by one job, and approximate number of jobs."""
WIDEST = 4 * 32767 // layout.TILE * layout.TILE
"""Largest width in pixels: columns of squares are stored in 15 bits."""
RUNS_PER_SPLAT = 3.0
"""Initial estimate of a splat's number of runs of tiles."""
NEIGHBOURS = 4
"""Edge of a block of tiles visited together."""
FRONT = 512
"""Initial splats per tile in a deep scene: more than most pixels need to become opaque."""
ENTRIES = 4
"""Entries of tiles' lists held at once, for each pixel and splat; with their weights 12 bytes each.
"""


def as_array(tensor: torch.Tensor, dtype: type) -> np.ndarray:
    """Convert a tensor to a contiguous array."""
    return np.ascontiguousarray(tensor.detach().numpy(), dtype=dtype)


def aligned(size: int) -> np.ndarray:
    """Allocate floats on a 64-byte boundary: a vector across two cache lines costs twice."""
    raw = np.empty(size + 16, np.float32)
    skip = (-raw.ctypes.data & 63) // 4
    return raw[skip : skip + size]


def aligned_doubles(size: int) -> np.ndarray:
    """Allocate float64 numbers on a 64-byte boundary."""
    return aligned(2 * size).view(np.float64)


def join(parts: list[np.ndarray]) -> np.ndarray:
    """Concatenate several arrays."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


@functools.lru_cache(maxsize=64)
def _visiting_order(across: int, down: int) -> np.ndarray:
    """Order all tiles block by block: neighbours list the same splats, which then are still in the
    cache.
    """
    y, x = np.divmod(np.arange(across * down), across)
    return np.lexsort([x, y, x // NEIGHBOURS, y // NEIGHBOURS])


def _view(inputs: Inputs) -> layout.View:
    pose, K = as_array(inputs.pose, np.float64), as_array(inputs.K, np.float64)
    rotation = np.ascontiguousarray(pose[:3, :3])
    return layout.View(
        rotation=rotation,
        translation=rotation @ as_array(inputs.origin, np.float64) + pose[:3, 3],
        fx=float(K[0, 0]),
        skew=float(K[0, 1]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        width=inputs.width,
        height=inputs.height,
        near=float(inputs.near),
        discs=inputs.kind == "2d",
        by_center=inputs.depth == "center",
        antialiased=inputs.antialiased,
        harmonic=inputs.harmonic,
        blur=float(inputs.screen_filter),
    )


def _splats(inputs: Inputs) -> layout.Splats:
    parts = (inputs.means, inputs.quats, inputs.scales, inputs.opacities)
    # Kernels are compiled for both types, but not for all mixtures.
    dtype = np.float32 if all(part.dtype == torch.float32 for part in parts) else np.float64
    values = as_array(inputs.values.flatten(1), np.float32)
    means, quats, scales, opacities = (as_array(part, dtype) for part in parts)
    return layout.Splats(means, quats, scales, opacities, values)


class BinnedSplats:
    """Ordered, projected and binned splats of one view, passed from the forward pass to the
    backward pass.

    Splats are indexed by their position in the depth order; only potentially visible ones are
    projected.

    Attributes:
        view, splats, tiles, table: see :mod:`attnwarp.render._kernels.layout`.
        order: (M,) int32 potentially visible splats, front to back.
        background: (C,) float32.
        projected: number of projected splats of ``order``.
        lists: lists from which the tiles were composited, filled by the forward pass.
    """

    def __init__(self, inputs: Inputs) -> None:
        self.view, self.splats = _view(inputs), _splats(inputs)
        self.background = as_array(inputs.background, np.float32)
        self.channels = inputs.channels
        across, down = -(-inputs.width // layout.TILE), -(-inputs.height // layout.TILE)
        if across > WIDEST // layout.TILE:
            raise ValueError(
                f"camera: {inputs.width} pixels wide; the CPU backend draws up to {WIDEST}: render"
                " it in parts"
            )
        self.tiles = layout.Tiles(across, down, _visiting_order(across, down))
        self.tile_count = across * down
        self._set_order()
        m = len(self.order)
        singles = np.empty((m, 2 * layout.ROW_DOUBLES), np.float32)
        features = np.empty((m if self.channels > 3 else 0, self.channels), np.float32)
        self.table = layout.Table(singles.view(np.float64), singles, features)
        self.projected = 0
        nothing = np.zeros(self.tile_count, np.int64)
        self.lists = layout.Lists(nothing, nothing, np.empty(0, np.int64))
        self._run_counts = np.empty(m, np.int32)
        self._project, self._find_runs = typed(projection.project), typed(binning.find_runs)
        self._runs_per_splat = RUNS_PER_SPLAT
        self._groups: list[tuple[int, int]] = []
        self._runs: list[np.ndarray] = []
        self._changes: list[np.ndarray] = []

    def _set_order(self) -> None:
        """Sort the potentially visible splats by depth, ties by their parameters."""
        n = len(self.splats.means)
        depth = np.empty(n, np.float32)
        pieces = ranges(n, PIECE)
        listed = np.zeros((len(pieces), 1))
        run_jobs(
            ordering.depths,
            [(*piece, self.view, self.splats, depth, listed[k]) for k, piece in enumerate(pieces)],
        )
        self._listed = float(listed.sum())
        self.order, ties = ordering.radix_order(
            depth, *(np.empty(n, kind) for kind in [np.int32] * 2 + [np.uint32] * 2)
        )
        if len(ties):
            s = self.splats
            content = [s.means, s.scales, s.quats, s.opacities, s.values]
            order.break_ties(self.order, depth, content, ties)

    def front(self) -> int:
        """Choose the initial number of nearest splats: all, unless the lists would be far longer
        than needed.
        """
        length, count = self._listed / self.tile_count, len(self.order)
        return count if length < 4 * FRONT else -(-count * FRONT // int(length))

    def project(self, count: int, live: np.ndarray) -> None:
        """Project the nearest ``count`` splats, and find the tiles that they may cover.

        Newly projected splats need only be right in the tiles that are ``live``.
        """
        wanted = np.zeros((self.tiles.down + 1, self.tiles.across + 1), np.int32)
        wanted[1:, 1:] = live.reshape(self.tiles.down, self.tiles.across).cumsum(0).cumsum(1)
        before = np.concatenate([[0], np.cumsum(live)])
        more = count - self.projected
        groups = [
            (self.projected + first, self.projected + last)
            for first, last in ranges(more, max(GROUP, -(-more // GROUPS)))
        ]
        runs: list[np.ndarray] = [np.empty((0, layout.RUN_SIZE), np.int32)] * len(groups)
        changes = np.zeros((len(groups), self.tile_count + 1), np.int32)

        def work(index: int) -> None:
            runs[index] = self._project_group(*groups[index], wanted, before, changes[index])

        run_jobs(work, [(k,) for k in range(len(groups))])
        self.projected = count
        self._groups += groups
        self._runs += runs
        self._changes.append(changes)

    def _project_group(
        self,
        first: int,
        last: int,
        wanted: np.ndarray,  # (tiles down + 1, tiles across + 1)
        before: np.ndarray,  # (tiles + 1,)
        changes: np.ndarray,  # (tiles + 1,)
    ) -> np.ndarray:
        """Project a group of splats and return their runs."""
        outlines = np.empty((last - first, layout.OUTLINE_SIZE), np.float32)
        self._project(
            first,
            last,
            self.view,
            self.splats,
            self.order,
            self.channels,
            wanted,
            self.table,
            outlines,
            aligned_doubles(projection.BATCH_DOUBLES),
            aligned(projection.BATCH_SINGLES),
            np.empty(16),
        )
        pieces = binning.Pieces(
            aligned(layout.OUTLINE_SIZE * binning.PIECES),
            aligned(binning.PIECE_SPANS * binning.PIECES).view(np.int32),
            np.empty((binning.PIECES, 3), np.int64),
        )
        room = int(self._runs_per_splat * (last - first)) + 256
        while True:
            target = layout.Runs(
                np.empty((room, layout.RUN_SIZE), np.int32), self._run_counts, changes
            )
            used = self._find_runs(
                first, last, self.view, self.tiles, self.table, outlines, before, target, pieces,
            )  # fmt: skip
            if used <= room:
                return target.runs[:used]
            room = used
            # Only used to size the next allocations.
            self._runs_per_splat = 1.1 * used / (last - first)
            changes[:] = 0

    def bands(self, live: np.ndarray) -> list[np.ndarray]:
        """Split the tiles that are ``live`` into parts whose total list length is bounded by the
        picture and the splats.

        Memory stays proportional to both, independent of the splats' coverage.
        """
        if not self._changes:
            return []
        lengths = np.cumsum(
            sum(changes.sum(axis=0, dtype=np.int64) for changes in self._changes)[:-1]
        )
        upto = np.cumsum((lengths * live)[self.tiles.order])
        most = ENTRIES * (self.tile_count * layout.PIXELS + len(self.order))
        if upto[-1] <= most:
            return [live]
        band = np.empty(self.tile_count, np.int64)
        band[self.tiles.order] = np.maximum(upto - 1, 0) // most
        return [live & (band == k) for k in np.unique(band[live])]

    def bin(self, live: np.ndarray) -> layout.Lists:
        """Build lists of the projected splats in the tiles that are ``live``."""
        starts, counts = np.zeros((2, self.tile_count), np.int64)
        no_changes = np.zeros((0, self.tile_count + 1), np.int32)
        changes = join(self._changes) if self._changes else no_changes
        cursors = np.empty(changes.shape, np.int64)
        call(binning.place_cursors, changes, live, cursors, starts, counts)
        entries = np.empty(int(counts.sum()), np.int64)
        before = np.concatenate([[0], np.cumsum(live)])
        run_jobs(
            binning.scatter,
            [
                (*group, runs, self._run_counts, live, before, cursors[k], entries)
                for k, (group, runs) in enumerate(zip(self._groups, self._runs, strict=True))
            ],
        )
        return layout.Lists(starts, counts, entries)

    def pieces(self, counts: np.ndarray) -> list[tuple[int, int]]:
        """Split the tiles, in visiting order, into consecutive pieces of about equal work.

        Args:
            counts: (tiles,) length of each tile's list.
        """
        pieces = 8 * thread_count()
        cost = np.cumsum(counts[self.tiles.order] + 16)
        cuts = np.unique(np.searchsorted(cost, np.linspace(0, cost[-1], pieces + 1)[1:-1]))
        edges = [0, *(int(c) for c in cuts if 0 < c < self.tile_count), self.tile_count]
        return list(itertools.pairwise(edges))
