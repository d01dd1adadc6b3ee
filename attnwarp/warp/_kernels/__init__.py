"""Numba kernels of the warp: one module for sampling, one for a pair of views.

Each module is compiled separately: numba's disk cache tracks only a function's file, so a kernel
here must not call compiled code from another module.
"""
