"""All numbers that define a picture of splats, with their reasons; every backend reads them
from here.
"""

from __future__ import annotations

import math

from attnwarp.gaussians import SCREEN_FILTER

ALPHA_MIN = 1 / 255
"""Alpha below which a splat is skipped at a pixel: one step of an 8-bit image, as in every
published renderer.

This is the only footprint cut-off: without a box of some sigmas, nothing visible is truncated.
"""

ALPHA_MAX = 0.99
"""Largest opacity of one splat at one pixel (original 2DGS and 3DGS, gsplat): keeps 1 / (1 - alpha)
finite.
"""

TRANSMITTANCE_STOP = 1e-4
"""A ray ends behind the splat that brings its transmittance to or below this (the published value).

That splat is still drawn. The published kernels leave it out, which loses up to 1 % of the light
and makes two opaque splats in a row (0.01 * 0.01 = 1e-4) a matter of rounding; here the loss is
at most 1e-4.
"""

NEAR = 0.01
"""Default near plane in scene units (gsplat's; the originals use 0.2). Scale it with the scene."""

FILTER_SIGMA_2D = math.sqrt(0.5)
"""Sigma in pixels of the 2DGS screen filter: rho = min(u^2 + v^2, |x - c|^2 / sigma^2)."""

BLUR_3D = SCREEN_FILTER
"""Variance in square pixels added to a projected 3D splat (3DGS): no splat is thinner than about a
pixel. Splats fitted with another have it in :attr:`attnwarp.Gaussians.screen_filter`.
"""

JACOBIAN_MARGIN = 0.3
"""3DGS linearises the projection at x/z clamped to the image's edge plus this times half of the
field of view.

Beyond it the linearisation grows without bound. The two sides are clamped separately, so an
off-centre principal point is treated correctly.
"""

EXTENT_SIGMAS = math.sqrt(2 * math.log(255.0))
"""3.33: sigmas at which an opaque splat falls to ALPHA_MIN. Depth within a splat is bounded to this
many sigmas of its extent.
"""

EDGE_ON = 1e-6
"""Smallest |n . c| / |c| of a 2D splat's plane: closer to edge-on than this, the plane is tilted to
this angle.

The screen filter still draws such a splat; the bound keeps its numbers finite in float32.
"""

COMPENSATION_MIN = 1e-6
"""Smallest squared opacity factor det S / det (S + 0.3 I) of the antialiased 3DGS mode; keeps its
square root's slope finite for a splat seen exactly edge-on."""

GAP_MIN = 1e-6
"""Share of a depth, ten roundings of float32, below which a gap has no sign: |gap| has no slope
there.
"""

MEDIAN_TRANSMITTANCE = 0.5
"""The median depth is that of the last splat drawn while the transmittance in front of it is above
this.
"""

TILE = 16
"""Edge of a tile in pixels, as in the published renderers: 16 squares of 4 x 4 pixels, each an
AVX-512 register.
"""
