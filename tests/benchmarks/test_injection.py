"""The benchmark of injection: its ratios against sums done by hand, its runs with a small editor."""

import numpy as np
import torch
from tiny_editors import pix2pix

from attnwarp.editing.editors.pix2pix import InstructPix2Pix
from benchmarks.injection import Case, Seconds, measure, plane_warp, table

NAMES = ("plain", "recorded", "injected", "injected along a warp", "plain again")


def test_what_a_run_adds_is_the_median_of_ratios_within_rounds():
    plain = [1.0, 2.0, 4.0]
    # 10, 30 and 20 % more than the plain edit of the same round; the medians alone would say 30 %.
    runs = {name: [Seconds(s, 3 * s) for s in plain] for name in NAMES}
    runs["recorded"] = [Seconds(s, 0) for s in (1.1, 2.6, 4.8)]
    runs["plain again"] = [Seconds(s, 0) for s in (0.95, 2.0, 4.2)]
    text = table([Case("small", 64, runs)], steps=20, load=1.5)
    row = next(line for line in text.splitlines() if line.startswith("| small"))
    cells = [cell.strip() for cell in row.split("|")[1:-1]]
    assert cells[:5] == ["small", "64", "2.00", "6.00", "+20 % (+10 to +30)"]
    assert cells[5:] == ["+0 % (+0 to +0)", "+0 % (+0 to +0)", "+0 % (-5 to +5)"]
    assert "3 rounds" in text


def test_every_run_is_timed_in_every_round():
    pipe = pix2pix()
    parts = pipe.unet, pipe.vae, pipe.text_encoder, pipe.tokenizer, pipe.scheduler
    runs = measure(InstructPix2Pix(*parts), 16, steps=1, rounds=2)
    assert tuple(runs) == NAMES
    assert all(len(s) == 2 and min(min(t.cpu, t.wall) for t in s) > 0 for s in runs.values())


def test_the_warp_moves_by_a_twentieth_of_the_picture():
    grid = plane_warp(40).at((40, 40))
    # Focal length 40 px times 0.1 / 2: two pixels.
    ramp = np.broadcast_to(np.arange(40.0), (1, 1, 40, 40)).copy()
    warped = grid.warp(torch.from_numpy(ramp))[0, 0].numpy()
    inside = grid.mask.numpy()
    assert inside.mean() > 0.9
    np.testing.assert_allclose(np.abs(warped - ramp[0, 0])[inside], 2, atol=1e-6)
