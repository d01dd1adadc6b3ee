"""Oracle: sets of pixels in plain Python."""

import math

import numpy as np

from attnwarp_eval import metrics


def sets(array):
    return {(y, x) for y, x in np.ndindex(array.shape) if array[y, x]}


def test_figures_are_those_of_sets_of_pixels():
    rng = np.random.default_rng(0)
    marked, thing, seen = (rng.uniform(size=(20, 30)) < share for share in (0.4, 0.3, 0.5))
    unseen = ~seen & (rng.uniform(size=seen.shape) < 0.7)
    got = metrics.mask_overlap(marked, thing, seen, unseen)
    for suffix, region in (("", np.ones_like(seen)), (".seen", seen), (".unseen", unseen)):
        mine, true = sets(marked & region), sets(thing & region)
        both = len(mine & true)
        assert got[f"masks.iou{suffix}"] == both / len(mine | true)
        assert got[f"masks.precision{suffix}"] == both / len(mine)
        assert got[f"masks.recall{suffix}"] == both / len(true)
        assert got[f"masks.union{suffix}"] == len(mine | true)


def test_too_little_of_the_thing_is_undefined_and_counted():
    thing = np.zeros((8, 8), dtype=bool)
    thing[:3, :5] = True
    got = metrics.mask_overlap(~thing, thing)
    assert all(math.isnan(got[f"masks.{name}"]) for name in ("iou", "precision", "recall"))
    assert got["masks.thing"] == 15
    thing[3, 0] = True
    assert metrics.mask_overlap(thing, thing)["masks.iou"] == 1
    assert metrics.mask_overlap(~thing, thing)["masks.iou"] == 0
    # A mask that marks nothing misses everything, and has no precision.
    nothing = metrics.mask_overlap(np.zeros_like(thing), thing)
    assert nothing["masks.iou"] == 0 and math.isnan(nothing["masks.precision"])
