"""Report on one cell of a feature grid: position, taps and mask."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from attnwarp.warp import in_bounds
from attnwarp.warp.correspondence import positions_in
from attnwarp.warp.masks import axis_weights
from attnwarp.warp.taps import taps_of
from attnwarp_eval.inspect.pair import LABELS, Pair, Size

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Tap:
    """A source cell read by bilinear sampling.

    Attributes:
        column, row: column and row of the cell in the source's grid.
        weight: share of the warped feature, in [0, 1].
        point: (3,) surface point seen by the source at the cell's centre; NaN if none.
    """

    column: int
    row: int
    weight: float
    point: Vector


@dataclass(frozen=True)
class CellReport:
    """Report on a cell of the target's feature grid.

    Attributes:
        size: (h, w) of the target's grid.
        depth: depth at the cell's centre, along the target's axis; NaN if taps straddle an edge.
        point: (3,) surface point in the world; NaN without a depth.
        xy: (2,) position in the source's grid, in cells.
        z: depth of the point in the source camera.
        inside: whether the position lies inside the source's image.
        share: share of the image-size mask inside the cell; accepted above one half.
        accepted: whether the cell gets features of the source.
        taps: source cells read, with their weights.
        label: label of the truth on this grid, "" without truth.
        true_xy: (2,) exact position in cells; NaN without truth.
    """

    column: int
    row: int
    size: Size
    depth: float
    point: Vector
    xy: Vector
    z: float
    inside: bool
    share: float
    accepted: bool
    taps: tuple[Tap, ...]
    label: str
    true_xy: Vector

    def lines(self) -> list[str]:
        """Text lines of the report."""
        h, w = self.size
        text = [f"cell ({self.column}, {self.row}) of {w} x {h}"]
        if self.label:
            text[0] += f": {self.label}"
        text.append(f"depth at its centre: {self.depth:.5g}")
        text.append(f"in the source: ({self.xy[0]:.3f}, {self.xy[1]:.3f}) cells, z {self.z:.5g}")
        if self.label:
            error = float(np.linalg.norm(self.xy - self.true_xy))
            text.append(f"  exact ({self.true_xy[0]:.3f}, {self.true_xy[1]:.3f})")
            text.append(f"  endpoint error {error:.3g} cells")
        text.append("inside the source" if self.inside else "OUTSIDE the source")
        text += [
            f"tap ({tap.column}, {tap.row}): weight {tap.weight:.4f}"
            for tap in self.taps
            if tap.weight > 0
        ]
        text.append(f"mask: {self.share:.3f} of the cell's pixels, above 0.5 counts")
        text.append("gets features" if self.accepted else "keeps its own")
        return text


def cell_of(pair: Pair, size: Size, column: int, row: int) -> tuple[int, int]:
    """The cell (column, row) of an (h, w) feature grid that contains a target pixel's centre."""
    (height, width), (h, w) = pair.size, size
    return (2 * column + 1) * w // (2 * width), (2 * row + 1) * h // (2 * height)


def cell_report(pair: Pair, size: Size, column: int, row: int) -> CellReport:
    """Report on one cell of the target's (h, w) feature grid.

    Raises:
        ValueError: the cell lies outside the grid.
    """
    h, w = size
    if not (0 <= column < w and 0 <= row < h):
        raise ValueError(
            f"cell: got ({column}, {row}), expected a column below {w} and a row below {h}"
        )
    warp, cell = pair.layer(size), (row, column)
    correspondence = warp.correspondence
    source, target = correspondence.source, correspondence.target
    depth = float(correspondence.target_depth[cell])
    centre = np.array([column + 0.5, row + 0.5])
    truth = pair.truth_at(size)
    return CellReport(
        column=column,
        row=row,
        size=size,
        depth=depth,
        point=target.unproject(centre, depth),
        xy=correspondence.xy[cell].numpy(),
        z=float(correspondence.z[cell]),
        inside=bool(in_bounds(correspondence)[cell]),
        share=_share(pair, size, cell),
        accepted=bool(warp.mask[cell]),
        taps=_taps(pair, size, cell, source.height, source.width),
        label="" if truth is None else LABELS[int(truth.label[cell])],
        true_xy=np.full(2, np.nan) if truth is None else truth.xy[cell],
    )


def _taps(pair: Pair, size: Size, cell: tuple[int, int], h: int, w: int) -> tuple[Tap, ...]:
    correspondence = pair.layer(size).correspondence
    taps = taps_of(positions_in(correspondence, w, h)[cell][None, None], h, w)
    source = correspondence.source
    depth = np.asarray(pair.surfaces[0].depth, dtype=np.float64)
    result = []
    for index, weight in zip(taps.index[:, 0].tolist(), taps.weight[:, 0].tolist(), strict=True):
        row, column = divmod(index, w)
        # The image's pixel that holds the centre of the source's cell.
        y, x = (
            (2 * row + 1) * depth.shape[0] // (2 * h),
            (2 * column + 1) * depth.shape[1] // (2 * w),
        )
        point = source.unproject(np.array([column + 0.5, row + 0.5]), depth[y, x])
        result.append(Tap(column, row, weight, point))
    return tuple(result)


def _share(pair: Pair, size: Size, cell: tuple[int, int]) -> float:
    mask, mode = pair.view.mask, pair.settings.mask_resize
    rows = axis_weights(size[0], mask.shape[0], mode)[cell[0]]
    columns = axis_weights(size[1], mask.shape[1], mode)[cell[1]]
    return float(rows @ mask.double() @ columns)
