"""The benchmark of the paper's tables: rows against products by hand, and its page with small networks."""

import pytest

from attnwarp_lab.captures.manifest import load_manifest
from benchmarks.gpu import TINY
from benchmarks.reproducing import costs, needs, table


@pytest.mark.slow
def test_rows_are_those_of_products_by_hand_and_stand_on_the_page():
    """Oracle: views x steps x guidance branches, and hooks on the networks."""
    loaded = load_manifest("paper")
    needed = {need.name: need for need in needs(loaded, views=50)}
    edits = 7
    expected = {
        "IGS2GS": (edits, 3 * 50 * 20 * 3, 7500),  # three rounds, three branches
        "attention warp, IP2P": (edits, (1 + 40 + 40) * 20 * 3, 2 * 960),  # a last stage filled up
        # Of 40 views and four references with every five; an inversion of each view, one branch.
        "GaussCtrl": (edits, (40 + 4 * 8) * 20 * 2 + 40 * 20, 1000),
        "attention warp, ControlNet random": (4 * edits, (1 + 40 + 40) * 20 * 2 + 40 * 20, 1920),
        "full": (0, (1 + 40 + 40) * 20 * 2 + 40 * 20, 1920),  # the cells of the row above
    }
    for name, (cells, rows, iterations) in expected.items():
        need = needed[name]
        assert (need.cells, need.rows, need.iterations) == (cells, rows, iterations), name
    measured = list(costs(loaded, TINY))
    assert [(cost.name, cost.rows, cost.widest) for cost in measured] == [
        ("each view alone", 2 * 3, 3),
        ("attention warp, IP2P", 2 * 3, 3),
        ("DGE", (2 + 1) * 3, 2 * 3),  # with a key view
        ("each view alone", 2 * 3, 3),
        ("each view alone", 2 * 2, 2),
        ("attention warp, ControlNet random", 2 * 2, 2),
        ("GaussCtrl", 2 + (2 + 2) * 2, 4 * 2),
        ("each view alone", 2 * 2, 2),
    ]
    assert all(cost.row > 0 and cost.coder > 0 and cost.peak > 0 for cost in measured)
    total = sum(need.cells * need.rows for need in needed.values())
    page = table(list(needed.values()), 50, measured, TINY)
    assert f"| **all** | {16 * edits} | | | | {total:,} |" in page
