"""A card on a floor of its own colour, and a larger one behind it; the oracle are the planes'
intersections with rays.
"""

import cv2
import numpy as np
import pytest
import torch

from attnwarp import Camera, Gaussians
from attnwarp.errors import InputError
from attnwarp.warp import piece_around

CAMERA = Camera.look_at((0, -4, 1.5), (0, 0, 0.5), width=96, height=96, fov_y=50)


def rectangle(low, high, normal_quat):
    """Centres of discs 0.03 apart on an axis-parallel rectangle, and their rotations."""
    axes = [
        np.arange(a, b + 1e-9, 0.03) if b > a else np.array([a])
        for a, b in zip(low, high, strict=True)
    ]
    place = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return place, np.tile(normal_quat, (len(place), 1))


FLAT, UPRIGHT = (1, 0, 0, 0), (np.sqrt(0.5), np.sqrt(0.5), 0, 0)
FLOOR = rectangle((-2, -2, 0), (2, 3, 0), FLAT)


@pytest.fixture(scope="module")
def splats():
    return discs(
        FLOOR,
        rectangle((-0.5, 0, 0), (0.5, 0, 1), UPRIGHT),  # the card
        rectangle((-1.2, 1.5, 0), (1.2, 1.5, 2), UPRIGHT),  # the one behind
    )


def discs(*parts):
    means, quats = (
        torch.tensor(np.concatenate(v), dtype=torch.float32) for v in zip(*parts, strict=True)
    )
    count = len(means)
    return Gaussians(
        "2d", means, quats, torch.full((count, 2), 0.02), torch.full((count,), 0.99),
        torch.zeros(count, 1, 3),
    )  # fmt: skip


def seen():
    """(96, 96) 0 where a ray meets the floor, 1 the card, 2 the one behind, -1 nothing."""
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(96) + 0.5)
    ray = CAMERA.unproject(np.stack([x, y], -1), np.ones((96, 96))) - CAMERA.position
    nearest, thing = np.full((96, 96), np.inf), np.full((96, 96), -1)
    bounds = [(2, 0, (-2, 2), (-2, 3)), (1, 0, (-0.5, 0.5), (0, 1)), (1, 1.5, (-1.2, 1.2), (0, 2))]
    for k, (axis, height, *sides) in enumerate(bounds):
        reach = (height - CAMERA.position[axis]) / ray[..., axis]
        across = np.delete(CAMERA.position + reach[..., None] * ray, axis, -1)
        inside = [(a <= across[..., i]) & (across[..., i] <= b) for i, (a, b) in enumerate(sides)]
        hit = (reach > 0) & (reach < nearest) & inside[0] & inside[1]
        nearest[hit], thing[hit] = reach[hit], k
    return thing


@pytest.mark.parametrize("thing", [1, 2])
def test_a_piece_ends_at_the_floor_and_at_steps_of_depth(splats, thing):
    true = (seen() == thing).astype(np.uint8)
    away = cv2.distanceTransform(np.pad(true, 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(away.argmax(), away.shape)
    piece = piece_around(splats, CAMERA, (column + 0.5, row + 0.5))
    square = np.ones((7, 7), np.uint8)  # discs are 2 px wide, and a pixel around is the piece's too
    assert piece[cv2.erode(true, square) > 0].all()
    assert not piece[cv2.dilate(true, square) == 0].any()


def test_a_point_on_the_floor_has_the_floor_and_one_on_nothing_all(splats):
    thing = seen()
    row, column = np.argwhere(thing == 0)[-1] - (3, 3)
    assert thing[row, column] == 0
    piece = piece_around(splats, CAMERA, (column, row))
    assert piece[thing == 0].mean() > 0.9
    row, column = np.argwhere(thing == -1)[0]
    assert piece_around(splats, CAMERA, (column, row)).all()


def test_a_piece_ends_at_the_slab_that_it_stands_on():
    """Oracle: the card's rectangle in the picture, above a slab a fifth as high."""
    slab = [
        rectangle((-0.8, -0.4, 0.2), (0.8, 0.4, 0.2), FLAT),
        rectangle((-0.8, -0.4, 0), (0.8, -0.4, 0.2), UPRIGHT),
    ]
    scene = discs(FLOOR, *slab, rectangle((-0.5, 0, 0.2), (0.5, 0, 1), UPRIGHT))
    corners = np.array([[x, 0, z] for x in (-0.5, 0.5) for z in (0.2, 1)])
    (left, top), (right, bottom) = (f(CAMERA.project(corners)[0], 0) for f in (np.min, np.max))
    piece = piece_around(scene, CAMERA, ((left + right) / 2, (top + bottom) / 2))
    rows, columns = np.nonzero(piece)
    found = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    assert np.abs(np.array(found) - (left, top, right, bottom)).max() < 3  # discs are 2 px wide


@pytest.mark.parametrize("at", [(-1, 5), (5, -1), (CAMERA.width + 1, 5), (np.nan, 5)])
def test_a_point_outside_of_the_picture_has_no_piece(splats, at):
    # -1 would read the opposite edge.
    with pytest.raises(InputError, match=r"at: got .* inside the picture of"):
        piece_around(splats, CAMERA, at)
