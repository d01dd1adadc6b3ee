"""Warp kernels of the GPU backend; :mod:`attnwarp.render.gpu` launches them and describes their
order.

A kernel is compiled when it is first launched, by NVRTC for a GPU and by Clang for Warp's CPU
device, and kept in Warp's cache (``WARP_CACHE_PATH``). Plain loops, one thread a splat, an entry or
a pixel: the same code runs on both devices. Only :mod:`attnwarp.render._gpu.lanes` knows that the
threads of a GPU come 32 at a time.

Values that Warp accesses by name are module constants and class attributes here, since Warp cannot
read members of named tuples.
"""
