"""Edit PSNR of splats whose colours alone are fitted: against the brute-force renderer's matrix and
numpy's least squares.
"""

import numpy as np
import pytest
import torch

from attnwarp import Camera, Gaussians
from attnwarp.render import render
from attnwarp_eval.metrics.refit import refit


@pytest.fixture(scope="module")
def scene():
    """Twelve large discs on a ball, two views of 16 px."""
    rng = np.random.default_rng(4)
    means = rng.normal(size=(12, 3))
    means /= 2 * np.linalg.norm(means, axis=1, keepdims=True)
    quats = rng.normal(size=(12, 4))
    splats = Gaussians(
        "2d",
        torch.tensor(means, dtype=torch.float32),
        torch.tensor(quats / np.linalg.norm(quats, axis=1, keepdims=True), dtype=torch.float32),
        torch.full((12, 2), 0.3),
        torch.full((12,), 0.8),
        torch.zeros(12, 1, 3),
    )
    view = {"width": 16, "height": 16, "fov_y": 40, "up": (0, 0, 1)}
    return splats, [Camera.look_at((3, y, 0.4), (0, 0, 0), **view) for y in (-1, 1)]


def matrix(splats, cameras):
    """(pixels of all views, N) weights, and (pixels,) coverage, by the brute-force renderer."""
    views = [
        render(splats, camera, backend="reference", features=torch.eye(12)) for camera in cameras
    ]
    return (
        np.concatenate([view.color.numpy().reshape(-1, 12) for view in views]),
        np.concatenate([view.alpha.numpy().reshape(-1) for view in views]),
    )


def test_what_is_left_is_least_squares(scene):
    splats, cameras = scene
    rng = np.random.default_rng(0)
    sets = [[rng.random((16, 16, 3)) for _ in cameras] for _ in range(2)]
    weights, covered = matrix(splats, cameras)
    for found, pictures in zip(refit(splats, cameras, sets), sets, strict=True):
        wanted = np.concatenate([one.reshape(-1, 3) for one in pictures]) * covered[:, None]
        best = np.linalg.lstsq(weights, wanted, rcond=None)[0]
        error = ((wanted - weights @ best) ** 2).mean()
        assert found.fitted == pytest.approx(-10 * np.log10(error), abs=1e-3)


def test_pictures_that_the_splats_can_show_leave_nothing(scene):
    splats, cameras = scene
    weights, _ = matrix(splats, cameras)
    shown = (weights @ np.random.default_rng(1).random((12, 3))).reshape(2, 16, 16, 3)
    _, covered = matrix(splats, cameras)
    # Behind them lies the picture itself: premultiplied colours over coverage.
    pictures = shown / np.maximum(covered, 1e-9).reshape(2, 16, 16, 1)
    (found,) = refit(splats, cameras, [list(np.clip(pictures, 0, 1))])
    assert found.fitted > 60


def test_a_view_held_out_shows_the_colours_of_least_squares_over_the_others(scene):
    splats, cameras = scene
    rng = np.random.default_rng(2)
    pictures = [rng.random((16, 16, 3)) for _ in cameras]
    weights, covered = (part.reshape(2, 256, -1) for part in matrix(splats, cameras))
    # Of all best colours, the nearest to the grey that the splats have before.
    wanted = pictures[0].reshape(-1, 3) * covered[0]
    best = (
        0.5
        + np.linalg.lstsq(weights[0], wanted - weights[0] @ np.full((12, 3), 0.5), rcond=None)[0]
    )
    error = pictures[1].reshape(-1, 3) * covered[1] - weights[1] @ best
    (found,) = refit(splats, cameras, [pictures], held=[1])
    assert found.held_out == pytest.approx(-10 * np.log10((error**2).mean()), abs=0.02)
    over = np.clip(pictures[1].reshape(-1, 3) - error, 0, 1)
    np.testing.assert_allclose(found.renders[1].reshape(-1, 3), over, atol=0.01)


def test_a_set_of_another_number_of_pictures_is_refused(scene):
    splats, cameras = scene
    with pytest.raises(ValueError, match=r"sets\[0\]: got 1 pictures, expected 2"):
        refit(splats, cameras, [[np.zeros((16, 16, 3))]])
    assert refit(splats, cameras, []) == []
