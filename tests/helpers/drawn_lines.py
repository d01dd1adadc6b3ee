"""Distances from epipolar lines that are drawn through two projections, without a fundamental matrix."""

import numpy as np


def drawn_distances(view, key, size):
    """(L, L) distances from the line through the projections of two points of each cell's ray."""
    h, w = size
    grid, onto = view.resize(w, h), key.resize(w, h)
    result = np.zeros((h * w, h * w))
    for i in range(h * w):
        ray = grid.directions(np.array([i % w + 0.5, i // w + 0.5])) @ grid.rotation
        a, b = (onto.project(grid.position + depth * ray)[0] for depth in (2.0, 5.0))
        for j in range(h * w):
            x, y = j % w + 0.5 - a[0], j // w + 0.5 - a[1]
            result[i, j] = abs(x * (b - a)[1] - y * (b - a)[0]) / np.linalg.norm(b - a)
    return result
