"""The CPU backend: numba kernels over tiles of 8 x 8 pixels, float32 with a float64 set-up.

1. ``project``: each splat's outline, depth and colour as seen by the camera, in float64.
2. ``radix_order`` and :func:`attnwarp.render.order.break_ties`: front to back.
3. ``bin_tiles``: the splats of each tile, in that order; exact outlines, no bounding circles.
4. ``forward``: composite tile by tile until every pixel of it is opaque.

Threads follow ``torch.set_num_threads``; the result has the same bits for any number of them.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch

from attnwarp.render import _kernels as kernels
from attnwarp.render import _threads, order
from attnwarp.render.reference import Inputs, Outputs

BIN_CHUNKS = 8


def _array(tensor: torch.Tensor, dtype: type) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy(), dtype=dtype)


def _aligned(size: int) -> np.ndarray:
    """Floats on a 64-byte boundary: a vector that straddles two cache lines costs twice."""
    raw = np.empty(size + 16, np.float32)
    skip = (-raw.ctypes.data & 63) // 4
    return raw[skip : skip + size]


class _Scene:
    """One view's splats, projected, ordered and binned: what the forward pass leaves to the backward pass."""

    def __init__(self, inputs: Inputs) -> None:
        self.means, self.quats = _array(inputs.means, np.float64), _array(inputs.quats, np.float64)
        self.scales, self.opacities = _array(inputs.scales, np.float64), _array(inputs.opacities, np.float64)
        self.values = _array(inputs.values.flatten(1), np.float32)
        self.background = _array(inputs.background, np.float32)
        self.channels = inputs.channels
        n = len(self.means)
        pose, K = _array(inputs.pose, np.float64), _array(inputs.K, np.float64)
        view = np.zeros(kernels.VIEW)
        view[:9] = pose[:3, :3].reshape(-1)
        view[kernels.TX : kernels.TX + 3] = pose[:3, :3] @ _array(inputs.origin, np.float64) + pose[:3, 3]
        view[kernels.FX :] = (
            K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2], inputs.width, inputs.height, inputs.near,
            inputs.kind == "2d", inputs.depth == "center", inputs.antialiased, inputs.harmonic,
        )  # fmt: skip
        self.view = view
        self.table = np.empty((n, kernels.COLUMNS))
        self.features = np.empty((n, 3 + max(3, self.channels)), np.float32)
        key = np.empty(n, np.float32)
        self.tiles_x = -(-inputs.width // kernels.TILE)
        self.tiles_y = -(-inputs.height // kernels.TILE)
        self.tiles = self.tiles_x * self.tiles_y
        pieces = _threads.ranges(n, kernels.CHUNK)
        begins, counts = np.empty(n, np.int64), np.empty(n, np.int64)
        spans: list[np.ndarray] = [np.empty((0, 2), np.int32)] * len(pieces)

        def set_up(index: int) -> None:
            first, last = pieces[index]
            kernels.project(
                first, last, view, self.means, self.quats, self.scales, self.opacities, self.values, self.channels,
                self.table, self.features, key,
            )  # fmt: skip
            room = 4 * kernels.CHUNK
            while True:
                rows = np.empty((room, 2), np.int32)
                used = kernels.outline(
                    first, last, key, self.table, view, self.tiles_x, self.tiles_y, rows, begins, counts
                )
                if used <= room:
                    break
                room = used
            spans[index] = rows[:used]

        _threads.run(set_up, [(k,) for k in range(len(pieces))])
        self.order = kernels.radix_order(key)
        order.break_ties(self.order, key, [self.means, self.scales, self.quats, self.opacities, self.values])
        self._bin(np.concatenate([np.empty((0, 2), np.int32), *spans]), [len(rows) for rows in spans], begins, counts)

    def _bin(self, spans: np.ndarray, lengths: list[int], begins: np.ndarray, counts: np.ndarray) -> None:
        base = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
        size = max(256, -(-len(self.order) // BIN_CHUNKS))
        pieces = _threads.ranges(len(self.order), size)
        cursors = np.zeros((max(1, len(pieces)), self.tiles), np.int64)
        self.starts = np.zeros(self.tiles + 1, np.int64)
        entries = np.empty(0, np.int32)
        for fill in (False, True):
            jobs = [
                (*piece, self.order, base, begins, counts, spans, fill, cursors[k], entries)
                for k, piece in enumerate(pieces)
            ]
            _threads.run(kernels.scatter, jobs)
            if not fill:
                kernels.place_cursors(cursors, self.starts)
                entries = np.empty(self.starts[-1], np.int32)
        self.entries = entries

    def tile_ranges(self) -> list[tuple[int, int]]:
        """Consecutive tiles in pieces of about equal work."""
        pieces = 8 * _threads.count()
        cost = self.starts + 32 * np.arange(self.tiles + 1)
        cuts = np.unique(np.searchsorted(cost, np.linspace(0, cost[-1], pieces + 1)[1:-1]))
        edges = [0, *(int(c) for c in cuts if 0 < c < self.tiles), self.tiles]
        return list(itertools.pairwise(edges))


def render(inputs: Inputs) -> Outputs:
    """Render on the CPU; see :func:`attnwarp.render.render`."""
    scene = _Scene(inputs)
    h, w = inputs.height, inputs.width
    near, far = inputs.ndc
    scale = (far * near / (far - near)) ** 2
    color = np.empty((h, w, scene.channels), np.float32)
    normal = np.empty((h, w, 3), np.float32)
    alpha, depth, median, l1, l2 = (np.empty((h, w), np.float32) for _ in range(5))
    state = np.empty((6, h, w), np.float32)
    done = np.zeros(scene.tiles, np.int64)
    seen = np.empty(len(scene.entries), np.float32)
    jobs = scene.tile_ranges()
    counts = np.zeros((len(jobs), 2), np.int64)
    _threads.run(
        kernels.forward,
        [
            (*job, scene.view, scene.tiles_x, scene.starts, scene.entries, scene.table, scene.features,
             scene.background, scale, color, alpha, depth, median, normal, l1, l2, state, done, seen, counts[k],
             _aligned((kernels.SLOTS + max(0, scene.channels - 3)) * kernels.PIXELS))
            for k, job in enumerate(jobs)
        ],
    )  # fmt: skip
    weight = np.zeros(len(scene.means), np.float32)
    kernels.gather_weights(scene.starts, done, scene.entries, seen, weight)
    counters = {
        "splats": len(scene.means),
        "visible": len(scene.order),
        "tiles": scene.tiles,
        "tile_pairs": int(done.sum()),
        "pairs": int(counts[:, 0].sum()),
        "contributing": int(counts[:, 1].sum()),
    }
    names = ("color", "alpha", "depth", "median_depth", "normal", "distortion_l1", "distortion_l2_ndc", "weight")
    arrays = (color, alpha, depth, median, normal, l1, l2, weight)
    tensors = {name: torch.from_numpy(array) for name, array in zip(names, arrays, strict=True)}
    return Outputs(**tensors, counters=counters)
