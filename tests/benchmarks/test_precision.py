"""The measurement of the renderer's error. Oracle: the camera's own projection."""

import json

import numpy as np
import torch

from attnwarp.render import render
from benchmarks import precision


def test_a_displaced_splat_moves_by_what_float32_rounds_in_x_and_in_y():
    splats, camera = precision.scene(3, "2d", 1e4)
    inputs = precision.prepared(splats, camera)
    moved = precision.displaced(inputs, 0).means.numpy()
    before, after = (camera.project(m)[0] for m in (splats.means.double().numpy(), moved))
    assert np.abs(np.abs(after - before) - 21 * 2.0**-24).max() < 1e-11


def test_a_needle_has_alpha_of_one_sigma_at_its_pixel():
    splats, camera, pixel = precision.needle(5, 0.1)
    xy, _ = camera.project(splats.means.double().numpy())
    distance = np.linalg.norm(xy[0] - np.array(pixel[::-1]) - 0.5)
    along = (distance**2 - 0.1**2) / (40 / 3) ** 2
    alpha = render(splats, camera, backend="reference").alpha[pixel]
    assert abs(float(alpha) - np.exp(-(1 + along) / 2)) < 1e-4  # means in float32, of a tenth px


def test_a_quick_run_writes_what_it_prints(tmp_path, capsys):
    threads = torch.get_num_threads()
    try:
        precision.main(["--quick", "--out", str(tmp_path / "figures.json")])
    finally:
        torch.set_num_threads(threads)
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert [row["worst"] <= row["bound"] for row in figures["needles"]] == [True] * 6
    rows = figures["ratios"]
    table = capsys.readouterr().out
    assert len(rows) == 8 and table.count("\n| 1e+0") == 8
    for row in rows:
        assert row["mode"] in table and max(row["worst"].values()) < precision.LIMIT
        assert row["beyond"] == 0
