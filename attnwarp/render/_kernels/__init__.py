"""The numba kernels of the CPU backend; :mod:`attnwarp.render.cpu` calls them, and says how they
fit together.

Every sum that crosses tiles is formed in a fixed order, or in whole numbers, so the bits never
depend on the number of threads. No kernel starts threads: they release the GIL and are handed
ranges of work.
"""
