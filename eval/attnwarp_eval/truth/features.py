"""Solid feature field, a function of the 3D point, so that every warp's result is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from attnwarp import check

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SolidField:
    """Band-limited functions of the 3D point: each channel a sum of sinusoids, zero mean, unit
    variance.

    A feature pixel's value is the field at the surface point that the exact ray through the pixel's
    CENTRE hits, at every feature size: it is a point sample, not a mean over the pixel.

    Args:
        center: (3,) middle of the scene, world coordinates; subtracted in float64.
        extent: size of the scene in world units.
        cycles: bandwidth: the highest spatial frequency, in cycles per ``extent``. At the default
            4, a scene that fills an image has wavelengths of at least 16 px on its 64 grid, where
            bilinear sampling at the worst place (half way between two taps) errs by 1 - cos(pi/16)
            = 2 % of a channel's amplitude, and 8 % on the 32 grid.
        terms: number of sinusoids per channel.
        seed: seed of the frequencies (uniform in the ball) and phases.
    """

    center: Sequence[float] | Array
    extent: float
    channels: int = 8
    cycles: float = 4.0
    terms: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        check.shape(np.asarray(self.center), (3,), "center")
        object.__setattr__(self, "center", tuple(float(c) for c in self.center))
        for name in ("extent", "channels", "cycles", "terms"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: got {getattr(self, name)}, expected a positive number")

    @cached_property
    def frequencies(self) -> Array:
        """(C, terms, 3) spatial frequencies in cycles per world unit."""
        rng = np.random.default_rng([self.seed, 0])
        direction = rng.standard_normal((self.channels, self.terms, 3))
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        radius = rng.random((self.channels, self.terms, 1)) ** (1 / 3)
        return direction * radius * (self.cycles / self.extent)

    @cached_property
    def phases(self) -> Array:
        """(C, terms) phases in cycles."""
        return np.random.default_rng([self.seed, 1]).random((self.channels, self.terms))

    def __call__(self, points: npt.ArrayLike) -> Array:
        """(..., C) float64 values at (..., 3) world points; NaN at points that are not finite."""
        p = np.asarray(points, dtype=np.float64)
        local = p - np.asarray(self.center, dtype=np.float64)
        value = np.zeros((*p.shape[:-1], self.channels))
        with np.errstate(invalid="ignore"):
            for term in range(self.terms):
                cycles = local @ self.frequencies[:, term].T + self.phases[:, term]
                value += np.sin(2 * np.pi * cycles)
        value *= np.sqrt(2 / self.terms)
        return np.where(np.isfinite(p).all(axis=-1, keepdims=True), value, np.nan)

    def on_grid(self, points: npt.ArrayLike, *, background: float = 0.0) -> Array:
        """A feature map (C, h, w) from the surface points (h, w, 3) hit by a grid's central rays.

        Args:
            background: value without a surface. Use a number for the source's map, since a network
                has features there too and bilinear taps reach across the outline; use NaN for the
                exact features of the target.
        """
        features = np.moveaxis(self(points), -1, 0)
        return np.where(np.isnan(features), background, features)
