"""Pictures before and after an edit, one by one, as editors are assessed on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from training.worlds.editing_pairs import SIZE, THING, Worlds


@dataclass(frozen=True)
class Row:
    """Pictures that a pair is made of."""

    world: int
    view: int
    source: int
    target: int
    corner: tuple[int, int, int]
    flip: bool = False


class Pictures:
    """Pictures of worlds, one by one.

    Args:
        worlds: at :data:`training.worlds.editing_pairs.SIZE`.
        size: size of the pictures in px, 64 or 128. At 64, half of the pictures are a quarter of the full one
            about the thing, so that things come large and small.
    """

    def __init__(self, worlds: Worlds, size: int) -> None:
        self.worlds, self.size = worlds, size

    def corner(self, world: int, view: int, rng: np.random.Generator) -> tuple[int, int, int]:
        """Place that a picture is cut from: (y, x, px of the full picture to one of the cut)."""
        step = SIZE // self.size
        if step == 1 or rng.uniform() < 0.5:
            return 0, 0, step
        seen = np.argwhere(self.worlds.ids[world, view] == THING)
        y, x = seen[int(rng.integers(len(seen)))] if len(seen) else (SIZE // 2, SIZE // 2)
        low = [
            int(np.clip(v - rng.uniform(0.25, 0.75) * self.size, 0, SIZE - self.size))
            for v in (y, x)
        ]
        return low[0], low[1], 1

    def cut(self, full: npt.NDArray[Any], row: Row) -> npt.NDArray[np.float32]:
        """The part of a full picture (128, 128, ...) that a row shows, as means of blocks."""
        y, x, n = row.corner
        part = full[y : y + n * self.size, x : x + n * self.size].astype(np.float32)
        part = part.reshape(self.size, n, self.size, n, *full.shape[2:]).mean(axis=(1, 3))
        return part[:, ::-1] if row.flip else part

    def picture(self, row: Row, look: int) -> npt.NDArray[np.float32]:
        """(S, S, 3) in [-1, 1]."""
        return self.cut(self.worlds.images[row.world, row.view, look], row) / 127.5 - 1

    def shown(self, row: Row, look: int) -> npt.NDArray[np.float32]:
        """(S, S, 3) in [0, 1]."""
        return np.clip((self.picture(row, look) + 1) / 2, 0, 1)

    def thing(self, row: Row) -> npt.NDArray[np.float32]:
        """(S, S) share of each pixel that the thing covers."""
        return self.cut(self.worlds.ids[row.world, row.view] == THING, row)

    def mask(self, row: Row) -> npt.NDArray[np.bool_]:
        """(S, S) where a row's picture shows nothing else than the thing."""
        return self.thing(row) > 0.99
