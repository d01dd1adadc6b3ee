"""Splats from pictures: the optimisation of 2D and 3D Gaussians on posed images; see
docs/method/fitting.md.
"""

from attnwarp.fit.exposure import read_exposures
from attnwarp.fit.loop import Fit, Record, fit
from attnwarp.fit.quality import beside_mean_color, say_unlike
from attnwarp.fit.settings import FitSettings
from attnwarp.fit.sky import say_without_surface, with_sky, without_surface
from attnwarp.fit.start import extent_of, first_splats, from_points, random_points
from attnwarp.fit.views import Views, hold_out, load_views
from attnwarp.fit.warm import compile_kernels

__all__ = [
    "Fit",
    "FitSettings",
    "Record",
    "Views",
    "beside_mean_color",
    "compile_kernels",
    "extent_of",
    "first_splats",
    "fit",
    "from_points",
    "hold_out",
    "load_views",
    "random_points",
    "read_exposures",
    "say_unlike",
    "say_without_surface",
    "with_sky",
    "without_surface",
]
