# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Kernels of a pair of views: positions and all mask rules in one pass over the target's pixels.

The definitions are in :mod:`attnwarp.warp.correspondence`, ``depth``, ``rules`` and ``masks``;
names and summation order match them. Everything is float64. A matrix product in a definition
becomes a chain of fused multiply-adds here, as in the BLAS of processors that support them; every
other operation is rounded separately.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from attnwarp.render._kernels.compilation import exact, exact_inlined, exact_pasted

INVERSE, BILINEAR, NEAREST = range(3)
"""Ways to interpolate depth."""


class Lens(NamedTuple):
    """Intrinsics of one camera, in pixels, and its image size."""

    fx: float
    skew: float
    fy: float
    cx: float
    cy: float
    width: float
    height: float


class Pair(NamedTuple):
    """Pair of cameras; ``pose`` (3, 4) maps points from the target's axes to the source's."""

    source: Lens
    target: Lens
    pose: np.ndarray
    source_rotation: np.ndarray
    target_rotation: np.ndarray
    integer: bool
    in_front: bool
    snap: float
    bounds_width: float
    bounds_height: float


class Positions(NamedTuple):
    """Output buffers with the fields of a Correspondence."""

    xy: np.ndarray
    points: np.ndarray
    depth: np.ndarray


class View(NamedTuple):
    """Maps of a view; maps that no rule needs are (0, 0) or (0, 0, 0) arrays."""

    depth: np.ndarray
    alpha: np.ndarray
    image: np.ndarray
    normal: np.ndarray


class Pixel(NamedTuple):
    """Pixel of the target: its place, depth, point in the source's axes and source position.

    ``u``, ``v`` and ``taps`` give the position in pixels of the source's depth map, if it is
    ``inside`` the source image.
    """

    i: int
    j: int
    depth: float
    px: float
    py: float
    z: float
    x: float
    y: float
    defined: bool
    inside: bool
    u: float
    v: float
    taps: tuple[int, int, int, int, float, float]


class Axis(NamedTuple):
    """Resize weights of one mask axis, (new, old), zero outside of first <= k < last."""

    weights: np.ndarray
    first: np.ndarray
    last: np.ndarray


@intrinsic
def _fma(typing: Any, x: Any, y: Any, z: Any) -> Any:
    """Compute x y + z, rounded once if the processor supports it."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        double = ir.DoubleType()
        kind = ir.FunctionType(double, [double] * 3)
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.fmuladd.f64")
        return builder.call(function, args)

    return types.float64(types.float64, types.float64, types.float64), build


@exact_inlined
def _turn(matrix, row, x, y, z):
    """Compute row ``row`` of matrix @ (x, y, z)."""
    return _fma(z, matrix[row, 2], _fma(y, matrix[row, 1], x * matrix[row, 0]))


@exact_inlined
def _valid(depth):
    return depth > 0 and depth < np.inf


@exact_inlined
def _clamp(value, length):
    # Unsigned, so that numba skips the check for negative indices.
    return np.uint64(min(max(value, 0.0), length - 1.0))


@exact_inlined
def _axis(position, length, snap):
    """Compute lower tap, upper tap and the upper tap's share along one axis."""
    index = min(max(position - 0.5, -1.0), float(length))
    nearest = np.floor(index + 0.5)
    if abs(index - nearest) < snap:
        index = nearest
    floor = np.floor(index)
    low = int(floor)
    first, last = min(max(low, 0), length - 1), min(max(low + 1, 0), length - 1)
    return np.uint64(first), np.uint64(last), index - floor


@exact_inlined
def _taps(x, y, shape, snap):
    """Find columns and rows of four taps in an image of ``shape``, and shares along both axes."""
    x0, x1, fx = _axis(x, shape[1], snap)
    y0, y1, fy = _axis(y, shape[0], snap)
    return x0, x1, y0, y1, fx, fy


@exact_inlined
def _blend_depth(depth, taps, how, spread):
    """Interpolate depth between four taps, NaN if taps are undefined or spread too far."""
    x0, x1, y0, y1, fx, fy = taps
    total, largest, smallest = 0.0, -np.inf, np.inf
    for k in range(4):
        right, below = k & 1, k >> 1
        weight = (fx if right else 1 - fx) * (fy if below else 1 - fy)
        if weight > 0:
            tap = float(depth[y1 if below else y0, x1 if right else x0])
            if not _valid(tap):
                return np.nan
            total += weight / tap if how == INVERSE else weight * tap
            largest, smallest = max(largest, tap), min(smallest, tap)
    if not largest <= smallest * (1 + spread):
        return np.nan
    return 1 / total if how == INVERSE else total


@exact_inlined
def _nearest_depth(depth, x, y):
    """Read the depth of the pixel that contains the position, NaN if undefined."""
    value = float(depth[_clamp(np.floor(y), depth.shape[0]), _clamp(np.floor(x), depth.shape[1])])
    return value if _valid(value) else np.nan


@exact_inlined
def _sample(image, taps):
    """Interpolate an (h, w) image between four taps."""
    x0, x1, y0, y1, fx, fy = taps
    total = 0.0
    for k in range(4):
        right, below = k & 1, k >> 1
        weight = (fx if right else 1 - fx) * (fy if below else 1 - fy)
        if weight > 0:
            total += float(image[y1 if below else y0, x1 if right else x0]) * weight
    return total


@exact_inlined
def _step(z, neighbour):
    """Compute the depth step to a neighbour, infinite if the neighbour is undefined."""
    # An infinite neighbour gives an infinite step without an extra comparison.
    return abs(z - neighbour) if neighbour > 0 else np.inf


@exact_inlined
def _smaller(before, after):
    """Return the smaller of two steps, 0 if both are infinite."""
    smaller = min(before, after)
    return smaller if smaller < np.inf else 0.0


@exact_inlined
def _slope(depth, i, j):
    """Compute the depth slope per pixel, 0 if undefined."""
    h, w = depth.shape
    z = float(depth[i, j])
    if not _valid(z):
        return 0.0
    one = np.uint64(1)
    up = _step(z, float(depth[i - one, j])) if i > 0 else np.inf
    down = _step(z, float(depth[i + one, j])) if i + one < np.uint64(h) else np.inf
    left = _step(z, float(depth[i, j - one])) if j > 0 else np.inf
    right = _step(z, float(depth[i, j + one])) if j + one < np.uint64(w) else np.inf
    return _smaller(up, down) + _smaller(left, right)


@exact_inlined
def _scaled(position, length, other, integer):
    """Convert a position from an axis of ``length`` pixels to an axis of ``other`` pixels."""
    if integer:
        return (position - 0.5) * ((other - 1) / max(length - 1, 1.0)) + 0.5
    return position * (other / length)


@exact_inlined
def _in_image(pair, shape, x, y):
    """Convert a source position to pixels of an image of ``shape``."""
    u = _scaled(x, pair.source.width, float(shape[1]), pair.integer)
    return u, _scaled(y, pair.source.height, float(shape[0]), pair.integer)


@exact_inlined
def _inside(x, y, width, height, integer):
    if integer:
        x, y = x - 0.5, y - 0.5
        return x >= 0 and x < width and y >= 0 and y < height
    return x >= 0 and x <= width and y >= 0 and y <= height


@exact_inlined
def _locate(pair, i, j, depth, positions):
    """Fill pixel (i, j) of ``positions`` from its depth; return True if the position exists."""
    lens, other, pose = pair.target, pair.source, pair.pose
    xy, points = positions.xy, positions.points
    x, y = (j + 0.5, i + 0.5) if not pair.integer else (float(j), float(i))
    y = (y - lens.cy) / lens.fy
    x = (x - lens.cx - lens.skew * y) / lens.fx
    if not _valid(depth):
        positions.depth[i, j] = np.nan
        for k in range(3):
            points[i, j, k] = np.nan
        xy[i, j, 0] = xy[i, j, 1] = np.nan
        return False
    positions.depth[i, j] = depth
    px, py = x * depth, y * depth
    X = _turn(pose, 0, px, py, depth) + pose[0, 3]
    Y = _turn(pose, 1, px, py, depth) + pose[1, 3]
    z = _turn(pose, 2, px, py, depth) + pose[2, 3]
    points[i, j, 0], points[i, j, 1], points[i, j, 2] = X, Y, z
    # Tested before the division: a point in the camera centre's plane has no position.
    usable = z > 0 if pair.in_front else z != 0
    u = v = np.nan
    if usable and abs(z) < np.inf:
        X, Y = X / z, Y / z
        u = _fma(Y, other.skew, X * other.fx) + other.cx
        v = Y * other.fy + other.cy
        if pair.integer:
            u, v = u + 0.5, v + 0.5
    defined = abs(u) < np.inf and abs(v) < np.inf
    xy[i, j, 0], xy[i, j, 1] = (u, v) if defined else (np.nan, np.nan)
    return defined


@exact
def layer(begin, end, pair, depth, how, spread, positions):
    """Fill rows ``begin`` to ``end`` of a feature grid's positions, from image depth (H, W)."""
    h, w = positions.depth.shape
    step_y, step_x = depth.shape[0] / h, depth.shape[1] / w
    for i in range(begin, end):
        for j in range(w):
            x, y = (j + 0.5) * step_x, (i + 0.5) * step_y
            if how == NEAREST:
                z = _nearest_depth(depth, x, y)
            else:
                z = _blend_depth(depth, _taps(x, y, depth.shape, pair.snap), how, spread)
            _locate(pair, i, j, z, positions)


@exact_inlined
def _angle(ax, ay, az, bx, by, bz):
    """Compute the degrees between two vectors, as :func:`attnwarp.warp.rules.angle_between`."""
    a, b = math.sqrt(ax * ax + ay * ay + az * az), math.sqrt(bx * bx + by * by + bz * bz)
    ax, ay, az, bx, by, bz = ax / a, ay / a, az / a, bx / b, by / b, bz / b
    minus = math.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)
    plus = math.sqrt((ax + bx) ** 2 + (ay + by) ** 2 + (az + bz) ** 2)
    return 2 * math.atan2(minus, plus) * (180 / math.pi)


@exact_pasted
def _in_front(pair, target, source, at, limits):
    return at.z > 0


@exact_inlined
def _opaque(pair, target, source, at, limits):
    if target.alpha.size > 0 and not float(target.alpha[at.i, at.j]) >= limits[0]:
        return False
    shape = source.alpha.shape
    if shape[0] == 0:
        return True
    if not at.inside:
        return False
    taps = at.taps
    if shape != source.depth.shape:
        u, v = _in_image(pair, shape, at.x, at.y)
        taps = _taps(u, v, shape, pair.snap)
    return _sample(source.alpha, taps) >= limits[0]


@exact_inlined
def _depth_agrees(pair, target, source, at, limits):
    relative, slope, spread = limits
    if not at.inside:
        return False
    h, w = source.depth.shape
    d = _blend_depth(source.depth, at.taps, INVERSE, spread)
    error, tolerance = abs(at.z - d), relative * at.z
    if error <= tolerance:  # true for most points; the slope only adds tolerance
        return True
    change = _slope(source.depth, _clamp(np.floor(at.v), h), _clamp(np.floor(at.u), w))
    return error <= tolerance + slope * change


@exact_inlined
def _photometric(pair, target, source, at, limits):
    if not at.defined:
        return False
    h, w, channels = source.image.shape
    u, v = _in_image(pair, (h, w), at.x, at.y)
    taps = _taps(u, v, (h, w), pair.snap)
    total = 0.0
    for c in range(channels):
        total += abs(_sample(source.image[..., c], taps) - float(target.image[at.i, at.j, c]))
    return total / channels <= limits[0]


@exact_inlined
def _normal(pair, target, at):
    """Return the target's normal in the source's axes, its product with the point, and validity."""
    n = target.normal
    x, y, z = float(n[at.i, at.j, 0]), float(n[at.i, at.j, 1]), float(n[at.i, at.j, 2])
    length = x * x + y * y + z * z
    usable = length > 0 and length < np.inf and abs(at.z) < np.inf
    turn = pair.source_rotation
    nx, ny, nz = _turn(turn, 0, x, y, z), _turn(turn, 1, x, y, z), _turn(turn, 2, x, y, z)
    return nx, ny, nz, nx * at.px + ny * at.py + nz * at.z, usable


@exact_pasted
def _same_side(pair, at, nx, ny, nz, along):
    pose = pair.pose
    other = nx * (pose[0, 3] - at.px) + ny * (pose[1, 3] - at.py) + nz * (pose[2, 3] - at.z)
    return -along * other > 0


@exact_inlined
def _facing(pair, target, source, at, limits):
    nx, ny, nz, along, usable = _normal(pair, target, at)
    return usable and _same_side(pair, at, nx, ny, nz, along)


@exact_inlined
def _source_incidence(pair, target, source, at, limits):
    nx, ny, nz, along, usable = _normal(pair, target, at)
    if not (usable and _same_side(pair, at, nx, ny, nz, along)):
        return False
    if along > 0:
        nx, ny, nz = -nx, -ny, -nz
    return _angle(nx, ny, nz, -at.px, -at.py, -at.z) < limits[0]


@exact_inlined
def _camera_frame(pair, target, source, at, limits):
    nx, ny, nz, along, usable = _normal(pair, target, at)
    if not usable:
        return False
    n, turn = target.normal, pair.target_rotation
    x, y, z = float(n[at.i, at.j, 0]), float(n[at.i, at.j, 1]), float(n[at.i, at.j, 2])
    mx, my, mz = _turn(turn, 0, x, y, z), _turn(turn, 1, x, y, z), _turn(turn, 2, x, y, z)
    lens, d = pair.target, at.depth
    slip = 0.0 if pair.integer else 0.5
    py = (at.i + slip - lens.cy) / lens.fy
    px = (at.j + slip - lens.cx - lens.skew * py) / lens.fx
    if mx * (px * d) + my * (py * d) + mz * d > 0:
        mx, my, mz = -mx, -my, -mz
    if along > 0:
        nx, ny, nz = -nx, -ny, -nz
    return _angle(nx, ny, nz, mx, my, mz) < limits[0]


RULES = {
    "in_front": _in_front,
    "opaque": _opaque,
    "depth_agrees": _depth_agrees,
    "photometric": _photometric,
    "facing": _facing,
    "source_incidence": _source_incidence,
    "camera_frame": _camera_frame,
}
"""Rule kernels: functions of the pair, a target :class:`View`, a source :class:`View`, a
:class:`Pixel` and the rule's limits in the order of its record; None becomes infinity."""
OPAQUE = list(RULES).index("opaque")


def _then(before, k, kernel):
    """Chain rule ``k`` after ``before``, since numba cannot loop over functions."""

    @exact_pasted
    def passes_all(pair, target, source, at, rows, limits, passes):
        every = before(pair, target, source, at, rows, limits, passes)
        if rows[k] >= 0:
            good = kernel(pair, target, source, at, limits[k])
            passes[rows[k], at.i, at.j] = good
            every = every and good
        return every

    return passes_all


@exact_pasted
def _always(pair, target, source, at, rows, limits, passes):
    """Apply the rules of every view: defined and in_bounds."""
    bounds = _inside(at.x, at.y, pair.bounds_width, pair.bounds_height, pair.integer)
    passes[0, at.i, at.j] = at.defined
    passes[1, at.i, at.j] = bounds
    return at.defined and bounds


_passes_all = _always
for _k, _kernel in enumerate(RULES.values()):
    _passes_all = _then(_passes_all, _k, _kernel)


@exact
def rules_of_pair(begin, end, pair, rows, limits, target, source, positions, passes, mask):
    """Compute positions, rules and the mask of rows ``begin`` to ``end``.

    Args:
        rows: row of ``passes`` for each of :data:`RULES`, -1 for a rule that is off.
        limits: tuple of floats for each rule.
        target, source: :class:`View` of each side.
        positions: output positions at the target's size.
        passes: (R, H, W) bool, a row per rule: defined, in_bounds, then those of ``rows``.
        mask: (H, W) bool, the conjunction of all rules.
    """
    image = pair.source
    shape = source.depth.shape
    nowhere = _taps(0.5, 0.5, (1, 1), pair.snap)
    for i in range(begin, end):
        for j in range(mask.shape[1]):
            depth = float(target.depth[i, j])
            defined = _locate(pair, i, j, depth, positions)
            if not _valid(depth):  # background: every rule except opacity fails
                for row in range(len(passes)):
                    passes[row, i, j] = False
                if rows[OPAQUE] >= 0 and source.alpha.shape[0] == 0:
                    passes[rows[OPAQUE], i, j] = (
                        target.alpha.size == 0 or float(target.alpha[i, j]) >= limits[OPAQUE][0]
                    )
                mask[i, j] = False
                continue
            x, y = positions.xy[i, j, 0], positions.xy[i, j, 1]
            px, py = positions.points[i, j, 0], positions.points[i, j, 1]
            inside = _inside(x, y, image.width, image.height, pair.integer)
            u = v = 0.5
            taps = nowhere
            if inside and shape[0] > 0:
                u, v = _in_image(pair, shape, x, y)
                taps = _taps(u, v, shape, pair.snap)
            at = Pixel(
                i, j, depth, px, py, positions.points[i, j, 2], x, y, defined, inside, u, v, taps
            )
            mask[i, j] = _passes_all(pair, target, source, at, rows, limits, passes)


@exact
def taps_of(begin, end, xy, source, integer, shape, snap, index, weight):
    """Compute the four taps of each position of rows ``begin`` to ``end`` in a ``shape`` image.

    Args:
        xy: (H, W, 2) positions in pixels of the source's image.
        source: :class:`Lens` of the source.
        index: (4, H, W) int32, flat indices into the image of ``shape``.
        weight: (4, H, W) float32 or float64, 0 for an undefined position.
    """
    w = np.uint64(shape[1])
    for i in range(begin, end):
        for j in range(xy.shape[1]):
            x = _scaled(xy[i, j, 0], source.width, float(shape[1]), integer)
            y = _scaled(xy[i, j, 1], source.height, float(shape[0]), integer)
            defined = abs(x) < np.inf and abs(y) < np.inf
            if not defined:
                x = y = 0.5
            x0, x1, y0, y1, fx, fy = _taps(x, y, shape, snap)
            index[0, i, j], index[1, i, j] = y0 * w + x0, y0 * w + x1
            index[2, i, j], index[3, i, j] = y1 * w + x0, y1 * w + x1
            one = 1.0 if defined else 0.0
            weight[0, i, j], weight[1, i, j] = one * ((1 - fx) * (1 - fy)), one * (fx * (1 - fy))
            weight[2, i, j], weight[3, i, j] = one * ((1 - fx) * fy), one * (fx * fy)


@exact
def resize_mask(begin, end, mask, rows, columns, defined, result):
    """Resize rows ``begin`` to ``end`` of a mask to another grid, intersected with ``defined``.

    Args:
        mask: (H, W) bool mask.
        rows, columns: :class:`Axis` of each direction.
        defined, result: (h, w) bool.
    """
    for i in range(begin, end):
        for j in range(result.shape[1]):
            share = 0.0
            for r in range(rows.first[i], rows.last[i]):
                line = 0.0
                for c in range(columns.first[j], columns.last[j]):
                    line += columns.weights[j, c] if mask[r, c] else 0.0
                share += rows.weights[i, r] * line
            # Exactly half of a pixel must not count, even if the sum's rounding exceeds a half.
            result[i, j] = share > 0.5 + 1e-9 and defined[i, j]
