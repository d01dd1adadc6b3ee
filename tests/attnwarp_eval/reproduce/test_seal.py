"""Two sealed runs side by side. Oracle: differences known in closed form."""

import json

import pytest

from attnwarp_eval.reproduce.manifest import FIGURES
from attnwarp_eval.reproduce.seal import side_by_side, write_seal
from attnwarp_eval.study.store import Store

CLIP = FIGURES["CLIP"]


def sealed(folder, figures):
    """A run's folder with a figure of each scene, of two seeds that lie 0.02 apart."""
    store = Store(folder)
    nothing = {name: {} for name in ("captures", "splats", "masks", "weights")}
    store.write_study({"inputs": nothing, "cells": []})
    cells = [
        {"kind": "edit", "methods": ["DGE"], "scene": scene, "edit": "red", "seed": seed,
         "figures": {CLIP: value and value + sign * 0.01}, "authors": {}}
        for scene, value in figures.items()
        for seed, sign in ((0, -1), (1, 1))
    ]  # fmt: skip
    (folder / "results.json").write_text(json.dumps({"cells": cells}))
    write_seal(store)
    return folder


@pytest.mark.parametrize(
    ("scenes", "shown"),
    # Of six scenes only the two patterns without or with all signs turned are as rare as 5 %, so
    # the interval reaches from the least difference to the largest.
    [(6, "0.0350 [0.0100, 0.0600]"), (5, "0.0300")],
)
def test_figures_are_paired_over_scenes_and_fewer_than_six_have_no_interval(
    tmp_path, scenes, shown
):
    first = {f"s{k}": 0.2 + k for k in range(scenes)}
    second = {f"s{k}": 0.2 + k + 0.01 * (k + 1) for k in range(scenes)}
    lines, table = side_by_side(
        sealed(tmp_path / "a", {**first, "alone": 0.9, "undefined": 0.9}),
        sealed(tmp_path / "b", {**second, "undefined": None}),
    )
    assert lines == []
    mean = sum(first.values()) / scenes
    rows = {row[1]: row for row in table.rows}
    assert rows["CLIP"] == ["DGE", "CLIP", str(2 * scenes), str(scenes), f"{mean:.2f}",
                            f"{sum(second.values()) / scenes:.2f}", shown]  # fmt: skip
    assert rows["DINO img"][2:] == ["0", "0", "–", "–", "–"]
