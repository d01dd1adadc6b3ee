"""A corner of three textured walls, and six cameras around it."""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from attnwarp import Camera


def picture(seed, camera):
    """(H, W, 3) picture of three walls that meet at the origin, each with a texture of its own."""
    rng = np.random.default_rng(seed)
    directions = camera.unproject(
        np.stack(np.meshgrid(np.arange(256) + 0.5, np.arange(256) + 0.5), -1).reshape(-1, 2),
        np.ones(256 * 256),
    ) - np.asarray(camera.position)
    reach, shown = np.full(len(directions), np.inf), np.zeros(len(directions))
    for axis in range(3):
        texture = gaussian_filter(rng.random((300, 300)), 1.5)
        texture = (texture - texture.min()) / np.ptp(texture)
        length = -camera.position[axis] / directions[:, axis]
        place = camera.position + length[:, None] * directions
        across = np.delete(place, axis, axis=1).T * 100
        hit = (length > 0) & (length < reach) & (across >= 0).all(0) & (across < 299).all(0)
        reach[hit] = length[hit]
        shown[hit] = map_coordinates(texture, across[:, hit], order=1)
    return np.repeat(np.clip(shown, 0, 1).reshape(256, 256, 1), 3, axis=2)


def cameras():
    places = [(3 + 0.5 * np.cos(t), 3 + 0.5 * np.sin(t), 2.5) for t in np.linspace(0, 5, 6)]
    view = {"width": 256, "height": 256, "fov_y": 45, "up": (0, 0, 1)}
    return [Camera.look_at(place, (0.7, 0.7, 0.7), **view) for place in places]
