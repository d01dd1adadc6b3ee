"""Tracks: image points that structure from motion assigns to one surface point."""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.errors import InputError
from attnwarp.io import Dataset
from attnwarp.io.colmap import find_model
from attnwarp.io.images import read_image
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval import sfm
from attnwarp_eval.files import write_atomic

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

FILE = "tracks.npz"

MISFIT = 3.0
"""Median distance, px of the pictures, from a track's image points to its 3D point, beyond
which tracks and cameras belong to different scenes."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """N observations of P points in pictures.

    Attributes:
        image: (N,) index of the camera.
        point: (N,) index of the point, 0 to P - 1.
        xy: (N, 2) float64 px of the camera, pixel centres at +0.5.
        started: (P,) bool, True for a fit's initial points, which are not judged.
    """

    image: Index
    point: Index
    xy: Array
    started: Mask

    def shared(self, a: int, b: int) -> tuple[Index, Index]:
        """Rows of judged points visible in images ``a`` and ``b``: of ``a``, and of ``b``."""
        rows = [np.flatnonzero((self.image == k) & ~self.started[self.point]) for k in (a, b)]
        _, first, second = np.intersect1d(
            self.point[rows[0]], self.point[rows[1]], return_indices=True
        )
        return rows[0][first], rows[1][second]

    def resized(self, before: Sequence[Camera], after: Sequence[Camera]) -> Tracks:
        """These tracks in cameras of other sizes."""
        scale = np.array(
            [[b.width / a.width, b.height / a.height] for a, b in zip(before, after, strict=True)]
        )
        return replace(self, xy=self.xy * scale[self.image])


def world_points(tracks: Tracks, cameras: Sequence[Camera]) -> Array:
    """(P, 3) points nearest to the rays of their observations, in the sense of least squares; NaN
    where the rays are parallel.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp_eval.tracks.find import Tracks, world_points
        >>> view = dict(width=8, height=8, fov_y=60)
        >>> cameras = [Camera.look_at((x, -4, 0), (0, 0, 0), **view) for x in (0, 1)]
        >>> xy = np.concatenate([camera.project([[0, 1, 0]])[0] for camera in cameras])
        >>> tracks = Tracks(np.array([0, 1]), np.array([0, 0]), xy, np.array([False]))
        >>> bool(np.abs(world_points(tracks, cameras) - [0, 1, 0]).max() < 1e-9)
        True
    """
    rays = np.empty((len(tracks.image), 3))
    centers = np.empty_like(rays)
    for k, camera in enumerate(cameras):
        rows = tracks.image == k
        rays[rows] = camera.directions(tracks.xy[rows]) @ camera.rotation
        centers[rows] = camera.position
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    count = len(tracks.started)
    left, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(left, tracks.point, across)
    np.add.at(right, tracks.point, (across @ centers[:, :, None])[:, :, 0])
    points = np.full((count, 3), np.nan)
    solvable = np.linalg.cond(left) < 1e12
    points[solvable] = np.linalg.solve(left[solvable], right[solvable][:, :, None])[:, :, 0]
    return points


def find_tracks(
    data: Path,
    dataset: Dataset,
    kept: Path,
    *,
    model: Path | None = None,
    report: Reporter = SILENT,
) -> Tracks:
    """Tracks of a capture: read from its folder, from a COLMAP model, or computed by pycolmap at
    the capture's poses.

    Args:
        data: path of the capture; ``tracks.npz`` in its folder is read.
        dataset: the capture, every view with a picture and without a lens.
        kept: cache file of tracks, so that a second call does not match pictures again.
        model: COLMAP's sparse model with tracks, in any coordinates; by default that of a COLMAP
            capture.
        report: callback for a line before pictures are matched.

    Raises:
        InputError: pycolmap is missing (MissingExtraError) or fails, no picture of the model
            belongs to the capture, or tracks do not fit the capture's cameras.
    """
    folder = data if data.is_dir() else data.parent
    model = model or find_model(folder)
    beside = folder / FILE
    if beside.is_file():
        tracks = _read(beside, None)
        assert tracks is not None
    else:
        key = _key(dataset, model)
        found = _read(kept, key)
        tracks = found or _made(dataset, model, report)
        if found is None:
            write(tracks, kept, key)
    if tracks.image.size and tracks.image.max() >= len(dataset):
        raise InputError(f"{beside}: names image {tracks.image.max()} of {len(dataset)}")
    _check(tracks, dataset, beside if beside.is_file() else model or data)
    return tracks


def write(tracks: Tracks, path: Path, key: str = "") -> None:
    """Write tracks as a .npz, atomically."""
    buffer = io.BytesIO()
    np.savez(buffer, key=key, **{name: value for name, value in vars(tracks).items()})
    write_atomic(path, buffer.getvalue())


# --------------------------------------------------------------------------------------------------


def _read(path: Path, key: str | None) -> Tracks | None:
    """The tracks of a file; None if missing, or not of ``key``."""
    if not path.is_file():
        return None
    try:
        with np.load(path) as arrays:
            if key is not None and str(arrays["key"]) != key:
                return None
            return Tracks(*(arrays[name] for name in ("image", "point", "xy", "started")))
    except (OSError, KeyError, ValueError, EOFError) as error:
        if key is not None:
            return None
        raise InputError(f"{path}: is no file of tracks ({error}); remove it") from None


def _made(dataset: Dataset, model: Path | None, report: Reporter) -> Tracks:
    """Tracks from a model or from the pictures, in the order of the data set."""
    with tempfile.TemporaryDirectory(prefix="attnwarp-colmap-") as name:
        folder = Path(name)
        if model is not None:
            sfm.run("read", folder, model.resolve())
        else:
            pairs = len(dataset) * (len(dataset) - 1) // 2
            report.log(f"matching {len(dataset)} pictures, {pairs} pairs, by pycolmap")
            paths = [path for path in dataset.image_paths if path is not None]
            images = [_eight_bits(path) for path in paths]
            names = sfm.write_pictures(folder, images, dataset.cameras)
            poses = {
                name: camera.world_to_camera[:3].tolist()
                for name, camera in zip(names, dataset.cameras, strict=True)
            }
            (folder / "poses.json").write_text(json.dumps(poses))
            sfm.run("triangulate", folder, report=report)
        with np.load(folder / "tracks.npz") as arrays:
            found = [str(name) for name in arrays["names"]]
            image, point, places = (arrays[name] for name in ("image", "point", "xy"))
    if model is None:
        order = {name: int(Path(name).stem) for name in found}
    else:
        # By stem, as undistorted pictures are PNG.
        known = {Path(camera.name).stem: k for k, camera in enumerate(dataset.cameras)}
        order = {name: known[Path(name).stem] for name in found if Path(name).stem in known}
        if not order:
            raise InputError(
                f"{model}: none of its {len(found)} pictures, {', '.join(found[:2])} first, is one"
                f" of the capture, {dataset.cameras[0].name} first"
            )
    index = np.array([order.get(name, -1) for name in found], dtype=np.int64)
    image = index[image.astype(np.int64)]
    there = image >= 0
    image, places = image[there], places[there]
    _, point = np.unique(point[there], return_inverse=True)
    xy = np.empty_like(places)
    for k, camera in enumerate(dataset.cameras):
        rows = image == k
        ray = np.column_stack([places[rows], np.ones(int(rows.sum()))])
        xy[rows] = (ray @ camera.K.T)[:, :2]
    count = int(point.max()) + 1 if len(point) else 0
    return Tracks(image, point.astype(np.int64), xy, np.zeros(count, dtype=bool))


def _eight_bits(path: Path) -> npt.NDArray[np.uint8]:
    image = read_image(path)[..., :3]
    return np.asarray(image // 257 if image.dtype == np.uint16 else image, dtype=np.uint8)


def _check(tracks: Tracks, dataset: Dataset, origin: Path) -> None:
    """Refuse tracks whose 3D points reproject far from their observations."""
    if not len(tracks.image):
        raise InputError(
            f"{origin}: no two pictures have points in common; pictures need texture, and overlap"
        )
    points = world_points(tracks, dataset.cameras)
    errors = []
    for k, camera in enumerate(dataset.cameras):
        rows = tracks.image == k
        errors.append(
            np.linalg.norm(camera.project(points[tracks.point[rows]])[0] - tracks.xy[rows], axis=1)
        )
    median = float(np.median(np.nan_to_num(np.concatenate(errors), nan=np.inf)))
    if not median <= MISFIT:
        raise InputError(
            f"{origin}: half of its image points lie more than {median:.1f} px from where the"
            " capture's cameras see their own 3D points, so tracks and cameras are not of one"
            " scene; leave --model out to make tracks at these cameras"
        )


def _key(dataset: Dataset, model: Path | None) -> str:
    """Digest of the cameras, the pictures and the model."""
    digest = hashlib.sha256()
    files = [] if model is None else sorted(p for p in model.iterdir() if p.is_file())
    for camera in dataset.cameras:
        digest.update(json.dumps(camera.to_dict()).encode())
    for path in [*dataset.image_paths, *files]:
        assert path is not None
        with path.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()
