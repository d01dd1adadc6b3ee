"""Trainings of the recipes on pictures of two worlds, and how one is stopped."""

import itertools
from contextlib import contextmanager

import pytest

from training.worlds import editing_pairs


def draw_pairs(folder, split="edit-train"):
    """Draw the pictures of the first two worlds of a split; the folder."""
    for index in range(2):
        editing_pairs._make(editing_pairs._path(folder, split, index), index, split)
    return folder


@contextmanager
def stopped_at(owner, name, call):
    """Interrupt the block at a call, counted from 0, of a function that its owner has by a name."""
    original, calls = getattr(owner, name), itertools.count()

    def limited(*arguments):
        if next(calls) == call:
            raise KeyboardInterrupt
        return original(*arguments)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(owner, name, limited)
        yield
