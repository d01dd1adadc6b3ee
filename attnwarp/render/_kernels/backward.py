# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Backward pass of the rasterization: the tiles back to front, a row of gradients for each entry.

In vectors of 16 pixels, a square of 4 x 4, with the sums of a splat in registers while the squares
of its tile go by.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from attnwarp.render._kernels.compilation import bare, f32, f64, inlined, jit, prefetch, u64
from attnwarp.render._kernels.evaluation import (
    depth_from,
    evaluate,
    footprint_terms,
    lay_out,
    linear_at,
    move_to_quarter,
    peak_terms,
    prepare_moments,
)
from attnwarp.render._kernels.lanes import (
    any_true,
    broadcast,
    copy4,
    invert,
    load,
    lowest_bit,
    reciprocal,
    select,
    separate4,
    store,
    sum_each,
    sum_each8,
    sum_lanes,
)
from attnwarp.render._kernels.layout import (
    DISC,
    ELLIPSOID,
    ELLIPSOID_GRADIENT,
    GRADIENTS,
    LINEAR,
    PIXELS,
    PLACE,
    PLACE_BITS,
    QUARTER,
    QUARTER_CORNER,
    ROOT2,
    ROW,
    SIDE,
    SPLAT,
    STATE,
    TILE,
)
from attnwarp.render._kernels.rasterization import prefetch_row, quarter_offset, tile_at
from attnwarp.render.constants import ALPHA_MAX, GAP_MIN


class Slots(NamedTuple):
    """Slots of a tile's buffer, PIXELS float32 each; square by square, then row by row.

    "d_" is the gradient of the loss in a pixel's sum; "behind" marks sums over the splats
    behind the current one.
    """

    x: int = 0  # relative to the tile's middle
    y: int = 1
    transmittance: int = 2  # behind the current splat
    last_step: int = 3
    median_step: int = 4
    # Relative to the mean the first moment vanishes, and with it most terms.
    depth: int = 5
    alpha: int = 6
    d_depth: int = 7
    d_ordered: int = 8
    d_median: int = 9
    behind_alpha: int = 10
    behind_depth: int = 11
    # Begins with minus the gradient in alpha times the transmittance, which is all that alpha
    # changes with: where a pixel is opaque, a difference of sums of weights has no digits of it.
    behind_loss: int = 12
    # Each splat's part with the sign of its gap; see _blame.
    signed_alpha: int = 13
    signed_depth: int = 14
    d_normal: int = 15  # (3)
    d_color: int = 18  # (channels)


SLOT = Slots()


def buffer_floats(channels: int) -> int:
    """Count the floats of a tile's buffer."""
    return (SLOT.d_color + max(3, channels)) * PIXELS


class WorkRegions(NamedTuple):
    """Offsets of the parts of a splat's work buffer, in float32."""

    row: int = 0  # see lay_out
    sums: int = ROW  # (24) over the tile, see DiscSums and EllipsoidSums
    linear: int = ROW + 32  # at the current quarter


WORK = WorkRegions()
WORK_FLOATS = ROW + 32 + 16


class Workspace(NamedTuple):
    """Memory of one job of :func:`rasterize_backward`."""

    buffer: np.ndarray  # (buffer_floats,) float32, see Slots
    splat: np.ndarray  # (WORK_FLOATS,) float32, see WorkRegions
    moments: np.ndarray  # (MOMENTS,) float64; see lay_out


class DiscSums(NamedTuple):
    """Sums of a 2D splat over its tile, from WORK.sums on; "d_": gradients, up to their sign."""

    features: int = 0  # (6) normal, values
    exponent: int = 6  # in rho / 2
    d_u: int = 7  # (3) in U, and times the pixel's x and y
    d_v: int = 10
    d_w: int = 13
    d_center: int = 16  # (2) through the screen filter
    d_depth: int = 18
    d_low: int = 19
    d_high: int = 20


class EllipsoidSums(NamedTuple):
    """Sums of a 3D splat over its tile, from WORK.sums on; "d_": gradients, up to their sign."""

    features: int = 0  # (6) normal, values
    exponent: int = 6  # in rho / 2
    uv: int = 7  # (2) in rho / 2, times u and v
    shape: int = 9  # (3) times u^2, u v, v^2
    d_low: int = 12
    d_high: int = 13
    peak: int = 14  # (8) see EllipsoidGradients


DISC_SUM, ELLIPSOID_SUM = DiscSums(), EllipsoidSums()


@inlined
def _write_disc_row(work, row, rows, dx, dy, line):
    """Write a 2D splat's row of gradients from its sums.

    Args:
        row: row of the splat in the table, as float64.
        dx, dy: middle of the tile, relative to the reference point.
    """
    b = u64(WORK.sums)
    for k in range(3):
        # Terms U, V and W one after another, in their columns as in their sums.
        term, column = b + u64(DISC_SUM.d_u + 3 * k), DISC.u_x + 2 * k
        d, d_x, d_y = f64(work[term]), f64(work[term + u64(1)]), f64(work[term + u64(2)])
        rows[line, column], rows[line, column + 1] = d_x + dx * d, d_y + dy * d
    du, dv = f64(work[b + u64(DISC_SUM.d_u)]), f64(work[b + u64(DISC_SUM.d_v)])
    dw = f64(work[b + u64(DISC_SUM.d_w)])
    rows[line, SPLAT.center_x] = (
        -(row[DISC.u_x] * du + row[DISC.v_x] * dv + row[DISC.w_x] * dw)
        - work[b + u64(DISC_SUM.d_center)]
    )
    rows[line, SPLAT.center_y] = (
        -(row[DISC.u_y] * du + row[DISC.v_y] * dv + row[DISC.w_y] * dw)
        - work[b + u64(DISC_SUM.d_center + 1)]
    )
    rows[line, SPLAT.depth] = work[b + u64(DISC_SUM.d_depth)]
    for column in (8, 9, 10, ELLIPSOID_GRADIENT.square_last):  # unused by this kind
        rows[line, column] = f32(0.0)
    rows[line, SPLAT.depth_low] = work[b + u64(DISC_SUM.d_low)]
    rows[line, SPLAT.depth_high] = work[b + u64(DISC_SUM.d_high)]


@inlined
def _write_ellipsoid_row(work, row, rows, line):
    """Write a 3D splat's row of gradients from its sums; ``row`` is its float64 table row."""
    b = u64(WORK.sums)
    u, v = f64(work[b + u64(ELLIPSOID_SUM.uv)]), f64(work[b + u64(ELLIPSOID_SUM.uv + 1)])
    rows[line, SPLAT.center_x] = row[ELLIPSOID.factor_xx] * u
    rows[line, SPLAT.center_y] = row[ELLIPSOID.factor_xy] * u + row[ELLIPSOID.factor_yy] * v
    for c in range(3):
        rows[line, ELLIPSOID_GRADIENT.shape + c] = work[b + u64(ELLIPSOID_SUM.shape + c)]
    for c in range(7):
        rows[line, ELLIPSOID_GRADIENT.linear + c] = work[b + u64(ELLIPSOID_SUM.peak + c)]
    rows[line, ELLIPSOID_GRADIENT.square_last] = work[b + u64(ELLIPSOID_SUM.peak + 7)]
    rows[line, SPLAT.depth_low] = work[b + u64(ELLIPSOID_SUM.d_low)]
    rows[line, SPLAT.depth_high] = work[b + u64(ELLIPSOID_SUM.d_high)]


@inlined
def _select_drawn(buffer, p, background):
    """Prepare the outputs and gradients of 16 pixels for their splats.

    Values are selected, not multiplied: depth is NaN and gradients are arbitrary if nothing is
        drawn.
    """
    zero = f32(0.0)
    drawn = load(buffer, SLOT.last_step * PIXELS + p) > zero
    A = select(drawn, load(buffer, SLOT.alpha * PIXELS + p), f32(1.0))
    d_alpha = load(buffer, SLOT.behind_loss * PIXELS + p)
    for c in range(3):
        slot = (SLOT.d_color + c) * PIXELS + p
        d_alpha = d_alpha - load(buffer, slot) * background[c]
        store(buffer, slot, select(drawn, load(buffer, slot), zero))
        slot = (SLOT.d_normal + c) * PIXELS + p
        store(buffer, slot, select(drawn, load(buffer, slot), zero))
    d_alpha = d_alpha * load(buffer, SLOT.transmittance * PIXELS + p)
    store(buffer, SLOT.behind_loss * PIXELS + p, select(drawn, zero - d_alpha, zero))
    slot = SLOT.d_depth * PIXELS + p
    store(buffer, slot, select(drawn, load(buffer, slot) / A, zero))
    slot = SLOT.d_ordered * PIXELS + p
    store(buffer, slot, select(drawn, load(buffer, slot) * f32(2.0), zero))
    slot = SLOT.d_median * PIXELS + p
    store(buffer, slot, select(drawn, load(buffer, slot), zero))
    slot = SLOT.depth * PIXELS + p
    store(buffer, slot, select(drawn, load(buffer, slot), zero))
    store(buffer, SLOT.alpha * PIXELS + p, select(drawn, A, zero))


@inlined
def _load_whole_tile(buffer, tile, view, background, pictures, upstream):
    """Load outputs and gradients of a complete tile of three channels into its buffer."""
    width, plane = view.width, view.width * view.height
    state = pictures.state
    for k in range(PIXELS // 4):
        r, q = k // SIDE, k % SIDE
        p = (r // 4 * SIDE + q) * 16 + r % 4 * 4
        pixel = (tile.top + r) * width + tile.left + q * 4
        copy4(buffer, SLOT.transmittance * PIXELS + p, state, pixel + STATE.transmittance * plane)
        copy4(buffer, SLOT.last_step * PIXELS + p, state, pixel + STATE.last_step * plane)
        copy4(buffer, SLOT.median_step * PIXELS + p, state, pixel + STATE.median_step * plane)
        copy4(buffer, SLOT.depth * PIXELS + p, pictures.depth, pixel)
        copy4(buffer, SLOT.alpha * PIXELS + p, pictures.alpha, pixel)
        copy4(buffer, SLOT.behind_loss * PIXELS + p, upstream.alpha, pixel)
        copy4(buffer, SLOT.d_depth * PIXELS + p, upstream.depth, pixel)
        copy4(buffer, SLOT.d_ordered * PIXELS + p, upstream.ordered, pixel)
        copy4(buffer, SLOT.d_median * PIXELS + p, upstream.median, pixel)
        separate4(buffer, SLOT.d_normal * PIXELS + p, PIXELS, upstream.normal, 3 * pixel)
        separate4(buffer, SLOT.d_color * PIXELS + p, PIXELS, upstream.color, 3 * pixel)
    for p in range(0, PIXELS, 16):
        _select_drawn(buffer, p, background)


@inlined
def _load_tile(buffer, tile, background, pictures, upstream):
    """Load outputs and gradients of a tile of any size and channel count into its buffer."""
    state = pictures.state
    for r in range(tile.rows):
        for k in range(tile.columns):
            p = u64((r // 4 * SIDE + k // 4) * 16 + r % 4 * 4 + k % 4)
            y, x = u64(tile.top + r), u64(tile.left + k)
            A = pictures.alpha[y, x]
            if state[STATE.last_step, y, x] == 0:
                continue
            buffer[u64(SLOT.transmittance * PIXELS) + p] = state[STATE.transmittance, y, x]
            buffer[u64(SLOT.last_step * PIXELS) + p] = state[STATE.last_step, y, x]
            buffer[u64(SLOT.median_step * PIXELS) + p] = state[STATE.median_step, y, x]
            buffer[u64(SLOT.depth * PIXELS) + p] = pictures.depth[y, x]
            d_depth = upstream.depth[y, x] / A
            d_alpha = upstream.alpha[y, x]
            for c in range(background.shape[0]):
                d_alpha -= upstream.color[y, x, u64(c)] * background[c]
                buffer[u64((SLOT.d_color + c) * PIXELS) + p] = upstream.color[y, x, u64(c)]
            for c in range(3):
                buffer[u64((SLOT.d_normal + c) * PIXELS) + p] = upstream.normal[y, x, u64(c)]
            buffer[u64(SLOT.behind_loss * PIXELS) + p] = -d_alpha * state[STATE.transmittance, y, x]
            buffer[u64(SLOT.d_depth * PIXELS) + p] = d_depth
            buffer[u64(SLOT.d_ordered * PIXELS) + p] = f32(2.0) * upstream.ordered[y, x]
            buffer[u64(SLOT.d_median * PIXELS) + p] = upstream.median[y, x]
            buffer[u64(SLOT.alpha * PIXELS) + p] = A


@inlined
def _blame(space, s, row, hit, alpha, z, step, d_weight, k, channels, features, out):
    """Compute gradients of a splat's 16 pixels in its alpha and z; update the sums behind it.

    Returns:
        The splat's weights; alpha times the gradient in alpha; the gradient in z.
    """
    buffer, work = space.buffer, space.splat
    zero, one = f32(0.0), f32(1.0)
    alpha = select(hit, alpha, zero)
    rest = reciprocal(one - alpha)
    T = load(buffer, SLOT.transmittance * PIXELS + s) * rest
    w = alpha * T
    dz = z - load(buffer, SLOT.depth * PIXELS + s)
    d_depth = load(buffer, SLOT.d_depth * PIXELS + s)
    d_ordered = load(buffer, SLOT.d_ordered * PIXELS + s)
    behind_alpha = load(buffer, SLOT.behind_alpha * PIXELS + s)
    behind_depth = load(buffer, SLOT.behind_depth * PIXELS + s)
    behind_loss = load(buffer, SLOT.behind_loss * PIXELS + s)
    signed_alpha = load(buffer, SLOT.signed_alpha * PIXELS + s)
    signed_depth = load(buffer, SLOT.signed_depth * PIXELS + s)
    # The gradient in the weight.
    g = d_depth * dz + d_weight
    for c in range(3):
        d_normal = load(buffer, (SLOT.d_normal + c) * PIXELS + s)
        g = g + d_normal * broadcast(work, row + SPLAT.normal + c)
    for c in range(3):
        d_color = load(buffer, (SLOT.d_color + c) * PIXELS + s)
        g = g + d_color * broadcast(work, row + SPLAT.values + c)
    if channels > 3:
        for c in range(3, channels):
            d_color = load(buffer, (SLOT.d_color + c) * PIXELS + s)
            g = g + d_color * features[u64(k), u64(c)]
            out[GRADIENTS + 3 + c] += sum_lanes(w * d_color)
    # In front the weights sum up to ``front``, and the gaps from there, times the weights, to
    # ``gap``: first moments vanish about the mean.
    w_dz = w * dz
    front = load(buffer, SLOT.alpha * PIXELS + s) - w - behind_alpha
    gap = dz * front + w_dz + behind_depth
    sign = select(z * f32(GAP_MIN) < gap, one, select(gap < z * f32(-GAP_MIN), -one, zero))
    g = g + d_ordered * (sign * gap + signed_depth - dz * signed_alpha)
    in_z = w * (d_depth + d_ordered * (sign * front - signed_alpha))
    is_median = step == load(buffer, SLOT.median_step * PIXELS + s)
    in_z = in_z + select(is_median, load(buffer, SLOT.d_median * PIXELS + s), zero)
    unclamped = hit & (alpha < f32(ALPHA_MAX))
    in_alpha = select(unclamped, (T * g - behind_loss * rest) * alpha, zero)
    store(buffer, SLOT.transmittance * PIXELS + s, T)
    store(buffer, SLOT.behind_loss * PIXELS + s, behind_loss + w * g)
    store(buffer, SLOT.behind_alpha * PIXELS + s, behind_alpha + w)
    store(buffer, SLOT.behind_depth * PIXELS + s, behind_depth + w_dz)
    store(buffer, SLOT.signed_alpha * PIXELS + s, signed_alpha + sign * w)
    store(buffer, SLOT.signed_depth * PIXELS + s, signed_depth + sign * w_dz)
    return w, in_alpha, in_z


@inlined
def _add_features(buffer, s, w, sums):
    """Add the gradients in the normal and the first three values to ``sums``, six Lanes."""
    n0, n1, n2, c0, c1, c2 = sums
    return (
        n0 + w * load(buffer, SLOT.d_normal * PIXELS + s),
        n1 + w * load(buffer, (SLOT.d_normal + 1) * PIXELS + s),
        n2 + w * load(buffer, (SLOT.d_normal + 2) * PIXELS + s),
        c0 + w * load(buffer, SLOT.d_color * PIXELS + s),
        c1 + w * load(buffer, (SLOT.d_color + 1) * PIXELS + s),
        c2 + w * load(buffer, (SLOT.d_color + 2) * PIXELS + s),
    )


@inlined
def _add_disc(work, x, y, nx, ny, z, in_alpha, in_z, by_center, zero_lanes, sums):
    """Add a 2D splat's gradients at 16 pixels to ``sums``, in the order of :class:`DiscSums`.

    Args:
        x, y: pixels relative to the tile's middle.
        nx, ny: pixels relative to the quarter's middle.
        z: scaled depth from evaluate.
    """
    zero, one, two = f32(0.0), f32(1.0), f32(2.0)
    row, linear = WORK.row, WORK.linear
    exponent, u_0, u_x, u_y, v_0, v_x, v_y, w_0, w_x, w_y, d_x, d_y, depth, low, high, s15, s16 = (
        sums
    )
    # As in evaluate.
    ex = nx + broadcast(work, linear + LINEAR.x)
    ey = ny + broadcast(work, linear + LINEAR.y)
    w = linear_at(work, linear + LINEAR.w, row, DISC.w_x, nx, ny)
    u = linear_at(work, linear + LINEAR.u, row, DISC.u_x, nx, ny)
    v = linear_at(work, linear + LINEAR.v, row, DISC.v_x, nx, ny)
    sx = nx * f32(ROOT2) + broadcast(work, linear + LINEAR.screen_x)
    sy = ny * f32(ROOT2) + broadcast(work, linear + LINEAR.screen_y)
    meets = (w <= broadcast(work, row + DISC.w_most)) & (
        (u * u + v * v) * (z * z) <= sx * sx + sy * sy
    )
    # Selected, not multiplied by 0, since the other factor may be infinite.
    scale = select(meets, z, zero)
    u, v = u * scale, v * scale
    blame = in_alpha * scale
    in_u, in_v = blame * u, blame * v
    in_w = in_u * u + in_v * v
    screened = select(meets, zero, in_alpha) * two
    # Strictly: a splat that faces the camera has w_low = w_high = W, and its depth is its plane's.
    under, over = broadcast(work, row + DISC.w_high) < w, w < broadcast(work, row + DISC.w_low)
    if by_center:
        under, over = zero_lanes < one, zero_lanes < zero
    scale = select(invert(over | under), z, zero)
    along = in_z * scale
    in_w = along * broadcast(work, row + SPLAT.depth) * scale - in_w
    # Subtracted: in_alpha is the gradient in -rho / 2.
    return (
        exponent + in_alpha,
        u_0 - in_u, u_x - in_u * x, u_y - in_u * y,
        v_0 - in_v, v_x - in_v * x, v_y - in_v * y,
        w_0 - in_w, w_x - in_w * x, w_y - in_w * y,
        d_x - screened * ex, d_y - screened * ey,
        depth + along,
        low + select(under, in_z, zero),
        high + select(over, in_z, zero),
        s15, s16,
    )  # fmt: skip


@inlined
def _add_ellipsoid(work, nx, ny, in_alpha, in_z, by_center, sums):
    """Add a 3D splat's gradients at 16 pixels, (nx, ny) relative to the quarter's middle, to
    ``sums``, in the order of :class:`EllipsoidSums`."""
    zero = f32(0.0)
    row, linear = WORK.row, WORK.linear
    exponent, u_0, v_0, uu, uv, vv, low, high, l_0, p_0, q_0, lp, lq, pp, pq, qq, s16 = sums
    u, v = footprint_terms(work, row, linear, nx, ny)
    exponent = exponent + in_alpha
    in_u, in_v = in_alpha * u, in_alpha * v
    u_0, v_0 = u_0 + in_u, v_0 + in_v
    uu, uv, vv = uu + in_u * u, uv + in_u * v, vv + in_v * v
    if by_center:
        low = low + in_z
    else:
        z0 = broadcast(work, row + SPLAT.depth)
        along, p, q, inverse = peak_terms(work, row, linear, nx, ny)
        unbounded = z0 * along * inverse
        under = unbounded <= broadcast(work, row + SPLAT.depth_low)
        over = broadcast(work, row + SPLAT.depth_high) < unbounded
        low = low + select(under, in_z, zero)
        high = high + select(over, in_z, zero)
        k = select(under | over, zero, in_z) * z0 * inverse
        in_along = k * along
        l_0, p_0, q_0 = l_0 + in_along, p_0 + k * p, q_0 + k * q
        k = in_along * inverse
        kp, kq = k * p, k * q
        lp, lq = lp + kp * along, lq + kq * along
        pp, pq, qq = pp + kp * p, pq + kp * q, qq + kq * q
    return exponent, u_0, v_0, uu, uv, vv, low, high, l_0, p_0, q_0, lp, lq, pp, pq, qq, s16


@inlined
def _splat_backward(space, table, view, tile, k, step, squares, d_weight, channels, rows, line):
    """Compute the row of gradients of table row k in a tile, from the squares the splat may
    cover."""
    buffer, work, moments = space.buffer, space.splat, space.moments
    discs, by_center = view.discs, view.by_center
    zero = load(buffer, SLOT.x * PIXELS) * f32(0.0)
    middle_x, middle_y = tile.left + TILE / 2, tile.top + TILE / 2
    lay_out(work, WORK.row, moments, 0, table, k, middle_x, middle_y, discs, by_center)
    if channels > 3:
        for c in range(3, channels):
            rows[line, GRADIENTS + 3 + c] = f32(0.0)
    # Features, and the other sums in the order of DiscSums or EllipsoidSums.
    f0 = f1 = f2 = f3 = f4 = f5 = zero
    b0 = b1 = b2 = b3 = b4 = b5 = b6 = b7 = b8 = b9 = zero
    b10 = b11 = b12 = b13 = b14 = b15 = b16 = zero
    hits = 0
    quarter, dx, dy = 0, 0.0, 0.0
    # Quarter by quarter.
    while squares != 0:
        if quarter == 0:
            corner = lowest_bit(squares) & QUARTER_CORNER
            quarter = squares & (QUARTER << corner)
            dx, dy = quarter_offset(corner)
            move_to_quarter(work, WORK.linear, moments, 0, dx, dy)
        q = lowest_bit(quarter)
        quarter &= quarter - 1
        squares &= ~(1 << q)
        s = q * 16
        x, y = load(buffer, SLOT.x * PIXELS + s), load(buffer, SLOT.y * PIXELS + s)
        nx, ny = x - f32(dx), y - f32(dy)
        sx, sy = nx * f32(ROOT2), ny * f32(ROOT2)
        inside, alpha, scaled = evaluate(
            work, WORK.row, WORK.linear, nx, ny, sx, sy, discs, by_center
        )
        z = depth_from(work, WORK.row, scaled, discs, by_center, zero)
        hit = inside & (step <= load(buffer, SLOT.last_step * PIXELS + s))
        if not any_true(hit):
            continue
        hits += 1
        w, in_alpha, in_z = _blame(
            space, s, WORK.row, hit, alpha, z, step, d_weight, k, channels,
            table.features, rows[line],
        )  # fmt: skip
        f0, f1, f2, f3, f4, f5 = _add_features(buffer, s, w, (f0, f1, f2, f3, f4, f5))
        sums = (b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14, b15, b16)
        if discs:
            b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14, b15, b16 = _add_disc(
                work, x, y, nx, ny, scaled, in_alpha, in_z, by_center, zero, sums
            )
        else:
            b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14, b15, b16 = (
                _add_ellipsoid(work, nx, ny, in_alpha, in_z, by_center, sums)
            )
    if hits == 0:
        for c in range(GRADIENTS + 6):
            rows[line, c] = f32(0.0)
        return
    store(work, WORK.sums, sum_each(f0, f1, f2, f3, f4, f5, b0, b1, b2, b3, b4, b5, b6, b7, b8, b9))
    store(work, WORK.sums + 16, sum_each8(b10, b11, b12, b13, b14, b15, b16, b16))
    for c in range(6):
        rows[line, GRADIENTS + c] = work[u64(WORK.sums + c)]
    in_exponent = work[u64(WORK.sums + DISC_SUM.exponent)]
    rows[line, SPLAT.opacity] = in_exponent / work[u64(WORK.row + SPLAT.opacity)]
    if discs:
        _write_disc_row(
            work, table.doubles[k], rows, moments[u64(LINEAR.x)], moments[u64(LINEAR.y)], line
        )
    else:
        _write_ellipsoid_row(work, table.doubles[k], rows, line)


@bare
def rasterize_backward(
    first,
    last,
    view,
    tiles,
    lists,
    table,
    background,  # (C,) float32
    pictures,
    upstream,
    target,
    space,
):
    """Compute gradients of the tiles order[first:last], a row of ``target``, ``Rows``, per entry.

    Entries without squares, which are not drawn, get no row. A row holds the gradients of the first
    GRADIENTS columns of the splat's table row, or those listed in :class:`EllipsoidGradients`, then
    of its normal and values.
    Splats are visited back to front: the transmittance before each is recovered by division from
    the forward pass's state. A splat's sums stay in registers while its squares go by.
    """
    buffer, entries, channels = space.buffer, lists.entries, background.shape[0]
    for p in range(PIXELS):
        buffer[SLOT.x * PIXELS + p] = f32(p // 16 % SIDE * 4 + p % 4) - f32(TILE / 2 - 0.5)
        buffer[SLOT.y * PIXELS + p] = f32(p // (16 * SIDE) * 4 + p // 4 % 4) - f32(TILE / 2 - 0.5)
    prepare_moments(space.moments, 0)
    for visited in range(first, last):
        t = tiles.order[visited]
        begin, count = lists.starts[t], lists.counts[t]
        if count == 0:
            continue
        tile = tile_at(t, tiles, view)
        for p in range(SLOT.transmittance * PIXELS, buffer.shape[0], 16):
            store(buffer, p, f32(0.0))
        if tile.rows == TILE and tile.columns == TILE and channels == 3:
            _load_whole_tile(buffer, tile, view, background, pictures, upstream)
        else:
            _load_tile(buffer, tile, background, pictures, upstream)
        for back in range(count):
            e = begin + count - 1 - back
            entry = entries[e]
            prefetch_row(table, entries[max(e - 8, begin)] & PLACE)
            squares = entry >> PLACE_BITS
            if squares != 0:
                k, step = entry & PLACE, f32(e - begin + 1)
                line = target.starts[t] + count - 1 - back
                _splat_backward(
                    space, table, view, tile, k, step, squares, upstream.weight[k], channels,
                    target.rows, line,
                )  # fmt: skip


@jit
def reduce_rows(
    low,
    high,
    first,
    last,
    tiles,
    lists,
    source,
    total,  # (M, columns) float64
):
    """Add the rows of the tiles order[first:last] to those of the splats low..high in ``total``.

    Threads partition splats, so each splat's rows are summed in tile order: the same bits for any
    number of threads.
    """
    order, starts, counts, entries = tiles.order, lists.starts, lists.counts, lists.entries
    row_starts, rows = source.starts, source.rows
    columns = rows.shape[1]
    for visited in range(first, last):
        t = order[visited]
        for k in range(counts[t]):
            ahead = (entries[min(starts[t] + k + 8, entries.shape[0] - 1)] & PLACE) * columns
            prefetch(total, ahead)
            prefetch(total, ahead + 8)
            prefetch(total, ahead + 16)
            entry = entries[starts[t] + k]
            i = entry & PLACE
            # A splat that is not drawn has no row.
            if entry > PLACE and low <= i < high:
                row = row_starts[t] + k
                for c in range(columns):
                    total[i, c] += rows[row, c]
