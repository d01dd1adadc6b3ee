"""Everything about one target pixel: depths, positions, each rule's verdict and its margin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.warp import angle_between, depth_slope, sample, sample_depth
from attnwarp_eval.inspect.pair import LABELS, Pair

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Verdict:
    """A rule at one pixel.

    Attributes:
        rule: its name.
        passed: what the rule says.
        margin: how far the pixel is from the other verdict, positive where it passes; NaN where
            the quantity is undefined.
        unit: of the margin.

    Example:
        >>> Verdict("in_front", passed=False, margin=-0.2, unit="scene units").passed
        False
    """

    rule: str
    passed: bool
    margin: float
    unit: str


@dataclass(frozen=True)
class PixelReport:
    """What is known of a target pixel.

    Attributes:
        column, row: of the pixel.
        label: of the truth: none, visible, hidden or ambiguous.
        object: name of the object that the pixel shows, or "".
        point: (3,) true surface point in the world; NaN without a surface.
        depths: z along the target's axis, by definition.
        true_xy, xy: source pixel coordinates, exact and of the warp.
        true_z, z: depth in the source camera, exact and of the warp.
        source_depth: depth that the source itself has at ``xy``; NaN where it has none.
        tolerance: of the depth agreement there.
        verdicts: every rule that was applied, in order.
        accepted: all rules together.
        blocker: (3,) what the source really sees toward the point; equal to ``point`` where the
            way is free.
        blocked_by: name of the object there, or "" where the way is free.

    Example:
        >>> from attnwarp.warp import PRESETS
        >>> from attnwarp_eval.splats.surface import surface_splats
        >>> from attnwarp_eval.world import world
        >>> scene = world("spheres", 16)
        >>> model = surface_splats(scene.scene, count=2000)
        >>> pair = Pair(scene, "yaw030", PRESETS["corrected"], model)
        >>> print(report(pair, 8, 12).lines()[0])
        pixel (8, 12) marble: visible
    """

    column: int
    row: int
    label: str
    object: str
    point: Vector
    depths: dict[str, float]
    true_xy: Vector
    xy: Vector
    true_z: float
    z: float
    source_depth: float
    tolerance: float
    verdicts: tuple[Verdict, ...]
    accepted: bool
    blocker: Vector
    blocked_by: str

    @property
    def endpoint_error(self) -> float:
        """Distance between the warp's position and the exact one, in source pixels."""
        return float(np.linalg.norm(self.xy - self.true_xy))

    def lines(self) -> list[str]:
        """The report in words, a line each."""
        text = [f"pixel ({self.column}, {self.row}) {self.object or 'nothing'}: {self.label}"]
        text += [f"depth, {name}: {value:.5g}" for name, value in self.depths.items()]
        text.append(f"in the source: ({self.xy[0]:.2f}, {self.xy[1]:.2f}) px")
        text.append(f"  exact ({self.true_xy[0]:.2f}, {self.true_xy[1]:.2f}), z {self.true_z:.5g}")
        text.append(f"  endpoint error {self.endpoint_error:.3g} px, z {self.z:.5g}")
        text.append(f"  source depth {self.source_depth:.5g}, tolerance {self.tolerance:.3g}")
        for verdict in self.verdicts:
            word = "pass" if verdict.passed else "FAIL"
            text.append(f"{word} {verdict.rule}: margin {verdict.margin:.3g} {verdict.unit}")
        text.append("accepted" if self.accepted else "rejected")
        if self.blocked_by:
            text.append(f"hidden behind: {self.blocked_by}")
        return text


def report(pair: Pair, column: int, row: int) -> PixelReport:
    """Everything about one target pixel.

    Args:
        pair: the views and the variant.
        column, row: of the pixel.

    Raises:
        ValueError: the pixel lies outside the target's image.

    Example:
        >>> from attnwarp.warp import PRESETS
        >>> from attnwarp_eval.splats.surface import surface_splats
        >>> from attnwarp_eval.world import world
        >>> scene = world("spheres", 16)
        >>> model = surface_splats(scene.scene, count=2000)
        >>> pair = Pair(scene, "yaw030", PRESETS["corrected"], model)
        >>> report(pair, 8, 12).endpoint_error < 1
        True
    """
    truth, view = pair.truth, pair.view
    height, width = truth.label.shape
    if not (0 <= column < width and 0 <= row < height):
        raise ValueError(
            f"pixel: got ({column}, {row}), expected a column below {width} and a row below"
            f" {height}"
        )
    pixel = row, column
    names = pair.world.scene.object_names
    hits = truth.hits
    blocker, blocked_by = _blocker(pair, hits.point[pixel], int(hits.primitive_id[pixel]))
    source_depth, tolerance = _source_depth(pair, pixel)
    return PixelReport(
        column=column,
        row=row,
        label=LABELS[int(truth.label[pixel])],
        object=names[hits.object_id[pixel]] if hits.valid[pixel] else "",
        point=hits.point[pixel],
        depths={name: float(depth[pixel]) for name, depth in pair.depths.items()},
        true_xy=truth.xy[pixel],
        xy=view.correspondence.xy[pixel].numpy(),
        true_z=float(truth.z_source[pixel]),
        z=float(view.correspondence.z[pixel]),
        source_depth=source_depth,
        tolerance=tolerance,
        verdicts=tuple(
            Verdict(name, bool(mask[pixel]), *_margin(pair, name, pixel))
            for name, mask in view.rules.items()
        ),
        accepted=bool(view.mask[pixel]),
        blocker=blocker,
        blocked_by=blocked_by,
    )


def _blocker(pair: Pair, point: Vector, primitive: int) -> tuple[Vector, str]:
    if not np.isfinite(point).all():
        return point, ""
    geometry, eye = pair.world.geometry, pair.world.source.position
    if geometry.reached(eye, point[None], [primitive])[0]:
        return point, ""
    hits = geometry.trace_rays(eye, (point - eye)[None])
    return hits.point[0], pair.world.scene.object_names[hits.object_id[0]]


def _source_depth(pair: Pair, pixel: tuple[int, int]) -> tuple[float, float]:
    """Depth that the source has at the warp's position, and the tolerance of the agreement."""
    settings, correspondence = pair.settings, pair.view.correspondence
    depth = torch.as_tensor(np.asarray(pair.surfaces[0].depth, dtype=np.float64))
    seen = sample_depth(depth, correspondence, spread=settings.depth_spread)[pixel]
    slope = sample(depth_slope(depth)[None], correspondence, mode="nearest")[0][0][pixel]
    tolerance = settings.depth_relative * correspondence.z[pixel]
    tolerance = tolerance + settings.depth_slope * torch.nan_to_num(slope, nan=0.0)
    return float(seen), float(tolerance)


def _margin(pair: Pair, rule: str, pixel: tuple[int, int]) -> tuple[float, str]:
    """How far a pixel is from the other verdict of a rule, and the unit."""
    settings, correspondence = pair.settings, pair.view.correspondence
    source, _ = pair.surfaces
    if rule == "defined":
        return float(pair.view.target.depth[pixel]), "of depth"
    if rule == "in_bounds":
        camera = correspondence.source if settings.bounds == "source" else correspondence.target
        # With integer centres the rule holds the index against the border, as the method does.
        slip = 0.5 if correspondence.pixel_centers == "integer" else 0.0
        x, y = (correspondence.xy[pixel] - slip).tolist()
        return min(x, y, camera.width - x, camera.height - y), "px to the border"
    if rule == "in_front":
        return float(correspondence.z[pixel]), "of depth"
    if rule == "opaque" and settings.opaque is not None:
        margins = []
        if pair.view.target.alpha is not None:
            margins.append(float(pair.view.target.alpha[pixel]) - settings.opaque)
        if source.alpha is not None:
            alpha = torch.as_tensor(np.asarray(source.alpha, dtype=np.float64))
            sampled, inside = sample(alpha[None], correspondence)
            if not inside[pixel]:
                return float("nan"), "of alpha: outside the source image"
            margins.append(float(sampled[0][pixel]) - settings.opaque)
        return min(margins, default=float("nan")), "of alpha"
    if rule == "depth_agrees":
        depth, tolerance = _source_depth(pair, pixel)
        return tolerance - abs(float(correspondence.z[pixel]) - depth), "of depth"
    if rule == "photometric" and settings.photometric is not None:
        image = torch.as_tensor(np.asarray(pair.images[0], dtype=np.float64))
        warped = sample(image.permute(2, 0, 1), correspondence)[0][(slice(None), *pixel)].numpy()
        away = np.abs(warped - np.asarray(pair.images[1])[pixel]).mean()
        return settings.photometric - float(away), "of colour"
    if rule in ("facing", "source_incidence"):
        limit = 90.0 if rule == "facing" else settings.normal_angle
        return limit - _incidence(pair, pixel), "degrees of incidence"
    return float("nan"), "(no single quantity)"


def _incidence(pair: Pair, pixel: tuple[int, int]) -> float:
    """Degrees between the warp's normal, flipped to the target, and the ray to the source."""
    correspondence = pair.view.correspondence
    normal = torch.as_tensor(np.asarray(pair.view.target.normal, dtype=np.float64)[pixel])
    source = torch.from_numpy(correspondence.source.rotation.copy())
    point = source.T @ correspondence.points[pixel]
    to_source = -point
    offset = correspondence.source.position - correspondence.target.position
    to_target = to_source - torch.from_numpy(offset)
    if normal @ to_target < 0:
        normal = -normal
    return float(angle_between(normal, to_source))
