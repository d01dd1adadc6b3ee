"""Short runs of the baselines, and what counts and compares them."""

import numpy as np

from attnwarp.baselines import ByViewSettings, DGESettings, GaussCtrlSettings, IGS2GSSettings

QUICK = {
    "by_view": ByViewSettings(steps=2, iterations=3, perceptual=0.0, batch=2),
    "igs2gs": IGS2GSSettings(steps=2, iterations=5, every=3),
    "dge": DGESettings(steps=2, iterations=4, every=2, batch=2, views=2, perceptual=0.0),
    "gaussctrl": GaussCtrlSettings(steps=2, iterations=3, references=2, batch=2),
}


def rows_of(network, call):
    """Rows that go through the network, and the call's result."""
    rows = []

    def count(module, args, kwargs):
        rows.append((args[0] if args else kwargs["sample"]).shape[0])

    handle = network.register_forward_pre_hook(count, with_kwargs=True)
    try:
        return rows, call()
    finally:
        handle.remove()


def close(a, b):
    """Equal but for the last bits of float32, which may round to another of 256 levels."""
    return np.abs(a.astype(int) - b).max() <= 1
