"""Bodies: models of a scene file's shapes of blended parts, and their conversion to parts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from attnwarp_eval.scene import solids
from attnwarp_eval.scene.base import (
    Color,
    Coordinate,
    Length,
    Positive,
    Seed,
    Spec,
    Vector,
    linear_rgb,
)
from attnwarp_eval.scene.shapes import Mesh
from attnwarp_eval.scene.textures import lattice_noise


class RingSpec(Spec):
    """``count`` copies of a part about the vertical axis through ``about``, over ``sweep`` degrees
    from its position.

    ``jitter`` (0 to 1) turns each by up to that share of the step, and makes ellipsoids, capsules
    and tubes thinner by up to half that share; ``lift`` raises each above the one before.
    """

    count: int = Field(ge=1, le=500)
    about: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    sweep: float = 360.0
    jitter: float = Field(0.0, ge=0, le=1)
    lift: Coordinate = 0.0
    seed: Seed = 0


class _PartSpec(Spec):
    """Fields that every part may have.

    ``color`` multiplies the object's texture; ``mirror`` doubles the part across y = 0; ``blend:
    false`` is a sharp joint, a number a joint of that width; ``carve`` takes the part away from the
    blended parts before it.
    """

    mirror: bool = False
    color: Color = "#ffffff"
    blend: bool | Length = True
    carve: bool = False
    ring: RingSpec | None = None


class _TurnedPart(_PartSpec):
    """A part with local axes: rolled about x, pitched about y, then turned about z."""

    center: Vector
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


class EllipsoidPart(_TurnedPart):
    """An ellipsoid with radii along its local x, y, z."""

    type: Literal["ellipsoid"]
    radii: tuple[Positive, Positive, Positive]


class TorusPart(_TurnedPart):
    """A ring about its local z: radii of the ring and of its thickness."""

    type: Literal["torus"]
    radii: tuple[Positive, Positive]


class BlockPart(_TurnedPart):
    """A box with edges rounded by ``round``."""

    type: Literal["block"]
    size: tuple[Positive, Positive, Positive]
    round: Length = 0.0

    @model_validator(mode="after")
    def _room_for_the_edges(self) -> BlockPart:
        if 2 * self.round > min(self.size):
            raise ValueError(
                f"got round {self.round}, expected at most half the smallest size,"
                f" {min(self.size) / 2}"
            )
        return self


class DiscPart(_TurnedPart):
    """A cylinder along its local z with edges rounded by ``round``."""

    type: Literal["disc"]
    radius: Positive
    height: Positive
    round: Length = 0.0

    @model_validator(mode="after")
    def _room_for_the_edges(self) -> DiscPart:
        if self.round > min(self.radius, self.height / 2):
            most = min(self.radius, self.height / 2)
            raise ValueError(
                f"got round {self.round}, expected at most {most} (the radius, or half the height)"
            )
        return self


class CapsulePart(_PartSpec):
    """A rod with round ends, its radius running from the first of ``radii`` to the second."""

    type: Literal["capsule"]
    start: Vector
    end: Vector
    radii: tuple[Positive, Positive]


class TubePart(_PartSpec):
    """Rods from point to point with the given radii: a tail, a neck, a branch."""

    type: Literal["tube"]
    points: tuple[Vector, ...] = Field(min_length=2)
    radii: tuple[Positive, ...]

    @model_validator(mode="after")
    def _a_radius_a_point(self) -> TubePart:
        if len(self.radii) != len(self.points):
            raise ValueError(
                f"got {len(self.radii)} radii for {len(self.points)} points, expected one for each"
            )
        return self


PartSpec = Annotated[
    EllipsoidPart | CapsulePart | TorusPart | BlockPart | DiscPart | TubePart,
    Field(discriminator="type"),
]


class ReliefSpec(Spec):
    """Noise that moves the surface out and in by up to ``depth``: bark, rock, foliage."""

    depth: Positive
    size: Positive
    octaves: int = Field(3, ge=1, le=8)
    seed: Seed = 0


class BodySpec(Spec):
    """A body of blended parts, meshed by marching cubes. ``mirror`` doubles one across y = 0."""

    type: Literal["body"]
    parts: tuple[PartSpec, ...] = Field(min_length=1)
    blend: Length = 0.1
    resolution: int = Field(128, ge=8, le=512)
    position: Vector = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    scale: Positive = 1.0
    relief: ReliefSpec | None = None

    @model_validator(mode="after")
    def _something_to_carve(self) -> BodySpec:
        if self.parts[0].carve:
            raise ValueError(
                "got a body whose first part carves, expected something to carve from before it"
            )
        return self

    def solid(self) -> list[solids.Part]:
        """The parts, copies and mirror images included."""
        return [
            copy for spec in self.parts for part in _parts(spec) for copy in _ring(part, spec.ring)
        ]

    def surface(self) -> solids.Relief | None:
        """The relief."""
        return solids.Relief(**self.relief.model_dump()) if self.relief else None

    def mesh(self) -> Mesh:
        """The surface as triangles, in the body's coordinates."""
        return solids.mesh_body(self.solid(), self.blend, self.resolution, self.surface())

    def contains(self, point: npt.NDArray[np.float64]) -> bool:
        """Return True if a (3,) point in the body's coordinates is inside; needs no meshing."""
        return bool(
            solids.body_distance(self.solid(), self.blend, point[None], self.surface())[0] < 0
        )


_TURNED = {
    "ellipsoid": solids.Ellipsoid,
    "torus": solids.Torus,
    "block": solids.Block,
    "disc": solids.Disc,
}


def _parts(spec: PartSpec) -> Iterator[solids.Part]:
    said = spec.model_dump(exclude={"type", "mirror", "ring"}) | {"color": linear_rgb(spec.color)}
    for side in (1.0, -1.0) if spec.mirror else (1.0,):

        def flip(v: Vector, side: float = side) -> Vector:
            return (v[0], v[1] * side, v[2])

        match spec:
            case CapsulePart(start=start, end=end):
                yield solids.Capsule(**said | {"start": flip(start), "end": flip(end)})
            case TubePart(points=points, radii=radii):
                shared = {key: said[key] for key in ("color", "blend", "carve")}
                for ends, pair in zip(pairwise(points), pairwise(radii), strict=True):
                    yield solids.Capsule(flip(ends[0]), flip(ends[1]), pair, **shared)
            case _:
                turn = {"yaw": spec.yaw * side, "roll": spec.roll * side}
                yield _TURNED[spec.type](**said | turn | {"center": flip(spec.center)})


def _ring(part: solids.Part, ring: RingSpec | None) -> Iterator[solids.Part]:
    if ring is None:
        yield part
        return
    # A full turn ends where it begins; part of one has a copy at both of its ends.
    step = ring.sweep / (
        ring.count if abs(ring.sweep) >= 360 or ring.count == 1 else ring.count - 1
    )
    cells = np.stack(np.meshgrid(np.arange(ring.count), [0, 1], indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    dice = lattice_noise(
        np.column_stack([cells, np.full(len(cells), 77)]).astype(float), ring.seed
    ).reshape(-1, 2)
    for k in range(ring.count):
        angle = step * (k + ring.jitter * (dice[k, 0] - 0.5))
        size = 1 - 0.5 * ring.jitter * dice[k, 1]
        a = math.radians(angle)
        c, s = math.cos(a), math.sin(a)

        def turn(v: Vector, c: float = c, s: float = s, lift: float = k * ring.lift) -> Vector:
            x, y = v[0] - ring.about[0], v[1] - ring.about[1]
            return (ring.about[0] + c * x - s * y, ring.about[1] + s * x + c * y, v[2] + lift)

        match part:
            case solids.Capsule():
                yield replace(
                    part,
                    start=turn(part.start),
                    end=turn(part.end),
                    radii=(part.radii[0] * size, part.radii[1] * size),
                )
            case solids.Ellipsoid():
                x, y, z = part.radii
                yield replace(
                    part,
                    center=turn(part.center),
                    yaw=part.yaw + angle,
                    radii=(x * size, y * size, z * size),
                )
            case _:
                yield replace(part, center=turn(part.center), yaw=part.yaw + angle)
