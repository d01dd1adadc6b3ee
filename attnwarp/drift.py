"""Drift of an edit: shift, scale and turn of what it should have left in place.

Every warp along depth assumes that an edited picture lies where its original lay. Tiles of both
pictures are aligned by Lucas-Kanade with a gain and an offset of each tile, so that changes of
colour, light and blur do not count; the similarity that most tiles share is the drift. Repainted
tiles disagree and drop out. A stretched or sheared picture is told apart by an affine map of the
same tiles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt
from scipy import fft
from scipy.linalg import eigh, expm, logm
from scipy.special import stdtrit

Floats = npt.NDArray[Any]

SEARCHED = 0.24, 0.105
"""Largest searched log scale and turn in radians."""

LONGEST = 512
"""Longest side in px at which tiles are aligned; larger pictures are reduced."""

SHORTEST = 40
"""Longest side in px from which on drift is searched for; of 32 px, 16 tiles, 3 known drifts of 40
are told."""

AGREEING = 0.35
"""Least share of textured tiles, weighted by their agreement, that must share one similarity.
Unrelated pictures and neighbouring views of a capture reach 0.25 at most."""

SINGULAR = 1e10
"""Condition of the normal equations from which tiles in one row leave a stretch undetermined."""

FLOOR = np.array([0.03, 0.03, 3e-4, 3.5e-4])
"""Half widths (px at the working size, twice; log scale; radians) below which resampling and
rounding to 8 bits dominate, added in quadrature."""

NOISE_SLOPE = (1 - np.exp(-1)) / 8
"""Variance per px of the mean slope of two pictures' white noise, of that of their difference: of
white noise blurred by 1 px, neighbours two px apart correlate by exp(-1)."""

ROUNDING = 2 / 12 / 255**2 / (4 * np.pi)
"""Variance of the difference of two pictures in 8 bits, blurred by 1 px."""

OVER_NOISE, ISOTROPY = 4.0, 0.02
"""Least information on a motion that the texture must hold: in that of the slopes of the pictures'
own noise, and in that on the best known motion. Stripes in every direction reach 3 and, where their
jagged edges exceed the noise, 0.01; the drifts of ``benchmarks/drift.py`` 6 and 0.15."""

WIDENING = 2.0
"""Factor on the half widths of the sandwich estimate, which neglects that residuals correlate
beyond a cell and that tiles are selected."""


@dataclass(frozen=True)
class Drift:
    """Similarity from a picture to its edit, about the picture's middle.

    Attributes:
        right, down: shift of the middle, px of the picture.
        scale: percent; 2 means that the edit shows everything 2 % larger.
        turn: degrees, clockwise as displayed.
        half_widths: 99 % half widths of right, down, scale and turn, in their units.
        largest: displacement of the corner that moves most, px.
    """

    right: float
    down: float
    scale: float
    turn: float
    half_widths: tuple[float, float, float, float]
    largest: float

    @property
    def seen(self) -> bool:
        """True if a corner moves by 1 px and more, and a value exceeds its half width."""
        values = (self.right, self.down, self.scale, self.turn)
        beyond = (abs(v) > half for v, half in zip(values, self.half_widths, strict=True))
        return self.largest >= 1 and any(beyond)

    def __str__(self) -> str:
        values = (self.right, self.down, self.scale, self.turn)
        names = ("px right", "px down", "% larger", "degrees clockwise")
        return ", ".join(
            f"{round(value, 2) + 0.0:.2f} ± {half:.2f} {name}"
            for value, half, name in zip(values, self.half_widths, names, strict=True)
        )


@dataclass(frozen=True)
class NoDrift:
    """Absence of a similarity between a picture and its edit.

    Attributes:
        why: the reason; empty if the picture is stretched or sheared.
        stretch: percent by which the edit shows everything longer in one direction than across it,
            0 if unknown; a shear by 5 % is a stretch by 5 %.
        largest: displacement of the corner that a stretch moves most, px; -1 if unknown.
    """

    why: str
    stretch: float = 0.0
    largest: float = -1.0

    @property
    def seen(self) -> bool:
        """True if the picture is stretched or sheared."""
        return not self.why

    def __str__(self) -> str:
        return self.why or (
            f"but by no shift, scale and turn: it is stretched or sheared by {self.stretch:.1f} %,"
            f" corners by {self.largest:.1f} px"
        )


UNTEXTURED = NoDrift("too little of what it should leave alone is textured")
STRIPED = NoDrift("its texture runs in one direction, and a shift along it leaves no trace")
UNRELATED = NoDrift("what it should leave alone shares no motion with the picture")
SMALL = NoDrift(f"the picture is smaller than {SHORTEST} px")


def drift(
    before: npt.NDArray[Any], after: npt.NDArray[Any], left: npt.NDArray[np.bool_] | None = None
) -> Drift | None:
    """Measure the drift between a picture and its edit; None if :func:`drift_or_why` finds none.

    Example:
        >>> import cv2
        >>> noise = np.random.default_rng(0).random((128, 128, 3), np.float32)
        >>> before = cv2.GaussianBlur(noise, (0, 0), 2)
        >>> moved = drift(before, np.roll(before, 3, axis=1) * 0.5)
        >>> round(moved.right, 1), abs(round(moved.down, 1)), abs(round(moved.scale, 1))
        (3.0, 0.0, 0.0)
        >>> drift(before, np.zeros_like(before)) is None
        True
    """
    found = drift_or_why(before, after, left)
    return found if isinstance(found, Drift) else None


def drift_or_why(
    before: npt.NDArray[Any], after: npt.NDArray[Any], left: npt.NDArray[np.bool_] | None = None
) -> Drift | NoDrift:
    """Measure the drift between a picture and its edit, or find why there is none to tell.

    Args:
        before: (h, w, 3) the picture, uint8 or floating in [0, 1].
        after: (h, w, 3) its edit.
        left: (h, w) True where the edit should leave the picture as it is; None for everywhere.

    Returns:
        The drift; else a stretch, or the reason why neither can be told.

    Raises:
        ValueError: the pictures or the mask have other shapes.

    Example:
        >>> flat = np.full((128, 128, 3), 0.5)
        >>> drift_or_why(flat, flat).why
        'too little of what it should leave alone is textured'
        >>> drift_or_why(flat[:32, :32], flat[:32, :32]).why
        'the picture is smaller than 40 px'
    """
    size = before.shape[:2]
    mask = np.ones(size, bool) if left is None else np.asarray(left, bool)
    if before.shape != after.shape or mask.shape != size:
        raise ValueError(
            f"drift: got {before.shape}, {after.shape}, mask {mask.shape}; expected one size"
        )
    longest = max(size)
    if longest < SHORTEST:
        return SMALL
    pictures = _gray(before), _gray(after)
    sides = [side for side in (64, 128, 256) if side < longest] + [min(longest, LONGEST)]
    levels = [_Level.of(pictures[0], pictures[1], mask, side) for side in sides]
    draw = np.random.default_rng(0)
    if levels[-1].textured < 10:
        return UNTEXTURED
    coarse, fine, starts = levels[:2], levels[2:], [np.zeros(4)]

    def refined(fit: _Fit | None) -> _Fit | None:
        return _aligned(fine, fit.motion, draw) if fit is not None and fine else fit

    found = _aligned(coarse, starts[0], draw)
    if found is None or found.agreeing < 2 * AGREEING:
        starts += _search(coarse[0])
        found = _best([found, *(_aligned(coarse, start, draw) for start in starts[1:])])
    fit = refined(found)
    if fit is not None and fit.agreeing >= AGREEING:
        affine = _aligned(levels[-1:], np.r_[fit.motion, 0, 0], draw)
    else:
        fit = affine = refined(_best(_aligned(coarse, np.r_[s, 0, 0], draw) for s in starts))
        if fit is None or fit.agreeing < AGREEING:
            return UNRELATED
    if not fit.resolved:
        return STRIPED
    if affine is not None and (stretch := affine.stretch()) is not None:
        away = float(np.sinh(stretch) * np.hypot(*size) / 2)
        if away >= 0.5 or fit is affine:  # half of what the edges move by, so that 1 px is seen
            return NoDrift("", 100 * float(np.expm1(2 * stretch)), away)
    if fit is affine:
        return UNRELATED
    half = fit.half_widths()
    return UNTEXTURED if half is None else _drift(fit.motion, half, longest, size)


def _best(fits: Iterable[_Fit | None]) -> _Fit | None:
    """Return the fit on which most tiles agree; None for none."""
    return max((fit for fit in fits if fit), key=lambda fit: fit.agreeing, default=None)


@dataclass(frozen=True, eq=False)
class _Level:
    """Both pictures at one size, smoothed so that cubic resampling is exact to 0.01 px."""

    before: Floats
    after: Floats
    left: npt.NDArray[np.bool_]
    middle: Floats
    side: int

    @classmethod
    def of(cls, before: Floats, after: Floats, left: npt.NDArray[np.bool_], side: int) -> _Level:
        h, w = (max(16, round(n * side / max(before.shape))) for n in before.shape)
        one, two, mask = (
            cv2.resize(p.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
            for p in (before, after, left)
        )
        one, two = (cv2.GaussianBlur(p, (0, 0), 1.0) for p in (one, two))
        return cls(one, two, mask > 0.95, np.array([w - 1, h - 1]) / 2, side)

    @property
    def tile(self) -> int:
        """Side of a tile in px."""
        return max(8, self.side // 16)

    @property
    def textured(self) -> int:
        """Number of textured tiles of the picture."""
        return int(_tiles(self.before, self.before, self.left, self.tile)[3].sum())

    def affine(self, motion: Floats) -> Floats:
        """Return the (2, 3) map from px of the picture to px of the edit."""
        turned = _linear(motion)
        return np.c_[turned, self.middle + motion[:2] * self.side - turned @ self.middle]

    def moved_back(self, motion: Floats) -> tuple[Floats, npt.NDArray[np.bool_]]:
        """Resample the edit to the picture, and mark pixels that the edit shows."""
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        h, w = self.after.shape
        back = cv2.warpAffine(
            self.after, self.affine(motion), (w, h), flags=flags, borderMode=cv2.BORDER_REFLECT
        )
        y, x = np.mgrid[:h, :w].reshape(2, -1)
        at = self.affine(motion) @ np.stack([x, y, np.ones_like(x)])
        shown = (at >= 3).all(0) & (at <= np.array([[w - 4], [h - 4]])).all(0)
        return np.asarray(back), np.asarray(shown.reshape(h, w))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Similarity, or affine map, that most tiles share."""

    motion: Floats
    agreeing: float
    used: npt.NDArray[np.bool_]
    scores: Floats
    """(tiles, 4 or 6) weighted gradients of the fit."""
    normal: Floats
    cells: npt.NDArray[np.intp]
    information: Floats
    """(4 or 6,) information on its motions in that of the pictures' own noise, ascending."""

    @property
    def resolved(self) -> bool:
        """True if the texture shows every motion."""
        least, most = self.information[[0, -1]]
        return bool(least >= OVER_NOISE and least >= ISOTROPY * most)

    def stretch(self) -> float | None:
        """Return half the log ratio of an affine map's axes; None within its half widths."""
        half = self.half_widths()
        told = half is not None and (np.abs(self.motion[4:]) > half[4:]).any()
        return float(np.hypot(*self.motion[4:])) if told else None

    def half_widths(self) -> Floats | None:
        """Return 99 % half widths from the scatter between cells; None for too few cells.

        The cluster-robust sandwich of Liang and Zeger (1986): residuals may correlate within
        cells of a sixth of the picture.
        """
        cells = np.unique(self.cells[self.used])
        if len(cells) < len(self.motion) + 2 or self.used.sum() < 10:
            return None
        sums = np.stack([self.scores[self.used & (self.cells == cell)].sum(0) for cell in cells])
        inverse = np.linalg.inv(self.normal)
        free = len(cells) - len(self.motion)
        covariance = inverse @ (sums.T @ sums) @ inverse * len(cells) / free
        return np.asarray(WIDENING * stdtrit(free, 0.995) * np.sqrt(np.diag(covariance)))


def _drift(motion: Floats, half: Floats, longest: int, size: tuple[int, ...]) -> Drift:
    working = min(longest, LONGEST)
    wide = np.hypot(half, FLOOR / [working, working, 1, 1])
    scale = float(np.exp(motion[2]))
    units = np.array([longest, longest, 100 * scale, np.degrees(1)])
    corners = np.array([[x, y] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * size[1::-1]
    moved = corners @ (_linear(motion) - np.eye(2)).T + motion[:2] * longest
    right, down, _, turn = (float(v) for v in motion * units)
    return Drift(
        right, down, 100 * (scale - 1), turn,
        cast("tuple[float, float, float, float]", tuple(float(v) for v in wide * units)),
        float(np.linalg.norm(moved, axis=1).max()),
    )  # fmt: skip


def _linear(motion: Floats) -> Floats:
    """Return the (2, 2) matrix of shift, log scale and turn, and of a stretch along and across the
    axes and their diagonals, if given."""
    scale, turn, along, across = np.r_[motion[2:], 0, 0][:4]
    return np.asarray(
        expm(np.array([[scale + along, across - turn], [across + turn, scale - along]]))
    )


def _gray(picture: npt.NDArray[Any]) -> Floats:
    scale = 255.0 if picture.dtype == np.uint8 else 1.0
    gray = picture.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return np.asarray(gray / np.float32(scale))


def _aligned(levels: Sequence[_Level], motion: Floats, draw: np.random.Generator) -> _Fit | None:
    """Refine a motion through levels, from coarse to fine; None if too few tiles agree."""
    fit = None
    for level in levels:
        for step in range(8):
            fit = _step(level, motion, 1.0 if step > 2 else 2.0, draw)
            if fit is None:
                return None
            moved = np.abs(fit.motion - motion).max() * level.side
            motion = fit.motion
            if step > 2 and moved < 1e-3:
                break
    return fit


def _step(level: _Level, motion: Floats, radius: float, draw: np.random.Generator) -> _Fit | None:
    back, shown = level.moved_back(motion)
    shift, variance, over_noise, textured, good, at, cells = _tiles(
        level.before, back, level.left & shown, level.tile
    )
    if good.sum() < 4:
        return None
    x, y = ((at - level.middle) / level.side).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    design = np.stack(
        [np.stack([one, zero, x, -y, x, y], -1), np.stack([zero, one, y, x, -y, x], -1)], 1
    )[..., : len(motion)]
    shift, radius = shift / level.side, radius / level.side
    change = _consensus(design[good], shift[good], radius, draw)
    inverse = np.linalg.inv(variance / level.side**2 + 0.01 * radius**2 * np.eye(2))
    for _ in range(10):
        residual = shift - design @ change
        weight = np.clip(1 - (residual**2).sum(-1) / radius**2, 0, None) ** 2 * good
        if (weight > 0).sum() < 4:
            return None
        weighted = np.einsum("tki,tkl,t->til", design, inverse, weight)
        normal = np.einsum("til,tlj->ij", weighted, design)
        if np.linalg.cond(normal) > SINGULAR:
            return None
        change = np.linalg.solve(normal, np.einsum("til,tl->i", weighted, shift))
    scores = np.einsum("til,tl->ti", weighted, shift - design @ change)
    known = np.einsum("tki,tkl,tlj,t->ij", design, over_noise, design, weight)
    of_noise = np.einsum("tki,tkj,t->ij", design, design, weight)
    scale, turn, along, across = np.r_[change[2:], 0, 0][:4]
    linear = _linear(motion)
    grown = linear @ (
        np.eye(2) + np.array([[scale + along, across - turn], [across + turn, scale - along]])
    )
    log = np.real(logm(grown))
    halves = (
        np.array(
            [
                log[0, 0] + log[1, 1],
                log[1, 0] - log[0, 1],
                log[0, 0] - log[1, 1],
                log[0, 1] + log[1, 0],
            ]
        )
        / 2
    )
    total = np.r_[motion[:2] + linear @ change[:2], halves][: len(motion)]
    return _Fit(
        total, float(weight.sum() / max(textured.sum(), 1)), weight > 0, scores, normal, cells,
        eigh(known, of_noise, eigvals_only=True),
    )  # fmt: skip


def _consensus(design: Floats, shift: Floats, radius: float, draw: np.random.Generator) -> Floats:
    """Return the map of two or three tiles that most tiles share (RANSAC, truncated squares)."""
    count = design.shape[2]
    picks = draw.integers(0, len(shift), (300, count // 2))
    picks = picks[(np.diff(np.sort(picks)) > 0).all(1)]
    systems = design[picks].reshape(-1, count, count)
    solved = np.einsum("nij,nj->ni", np.linalg.pinv(systems), shift[picks].reshape(-1, count))
    residual = shift[None] - np.einsum("tki,ni->ntk", design, solved)
    loss = np.minimum((residual**2).sum(-1) / radius**2, 1).sum(1)
    return np.asarray(solved[np.argmin(loss)])


def _tiles(before: Floats, back: Floats, valid: npt.NDArray[np.bool_], tile: int) -> Any:
    """Align tiles by one Gauss-Newton step with a gain and an offset of each tile.

    The gradient is the mean of both pictures', so that noise in one does not shorten the step
    (Malis 2004, efficient second-order minimisation).

    Returns:
        (tiles, 2) shifts in px, (tiles, 2, 2) their variances, (tiles, 2, 2) their information in
        that of the pictures' own noise, (tiles,) textured, (tiles,) aligned, (tiles, 2) middles,
        (tiles,) numbers of cells.
    """
    h, w = before.shape
    rows, columns = h // tile, w // tile
    top, start = (h - rows * tile) // 2, (w - columns * tile) // 2

    def cut(picture: Floats) -> Floats:
        inner = picture[top : top + rows * tile, start : start + columns * tile]
        parts = inner.reshape(rows, tile, columns, tile).swapaxes(1, 2)
        return np.asarray(parts.reshape(rows * columns, -1), dtype=np.float64)

    share = cut(valid)
    count = share.sum(1)

    def centred(values: Floats) -> Floats:
        mean = (values * share).sum(1) / np.maximum(count, 1)
        return np.asarray((values - mean[:, None]) * share)

    one, two = centred(cut(before)), centred(cut(back))
    squares, others = (one**2).sum(1), (two**2).sum(1)
    product = (one * two).sum(1)
    gain = np.sign(product) * np.sqrt(squares / np.maximum(others, 1e-9))
    slopes = [
        centred(
            (
                cut(np.gradient(before, axis=axis))
                + gain[:, None] * cut(np.gradient(back, axis=axis))
            )
            / 2
        )
        for axis in (1, 0)
    ]
    jacobian = np.stack([*slopes, two], -1)
    error = one - gain[:, None] * two
    normal = np.einsum("tpi,tpj->tij", jacobian, jacobian) + 1e-9 * np.eye(3)
    inverse = np.linalg.inv(normal)
    step = np.einsum("tij,tpj,tp->ti", inverse, jacobian, error, optimize=True)
    rest = error - np.einsum("tpi,ti->tp", jacobian, step)
    # The blur of 1 px makes about four neighbouring residuals one.
    spread = (rest**2).sum(1) / np.maximum(count - 5, 1)
    noise = 4 * spread
    of_noise = NOISE_SLOPE * np.maximum(spread, ROUNDING) * np.maximum(count, 1)
    over_noise = np.linalg.inv(inverse[:, :2, :2]) / of_noise[:, None, None]
    textured = (count >= 0.6 * tile**2) & (squares > 2e-5 * count)
    good = textured & (others > 2e-5 * count) & (np.linalg.norm(step[:, :2], axis=1) < 6)
    good &= np.abs(product) > 0.3 * np.sqrt(squares * others)
    good &= np.linalg.det(normal[:, :2, :2]) > 1e-12
    row, column = np.divmod(np.arange(rows * columns), columns)
    at = np.stack([column, row], -1) * tile + (tile - 1) / 2 + [start, top]
    cells = (row * 6 // rows) * 6 + column * 6 // columns
    return (
        step[:, :2],
        inverse[:, :2, :2] * noise[:, None, None],
        over_noise,
        textured,
        good,
        at,
        cells,
    )


def _search(level: _Level, best: int = 4) -> list[Floats]:
    """Return the most likely motions by masked normalised correlation (Padfield 2012)."""
    before, left = _normalised(level.before, level.left), level.left.astype(np.float32)
    shape = tuple(fft.next_fast_len(2 * n) for n in before.shape)

    def transform(picture: Floats) -> Any:
        return fft.rfft2(picture, shape)

    one, squares, ones = (np.conj(transform(p)) for p in (before, before**2, left))
    found = []
    for scale in np.arange(-SEARCHED[0], SEARCHED[0] + 1e-9, 0.04):
        for turn in np.arange(-SEARCHED[1], SEARCHED[1] + 1e-9, 0.03):
            motion = np.array([0, 0, scale, turn])
            back, shown = level.moved_back(motion)
            after = _normalised(back, shown)
            other, its_squares, its_ones = (transform(p) for p in (after, after**2, shown))
            product, energy, its_energy, count = (
                fft.irfft2(p, shape)
                for p in (one * other, squares * its_ones, ones * its_squares, ones * its_ones)
            )
            near = np.abs(product) / np.sqrt(np.maximum(energy * its_energy, 1e-6))
            score = np.where(count > left.sum() / 4, near * np.sqrt(np.maximum(count, 0)), 0)
            where = np.unravel_index(np.argmax(score), score.shape)
            down, right = ((k + n // 2) % n - n // 2 for k, n in zip(where, shape, strict=True))
            motion[:2] = _linear(motion) @ [right, down] / level.side
            found.append((score[where], motion))
    kept: list[Floats] = []
    for _, motion in sorted(found, key=lambda item: -item[0]):
        apart = [np.abs(motion - other) > [0.03, 0.03, 0.06, 0.05] for other in kept]
        if all(a.any() for a in apart):
            kept.append(motion)
    return kept[:best]


def _normalised(picture: Floats, mask: npt.NDArray[np.bool_]) -> Floats:
    """Subtract the local mean and divide by the local deviation of marked pixels."""
    share = mask.astype(np.float32)

    def blur(values: Floats) -> Floats:
        return np.asarray(cv2.GaussianBlur(values.astype(np.float32), (0, 0), 4))

    count = blur(share) + 1e-6
    centred = (picture - blur(picture * share) / count) * share
    return np.asarray(centred / np.sqrt(blur(centred**2) / count + 1e-4))
