"""Oracles: a loop over pixels, and the standard normal."""

import math

import numpy as np
import torch

from attnwarp.propagate.noise import NoiseField, carried


def white(seed, shape=(3, 8, 8)):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def positions(seed, size=8):
    """Random places, some outside and some undefined; a zoom, so that many fall into one pixel."""
    random = np.random.default_rng(seed)
    xy = random.uniform(-0.5, size * 0.6, (size, size, 2))
    xy[random.random((size, size)) < 0.1] = np.nan
    return torch.from_numpy(xy)


def setting(seed):
    first = NoiseField.own(white(100 + seed), 0)
    everywhere = torch.zeros((8, 8), dtype=torch.int64)
    second = carried(NoiseField.own(white(200 + seed), 1), [first], [positions(7)], everywhere)
    choice = torch.from_numpy(np.random.default_rng(3).integers(-1, 2, (8, 8)))
    own = NoiseField.own(white(300 + seed), 2)
    return own, [first, second], [positions(8), positions(9)], choice


def test_each_pixel_takes_its_sources_value_unless_a_nearer_one_does_by_a_loop():
    own, sources, places, choice = setting(0)
    result = carried(own, sources, places, choice)
    wanted = {}
    for row in range(8):
        for column in range(8):
            k = int(choice[row, column])
            if k < 0 or not torch.isfinite(places[k][row, column]).all():
                continue
            x, y = (float(v) for v in places[k][row, column])
            i, j = min(max(math.floor(y), 0), 7), min(max(math.floor(x), 0), 7)
            distance = (x - j - 0.5) ** 2 + (y - i - 0.5) ** 2
            value = int(sources[k].origin[i, j])
            if value not in wanted or distance < wanted[value][0]:
                wanted[value] = distance, (row, column), sources[k].values[:, i, j]
    taken = {place: (value, noise) for value, (_, place, noise) in wanted.items()}
    assert 10 < len(taken) < 50
    for row in range(8):
        for column in range(8):
            value, noise = taken.get(
                (row, column), (int(own.origin[row, column]), own.values[:, row, column])
            )
            assert int(result.origin[row, column]) == value
            assert torch.equal(result.values[:, row, column], noise)


def test_no_value_stands_twice_in_a_view():
    own, sources, places, choice = setting(0)
    origins = carried(own, sources, places, choice).origin.flatten().tolist()
    assert len(set(origins)) == 64
    assert len({origin >> 32 for origin in origins}) == 3  # values of all three views


def test_the_noise_of_a_view_is_white_with_unit_variance():
    """400 draws of the same geometry against the standard normal, 5 standard deviations wide."""
    draws = 400
    rows = np.stack(
        [carried(*setting(1000 * k)).values.flatten().double().numpy() for k in range(draws)]
    )
    count = rows.size
    assert abs(rows.mean()) < 5 / math.sqrt(count)
    assert abs(rows.var() - 1) < 5 * math.sqrt(2 / count)
    # Pixel by pixel: the sum of squares is chi-squared with ``draws`` degrees of freedom.
    squares = (rows**2).sum(axis=0)
    assert np.abs(squares - draws).max() < 5.5 * math.sqrt(2 * draws)
    # Correlations between all pairs of pixels and channels: mean 0, variance 1 / draws each.
    correlation = rows.T @ rows / draws
    off = correlation[~np.eye(len(correlation), dtype=bool)]
    assert np.abs(off).max() < 6.5 / math.sqrt(draws)
    assert abs((off**2).mean() * draws - 1) < 0.05


def test_interpolated_noise_would_fail_that_test():
    """The test's power: bilinear noise at half a pixel has a variance of 1/4 (closed form)."""
    rows = np.stack([white(k, (1, 8, 8)).double().numpy()[0] for k in range(400)])
    half = (rows[:, :-1, :-1] + rows[:, 1:, :-1] + rows[:, :-1, 1:] + rows[:, 1:, 1:]) / 4
    assert abs(half.var() - 0.25) < 0.02
    assert abs(half.var() - 1) > 5 * math.sqrt(2 / half.size)
