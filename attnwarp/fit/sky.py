"""First splats of a sky: a shell so far away that no camera's place shifts it by a pixel."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.camera import up_of
from attnwarp.devices import on_cpu_unless_named
from attnwarp.fit.settings import FitSettings
from attnwarp.fit.start import extent_of, usual_distance
from attnwarp.fit.views import Views
from attnwarp.gaussians import Gaussians

Array = npt.NDArray[np.float64]

SHELL = 300
"""Distance of the first sky splats, over the points' usual distance from the cameras. Cameras that
stand half of that usual distance apart see them shifted by a tenth of a degree, half a pixel of
256."""

DIRECTIONS = 2000
"""First sky splats around the whole sphere, 4.5 degrees apart; a fit splits those with detail."""

MARGIN = np.radians(5)
"""Least elevation of a first sky splat: up is known to as much, and splats are as wide."""

SECTORS = 80
"""Sectors of the horizon, as wide as the first sky splats are apart. The highest first splat in one
hides the sky below it: a ground without texture has no first splats either."""

ABOVE = np.radians(2.25)
"""Least elevation of a first sky splat above that of the highest first splat in its sector, half of
what the sky splats are apart: surfaces end above their highest point."""

BAND = 0.1
"""Width of the band around a picture whose directions get a splat, in sides."""

OVERLAP = 0.6
"""Size of a first sky splat over the distance to its neighbours."""

LOOKS, LOOK_SIZE = 24, 256
"""Largest number of views, and their longest side in px, whose share without surface is measured: a
share of areas needs no more."""

LITTLE = 0.02
"""Share without surface that is not worth a word, such as gaps between splats."""

OPACITY = 0.9
"""Opacity of the first sky splats: a clear shell would let the scene's splats grow into the sky."""


@on_cpu_unless_named
def with_sky(start: Gaussians, views: Views, up: npt.ArrayLike | None = None) -> Gaussians:
    """Add a shell of far splats to a fit's first ones, above the horizon, where a picture shows
    none of these there or higher up.

    A sky splat has the median colour of those pictures in its direction.

    Args:
        start: first splats, at least one.
        views: pictures to fit on.
        up: (3,) direction up, of length 1; by default what the cameras tell
            (:func:`attnwarp.camera.up_of`).

    Returns:
        Splats with ``far`` set at half of the shell's distance. ``start`` itself if it has a sky,
        if no picture shows one, if the direction up is not known, and for pictures with
        transparency, whose background is known.

    Example:
        >>> import numpy as np
        >>> from attnwarp.fit import Views, from_points, with_sky
        >>> from attnwarp.trial import view
        >>> blue = Views([view(side=16), view(3, 0, 16)], [np.full((16, 16, 3), [0, 0, 1.0])] * 2)
        >>> start = with_sky(from_points(np.eye(3)[:2], kind="3d"), blue, up=(0, 1, 0))
        >>> start.far > 100, start.sh[-1, 0].sign().tolist()
        (True, [-1.0, -1.0, 1.0])
    """
    known = True
    if up is None:
        up, known = up_of(views.cameras)
    if views.transparent or np.isfinite(start.far) or not known:
        return start
    middle = np.stack([camera.position for camera in views.cameras]).mean(0)
    points = start.world_means()
    radius = SHELL * usual_distance(points, views.cameras)
    frame = _frame(np.asarray(up, dtype=np.float64))
    toward = directions(DIRECTIONS)
    toward = toward[toward @ frame[2] > math.sin(MARGIN)]
    places = middle + radius * toward
    sector, height = _around(frame, toward)
    seen = np.full((len(views), len(toward), 3), np.nan, np.float32)
    for k, camera in enumerate(views.cameras):
        tops = np.full(SECTORS, -np.inf)
        np.maximum.at(tops, *_around(frame, points - camera.position))
        size = np.array([camera.width, camera.height])
        xy, z = camera.project(places)
        inside = (z > 0) & (np.abs(xy / size - 0.5) < 0.5 + BAND).all(1)
        inside &= height > tops[sector] + ABOVE
        column, row = xy[inside].clip(0, size - 1).astype(int).T
        picture = views.target(k, torch.zeros(3, dtype=torch.float32))
        kept = views.kept(k, picture.device)
        if kept is not None:
            picture = torch.where(kept[..., None], picture, torch.nan)
        seen[k, inside] = picture[row, column]
    shown = ~np.isnan(seen[..., 0]).all(0)
    if not shown.any():
        return start
    colors = torch.from_numpy(np.nanmedian(seen[:, shown], axis=0).astype(np.float32))
    toward, n = toward[shown], int(shown.sum())
    # Half-way between the axis z and the direction: half a turn about it lays one on the other.
    turns = np.concatenate([np.zeros((n, 1)), toward + np.array([0.0, 0.0, 1.0])], axis=1)
    rest = torch.zeros(n, start.sh.shape[1] - 1, 3, dtype=torch.float32)
    sh = torch.cat([Gaussians.sh_from_rgb(colors), rest], dim=1)
    size = OVERLAP * radius * np.sqrt(4 * np.pi / DIRECTIONS)
    added = {
        "means": torch.from_numpy(places[shown] - start.origin),
        "quats": torch.from_numpy(turns),
        "scales": torch.full((n, start.scales.shape[1]), size, dtype=torch.float32),
        "opacities": torch.full((n,), OPACITY, dtype=torch.float32),
        "sh": sh,
    }
    return replace(
        start,
        far=radius / 2,
        **{  # type: ignore[arg-type]
            name: torch.cat([getattr(start, name), value.to(getattr(start, name))])
            for name, value in added.items()
        },
    )


@on_cpu_unless_named
def without_surface(gaussians: Gaussians, views: Views) -> float:
    """Share of the pictures' area, in [0, 1], that shows no surface: no depth, or less than half of
    it opaque, as in the sky and where there are no splats. :func:`say_without_surface` words it.

    What masks ignore is left out. At most :data:`LOOKS` views are looked at, evenly spread and no
    larger than :data:`LOOK_SIZE`.

    Example:
        >>> import numpy as np
        >>> from attnwarp.fit import Views
        >>> from attnwarp.fit.sky import without_surface
        >>> from attnwarp.trial import disc, view
        >>> share = without_surface(disc(0.3), Views([view(side=32)], [np.zeros((32, 32, 3))]))
        >>> 0.8 < share < 1
        True
    """
    from attnwarp.warp import preset, render_surface, resize_mask

    settings = preset("corrected")
    opaque = settings.opaque or 0.0
    near = FitSettings().near * extent_of(views.cameras, gaussians.world_means())
    empty = total = 0.0
    for k in np.unique(np.linspace(0, len(views) - 1, LOOKS).round().astype(int)):
        camera, kept = views.cameras[k], views.kept(k, torch.device("cpu"))
        scale = min(1.0, LOOK_SIZE / max(camera.width, camera.height))
        w, h = (max(1, round(scale * side)) for side in (camera.width, camera.height))
        seen = render_surface(gaussians, camera.resize(w, h), settings, near=near)
        none = np.isnan(np.asarray(seen.depth)) | (np.asarray(seen.alpha) < opaque)
        counted = np.ones((h, w), bool) if kept is None else resize_mask(kept, (h, w)).numpy()
        empty += float((none & counted).mean())
        total += float(counted.mean())
    return empty / total if total else 0.0


def say_without_surface(share: float) -> str:
    """Write a sentence, without its full stop, about the result of :func:`without_surface`; empty
    for a share below :data:`LITTLE`.

    Example:
        >>> from attnwarp.fit.sky import say_without_surface
        >>> say_without_surface(0.234)[:51]
        "23 % of the pictures' area has no surface (sky or e"
    """
    if share < LITTLE:
        return ""
    return (
        f"{100 * share:.0f} % of the pictures' area has no surface (sky or empty): nothing is"
        " warped, masked or clicked there"
    )


def _frame(up: Array) -> Array:
    """Two horizontal axes and the direction up, (3, 3) by rows."""
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def _around(frame: Array, offsets: Array) -> tuple[npt.NDArray[np.intp], Array]:
    """Find the sector of the horizon, (P,), and the elevation in radians, (P,), of directions."""
    east, north, up = frame @ offsets.T
    turn = np.arctan2(north, east) / (2 * np.pi) % 1
    return (turn * SECTORS).astype(np.intp) % SECTORS, np.arctan2(up, np.hypot(east, north))


def directions(count: int) -> Array:
    """Spread unit vectors evenly over the sphere, (count, 3), along a Fibonacci spiral.

    Example:
        >>> from attnwarp.fit.sky import directions
        >>> spread = directions(100)
        >>> bool(abs(spread.mean(0)).max() < 0.01)
        True
    """
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
