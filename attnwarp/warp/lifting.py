"""Masks lifted through splats: from masks of a few views to the mask of any other view.

A splat's membership in a mask is the share of its weight on marked pixels. Splats seen by no masked
view follow their neighbours: they get the probability that a random walk over splats near in
position, normal and colour reaches a marked splat first (Grady, "Random Walks for Image
Segmentation", PAMI 2006).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.devices import on_cpu_unless_named, with_gradients
from attnwarp.gaussians import SH_C0, Gaussians
from attnwarp.render import Render, render
from attnwarp.warp.view import near_plane

NEIGHBORS = 16
"""Number of neighbours to which each splat is tied."""

COLOR_SPREAD, NORMAL_SPREAD = 0.1, 0.3
"""Difference of two splats' sRGB colours, and the sine of the angle between their normals, at which
their tie is exp(-1/2) as strong as the tie of equal splats."""

SEEN = 0.1
"""Smallest visible share of a splat's footprint for its votes to count. A smaller share shines
through an occluder, or is the rim of a splat behind an object's outline."""

TRUST = 30.0
"""Strength of a fully visible splat's votes, in units of the strongest tie."""

OPPOSED = 0.25
"""Smallest distance from 1/2 of two views' votes on a splat that count as contradictory."""


@dataclass(frozen=True, eq=False)
class LiftedMask:
    """Part of a scene of N splats marked by masks of a few views; built by :func:`lift_masks`.

    Attributes:
        membership: (N,) float64 in [0, 1]: each splat's membership in the marked part.
        seen: (N,) bool: splats visible in a masked view, whose votes decide.
        reached: (N,) bool: splats seen, or tied to seen ones; all others get membership 0.
        disputed: (N,) bool: splats seen by several masked views whose votes contradict each
            other.
        agreement: for each mask, its intersection over union with the rendered membership; NaN if
            both are empty.

    Example:
        >>> import numpy as np
        >>> from attnwarp.trial import disc, view
        >>> from attnwarp.warp import lift_masks
        >>> front, back = (view(z=z, side=8) for z in (3, -3))
        >>> lifted = lift_masks(disc(0.3), [front], [np.ones((8, 8), dtype=bool)])
        >>> lifted.seen.tolist(), bool(lifted.render(back)[4, 4] > 0.5)
        ([True], True)
    """

    gaussians: Gaussians
    near: float | None
    backend: str
    membership: npt.NDArray[np.float64]
    seen: npt.NDArray[np.bool_]
    reached: npt.NDArray[np.bool_]
    disputed: npt.NDArray[np.bool_]
    agreement: tuple[float, ...]

    def render(self, camera: Camera) -> npt.NDArray[np.float32]:
        """Render the marked share of each pixel, (H, W) in [0, 1]; above 1/2 is inside.

        Pixels without splats are 0.
        """
        return _shown(self.gaussians, self.membership, camera, self.near, self.backend)


@on_cpu_unless_named
@with_gradients
def lift_masks(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    masks: Sequence[npt.NDArray[Any]],
    *,
    kept: Sequence[npt.NDArray[np.bool_] | None] | None = None,
    near: float | None = None,
    backend: str = "auto",
) -> LiftedMask:
    """Lift masks of one object in one or a few views through splats.

    A splat's vote is the mean of the mask over its pixels, weighed by its contribution to each.
    That mean is one derivative: of sum(mask * picture) with respect to a value drawn with the
        splat. The
    memberships x minimise sum_i c_i (x_i - vote_i)^2 + sum_ij t_ij (x_i - x_j)^2: c grows with the
    visible share of a splat's footprint, and t ties neighbours that are alike in normal and colour.
    So seen splats keep their votes, and unseen ones get the probability that a random walk from
    them ends at a marked splat.

    Args:
        gaussians: N splats of kind "2d" or "3d".
        cameras: cameras of the masked views.
        masks: (h, w) of each view, bool or floating in [0, 1], of the camera's aspect ratio at any
            size. Everything unmarked is outside, so each mask must cover the object's visible part
            completely.
        kept: (h, w) bool of each view, at the size of its mask, or None: False where the view's
            picture is to be ignored, so that its pixels have no vote.
        near: near-plane depth, in scene units; by default a hundredth of the splats' median
            distance in each view.
        backend: renderer name, as for :func:`attnwarp.render.render`.

    Raises:
        ValueError: no masks, a wrong number of cameras, or a mask of wrong shape, type or range;
            the message names the argument.

    Example:
        A wall of two colours: the mask of its left half, seen from the front, from the side.

        >>> import numpy as np, torch
        >>> from attnwarp import Gaussians
        >>> from attnwarp.trial import view
        >>> from attnwarp.warp import lift_masks
        >>> x, y = torch.meshgrid(*[torch.linspace(-1, 1, 40)] * 2, indexing="ij")
        >>> place = torch.stack([x, y, 0 * x], dim=-1).reshape(-1, 3)
        >>> color = torch.where(place[:, :1] < 0, torch.tensor([[1.0, 0, 0]]), torch.ones(1, 3))
        >>> wall = Gaussians("2d", place, torch.tensor([[1.0, 0, 0, 0]]).repeat(1600, 1),
        ...                  torch.full((1600, 2), 0.04), torch.full((1600,), 0.99),
        ...                  Gaussians.sh_from_rgb(color))
        >>> front, side = view(0), view(2, 2.5)
        >>> left = np.arange(32) < 16
        >>> lifted = lift_masks(wall, [front], [np.broadcast_to(left, (32, 32))])
        >>> seen_from_side = lifted.render(side) > 0.5
        >>> bool(seen_from_side[16, 8]), bool(seen_from_side[16, 24])
        (True, False)
    """
    check.instance(gaussians, Gaussians, "gaussians", "attnwarp.Gaussians")
    if not len(masks):
        raise ValueError("masks: got none, expected at least one")
    if len(cameras) != len(masks):
        raise ValueError(f"cameras: got {len(cameras)}, expected {len(masks)}, one for each mask")
    splats = gaussians.detach()
    checked = [
        _checked_mask(mask, camera, f"masks[{k}]")
        for k, (mask, camera) in enumerate(zip(masks, cameras, strict=True))
    ]
    views = [
        camera.resize(mask.shape[1], mask.shape[0])
        for mask, camera in zip(checked, cameras, strict=True)
    ]
    count = len(splats)
    marked, weight, trust = (np.zeros(count) for _ in range(3))
    inside, outside = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    voting = [
        np.ones(mask.shape, dtype=bool) if part is None else part
        for mask, part in zip(checked, kept or [None] * len(checked), strict=True)
    ]
    for mask, part, view in zip(checked, voting, views, strict=True):
        votes, total = _votes(splats, mask, _counted(mask) & part, view, near, backend)
        share = np.minimum(1, total / footprints(splats, view))
        counts = share >= SEEN
        marked += np.where(counts, votes, 0)
        weight += np.where(counts, total, 0)
        trust = np.maximum(trust, np.where(counts, share, 0))
        own = votes / np.maximum(total, np.finfo(float).tiny)
        inside |= counts & (own > 0.5 + OPPOSED)
        outside |= counts & (own < 0.5 - OPPOSED)
    seen = trust > 0
    vote = np.where(seen, marked / np.maximum(weight, np.finfo(float).tiny), 0)
    membership, reached = _settled(splats, vote, TRUST * trust**2)
    agreement = []
    for mask, part, view in zip(checked, voting, views, strict=True):
        mine = part & (_shown(splats, membership, view, near, backend) > 0.5)
        given = part & (mask > 0.5)
        union = int((mine | given).sum())
        agreement.append(int((mine & given).sum()) / union if union else float("nan"))
    return LiftedMask(
        splats, near, backend, membership, seen, reached, inside & outside, tuple(agreement)
    )


def _checked_mask(mask: Any, camera: Camera, name: str) -> npt.NDArray[np.float32]:
    array = np.asarray(mask)
    check.shape(array, ("h", "w"), name)
    if array.dtype != np.bool_ and array.dtype.kind != "f":
        raise ValueError(f"{name}: got {array.dtype}, expected bool, or floating in [0, 1]")
    check.finite(array, name)
    if array.size and (array.min() < 0 or array.max() > 1):
        raise ValueError(f"{name}: got values to {array.max():g}, expected [0, 1]")
    full = (camera.height, camera.width)
    remedy = f"crop or pad it to the view {camera.name!r}"
    check.same_aspect((array.shape[0], array.shape[1]), full, name, remedy)
    return array.astype(np.float32)


def _votes(
    splats: Gaussians,
    mask: npt.NDArray[np.float32],
    counted: npt.NDArray[np.bool_],
    camera: Camera,
    near: float | None,
    backend: str,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Sum w_i mask, and w_i, over counted pixels, (N,) each."""
    values = torch.zeros(
        len(splats), 2, dtype=torch.float32, device=splats.means.device, requires_grad=True
    )
    picture = _picture(splats, values, camera, near, backend)
    marks = torch.from_numpy(np.stack([mask * counted, counted], axis=-1))
    (sums,) = torch.autograd.grad((picture.color * marks.to(picture.color)).sum(), values)
    first, second = sums.double().cpu().numpy().T
    return first, second


def _counted(mask: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Select the pixels whose votes count, (h, w) bool: all but those along a mask's outline.

    Splats of both sides appear at an outline with protruding rims. The inside of a part too thin to
    have anything but an outline counts.
    """
    import cv2

    square = np.ones((3, 3), np.uint8)
    inside = (mask > 0.5).astype(np.uint8)
    core = cv2.erode(inside, square, borderType=cv2.BORDER_REPLICATE)
    thin = (inside > 0) & (cv2.dilate(core, square) == 0)
    return (core > 0) | thin | (cv2.dilate(inside, square) == 0)


def _shown(
    splats: Gaussians,
    membership: npt.NDArray[np.float64],
    camera: Camera,
    near: float | None,
    backend: str,
) -> npt.NDArray[np.float32]:
    values = torch.from_numpy(membership).to(splats.means)[:, None]
    with torch.no_grad():
        picture = _picture(splats, values, camera, near, backend)
        share = picture.color[..., 0] / picture.alpha.clamp_min(1e-6)
    return np.asarray(share.clamp(0, 1).float().cpu().numpy())


def _picture(
    splats: Gaussians, values: torch.Tensor, camera: Camera, near: float | None, backend: str
) -> Render:
    plane = near_plane(splats, camera) if near is None else near
    return render(splats, camera, features=values, near=plane, backend=backend)


def footprints(splats: Gaussians, camera: Camera) -> npt.NDArray[np.float64]:
    """Sum each splat's unoccluded opacity over a picture, (N,) px.

    The sum is 2 pi opacity sqrt(det S), with S the splat's projected covariance (EWA splatting,
    Zwicker et al. 2001) plus the screen filter. A splat behind the camera gets 1.

    Example:
        >>> from attnwarp.render import render
        >>> from attnwarp.trial import disc, view
        >>> drawn = float(render(disc(0.2), view()).weight[0])
        >>> bool(abs(footprints(disc(0.2), view())[0] / drawn - 1) < 0.1)
        True
    """
    place = (splats.world_means() - camera.position) @ camera.rotation.T
    ahead = place[:, 2] > 0
    z = np.where(ahead, place[:, 2], 1.0)
    axes = (splats.rotations()[:, :, : splats.scales.shape[1]] * splats.scales[:, None]).double()
    turned = camera.rotation @ axes.cpu().numpy()
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    across = fx * (turned[:, 0] - turned[:, 2] * (place[:, 0] / z)[:, None]) / z[:, None]
    down = fy * (turned[:, 1] - turned[:, 2] * (place[:, 1] / z)[:, None]) / z[:, None]
    xx, yy = ((v * v).sum(-1) + splats.screen_filter for v in (across, down))
    xy = (across * down).sum(-1)
    area = 2 * np.pi * np.sqrt(np.maximum(xx * yy - xy * xy, 0))
    return np.where(ahead, area * splats.opacities.double().cpu().numpy() + 1e-9, 1.0)


def _settled(
    splats: Gaussians, vote: npt.NDArray[np.float64], trust: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Solve for memberships from votes and ties; flag the splats tied to any seen splat."""
    from scipy.sparse import diags
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import cg

    ties = _ties(splats)
    _, part = connected_components(ties, directed=False)
    reached = np.isin(part, np.unique(part[trust > 0]))
    if not (vote * trust).any():
        return np.zeros(len(vote)), reached
    # Splats that no vote reaches are fixed at 0, so that the system has one solution.
    held = np.where(reached, trust, 1.0)
    degree = np.asarray(ties.sum(axis=1)).ravel()
    system = diags(degree + held) - ties
    jacobi = diags(1 / (degree + held))
    solved, failed = cg(system, held * vote, x0=vote, rtol=1e-4, maxiter=2000, M=jacobi)
    if failed:
        warnings.warn("lift_masks: unseen splats did not settle", RuntimeWarning, stacklevel=4)
    return np.clip(np.where(reached, solved, 0), 0, 1), reached


def _ties(splats: Gaussians) -> Any:
    """Compute sparse symmetric ties of neighbours, (N, N) in [0, 1]."""
    from scipy.sparse import coo_array
    from scipy.spatial import cKDTree

    place = splats.world_means()
    count = len(place)
    k = min(NEIGHBORS, count - 1)
    if k < 1:
        return coo_array((count, count)).tocsr()
    distance, other = cKDTree(place).query(place, k=k + 1)
    distance, other = distance[:, 1:], other[:, 1:]
    own = np.broadcast_to(np.arange(count)[:, None], other.shape)
    reach = np.median(distance, axis=1)
    crowded = reach == 0
    if crowded.any():
        # Coincident copies use the spacing of distinct places; a single place allows any length.
        places = np.unique(place, axis=0)
        k = min(NEIGHBORS, len(places) - 1)
        apart, _ = cKDTree(places).query(place[crowded], k=k + 1)
        reach[crowded] = np.median(apart[:, 1:], axis=1) if k else 1.0
    near = (distance / reach[:, None]) * (distance / reach[other])
    normal = splats.normals().double().cpu().numpy()
    bend = 1 - (normal[own] * normal[other]).sum(-1) ** 2
    color = splats.sh[:, 0].double().cpu().numpy() * SH_C0
    paint = ((color[own] - color[other]) ** 2).sum(-1)
    tie = np.exp(-near / 2 - bend / (2 * NORMAL_SPREAD**2) - paint / (2 * COLOR_SPREAD**2))
    one = coo_array((tie.ravel(), (own.ravel(), other.ravel())), shape=(count, count)).tocsr()
    return one.maximum(one.T)
