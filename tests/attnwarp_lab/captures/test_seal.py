"""Two sealed runs side by side. Oracle: differences known in closed form."""

import json

import pytest

from attnwarp_eval.canonical_json import digest, write_json
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.store import Store, StoreError
from attnwarp_lab.captures.manifest import FIGURES
from attnwarp_lab.captures.seal import open_seal, side_by_side, verify, write_seal

CLIP = FIGURES["CLIP"]


def sealed(folder, figures):
    """A run's folder with a figure of each scene, of two seeds that lie 0.02 apart."""
    store = Store(folder)
    nothing = {name: {} for name in ("captures", "splats", "masks", "weights")}
    store.write_study({"inputs": nothing, "cells": []})
    cells = [
        {"kind": "edit", "variants": ["DGE"], "scene": scene, "edit": "red", "seed": seed,
         "figures": {CLIP: value and value + sign * 0.01}, "authors": {}}
        for scene, value in figures.items()
        for seed, sign in ((0, -1), (1, 1))
    ]  # fmt: skip
    (folder / "results.json").write_text(json.dumps({"cells": cells}))
    write_seal(store)
    return folder


def test_a_seal_is_compared_before_it_is_taken_off(tmp_path):
    """Oracle: by hand, the cells that rest on each damaged file; one of another scene stays."""
    cells = [Cell({"name": name}, name, "DGE", "captures", 0) for name in ("a", "b", "c")]
    _, b, c = cells
    files = ("originals/a/view-0000.png", f"made/{b.id[:16]}/measured/x.json",
             f"made/{c.id[:16]}/renders/view-0000.png", "notes.txt")  # fmt: skip
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("whole")
    store = Store(sealed(tmp_path, {}))
    assert open_seal(store, cells) == []
    for cell in cells:
        store.write({"id": cell.id, "spec": cell.spec})
    write_seal(store)
    (tmp_path / files[0]).unlink()
    (tmp_path / files[1]).write_text("cut")
    assert len(verify(store).damaged) == 2
    assert open_seal(store, cells) == sorted(files[:2])
    assert store.done() == {c.id}
    there = [(tmp_path / name).exists() for name in (*files, "seal.json")]
    assert there == [False, False, True, True, False]
    (tmp_path / "seal.json").write_text('{"files": {}}')
    with pytest.raises(StoreError, match="is damaged"):
        open_seal(store, cells)
    seal = {"files": {"../mine.txt": "0" * 64}}  # of a run from elsewhere
    write_json(tmp_path / "seal.json", {**seal, "sha256": digest(seal)})
    (tmp_path.parent / "mine.txt").write_text("mine")
    with pytest.raises(StoreError, match="is damaged"):
        open_seal(store, cells)
    assert (tmp_path.parent / "mine.txt").exists()


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
