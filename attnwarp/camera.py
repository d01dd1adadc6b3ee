"""Pinhole cameras.

OpenCV axes (x right, y down, z forward). Pixel centres lie at +0.5, so an image spans [0, W] x [0,
H] and resizing it by s maps a pixel coordinate u to exactly u * s. Everything is float64: the
world-to-camera step is where large world coordinates lose their digits first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from attnwarp import check

Array = npt.NDArray[np.float64]

ORTHONORMAL_TOLERANCE = 1e-5
"""Largest entry by which R R^T may differ from the identity. Poses read from float32 files stay
well below it.
"""

EXACT_ROTATION = 1e-12
"""Largest error of a rotation that counts as float64 rounding and is kept bit for bit."""

ROLL, UNSURE = np.radians(2), np.radians(5)
"""Usual roll of a photograph, standard deviation, and largest standard error of a direction up that
counts as known."""

SIDEWAYS = 0.1
"""Least amount by which the right axis leans more than the down axis in a picture on its side."""

SENSE = 0.2
"""Least mean of the pictures' up axes along the direction up that says which of its ends is up."""

SAME_PLACE = 1e-12
"""Distance of two centres, over their coordinates, below which the distance is rounding."""


def nearest_orthonormal(R: Array) -> Array:
    """Compute the orthonormal (3, 3) matrix nearest to ``R``, by SVD."""
    U, _, Vt = np.linalg.svd(R)
    nearest: Array = U @ Vt
    return nearest


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera without lens distortion.

    Args:
        K: (3, 3) intrinsics in pixels: [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]. The principal
            point may lie outside the image.
        world_to_camera: (4, 4) rigid transform from world to camera axes (x right, y down, z
            forward). A rotation that is orthonormal to 1e-12 is kept bit for bit; another is
            replaced by the nearest one, about the same centre of projection.
        width, height: image size in pixels, at least 1.
        name: label for messages; unused in computations.

    Raises:
        ValueError: a wrong shape, a non-finite value, a size that is not an integer, a focal length
            that is not positive, a last row other than [0, 0, 0, 1] ([0, 0, 1] for K), or a
            rotation that is not orthonormal to 1e-5 or mirrors.

    Example:
        >>> from attnwarp import Camera
        >>> camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=8, height=6, fov_y=60)
        >>> xy, z = camera.project([0.0, 0.0, 0.0])
        >>> xy.round(9).tolist(), float(z)
        ([4.0, 3.0], 4.0)
        >>> camera.resize(16, 12).project([0.0, 0.0, 0.0])[0].round(9).tolist()
        [8.0, 6.0]
    """

    K: Array
    world_to_camera: Array
    width: int
    height: int
    name: str = ""

    def __post_init__(self) -> None:
        K = np.array(np.asarray(self.K), dtype=np.float64)
        pose = np.array(np.asarray(self.world_to_camera), dtype=np.float64)
        check.shape(K, (3, 3), "K")
        check.shape(pose, (4, 4), "world_to_camera")
        check.finite(K, "K")
        check.finite(pose, "world_to_camera")
        for name in ("width", "height"):
            value = getattr(self, name)
            if not isinstance(value, Real) or not float(value).is_integer():
                raise ValueError(f"{name}: got {value!r}, expected a whole number of pixels")
        if self.width < 1 or self.height < 1:
            raise ValueError(
                f"width, height: got {self.width} x {self.height}, expected at least 1 x 1"
            )
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise ValueError(
                f"K: got focal lengths fx={K[0, 0]}, fy={K[1, 1]}, expected positive values"
            )
        if K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
            raise ValueError(
                f"K: got {K.tolist()}, expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"
            )
        if not np.array_equal(pose[3], [0, 0, 0, 1]):
            raise ValueError(
                f"world_to_camera: got last row {pose[3].tolist()}, expected [0, 0, 0, 1]"
            )
        R = pose[:3, :3]
        error = float(np.abs(R @ R.T - np.eye(3)).max())
        if error > ORTHONORMAL_TOLERANCE:
            raise ValueError(
                f"world_to_camera: rotation is not orthonormal, max |R R^T - I| = {error:.3g}"
                f" (allowed {ORTHONORMAL_TOLERANCE:g}); remove any scale from the pose or"
                " orthonormalise it"
            )
        if np.linalg.det(R) < 0:
            raise ValueError(
                "world_to_camera: rotation has determinant -1 (it mirrors); flip one axis of the"
                " pose"
            )
        if error > EXACT_ROTATION:
            # R^T replaces the inverse of R; its error times |t| displaces the camera.
            center = -np.linalg.solve(R, pose[:3, 3])
            pose[:3, :3] = nearest_orthonormal(R)
            pose[:3, 3] = -pose[:3, :3] @ center
        K.setflags(write=False)
        pose.setflags(write=False)
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "world_to_camera", pose)
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))

    @classmethod
    def look_at(
        cls,
        position: Sequence[float],
        target: Sequence[float],
        *,
        width: int,
        height: int,
        fov_y: float,
        up: Sequence[float] = (0.0, 0.0, 1.0),
        name: str = "",
    ) -> Camera:
        """Create a camera at ``position`` that looks at ``target``, with square pixels and a
        centred principal point.

        Args:
            position, target: (3,) world points.
            fov_y: vertical field of view in degrees, in (0, 180).
            up: (3,) world direction that points up in the image; not parallel to the view.
        """
        if not 0 < fov_y < 180:
            raise ValueError(f"fov_y: got {fov_y}, expected degrees in (0, 180)")
        eye = np.asarray(position, dtype=np.float64)
        forward = np.asarray(target, dtype=np.float64) - eye
        if np.linalg.norm(forward) == 0:
            raise ValueError(
                f"target: equals position {eye.tolist()}, so the camera has no direction"
            )
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(up, dtype=np.float64))
        if np.linalg.norm(right) < 1e-9:
            raise ValueError(
                f"up: {list(up)} is parallel to the viewing direction {forward.tolist()}"
            )
        right = right / np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3] = R
        pose[:3, 3] = -R @ eye
        f = height / 2 / np.tan(np.radians(fov_y) / 2)
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
        return cls(K, pose, width, height, name)

    @classmethod
    def from_c2w(
        cls,
        camera_to_world: npt.ArrayLike,
        K: npt.ArrayLike,
        width: int,
        height: int,
        *,
        axes: Literal["opencv", "opengl"] = "opencv",
        name: str = "",
    ) -> Camera:
        """Create a camera from a camera-to-world pose, as in Nerfstudio, Blender and many loaders.

        Args:
            camera_to_world: (4, 4) or (3, 4) rigid transform.
            K: (3, 3) intrinsics in pixels.
            width, height: image size in pixels.
            axes: "opencv" (x right, y down, z forward) or "opengl" (x right, y up, z backward), the
                convention of Nerfstudio and Blender.
            name: label of the camera, see :class:`Camera`.

        Raises:
            ValueError: a wrong shape or name of axes, a singular pose, or any value refused by
                :class:`Camera`.

        Example:
            >>> import numpy as np
            >>> from attnwarp import Camera
            >>> pose = np.eye(4)[:3]  # OpenGL's camera at the origin looks along -z
            >>> K = [[8, 0, 4], [0, 8, 3], [0, 0, 1]]
            >>> Camera.from_c2w(pose, K, 8, 6, axes="opengl").project([0.0, 1.0, -2.0])[0].tolist()
            [4.0, -1.0]
        """
        check.one_of(axes, ("opencv", "opengl"), "axes")
        given = np.asarray(camera_to_world, dtype=np.float64)
        if given.shape not in ((3, 4), (4, 4)):
            raise ValueError(f"camera_to_world: got shape {given.shape}, expected (4, 4) or (3, 4)")
        pose = np.eye(4)
        pose[: len(given)] = given
        if axes == "opengl":
            pose = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        try:
            world_to_camera = np.asarray(np.linalg.inv(pose), dtype=np.float64)
            return cls(np.asarray(K), world_to_camera, width, height, name)
        except np.linalg.LinAlgError:
            raise ValueError("camera_to_world: is singular, expected a rigid transform") from None

    @property
    def rotation(self) -> Array:
        """World-to-camera rotation, (3, 3)."""
        return self.world_to_camera[:3, :3]

    @property
    def translation(self) -> Array:
        """World-to-camera translation, (3,)."""
        return self.world_to_camera[:3, 3]

    @property
    def position(self) -> Array:
        """Centre of projection in world coordinates, (3,)."""
        return -self.rotation.T @ self.translation

    @property
    def forward(self) -> Array:
        """Unit viewing direction in world coordinates, (3,)."""
        return self.rotation[2].copy()

    def resize(self, width: int, height: int) -> Camera:
        """Resample the image to ``width`` x ``height``: return the camera of the resized image,
        with u' = u * s exactly on each axis.
        """
        sx, sy = width / self.width, height / self.height
        return Camera(
            np.diag([sx, sy, 1.0]) @ self.K, self.world_to_camera, width, height, self.name
        )

    def moved(self, offset: Sequence[float]) -> Camera:
        """Move the origin of the world: return the camera in a world whose points p become
        p + ``offset``.
        """
        pose = self.world_to_camera.copy()
        pose[:3, 3] = self.translation - self.rotation @ np.asarray(offset, dtype=np.float64)
        return Camera(self.K, pose, self.width, self.height, self.name)

    def relative_to(self, other: Camera) -> Array:
        """Compute the (4, 4) transform from ``other``'s camera axes to this camera's.

        The transform uses the difference of the two centres in float64, so a baseline of 1e-6 in a
        world at 1e6 keeps its digits. A product of the two 4x4 matrices would lose them.
        """
        pose = np.eye(4)
        pose[:3, :3] = self.rotation @ other.rotation.T
        pose[:3, 3] = self.rotation @ (other.position - self.position)
        return pose

    def pixel_centers(self) -> Array:
        """Compute the pixel centres' coordinates (x, y), (H, W, 2)."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([x, y], axis=-1)

    def directions(self, xy: npt.ArrayLike | None = None) -> Array:
        """Compute ray directions K^-1 (x, y, 1) in camera axes with z = 1, so that a point is
        direction * depth.

        Args:
            xy: (..., 2) pixel coordinates; by default the pixel centres, (H, W, 2).

        Returns:
            (..., 3) float64.
        """
        xy = self.pixel_centers() if xy is None else np.asarray(xy, dtype=np.float64)
        # K^-1 by back-substitution on centred coordinates: exact for focal lengths from 1 to 1e5
        # px.
        y = (xy[..., 1] - self.K[1, 2]) / self.K[1, 1]
        x = (xy[..., 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def project(self, points: npt.ArrayLike) -> tuple[Array, Array]:
        """Project world points to pixels.

        Args:
            points: (..., 3) world coordinates.

        Returns:
            xy: (..., 2) pixels; NaN for points not in front of the camera (z <= 0).
            z: (...) depth along the optical axis, of either sign.
        """
        camera = (np.asarray(points, dtype=np.float64) - self.position) @ self.rotation.T
        z = camera[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            normalised = np.where(
                (z > 0)[..., None], camera / np.where(z > 0, z, np.nan)[..., None], np.nan
            )
        return (normalised @ self.K.T)[..., :2], z

    def unproject(self, xy: npt.ArrayLike, depth: npt.ArrayLike) -> Array:
        """Compute (..., 3) world points at ``depth`` (along the optical axis) behind pixels ``xy``
        (..., 2).
        """
        camera = self.directions(xy) * np.asarray(depth, dtype=np.float64)[..., None]
        return camera @ self.rotation + self.position

    def to_dict(self) -> dict[str, Any]:
        """Convert to JSON values, from which :meth:`from_dict` restores the camera bit for bit."""
        return {
            "K": self.K.tolist(),
            "world_to_camera": self.world_to_camera.tolist(),
            "width": self.width,
            "height": self.height,
            "name": self.name,
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Camera:
        """Restore the camera from the result of :meth:`to_dict`."""
        return cls(**data)


def fundamental(view: Camera, key: Camera) -> Array | None:
    """Compute the fundamental matrix F, (3, 3) float64: y^T F x = 0 for pixels x of ``view`` and y
    of ``key`` that see one point; None if the centres of projection coincide.

    F = K_key^-T [t]_x R K_view^-1 with the motion (R, t) from ``view`` to ``key`` (Hartley and
    Zisserman 2004, section 9.2). F's scale is that of t.

    Example:
        >>> from attnwarp.camera import Camera, fundamental
        >>> view = dict(width=8, height=8, fov_y=60, up=(0, 1, 0))
        >>> left = Camera.look_at((0, 0, 3), (0, 0, 0), **view)
        >>> right = Camera.look_at((1, 0, 3), (1, 0, 0), **view)
        >>> line = fundamental(left, right) @ [2.5, 3.5, 1.0]  # a row of pixels
        >>> bool(abs(line[0]) < 1e-12), round(float(-line[2] / line[1]), 9)
        (True, 3.5)
    """
    scale = np.linalg.norm(view.position) + np.linalg.norm(key.position)
    if np.linalg.norm(view.position - key.position) <= SAME_PLACE * scale:
        return None
    pose = key.relative_to(view)
    x, y, z = pose[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential = cross @ pose[:3, :3]
    return np.asarray(np.linalg.inv(key.K).T @ essential @ np.linalg.inv(view.K))


def meeting_point(cameras: Sequence[Camera]) -> npt.NDArray[np.float64] | None:
    """Compute the (3,) world point nearest to all optical axes; None if they are parallel.

    Example:
        >>> from attnwarp.trial import view
        >>> bool(np.abs(meeting_point([view(0), view(3, 0)])).max() < 1e-9)
        True
        >>> meeting_point([view(0)]) is None
        True
    """
    centers = np.stack([camera.position for camera in cameras])
    forward = np.stack([camera.forward for camera in cameras])
    # Least squares over the distances to the axes: sum_i (I - f f^T)(p - c) = 0.
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    middle, system = centers.mean(0), across.sum(0)
    if not np.linalg.eigvalsh(system)[0] > 1e-3 * len(cameras):
        return None
    offset = np.linalg.solve(system, np.einsum("nij,nj->i", across, centers - middle))
    return np.asarray(middle + offset)


def up_of(cameras: Sequence[Camera]) -> tuple[npt.NDArray[np.float64], bool]:
    """Estimate the upward direction from pictures that are level, or level on their side.

    The direction is the one most orthogonal to all pictures' level edges: lower edges, or side
    edges of pictures that were stored on their side. Most pictures decide which end is up. Pictures
    that all look one way say this to the pitch alone, and pictures rolled at random say nothing;
    the direction is then near the mean of the cameras' up axes.

    Returns:
        up: (3,), of length 1.
        known: True if its standard error is at most :data:`UNSURE`, and the pictures' sense agrees.

    Example:
        >>> from attnwarp.camera import Camera, up_of
        >>> view = dict(width=8, height=8, fov_y=40)
        >>> side = [Camera.look_at((x, 3, 2), (0, 0, 0), **view) for x in (-2, -1, 0, 1, 2)]
        >>> up, known = up_of(side)
        >>> bool(up[2] > 0.999), known  # though all of them look down
        (True, True)
        >>> up_of(side[:1])[1]
        False
    """
    axes = np.stack([camera.rotation[:2] for camera in cameras])
    upright, count = -axes[:, 1].mean(0), len(axes)
    up = upright
    for _ in range(5):
        right, down = np.abs(axes @ up).T
        level = np.where((right > down + SIDEWAYS)[:, None], axes[:, 1], axes[:, 0])
        values, vectors = np.linalg.eigh(level.T @ level / count)
        up = vectors[:, 0]
    # Variance of an eigenvector. Rolls of few pictures look smaller than they are.
    small, large, _ = values.clip(ROLL**2)
    found = bool(np.sqrt(small * large / count) < UNSURE * (large - small))
    if not found:
        right = axes[:, 0]
        tilt = right.T @ right / count - 0.005 * np.outer(upright, upright)
        up = np.linalg.eigh(tilt)[1][:, 0]
    sense = float(up @ upright)
    return np.asarray(up if sense >= 0 else -up), found and abs(sense) > SENSE
