"""Report on one target pixel: depths, positions, each rule's verdict and its margin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from attnwarp_eval.inspect.pair import LABELS, Pair

Vector = npt.NDArray[np.float64]

NEARER = 1e-6
"""Least share of the distance by which an occluder must be nearer than the point."""


@dataclass(frozen=True)
class Verdict:
    """Verdict of a rule at one pixel.

    Attributes:
        passed: verdict of the rule.
        margin: distance of the pixel to the other verdict, positive if it passes; NaN if
            the quantity is undefined.
    """

    rule: str
    passed: bool
    margin: float
    unit: str


@dataclass(frozen=True)
class Exact:
    """The truth of a target pixel.

    Attributes:
        label: none, visible, hidden or ambiguous.
        object: name of the object that the pixel shows, or "".
        xy: (2,) source pixel coordinates of its surface point.
        z: depth of the point in the source camera.
        blocked_by: name of the object that the source sees instead, or "" if the way is free.
    """

    label: str
    object: str
    xy: Vector
    z: float
    blocked_by: str


@dataclass(frozen=True)
class PixelReport:
    """Report on a target pixel.

    Attributes:
        point: (3,) surface point in the world; NaN without a surface.
        depths: z along the target's axis, by definition.
        xy: (2,) source pixel coordinates of the warp.
        z: depth of the warp's point in the source camera.
        source_depth: depth of the source's surface at ``xy``; NaN if none.
        tolerance: tolerance of the depth agreement there.
        verdicts: every applied rule, in order.
        accepted: whether all rules pass.
        seen_instead: (3,) point really seen by the source toward this point, if something occludes
            it; None if the way is free or unknown.
        exact: the truth, if available.
    """

    column: int
    row: int
    point: Vector
    depths: dict[str, float]
    xy: Vector
    z: float
    source_depth: float
    tolerance: float
    verdicts: tuple[Verdict, ...]
    accepted: bool
    seen_instead: Vector | None
    exact: Exact | None

    @property
    def endpoint_error(self) -> float:
        """Distance between the warp's position and the exact one, in source pixels."""
        if self.exact is None:
            return float("nan")
        return float(np.linalg.norm(self.xy - self.exact.xy))

    def lines(self) -> list[str]:
        """Text lines of the report."""
        text = [f"pixel ({self.column}, {self.row})"]
        if self.exact is not None:
            text[0] += f" {self.exact.object or 'nothing'}: {self.exact.label}"
        text += [f"depth, {name}: {value:.5g}" for name, value in self.depths.items()]
        text.append(f"in the source: ({self.xy[0]:.2f}, {self.xy[1]:.2f}) px, z {self.z:.5g}")
        if self.exact is not None:
            x, y = self.exact.xy
            text.append(f"  exact ({x:.2f}, {y:.2f}), z {self.exact.z:.5g}")
            text.append(f"  endpoint error {self.endpoint_error:.3g} px")
        text.append(f"  source depth {self.source_depth:.5g}, tolerance {self.tolerance:.3g}")
        for verdict in self.verdicts:
            word = "pass" if verdict.passed else "FAIL"
            margin = f": margin {verdict.margin:.3g} {verdict.unit}"
            text.append(f"{word} {verdict.rule}{'' if np.isnan(verdict.margin) else margin}")
        text.append("accepted" if self.accepted else "rejected")
        if self.seen_instead is not None:
            name = self.exact.blocked_by if self.exact is not None else "something nearer"
            text.append(f"hidden behind: {name}")
        elif self.exact is not None and self.exact.label == "hidden":
            text.append("turned away from the source")
        return text


def report(pair: Pair, column: int, row: int) -> PixelReport:
    """Report on one target pixel.

    Raises:
        ValueError: the pixel lies outside the target's image.
    """
    height, width = pair.size
    if not (0 <= column < width and 0 <= row < height):
        raise ValueError(
            f"pixel: got ({column}, {row}), expected a column below {width} and a row below"
            f" {height}"
        )
    pixel, view = (row, column), pair.view
    exact, seen_instead = _truth(pair, pixel)
    if exact is None:
        seen_instead = _nearer(pair, pixel)
    return PixelReport(
        column=column,
        row=row,
        point=pair.seen.point[pixel],
        depths={name: float(depth[pixel]) for name, depth in pair.depths.items()},
        xy=view.correspondence.xy[pixel].numpy(),
        z=float(view.correspondence.z[pixel]),
        source_depth=float(pair.source_depth[pixel]),
        tolerance=float(pair.tolerance[pixel]),
        verdicts=tuple(
            Verdict(name, bool(mask[pixel]), float(pair.margins[name][0][pixel]), unit)
            for name, mask in view.rules.items()
            for unit in [pair.margins[name][1]]
        ),
        accepted=bool(view.mask[pixel]),
        seen_instead=seen_instead,
        exact=exact,
    )


def _truth(pair: Pair, pixel: tuple[int, int]) -> tuple[Exact | None, Vector | None]:
    world, truth = pair.world, pair.truth
    if world is None or truth is None:
        return None, None
    hits, names = truth.hits, world.scene.object_names
    blocker, name = None, ""
    if hits.valid[pixel]:
        point, eye = hits.point[pixel], world.source.position
        faces = hits.normal[pixel] @ (eye - point) > 0
        free = world.geometry.reached(eye, point[None], [hits.primitive_id[pixel]])[0]
        first = world.geometry.trace_rays(eye, (point - eye)[None])
        # The far side of a solid is hidden by its near side; that of a sheet by nothing in front.
        if not (free and faces) and first.valid[0] and first.t[0] < 1 - NEARER:
            blocker, name = first.point[0], names[first.object_id[0]]
    owner = names[hits.object_id[pixel]] if hits.valid[pixel] else ""
    z = float(truth.z_source[pixel])
    return Exact(LABELS[int(truth.label[pixel])], owner, truth.xy[pixel], z, name), blocker


def _nearer(pair: Pair, pixel: tuple[int, int]) -> Vector | None:
    """Point that occludes the target's point by the source's depth."""
    correspondence = pair.view.correspondence
    depth, z = float(pair.source_depth[pixel]), float(correspondence.z[pixel])
    if not depth < z - float(pair.tolerance[pixel]):  # NaN too
        return None
    return correspondence.source.unproject(correspondence.xy[pixel].numpy(), depth)
