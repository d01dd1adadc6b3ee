"""First splats of a fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.camera import Camera, meeting_point, up_of
from attnwarp.devices import on_cpu_unless_named
from attnwarp.gaussians import Gaussians, Kind

if TYPE_CHECKING:
    from attnwarp.fit.settings import FitSettings
    from attnwarp.fit.views import Views
    from attnwarp.io import Dataset
from attnwarp.reporting import SILENT, Reporter

Array = npt.NDArray[np.float64]

FIRST_OPACITY = 0.1
"""Opacity of the first splats (3DGS)."""

NEIGHBOURS = 3
"""Number of neighbours whose root mean square distance is a first splat's size (3DGS)."""

ROUNDINGS = 32
"""Rounding of a camera's position, in float64 epsilons of the largest coordinate.

A pose holds t = -R c, and the position is -R^T t. An entry of a product with a rotation errs by at
most 1.5 epsilons of the vector's length, which is at most sqrt(3) times the largest coordinate.
Both products together then err by at most 4.5 + 2.6 epsilons. R^T R differs from I by a few more,
and two positions are compared.
"""


LONE_SIZE = 0.01
"""Size of a first splat without neighbours, as a share of the scene's extent."""


def extent_of(cameras: Sequence[Camera], points: Array | None = None) -> float:
    """Size of a scene in scene units: 1.1 times the largest distance of a camera from their mean
    (3DGS).

    Cameras at one place do not determine the size; it is then the median distance of ``points``
    from that place.

    Args:
        cameras: cameras, at least one.
        points: (P, 3) world coordinates of the seen surface. For cameras at one place, the extent
            is 1 if points are missing or lie at that place too.

    Example:
        >>> from attnwarp.fit import extent_of
        >>> from attnwarp.trial import view
        >>> round(extent_of([view(-3), view(3)]), 6)  # 1.1 * 3
        3.3
    """
    centers = np.stack([camera.position for camera in cameras])
    if not _at_one_place(centers):
        return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    if points is None or len(points) == 0:
        return 1.0
    return float(np.median(np.linalg.norm(points - centers[0], axis=1))) or 1.0


def _at_one_place(centers: Array) -> bool:
    """Return True if positions, (N, 3), differ by no more than their float64 rounding.

    The test is independent of the world's unit of length.
    """
    apart = float(np.abs(centers - centers[0]).max())
    return apart <= ROUNDINGS * float(np.finfo(np.float64).eps * np.abs(centers).max())


@on_cpu_unless_named
def from_points(
    points: npt.ArrayLike,
    colors: npt.ArrayLike | None = None,
    *,
    kind: Kind,
    sh_degree: int = 3,
    seed: int = 0,
    cameras: Sequence[Camera] = (),
) -> Gaussians:
    """Create one splat per point: as large as the gaps around the point, opacity 0.1, grey without
    colours.

    3D splats begin round and unrotated. 2D splats begin as randomly rotated discs (2DGS).

    Args:
        points: (P, 3) world coordinates, at least one; duplicates are dropped.
        colors: (P, 3) uint8 sRGB.
        kind: "2d" or "3d".
        sh_degree: highest degree of the allocated harmonics; all but the constant are 0.
        seed: seed of the random rotations.
        cameras: cameras that see the points, used to size a lone point, which has no gaps around
            it: a hundredth of the scene's extent (:func:`extent_of`), or of one unit without
                cameras.

    Returns:
        float32 splats relative to an ``origin`` at the points' median.

    Raises:
        ValueError: no points, a wrong shape or dtype, a coordinate that is not finite, or a degree
            out of range.

    Example:
        >>> from attnwarp.fit import from_points
        >>> start = from_points([[0, 0, 0], [1, 0, 0], [0, 1, 0]], kind="3d", sh_degree=0)
        >>> start.world_means().tolist()
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    from scipy.spatial import cKDTree

    check.one_of(kind, ("2d", "3d"), "kind")
    if not 0 <= sh_degree <= 3:
        raise ValueError(f"sh_degree: got {sh_degree}, expected 0 to 3")
    xyz = np.asarray(points, dtype=np.float64)
    check.shape(xyz, ("P", 3), "points")
    check.finite(xyz, "points")
    if len(xyz) == 0:
        raise ValueError("points: got none, expected at least one")
    rgb = np.full((len(xyz), 3), 128, np.uint8) if colors is None else np.asarray(colors)
    check.shape(rgb, (len(xyz), 3), "colors")
    if rgb.dtype != np.uint8:
        raise ValueError(f"colors: got {rgb.dtype}, expected uint8")
    # Two coincident splats have no distance that sizes them, and would never separate.
    _, first = np.unique(xyz, axis=0, return_index=True)
    first.sort()
    xyz, rgb = xyz[first], rgb[first]
    # The median, since a few outliers must not cost the other points their digits.
    origin = np.median(xyz, axis=0)
    local = xyz - origin
    n = len(local)
    if n == 1:
        size = np.array([LONE_SIZE * (extent_of(cameras, xyz) if cameras else 1.0)])
    else:
        distance, _ = cKDTree(local).query(local, k=min(NEIGHBOURS + 1, n))
        size = np.sqrt((distance[:, 1:] ** 2).mean(1))
    quats = torch.zeros(n, 4, dtype=torch.float32)
    quats[:, 0] = 1
    if kind == "2d":
        # Four independent normals are uniform on the 3-sphere: all rotations are equally likely.
        generator = torch.Generator().manual_seed(seed)
        quats = torch.randn(n, 4, generator=generator, dtype=torch.float32)
        quats = quats / quats.norm(dim=1, keepdim=True)
    sh = torch.zeros(n, (sh_degree + 1) ** 2, 3, dtype=torch.float32)
    sh[:, :1] = Gaussians.sh_from_rgb(torch.from_numpy(rgb.astype(np.float32) / 255))
    return Gaussians(
        kind,
        torch.from_numpy(local.astype(np.float32)),
        quats,
        torch.from_numpy(size.astype(np.float32))[:, None].repeat(1, 2 if kind == "2d" else 3),
        torch.full((n,), FIRST_OPACITY, dtype=torch.float32),
        sh,
        origin=origin,
    )


FAR = 100
"""Distance, over the usual distance, beyond which points give no splat. Such first discs would be
equally large, and a few would outweigh all others in the depth distortion of 2DGS."""


def within_reach(points: Array, cameras: Sequence[Camera]) -> npt.NDArray[np.bool_]:
    """Select points at most 100 times as far from the cameras as usual, (P,) bool.

    The usual distance is :func:`usual_distance`. Non-finite points stay, so that a later check
    refuses them.

    Example:
        >>> import numpy as np
        >>> from attnwarp.trial import view
        >>> within_reach(np.array([[0, 0, 0], [1, 0, 0], [0, 0, 9e3]]), [view()]).tolist()
        [True, True, False]
    """
    with np.errstate(over="ignore"):
        away = _distances(points, cameras)
        usual = usual_distance(points, cameras)
    return ~(away > FAR * usual) | ~np.isfinite(points).all(1)


def usual_distance(points: Array, cameras: Sequence[Camera]) -> float:
    """Median distance of points from the cameras' mean, or the scene's extent if larger.

    Example:
        >>> import numpy as np
        >>> from attnwarp.trial import view
        >>> usual_distance(np.array([[0.0, 0, 0], [0, 0, -1], [0, 0, -2]]), [view()])
        4.0
    """
    return max(float(np.median(_distances(points, cameras))), extent_of(cameras, points))


def _distances(points: Array, cameras: Sequence[Camera]) -> Array:
    middle = np.stack([camera.position for camera in cameras]).mean(0)
    return np.asarray(np.linalg.norm(points - middle, axis=1))


FIRST_POINTS = 10_000
"""Number of random first points for a dataset without points."""


@on_cpu_unless_named
def first_splats(
    dataset: Dataset,
    cameras: Sequence[Camera],
    settings: FitSettings,
    report: Reporter = SILENT,
    *,
    random: int = FIRST_POINTS,
    views: Views | None = None,
) -> Gaussians:
    """Create first splats at a dataset's points, or at random points if it has none, and in the
    sky.

    Args:
        dataset: dataset with points and colours.
        cameras: cameras of the fitted views.
        settings: kind, degree, seed and largest number of the splats; of more, as many are drawn
            at random, and widened.
        report: receiver of a line if random points are used, if points lie too far away
            (:func:`within_reach`), if no direction up is known for a sky, or if there are more
            than ``max_splats``.
        random: number of random points.
        views: fitted pictures, which give the sky its colours; None begins without a sky.

    Example:
        >>> from attnwarp.fit import FitSettings, first_splats
        >>> from attnwarp.io import Dataset
        >>> from attnwarp.trial import view
        >>> cameras = [view(0), view(3, 0)]
        >>> data = Dataset(cameras, ["a.png", "b.png"])
        >>> splats = first_splats(data, cameras, FitSettings(), random=50)
        >>> len(splats), splats.kind
        (50, '2d')
    """
    points, colors = dataset.points, dataset.colors
    if points is None or not len(points):
        report.log(f"the data has no points: beginning with {random} random ones")
        points, colors = random_points(cameras, random, seed=settings.seed)
    else:
        near = within_reach(np.asarray(points, np.float64), cameras)
        if not near.all():
            count = int((~near).sum())
            verb = "is" if count == 1 else "are"
            report.log(
                f"{count} of {len(near)} points {verb} left out, over {FAR} times as far from the"
                " cameras as the others"
            )
            points, colors = points[near], None if colors is None else colors[near]
    start = from_points(
        points,
        colors,
        kind=settings.kind,
        sh_degree=settings.sh_degree,
        seed=settings.seed,
        cameras=cameras,
    )
    if views is not None and settings.sky and not views.transparent:
        from attnwarp.fit.sky import with_sky

        up = upward(settings, cameras)
        if up is None:
            report.log(
                "no sky is added: the cameras do not tell which way is up, as they look one way or"
                " straight down, or are rolled; if an axis of the world points up, name it, such as"
                " --set sky=z"
            )
        else:
            start = with_sky(start, views, up)
    most = settings.max_splats
    if most is None or len(start) <= most:
        return start
    report.log(f"beginning with {most} of {len(start)} first splats, as max_splats is {most}")
    drawn = torch.randperm(len(start), generator=torch.Generator().manual_seed(settings.seed))
    # Fewer splats cover the same surface.
    wider = start.scales * math.sqrt(len(start) / most)
    return replace(start, scales=wider).select(drawn[:most].sort().values)


def upward(settings: FitSettings, cameras: Sequence[Camera]) -> Array | None:
    """Direction up, (3,): the axis that the settings name, or what the cameras tell
    (:func:`attnwarp.camera.up_of`); None if that is not known.

    Example:
        >>> from attnwarp.fit import FitSettings
        >>> from attnwarp.fit.start import upward
        >>> upward(FitSettings(sky="-y"), []).tolist()
        [-0.0, -1.0, -0.0]
    """
    if isinstance(settings.sky, str):
        sign = -1.0 if settings.sky[0] == "-" else 1.0
        return sign * np.eye(3)["xyz".index(settings.sky[-1])]
    up, known = up_of(cameras)
    return up if known else None


def random_points(
    cameras: Sequence[Camera], count: int, *, seed: int = 0
) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Draw random points and colours for datasets without points.

    The points fill a cube around the point nearest to all cameras' optical axes. Half of the cube's
    edge is the cameras' mean distance from that point. For parallel axes the cube lies in front of
    the cameras.

    Args:
        cameras: cameras, at least one.
        count: number of points, at least 1.
        seed: seed of positions and colours.

    Returns:
        points: (count, 3) world coordinates.
        colors: (count, 3) uint8, random.

    Raises:
        ValueError: the count is below 1, or cameras at one place look in different directions.

    Example:
        >>> import numpy as np
        >>> from attnwarp.fit import random_points
        >>> from attnwarp.trial import view
        >>> points, colors = random_points([view(0), view(3, 0)], 100)
        >>> points.shape, bool((np.abs(points) <= 3 + 1e-9).all()), colors.dtype
        ((100, 3), True, dtype('uint8'))
    """
    if count < 1:
        raise ValueError(f"count: got {count}, expected at least 1")
    centers = np.stack([camera.position for camera in cameras])
    forward = np.stack([camera.forward for camera in cameras])
    focus = meeting_point(cameras)
    # Opposite axes are parallel, too.
    if _at_one_place(centers) and (focus is not None or (forward @ forward[0]).min() < 0):
        raise ValueError(
            "cameras: got cameras that all stand at one place and look different ways, so"
            " nothing says how far the scene is; expected first points (ply_file_path, or"
            " COLMAP's)"
        )
    if focus is None:
        focus = centers.mean(0) + extent_of(cameras) * forward.mean(0)
    half = float(np.linalg.norm(centers - focus, axis=1).mean())
    random = np.random.default_rng(seed)
    points = focus + half * random.uniform(-1, 1, (count, 3))
    return points, random.integers(0, 256, (count, 3), dtype=np.uint8)
