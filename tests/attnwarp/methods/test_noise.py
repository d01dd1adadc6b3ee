"""Oracles: a loop over pixels, and the standard normal."""

import math

import numpy as np
import torch

from attnwarp.methods.noise import carried

SIZE = 8


def positions(seed):
    """Random places, some outside and some undefined; a zoom, so that many fall into one pixel."""
    random = np.random.default_rng(seed)
    xy = random.uniform(-0.5, SIZE * 0.6, (SIZE, SIZE, 2))
    xy[random.random((SIZE, SIZE)) < 0.1] = np.nan
    return torch.from_numpy(xy)


def setting():
    """Places of a target's pixels in the source, and which of them the source shows."""
    return positions(8), torch.from_numpy(np.random.default_rng(3).random((SIZE, SIZE)) < 2 / 3)


def test_each_pixel_takes_its_sources_value_unless_a_nearer_one_does_by_a_loop():
    places, seen = setting()
    result = carried(places, seen).tolist()
    wanted = {}
    for row in range(SIZE):
        for column in range(SIZE):
            if not seen[row, column]:
                continue
            x, y = (float(v) for v in places[row, column])
            if not (0 <= x <= SIZE and 0 <= y <= SIZE):
                continue
            i, j = min(math.floor(y), SIZE - 1), min(math.floor(x), SIZE - 1)
            distance = (x - j - 0.5) ** 2 + (y - i - 0.5) ** 2
            value = SIZE * i + j
            if value not in wanted or distance < wanted[value][0]:
                wanted[value] = distance, (row, column)
    taken = {place: value for value, (_, place) in wanted.items()}
    assert 10 < len(taken) < 50
    rest = sorted(set(range(SIZE**2)) - set(taken.values()))
    for row in range(SIZE):
        for column in range(SIZE):
            own = row * SIZE + column
            if (row, column) in taken:
                assert result[row][column] == taken[row, column]
            elif own in rest:
                assert result[row][column] == own
                rest.remove(own)
    others = [
        result[p // SIZE][p % SIZE]
        for p in range(SIZE**2)
        if (p // SIZE, p % SIZE) not in taken and result[p // SIZE][p % SIZE] != p
    ]
    assert others == rest  # in their order
    assert len(others) > 5


def test_every_value_stands_once_in_a_view():
    assert carried(*setting()).flatten().sort().values.tolist() == list(range(SIZE**2))


def test_a_view_at_the_sources_place_has_the_sources_noise():
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    here = torch.stack([x, y], dim=-1).double()
    order = carried(here, torch.ones(SIZE, SIZE, dtype=torch.bool))
    assert order.flatten().tolist() == list(range(SIZE**2))


def draws(count):
    random = torch.Generator().manual_seed(0)
    return torch.randn((count, SIZE**2), generator=random, dtype=torch.float64)


def test_the_noise_of_a_view_is_white_with_unit_variance():
    """400 draws of one geometry against the standard normal, at least 5 standard deviations wide."""
    count = 400
    rows = draws(count)[:, carried(*setting()).flatten()].numpy()
    assert abs(rows.mean()) < 5 / math.sqrt(rows.size)
    assert abs(rows.var() - 1) < 5 * math.sqrt(2 / rows.size)
    # Pixel by pixel the sum of squares is chi-squared with ``count`` degrees of freedom.
    assert np.abs((rows**2).sum(axis=0) - count).max() < 5.5 * math.sqrt(2 * count)
    # Correlations between all pairs of pixels: mean 0, variance 1 / count each.
    correlation = rows.T @ rows / count
    off = correlation[~np.eye(len(correlation), dtype=bool)]
    assert np.abs(off).max() < 6.5 / math.sqrt(count)
    assert abs((off**2).mean() * count - 1) < 5 * math.sqrt(2 / (off.size / 2))
