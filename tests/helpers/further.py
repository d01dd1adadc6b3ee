"""Cases of one fault: the first in `make test`, the others in `make test-all`."""

import pytest


def further(first, *others):
    """Values for ``pytest.mark.parametrize`` of which all but the first are marked ``door``."""
    return [first, *(pytest.param(*_several(one), marks=pytest.mark.door) for one in others)]


def _several(case):
    return case if isinstance(case, tuple) else (case,)
