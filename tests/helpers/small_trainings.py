"""Interruption of a training at a call."""

import itertools
from contextlib import contextmanager

import pytest


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
