"""Drift of an edit against pictures of a formula, evaluated at moved coordinates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from further import further

from attnwarp import Gaussians
from attnwarp.camera import Camera
from attnwarp.drift import STRIPED, Drift, NoDrift, drift, drift_or_why
from attnwarp.editing.small import load_editor
from attnwarp.methods import attention_warping, preset
from attnwarp.methods.change import say_drift
from attnwarp.render import render
from attnwarp.trial import disc
from benchmarks.drift import Formula, of_formula, read, row

ROOT = Path(__file__).parents[2]
ASKED = np.array([0.1, 0.1, 0.1, 0.05])  # px, px, percent, degrees


@pytest.mark.parametrize("tries", [6, pytest.param(100, marks=pytest.mark.slow)])
def test_known_drifts_are_found_under_changes_of_colour_blur_noise_and_repaint(tries: int) -> None:
    told = [one for one in map(of_formula, range(tries)) if one.errors is not None]
    assert len(told) >= 0.9 * tries  # 94.7 % of the report's
    errors = np.abs([one.errors for one in told])
    half = np.array([one.half_widths for one in told])
    assert (np.median(errors, axis=0) <= ASKED).all()
    assert (errors <= 3 * half).all()
    assert (errors > half).mean() <= max(0.01, 1 / errors.size)


def test_the_page_of_drifts_says_what_its_raw_results_say() -> None:
    folder = ROOT / "reports/drift"
    sets = read(folder / "tries.jsonl.xz")
    page = (folder / "report.md").read_text()
    assert len(page.splitlines()) <= 150
    for name, tries in sets.items():
        assert "| " + " | ".join(row(name, tries)) + " |" in page
        told = [one for one in tries if one.errors is not None]
        errors = np.abs([one.errors for one in told])
        half = np.array([one.half_widths for one in told])
        assert (errors <= 3 * half).all()
        if "256 px" in name:
            assert (np.median(errors, axis=0) <= ASKED).all()


def test_a_picture_rendered_from_a_moved_camera_has_the_cameras_drift() -> None:
    draw = torch.Generator().manual_seed(0)
    count = 3000
    means = torch.rand(count, 3, generator=draw) * torch.tensor([4.0, 4.0, 0.5]) - 2
    splats = Gaussians(
        "2d", means + torch.tensor([0, 0, 4.0]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.full((count, 2), 0.04),
        torch.ones(count), torch.rand(count, 1, 3, generator=draw),
    )  # fmt: skip
    camera = Camera(np.array([[256.0, 0, 128], [0, 256, 128], [0, 0, 1]]), np.eye(4), 256, 256)
    K = np.array([[256 * 1.02, 0, 131.25], [0, 256 * 1.02, 126.5], [0, 0, 1]])
    moved = replace(camera, K=K)
    one, two = (render(splats, c).color.numpy().clip(0, 1) for c in (camera, moved))
    got = drift(one, two)
    assert got is not None
    errors = np.abs([got.right - 3.25, got.down + 1.5, got.scale - 2, got.turn])
    assert (errors <= np.minimum(ASKED, got.half_widths)).all()


def drawn_stripes(kind: str, angle: float, seed: int, size: int = 128) -> np.ndarray:
    """(size, size, 3) stripes in [0, 1], the same along the direction across ``angle``."""
    draw, at = np.random.default_rng(seed), np.arange(size) + 0.5
    x, y = np.meshgrid(at, at)
    across, width = np.cos(angle) * x + np.sin(angle) * y, draw.uniform(12, 30)
    values = {
        "blinds": 0.5 + 0.4 * np.tanh(4 * np.sin(2 * np.pi * across / width)),
        "planks": 0.2 + 0.6 * draw.random(40)[(across // width).astype(int) % 40],
        "curtain": 0.5 + 0.12 * sum(np.sin(across / c + c) for c in draw.uniform(2, 12, 6)),
    }[kind]
    return values[..., None] * draw.uniform(0.6, 1, 3)


@pytest.mark.parametrize(("kind", "angle", "noise"), [
    ("blinds", 0, 0.005), ("planks", np.pi / 2, 0.02), ("curtain", 0.5, 0.01),
])  # fmt: skip
def test_a_shift_along_stripes_is_not_told(kind: str, angle: float, noise: float) -> None:
    draw, before = np.random.default_rng(0), drawn_stripes(kind, angle, 0)
    pictures = (before, before * draw.uniform(0.6, 1, 3))  # recoloured, not moved
    noisy = [p + noise * draw.normal(size=p.shape) for p in pictures]
    found = drift_or_why(*(np.rint(255 * p.clip(0, 1)).astype(np.uint8) for p in noisy))
    assert found == STRIPED
    line, warns = say_drift({"view": "front", "drift": vars(found)})
    assert not warns and "can't be told: " in line and "runs in one direction" in line


@pytest.mark.parametrize(("matrix", "percent"), [
    *further(([[1.04, 0], [0, 1]], 4), ([[1, 0.1], [0, 1]], None)), ([[1, 0], [0.03, 1.03]], None),
])  # fmt: skip
def test_a_stretched_or_sheared_picture_moved_by_no_similarity(
    matrix: list[list[float]], percent: float | None
) -> None:
    formula, map_ = Formula(6), np.array(matrix)
    found = drift_or_why(formula.picture(144), 0.7 * formula.picture(144, stretch=map_))
    axes = np.linalg.svd(map_, compute_uv=False)
    assert isinstance(found, NoDrift) and found.seen
    assert found.stretch == pytest.approx(100 * (axes[0] / axes[1] - 1), abs=0.1)
    assert percent is None or found.stretch == pytest.approx(percent, abs=0.1)
    line, warns = say_drift({"view": "front", "drift": vars(found)})
    assert warns and "moved the picture, but by no shift, scale and turn" in line


@pytest.mark.parametrize(("other", "why"), [
    *further(("another picture", "shares no motion"), ("noise", "")), ("flat", ""),
    ("both flat", "too little"), ("nothing left", ""), ("small", "smaller than"),
])  # fmt: skip
def test_of_pictures_that_share_nothing_the_page_says_why_no_drift_is_told(
    other: str, why: str
) -> None:
    before, left = Formula(1).picture(128), np.ones((128, 128), bool)
    flat = np.full((128, 128, 3), 0.4)
    before, after = {
        "another picture": (before, Formula(2).picture(128)),
        "noise": (before, np.random.default_rng(0).random((128, 128, 3))),
        "flat": (before, flat),
        "both flat": (flat, flat),
        "nothing left": (before, before),
        "small": (before[:32, :32], before[:32, :32]),
    }[other]
    left = left[: len(before), : len(before)] & (other != "nothing left")
    found = drift_or_why(before, after, left)
    assert isinstance(found, NoDrift)
    line, warns = say_drift({"view": "front", "drift": vars(found)})
    assert not warns and "can't be told: " in line and why in line


def test_tiles_in_one_row_tell_a_drift_but_no_stretch() -> None:
    """A thing that fills a picture leaves a stripe of it."""
    formula, left = Formula(3), np.zeros((128, 128), bool)
    left[20:36] = True
    found = drift_or_why(formula.picture(128), formula.picture(128, (3, 0, 0, 0)), left)
    assert isinstance(found, Drift)
    told = (found.right, found.down, found.scale, found.turn)
    np.testing.assert_allclose(told, (3, 0, 0, 0), atol=0.1)


def test_a_line_warns_of_a_moved_picture_alone() -> None:
    formula = Formula(3)
    moved = drift(formula.picture(128), formula.picture(128, (3, 0, 0, 0)))
    stays = drift(formula.picture(128), 0.5 * formula.picture(128))
    assert moved is not None and stays is not None
    line, warns = say_drift({"view": "front", "drift": vars(moved)})
    assert warns and "the edit of front moved the picture, corners by 3.0 px" in line
    line, warns = say_drift({"view": "front", "drift": vars(stays)})
    assert not warns and "left the picture in place" in line


def test_an_edit_says_how_far_its_source_moved_before_it_is_composed() -> None:
    formula = Formula(4)
    K = np.array([[128.0, 0, 64], [0, 128, 64], [0, 0, 1]])
    cameras = [Camera(K, np.eye(4), 128, 128, name) for name in ("one", "two")]
    ahead = replace(disc(), means=torch.tensor([[0.0, 0, 3]]))
    before = formula.picture(128).astype(np.float32)
    marked = np.zeros((128, 128), bool)
    marked[:32, :32] = True
    result = attention_warping(
        ahead, cameras, [before, before], load_editor("small-plain"), "red",
        preset("attention_warping", stages=1, steps=2, iterations=0),
        source_picture=formula.picture(128, (3, 0, 0, 0)).astype(np.float32),
        segments=[marked, marked],
    )  # fmt: skip
    assert result.drift["view"] == "one"
    assert result.drift["drift"]["right"] == pytest.approx(3, abs=0.1)
    # The picture that is handed out is the original outside the mask.
    assert drift(before, result.edited[0].astype(np.float32) / 255, ~marked).largest < 0.1
