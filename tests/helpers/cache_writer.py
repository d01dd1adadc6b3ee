"""A process that writes to the cache. It imports nothing else, so that it starts quickly."""

import numpy as np

from attnwarp_eval import cache


def write_again_and_again(value):
    """Write the entry "same" of kind "k" sixty times; the environment names the folder."""
    for _ in range(60):
        cache.write_arrays("k", "same", {"x": np.full(20_000, value)})
