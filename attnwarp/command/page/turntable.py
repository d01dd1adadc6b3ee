"""Orbit cameras around a scene, near the capture's cameras, and a film of their renders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera, meeting_point, up_of
from attnwarp.errors import InputError
from attnwarp.gaussians import Gaussians
from attnwarp.io.file import write_atomically
from attnwarp.methods.pictures import Bytes, to_bytes
from attnwarp.methods.scene import near_of, render_picture

Array = npt.NDArray[np.float64]

FRAMES = 36
"""Frames per turn: one every 10 degrees."""

SPEED = 12
"""Frames per second of a film."""

LONGEST = 320
"""Longest side of a frame in px."""

ALL_AROUND = np.radians(120)
"""Largest gap between the directions of cameras that count as surrounding the scene."""

SMOOTH = np.radians(15)
"""Width of the moving mean over neighbouring cameras' heights and distances."""

FILMS = (".gif", ".mp4")


def focus_of(cameras: Sequence[Camera], points: Array) -> Array:
    """Compute the (3,) world point that cameras look at: nearest to all optical axes.

    If the axes are parallel or diverge, the point lies at the scene's distance before the cameras.
    """
    positions = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.forward for camera in cameras])
    depths = []
    for camera in cameras:
        xy, z = camera.project(points)
        seen = (z > 0) & (xy >= 0).all(axis=1) & (xy <= (camera.width, camera.height)).all(axis=1)
        depths += [float(np.median(z[seen]))] if seen.any() else []
    ahead = positions + axes * (np.median(depths) if depths else 1.0)
    point = meeting_point(cameras)
    if point is None or ((point - positions) * axes).sum(axis=1).mean() <= 0:
        return np.asarray(ahead.mean(axis=0))
    return point


def degrees_apart(one: Camera, other: Camera, middle: Array) -> float:
    """Compute the angle in degrees between two cameras' directions to the middle of a scene, (3,).

    Example:
        >>> import numpy as np
        >>> from attnwarp.trial import view
        >>> round(degrees_apart(view(), view(3, 0), np.zeros(3)))
        90
    """
    cosine = _unit(middle - one.position) @ _unit(middle - other.position)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def orbit(cameras: Sequence[Camera], points: Array, *, first: int = 0) -> list[Camera]:
    """Create cameras that orbit the point a capture looks at: all around, or to and fro if the
    capture was taken from one side.

    Args:
        cameras: cameras of the capture; the orbit's height and distance follow those nearby.
        first: number of the camera at which a full turn begins.

    Returns:
        :data:`FRAMES` cameras; the last leads to the first.
    """
    focus, up = focus_of(cameras, points), up_of(cameras)[0]
    ahead = focus - cameras[first].position
    east = ahead - (ahead @ up) * up
    east = _unit(
        east if np.linalg.norm(east) > 1e-6 else np.cross(up, np.eye(3)[np.argmin(abs(up))])
    )
    north = np.cross(up, east)
    away = np.stack([camera.position for camera in cameras]) - focus
    heights, angles = away @ up, np.arctan2(away @ north, away @ east)
    distances = np.hypot(away @ north, away @ east)
    ordered = np.sort(angles)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    turn = 2 * np.pi * np.arange(FRAMES) / FRAMES
    if gaps[widest] > ALL_AROUND:
        begin = ordered[(widest + 1) % len(ordered)]
        half = (2 * np.pi - gaps[widest]) / 2
        turn = begin + half + max(half, SMOOTH / 2) * np.sin(turn)
    else:
        turn = turn + angles[first]
    sides = np.array([[camera.width, camera.height] for camera in cameras])
    w, h = (sides[first] * min(1.0, LONGEST / sides[first].max())).round().astype(int).clip(1)
    fov = np.degrees(2 * np.arctan(cameras[first].height / (2 * cameras[first].K[1, 1])))
    result = []
    for number, angle in enumerate(turn):
        apart = (angles - angle + np.pi) % (2 * np.pi) - np.pi
        weights = np.exp(-0.5 * ((apart / SMOOTH) ** 2 - ((apart / SMOOTH) ** 2).min()))
        height, distance = (weights @ values / weights.sum() for values in (heights, distances))
        place = focus + height * up + distance * (np.cos(angle) * east + np.sin(angle) * north)
        result.append(
            Camera.look_at(
                tuple(place), tuple(focus), up=tuple(up), width=int(w), height=int(h),
                fov_y=float(fov), name=f"orbit-{number:02d}",
            )
        )  # fmt: skip
    return result


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def renders(gaussians: Gaussians, cameras: Sequence[Camera]) -> list[Bytes]:
    """Render splats from each camera, (H, W, 3) uint8."""
    near = near_of(cameras, gaussians)
    return [to_bytes(render_picture(gaussians, camera, near, "auto")) for camera in cameras]


def check_film(path: Path | None) -> None:
    """Refuse a film of an unsupported format."""
    if path is not None and path.suffix.lower() not in FILMS:
        raise InputError(f"--turntable: got {path}, expected a name ending in {' or '.join(FILMS)}")


def write_film(path: Path, before: Sequence[Bytes], after: Sequence[Bytes]) -> None:
    """Write a turn as GIF or MP4, before on the left and after on the right."""
    check_film(path)
    frames = []
    for pair in zip(before, after, strict=True):
        both = np.concatenate(pair, axis=1)
        h, w = (side - side % 2 for side in both.shape[:2])  # MP4's chroma needs even sides
        frames.append(both if path.suffix.lower() == ".gif" else both[:h, :w])
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".gif":
        from PIL import Image

        first, *others = [Image.fromarray(frame) for frame in frames]
        write_atomically(
            path,
            lambda stream: first.save(
                stream, "GIF", save_all=True, append_images=others, loop=0,
                duration=round(1000 / SPEED),
            ),
        )  # fmt: skip
        return
    import cv2

    h, w = frames[0].shape[:2]
    code = cv2.VideoWriter.fourcc(*"mp4v")
    film = cv2.VideoWriter(str(path), code, SPEED, (w, h))
    for frame in frames:
        film.write(np.ascontiguousarray(frame[..., ::-1]))
    film.release()
