"""Numba kernels of the warp: one module for sampling, one for a pair of views.

Each module is compiled on its own: numba's cache on disk looks at a function's own file, so nothing
that is compiled here may come from another one.
"""
