"""Drift of an edit against pictures of a formula, evaluated at moved coordinates."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from attnwarp import Gaussians
from attnwarp.camera import Camera
from attnwarp.drift import drift
from attnwarp.editing.small import load_editor
from attnwarp.methods import attention_warping, preset
from attnwarp.methods.change import say_drift
from attnwarp.render import render

ASKED = np.array([0.1, 0.1, 0.1, 0.05])  # px, px, percent, degrees


class Formula:
    """Sum of plane waves through tanh: smooth parts and edges, known at any coordinate."""

    def __init__(self, seed: int) -> None:
        draw = np.random.default_rng(seed)
        length = 10 * 12 ** draw.random(20)  # px
        turn = 2 * np.pi * draw.random(20)
        self.waves = 2 * np.pi / length * np.stack([np.cos(turn), np.sin(turn)])
        self.phases = 2 * np.pi * draw.random(20)
        self.sizes = draw.normal(size=(20, 3)) * np.sqrt(length)[:, None] / 8

    def picture(self, size: int, motion: tuple[float, ...] = (0, 0, 0, 0)) -> np.ndarray:
        """Return (size, size, 3) in [0, 1] at the pixels' centres."""
        right, down, percent, degrees = motion
        at = np.arange(size) + 0.5 - size / 2
        x, y = np.meshgrid(at - right, at - down)
        turn, scale = np.radians(degrees), 1 + percent / 100
        back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) / scale
        points = np.stack([x.ravel(), y.ravel()], -1) @ back.T
        values = np.tanh(np.sin(points @ self.waves + self.phases) @ self.sizes) / 2 + 0.5
        return values.reshape(size, size, 3)


def tried(number: int, size: int = 256) -> tuple[np.ndarray, np.ndarray] | None:
    """Draw a drift and an edit, and return errors and half widths; None if it isn't told."""
    draw = np.random.default_rng(number)
    formula = Formula(number)
    sign = draw.choice([-1, 1], 4)
    shift = draw.choice([0.1, 0.5, 2, 6, 20]) * size / 256 * np.array([draw.random(), 1])
    motion = sign * [*shift, draw.choice([0, 0.1, 1, 5, 20]), draw.choice([0, 0.1, 1, 5])]
    before, after = formula.picture(size), formula.picture(size, tuple(motion))
    left = np.ones((size, size), bool)
    if draw.random() < 0.5:  # the edited thing, which counts nowhere
        y, x = draw.integers(0, size // 2, 2)
        left[y : y + size // 3, x : x + size // 3] = False
    if draw.random() < 0.4:  # repainted where the mask says that nothing changes
        y, x = draw.integers(0, size // 2, 2)
        other = Formula(number + 10_000).picture(size)
        after[y : y + size // 3, x : x + size // 2] = other[: size // 3, : size // 2]
    if draw.random() < 0.5:
        mixed = after @ (np.eye(3) + 0.15 * draw.normal(size=(3, 3)))
        after = np.clip(mixed, 0, 1) ** draw.uniform(0.6, 1.6) * draw.uniform(0.6, 1)
    if draw.random() < 0.4:
        after = cv2.GaussianBlur(after, (0, 0), draw.uniform(0.5, 2))
    after = after + draw.normal(size=after.shape) * draw.choice([0, 0.02, 0.06])
    one, two = (np.clip(255 * p + 0.5, 0, 255).astype(np.uint8) for p in (before, after))
    got = drift(one, two, left)
    if got is None:
        return None
    values = np.array([got.right, got.down, got.scale, got.turn])
    return values - motion, np.array(got.half_widths)


@pytest.mark.parametrize(
    "tries", [6, pytest.param(1000, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])]
)
def test_known_drifts_are_found_under_changes_of_colour_blur_noise_and_repaint(tries: int) -> None:
    told = [values for values in map(tried, range(tries)) if values is not None]
    assert len(told) >= 0.95 * tries
    errors, half = map(np.abs, map(np.array, zip(*told, strict=True)))
    assert (np.median(errors, axis=0) <= ASKED).all()
    assert (errors <= 3 * half).all()
    assert (errors > half).mean() <= max(0.01, 1 / errors.size)


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


@pytest.mark.parametrize("other", ["another picture", "noise", "flat", "nothing left"])
def test_pictures_that_share_nothing_have_no_drift(other: str) -> None:
    before, left = Formula(1).picture(128), np.ones((128, 128), bool)
    after = {
        "another picture": Formula(2).picture(128),
        "noise": np.random.default_rng(0).random((128, 128, 3)),
        "flat": np.full((128, 128, 3), 0.4),
        "nothing left": before,
    }[other]
    assert drift(before, after, left & (other != "nothing left")) is None


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
    disc = Gaussians(
        "2d", torch.tensor([[0.0, 0, 3]]), torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 2), 0.5), torch.ones(1), torch.zeros(1, 1, 3),
    )  # fmt: skip
    before = formula.picture(128).astype(np.float32)
    marked = np.zeros((128, 128), bool)
    marked[:32, :32] = True
    result = attention_warping(
        disc, cameras, [before, before], load_editor("small-plain"), "red",
        preset("attention_warping", stages=1, steps=2, iterations=0),
        source_picture=formula.picture(128, (3, 0, 0, 0)).astype(np.float32),
        segments=[marked, marked],
    )  # fmt: skip
    assert result.drift["view"] == "one"
    assert result.drift["drift"]["right"] == pytest.approx(3, abs=0.1)
    # The picture that is handed out is the original outside the mask.
    assert drift(before, result.edited[0].astype(np.float32) / 255, ~marked).largest < 0.1
