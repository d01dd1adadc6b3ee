"""Models of pydantic for a scene file: objects, lights, cameras, edits.

docs/truth/scenes.md describes the format. Positions are in scene units (metres in the
scenes that come with the package), angles in degrees, colours sRGB '#rrggbb', z up.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from attnwarp_eval.scene.base import Color, Coordinate, Direction, Positive, Spec, Vector
from attnwarp_eval.scene.bodies import BodySpec
from attnwarp_eval.scene.materials import (
    TEXTURED,
    DiffuseMaterial,
    EffectsSpec,
    EmissionSpec,
    LensSpec,
    Material,
    MediumSpec,
    PointSpec,
    SpotSpec,
)
from attnwarp_eval.scene.terrain import ScatterSpec, TerrainSpec
from attnwarp_eval.scene.textures import Plain, Texture


class SphereSpec(Spec):
    """A sphere, exact."""

    type: Literal["sphere"]
    center: Vector
    radius: Positive


class RectangleSpec(Spec):
    """A flat rectangle, exact. ``size`` is width and height; a level one has its width along x."""

    type: Literal["rectangle"]
    center: Vector
    size: tuple[Positive, Positive]
    facing: Direction = (0.0, 0.0, 1.0)


class Repeat(Spec):
    """``count`` copies, each ``step`` further on."""

    count: int = Field(ge=1, le=1000)
    step: Vector


class BoxSpec(Spec):
    """A box of ``size`` (x, y, z), turned by ``yaw`` about z, tilted by ``pitch`` about its y."""

    type: Literal["box"]
    center: Vector
    size: tuple[Positive, Positive, Positive]
    yaw: float = 0.0
    pitch: float = 0.0
    repeat: Repeat | None = None


class MeshSpec(Spec):
    """A mesh from a file, its path relative to the scene file. ``up`` names the file's upright
    axis; edges longer than ``longest_edge`` are halved, so that textures show between vertices.
    """

    type: Literal["mesh"]
    file: str
    position: Vector = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    scale: Positive = 1.0
    up: Literal["y", "z"] = "z"
    longest_edge: Positive | None = None


ShapeSpec = Annotated[
    SphereSpec | RectangleSpec | BoxSpec | BodySpec | MeshSpec | TerrainSpec | ScatterSpec,
    Field(discriminator="type"),
]


class ObjectSpec(Spec):
    """One object: its index in the list is its object id.

    ``texture`` colours diffuse and plastic things; mirrors, metal and glass have a ``tint``, and
    lamps are black.
    """

    name: str = Field(min_length=1)
    shape: ShapeSpec
    texture: Texture = Plain(type="plain", color="#ffffff", variation=0.0, grain=0.1)
    material: Material = DiffuseMaterial()
    emission: EmissionSpec | None = None
    velocity: Vector | None = None

    @model_validator(mode="after")
    def _a_texture_where_it_shows(self) -> ObjectSpec:
        shows = isinstance(self.material, TEXTURED) and self.emission is None
        given = "texture" in self.model_fields_set
        if shows and not given:
            raise ValueError(
                f"got no texture, but {self.material.type} things need one; add 'texture: {{type:"
                " ...}'"
            )
        if given and not isinstance(self.material, TEXTURED):
            raise ValueError(
                f"got a texture, but {self.material.type} shows none; use the material's 'tint'"
                " instead"
            )
        if self.emission is not None and not isinstance(self.material, DiffuseMaterial):
            raise ValueError(
                f"got emission and the material {self.material.type}; what shines has no other"
                " material"
            )
        return self


class SunSpec(Spec):
    """Parallel light. ``irradiance`` on a facing surface; a white one shows irradiance / pi."""

    type: Literal["sun"]
    elevation: float = Field(gt=0, le=90)
    azimuth: float
    irradiance: Positive
    color: Color = "#ffffff"


class SkySpec(Spec):
    """Light and background from all directions: a ramp from ``horizon`` to ``zenith``."""

    type: Literal["sky"]
    horizon: Color
    zenith: Color
    radiance: Positive = 1.0


LightSpec = Annotated[SunSpec | SkySpec | PointSpec | SpotSpec, Field(discriminator="type")]


Pixels = Annotated[int, Field(le=65536)]


class ViewSpec(Spec):
    """One camera on the orbit; missing fields come from ``cameras``."""

    name: str | None = Field(None, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")  # part of file names
    yaw: float
    height: Coordinate
    radius: Positive | None = None
    fov: float | None = Field(None, gt=0, lt=180)
    look_at: Vector | None = None


class CamerasSpec(Spec):
    """An orbit about the vertical of ``look_at``: ``radius``, vertical ``fov``, views."""

    look_at: Vector
    radius: Positive
    fov: float = Field(45.0, gt=0, lt=180)
    size: tuple[Pixels, Pixels] = (512, 512)
    source: ViewSpec
    targets: tuple[ViewSpec, ...] = Field(min_length=1)
    lens: LensSpec | None = None


def _number_of_bounces(value: Any) -> Any:
    if isinstance(value, str) and value != "unlimited":
        raise ValueError(
            f"got {value!r}, expected 1 to 64 or unlimited; take it out, and attnwarp-eval scenes"
            " calibrate FILE measures the number"
        )
    return value


Bounces = Annotated[
    Annotated[int, Field(ge=1, le=64)] | Literal["unlimited"], BeforeValidator(_number_of_bounces)
]


class AppearanceSpec(Spec):
    """Settings of the pictures: light bounces (1 is direct light only) and samples a pixel.

    ``bounces: unlimited`` follows light without a cap, as does a file without a number.
    ``attnwarp-eval scenes calibrate`` prints the fewest bounces that hold every view's light within
    1 %. Every surface and every scattering counts as a bounce.
    """

    bounces: Bounces | None = None
    spp: int = Field(default=16, ge=1, le=65536)


CHANGES = ("shape", "texture", "material", "recolor", "paint")
"""Keys of a change, any of which changes something."""


class ObjectChange(Spec):
    """Change of one object by an edit.

    ``shape`` puts another shape in place of the object's; ``recolor`` replaces colours of the
    object by others; ``paint`` makes all its colours shades of one, except those of the parts
    listed under ``keep``.
    """

    object: str
    shape: ShapeSpec | None = None
    texture: Texture | None = None
    material: Material | None = None
    recolor: dict[Color, Color] = Field(default_factory=dict)
    paint: Color | None = None
    keep: tuple[Color, ...] = ()

    @model_validator(mode="after")
    def _one_way_of_colouring(self) -> ObjectChange:
        given = [name for name in CHANGES if getattr(self, name)]
        if not given:
            raise ValueError(
                "got a change that changes nothing; add a shape, a texture, a material, recolor or"
                " paint"
            )
        if self.paint and (self.recolor or self.texture):
            raise ValueError("got paint beside recolor or texture; keep one of them")
        if self.keep and not self.paint:
            raise ValueError("got keep without paint, which alone it is for; leave it out")
        return self


class AnswerSpec(Spec):
    """One right answer to an ambiguous instruction."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")
    target: str
    changes: tuple[ObjectChange, ...] = ()
    add: tuple[ObjectSpec, ...] = ()
    remove: tuple[str, ...] = ()
    lights: tuple[LightSpec, ...] | None = None
    bounces: Bounces | None = None


class EditSpec(Spec):
    """An edit with a known result: instruction, prompts, and changes of the scene.

    ``add`` and ``remove`` are objects and names of objects. An ambiguous instruction has several
    equally right ``answers``. ``bounces`` applies to the edited scene's pictures; the default is
    the scene's number.
    """

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")
    instruction: str
    source: str
    target: str
    changes: tuple[ObjectChange, ...] = ()
    add: tuple[ObjectSpec, ...] = ()
    remove: tuple[str, ...] = ()
    lights: tuple[LightSpec, ...] | None = None
    bounces: Bounces | None = None
    answers: tuple[AnswerSpec, ...] = ()

    @model_validator(mode="after")
    def _does_something(self) -> EditSpec:
        own = bool(self.changes or self.add or self.remove) or self.lights is not None
        if own == bool(self.answers):
            raise ValueError(
                "got an edit with both or neither of its own changes (add, remove, lights) and"
                " answers; keep one"
            )
        return self

    @property
    def ambiguous(self) -> bool:
        """True if more than one result is right."""
        return bool(self.answers)


class SceneSpec(Spec):
    """Model of a whole scene file."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")
    title: str
    description: str = ""
    units: str = "metres"
    objects: tuple[ObjectSpec, ...] = Field(min_length=1)
    lights: tuple[LightSpec, ...]
    cameras: CamerasSpec
    appearance: AppearanceSpec = Field(default_factory=AppearanceSpec)
    medium: MediumSpec | None = None
    effects: EffectsSpec = EffectsSpec()
    edits: tuple[EditSpec, ...] = ()
