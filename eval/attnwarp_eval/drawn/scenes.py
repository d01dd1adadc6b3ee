"""Unlimited scenes: generator 1, which draws a crowded scene with its edits from three numbers.

A scene is decided only by the generator's number, a seed and the scene's number, and not by the
machine, its locale or its threads, nor by scenes drawn before. It is held out from the training
of the bundled weights: no thing has a shape from training, and coloured things have colours that
training never shows for their kind.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.drawn import asked
from attnwarp_eval.drawn.assemblies import KINDS, USUAL, pieces
from attnwarp_eval.drawn.axes import Axes, to_words
from attnwarp_eval.drawn.draft import (
    GENERATOR,
    SATURATED,
    Draft,
    Thing,
    between,
    index,
    marks,
    unseen_colors,
)
from attnwarp_eval.drawn.objects import body, plain_numbers
from attnwarp_eval.drawn.shapes import shape_edits
from attnwarp_eval.drawn.worlds import (
    COLORS,
    FINISHES,
    OBJECTS,
    TIMES,
    Look,
    shade,
)
from attnwarp_eval.scene.bodies import BodySpec
from attnwarp_eval.scene.solids import reach
from attnwarp_eval.scene.spec import SceneSpec
from attnwarp_eval.scene.transport import likely_bounces

Array = npt.NDArray[np.float64]

FIRST_SHAPE = 2**40
"""Shapes of drawn scenes count from here; training's shapes have much lower numbers."""

YAWS = (10, 30, 45, 60, 90, 120, 150, 180)
"""Degrees from the source to the targets, counter-clockwise."""

SUBJECTS = tuple(kind for kind in KINDS if kind in OBJECTS)
"""Things with named parts with colours held out of training."""


@dataclass(frozen=True)
class Drawn:
    """A drawn scene, with its random choices.

    Attributes:
        spec: the scene, checked.
        data: the scene in the format of its file.
        axes: position on each axis of difficulty.
        things: things of the scene, the one with parts first.
        groups: group of each object by name: "thing 0" and so on, "fence", "around".
        files: mesh files, by their path relative to the scene's folder.
    """

    spec: SceneSpec
    data: dict[str, Any]
    axes: Axes
    things: tuple[Thing, ...]
    groups: Mapping[str, str]
    files: Mapping[str, Path] = field(default_factory=dict)


def draw(
    number: int, seed: int, axes: Mapping[str, float] | None = None, shapes: bool = False
) -> Drawn:
    """Draw the scene of a number and a seed.

    Args:
        number: number of the scene, from 0.
        axes: fixed positions on axes; the others are drawn.
        shapes: True gives the scene edits that change shapes, in place of its others.

    Example:
        >>> scene = draw(3, seed=7, axes={"things": 4})
        >>> scene.spec.name, len(scene.things), len(scene.spec.cameras.targets)
        ('drawn-3', 4, 8)
        >>> draw(3, seed=7, axes={"things": 4}).spec == scene.spec
        True
    """
    return SceneDraft(number, seed, axes or {}).finished(shapes)


class SceneDraft(Draft):
    """A scene being drawn, step by step."""

    def finished(self, shapes: bool = False) -> Drawn:
        """Draw everything in turn and return the scene, with edits that change shapes or with
        others.
        """
        self.begin()
        self.choose_things()
        self._place_things()
        self._place_extras()
        self._place_fences()
        self._place_cameras()
        around = [self._ground(), *self._walls()]
        groups = {name: f"thing {k}" for k, one in enumerate(self.things) for name in one.names}
        groups |= {item["name"]: "fence" for item in self.fences}
        groups |= {item["name"]: "around" for item in (*self.extras, *around)}
        objects = [o for one in self.things for o in one.objects]
        data: dict[str, Any] = {
            "name": f"{self.word}-{self.number}",
            "title": self._title(),
            "description": f"Generator {GENERATOR}, seed {self.seed}, number {self.number};"
            f" {to_words(self.axes)}.",
            "objects": [*objects, *self.fences, *self.extras, *around],
            "lights": self.lights,
            "appearance": {"spp": 16},
            "cameras": self.cameras,
        }
        if self.fog is not None:
            data["medium"] = self.fog
        data = plain_numbers(data)
        data["edits"] = plain_numbers(shape_edits(self, data) if shapes else asked.edits(self))
        with_bounces(data)
        spec = SceneSpec.model_validate(data)
        return Drawn(spec, data, self.axes, tuple(self.things), groups, self.files)

    # Things ----------------------------------------------------------------------------

    def choose_things(self) -> None:
        """Draw the scene's things."""
        rng = self.stream("things")
        count = self.axes.things
        shiny = marks(rng, count, 0.7 * self.axes.highlights)
        patterned = marks(rng, count, self.axes.texture)
        kinds = [SUBJECTS[index(rng, len(SUBJECTS))]]
        while len(kinds) < count:
            kind = OBJECTS[index(rng, len(OBJECTS))]
            # A second thing of one colour half of the time: kinds share their held-out colours.
            twin = len(kinds) == 1 and rng.random() < 0.5
            if kind in kinds or (
                twin and not set(unseen_colors(kind)) & set(unseen_colors(kinds[0]))
            ):
                continue
            kinds.append(kind)
        for k, kind in enumerate(kinds):
            own = self.stream(f"thing {k}")
            look = self.look_of(own, kind, shiny[k], patterned[k])
            instance = FIRST_SHAPE + int(own.integers(2**32))
            size = 1.0 if k == 0 else 0.4 + 0.7 * self.axes.occlusion
            scale = round(size * between(own, 0.95, 1.2), 3)
            yaw = round(between(own, 0, 360), 1)
            make = self._assembly if k == 0 else self._single
            self.things.append(make(own, kind, instance, look, scale, yaw))

    def _single(
        self,
        rng: np.random.Generator,
        kind: str,
        instance: int,
        look: Look,
        scale: float,
        yaw: float,
    ) -> Thing:
        shape = body(kind, instance, plain=look.statue, resolution=48)
        reach, height = _reach([shape])
        name = kind.replace(" ", "_")
        if FINISHES[look.finish] == "shiny":
            return self._exact(kind, instance, look, scale, yaw)
        shape |= {"yaw": yaw, "scale": scale}
        thing = {"name": name, "shape": shape, **self.surface(look)}
        return Thing(kind, instance, look, [thing], (scale * reach, scale * height))

    def _exact(self, kind: str, instance: int, look: Look, scale: float, yaw: float) -> Thing:
        """A ball or a cube as an exact shape, which alone can be plastic."""
        rng = np.random.default_rng([instance, *b"exact"])
        r = round(scale * between(rng, 0.36, 0.46), 3)
        if kind == "ball":
            shape: dict[str, Any] = {"type": "sphere", "center": [0, 0, r], "radius": r}
            reach = r
        else:
            h = round(2 * r * between(rng, 0.8, 1.1), 3)
            shape = {"type": "box", "center": [0, 0, h / 2], "size": [2 * r, 2 * r, h], "yaw": yaw}
            reach = 1.42 * r
        thing = {"name": kind, "shape": shape, **self.surface(look)}
        return Thing(kind, instance, look, [thing], (reach, 2 * r))

    def _assembly(
        self,
        rng: np.random.Generator,
        kind: str,
        instance: int,
        look: Look,
        scale: float,
        yaw: float,
    ) -> Thing:
        objects = []
        for k, (name, parts) in enumerate(pieces(kind, instance).items()):
            shape = {
                "type": "body", "parts": plain_numbers(parts), "blend": 0.03, "resolution": 48,
                "yaw": yaw, "scale": scale,
            }  # fmt: skip
            own = look
            if k and not look.statue:
                words = USUAL.get(name, ()) if rng.random() < 0.5 else SATURATED
                color = COLORS.index((words or SATURATED)[index(rng, len(words or SATURATED))])
                finish = FINISHES.index("plain")
                seed = int(rng.integers(2**31))
                own = Look(finish, color, -1, look.ground, look.time, seed)
            label = f"{kind}_{name}".replace(" ", "_")
            objects.append({"name": label, "shape": shape, **self.surface(own)})
        reach, height = _reach([item["shape"] for item in objects])
        return Thing(kind, instance, look, objects, (reach * scale, height * scale))

    # Positions --------------------------------------------------------------------------

    def _place_things(self) -> None:
        rng = self.stream("places")
        for k, thing in enumerate(self.things):
            if k == 0:
                place = (between(rng, -0.1, 0.1), between(rng, -0.1, 0.1))
            else:
                gap = 0.02 + (1 - self.axes.occlusion) * between(rng, 0.3, 0.9)
                # Tall things stay off the line between the source and the first thing.
                tall = thing.reach[1] > 0.4 * self.things[0].reach[1]
                place = self._free(rng, thing.reach[0], gap, clear=40.0 if tall else 0.0)
            _move([item["shape"] for item in thing.objects], *place)
            self.places.append((*place, thing.reach[0]))

    def _free(
        self, rng: np.random.Generator, radius: float, gap: float, clear: float
    ) -> tuple[float, float]:
        """A free position around the first thing, ``gap`` from it or as near as possible."""
        x, y, first = self.places[0]
        for attempt in range(200):
            far = first + radius + gap + 0.02 * attempt
            # A thing nearer to the source than the first one hides more of the scene behind.
            aside = clear + (180 - clear) * float(rng.random()) ** (0.6 + 1.4 * self.axes.occlusion)
            angle = math.radians(aside if rng.random() < 0.5 else -aside)
            place = (x + far * math.cos(angle), y + far * math.sin(angle))
            if all(math.dist(place, p[:2]) > radius + p[2] + 0.02 for p in self.places):
                return place
        raise RuntimeError(f"seed {self.seed}, number {self.number}: no room for a thing")

    def _place_extras(self) -> None:
        """A mirror, glass, or a lamp at night."""
        rng = self.stream("extras")
        if self.smooth:
            kind = ("mirror ball", "mirror", "glass ball", "pane")[index(rng, 4)]
            r = round(between(rng, 0.2, 0.34), 3)
            # A mirror hides things behind it from half of the views: small, and not near.
            wide = {"mirror": 0.4, "pane": 0.6}.get(kind, r)
            gap = between(rng, 0.5, 0.9) if kind == "mirror" else between(rng, 0.05, 0.4)
            x, y = self._free(rng, wide, gap, clear=50.0)
            self.places.append((x, y, wide))
            ball = {"type": "sphere", "center": [x, y, r], "radius": r}
            away = math.hypot(x, y)
            upright = {
                "type": "rectangle",
                "center": [x, y, 0.45],
                "size": [1.8 * wide, 0.9],
                "facing": [-x / away, -y / away, 0.0],
            }
            glass = {"type": "glass", "tint": "#f4fbf6"}
            name, shape, material = {
                "mirror ball": ("mirror_ball", ball, {"type": "mirror", "tint": "#f2f4f6"}),
                "mirror": ("mirror", upright, {"type": "mirror", "tint": "#e8eeee"}),
                "glass ball": ("glass_ball", ball, glass),
                "pane": ("pane", upright, glass | {"thin": True}),
            }[kind]
            self.extras.append({"name": name, "shape": shape, "material": material})
        if TIMES[self.time] == "night" and rng.random() < 0.7:
            r = round(between(rng, 0.1, 0.16), 3)
            x, y = self._free(rng, r, between(rng, 0.1, 0.5), clear=50.0)
            self.places.append((x, y, r))
            z = between(rng, 0.9, 1.5)
            light = {"radiance": between(rng, 12, 22), "color": "#ffd9a0"}
            lamp = {"type": "sphere", "center": [x, y, z], "radius": r}
            post = {"type": "box", "center": [x, y, (z - r) / 2], "size": [0.05, 0.05, z - r]}
            dark = {"type": "plain", "color": "#4a4440", "variation": 0.1}
            self.extras.append({"name": "lamp_light", "shape": lamp, "emission": light})
            self.extras.append({"name": "lamp_post", "shape": post, "texture": dark})

    def _place_fences(self) -> None:
        rng, thin = self.stream("fences"), self.axes.thin
        for k in range(round(3 * thin)):
            count = 5 + int(9 * thin)
            width, step = 0.055 - 0.035 * thin, 0.16 - 0.05 * thin
            half = 0.5 * step * (count - 1) + width
            high = between(rng, 0.45, 0.9)
            for attempt in range(60):
                angle = math.radians(between(rng, 0, 360))
                far = self.places[0][2] + between(rng, 0.15, 0.5) + 0.04 * attempt
                middle = (far * math.cos(angle), far * math.sin(angle))
                along = (-math.sin(angle), math.cos(angle))
                if all(_clear(middle, along, half, p) for p in self.places):
                    break
            else:
                continue
            yaw = round(math.degrees(angle) + 90, 1)
            ux, uy = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
            start = [
                middle[0] - ux * step * (count - 1) / 2,
                middle[1] - uy * step * (count - 1) / 2,
            ]
            texture = {
                "type": "plain",
                "color": shade(SATURATED[index(rng, len(SATURATED))], rng),
                "variation": 0.2,
                "grain": 0.05,
            }
            pickets = {
                "type": "box", "center": [*start, high / 2], "size": [width, 0.02, high], "yaw": yaw,
                "repeat": {"count": count, "step": [ux * step, uy * step, 0.0]},
            }  # fmt: skip
            rail = {
                "type": "box",
                "center": [*middle, 0.8 * high],
                "size": [2 * half, 0.025, 0.6 * width],
                "yaw": yaw,
            }
            self.fences.append({"name": f"fence{k}", "shape": pickets, "texture": texture})
            self.fences.append({"name": f"rail{k}", "shape": rail, "texture": texture})
            # Along its length, so that no wall or camera comes near.
            self.places.append((*middle, half))

    def _place_cameras(self) -> None:
        rng = self.stream("cameras")
        self.extent = max(math.hypot(x, y) + r for x, y, r in self.places)
        height = self.things[0].reach[1]
        self.radius = max(2.6, 1.15 * self.extent + 0.7) * between(rng, 1.0, 1.15)
        look = [between(rng, -0.05, 0.05), between(rng, -0.05, 0.05), round(0.42 * height, 2)]
        fov = math.degrees(2 * math.atan(1.1 * max(height, 1.0) / self.radius))
        tilt = 30 - 23 * self.axes.grazing
        views = []
        for yaw in (0, *YAWS):
            angle = math.radians(max(4.0, tilt + between(rng, -3, 3)))
            high = look[2] + self.radius * math.tan(angle)
            view = {"yaw": yaw, "height": round(high, 2)}
            views.append(view if yaw else {"name": "source", **view})
        self.cameras = {
            "look_at": look, "radius": round(self.radius, 2), "fov": round(min(max(fov, 28), 48), 1),
            "size": [512, 512], "source": views[0], "targets": views[1:],
        }  # fmt: skip

    def _ground(self) -> dict[str, Any]:
        rng = self.stream("ground")
        texture = dict(self.look.floor)
        if rng.random() < self.axes.texture * 0.6:
            colors = [shade(self.accent, rng), shade("white", rng)]
            size = round(between(rng, 0.3, 0.6) * (1.4 - 0.7 * self.axes.texture), 2)
            texture = {
                "type": "checker", "colors": colors, "size": size, "variation": 0.1, "grain": 0.05,
            }  # fmt: skip
            if rng.random() < 0.5:
                angle = between(rng, 0, math.pi)
                way = [round(math.cos(angle), 2), round(math.sin(angle), 2), 0.0]
                texture |= {"type": "stripes", "direction": way}
        texture["variation"] = round(texture["variation"] * (0.4 + 0.6 * self.axes.texture), 3)
        shape = {"type": "rectangle", "center": [0, 0, 0], "size": [30, 30]}
        return {"name": "ground", "shape": shape, "texture": texture}

    def _walls(self) -> Iterator[dict[str, Any]]:
        """Walls behind the cameras, where they leave the things in the sun."""
        rng = self.stream("walls")
        far = self.radius + between(rng, 0.8, 2.2)
        for k in range(4):
            wanted, high = rng.random() < 0.6, between(rng, 1.0, 2.8)
            texture = self._wall(rng)
            angle = math.pi / 2 * k
            for light in self.lights:
                if light["type"] == "sun":
                    toward = math.cos(math.radians(light["azimuth"]) - angle)
                    room = (far - self.extent) * math.tan(math.radians(light["elevation"]))
                    if toward > 0:
                        high = min(high, room / toward)
            if not wanted or high < 0.5:
                continue
            x, y = round(math.cos(angle)), round(math.sin(angle))
            shape = {
                "type": "rectangle",
                "center": [far * x, far * y, high / 2],
                "size": [2 * far, high],
                "facing": [-x, -y, 0],
            }
            yield {"name": f"wall{k}", "shape": shape, "texture": texture}

    def _wall(self, rng: np.random.Generator) -> dict[str, Any]:
        kind = ("bricks", "checker", "stripes", "noise")[index(rng, 4)]
        color = SATURATED[index(rng, len(SATURATED))]
        if rng.random() > 0.3 + self.axes.texture:
            kind = "plain"
        first, second = shade(color, rng), shade("white" if rng.random() < 0.5 else "grey", rng)
        size = round(between(rng, 0.3, 0.6), 2)
        match kind:
            case "bricks":
                return {"type": "bricks", "colors": [first, shade(color, rng)], "mortar": second,
                        "size": [size, round(0.4 * size, 2)], "variation": 0.2}  # fmt: skip
            case "checker":
                return {
                    "type": "checker",
                    "colors": [first, second],
                    "size": size,
                    "variation": 0.1,
                }
            case "stripes":
                return {"type": "stripes", "colors": [first, second], "size": size,
                        "direction": [1, 1, round(between(rng, -0.5, 0.5), 2)]}  # fmt: skip
            case "noise":
                return {"type": "noise", "colors": ["#24391a", "#46652c", "#7fa04e"], "size": size,
                        "octaves": 5, "variation": 0.4}  # fmt: skip
        return {"type": "plain", "color": first, "variation": 0.1}

    def _title(self) -> str:
        first, *others = (asked.described(one) for one in self.things)
        return f"{first} {asked.place(self.ground)}, with {', '.join(others)}".capitalize()


def with_bounces(data: dict[str, Any]) -> None:
    """Write the bounces of a scene and its edits into its data, by their materials."""
    spec = SceneSpec.model_validate(data)
    own = likely_bounces(spec)
    data["appearance"] = {"bounces": own, **data["appearance"]}
    spec = SceneSpec.model_validate(data)
    for edit, entry in zip(spec.edits, data["edits"], strict=True):
        for answer, part in zip(edit.answers, entry.get("answers", ()), strict=True):
            _own_bounces(spec, edit, answer, own, part)
        if not edit.answers:
            _own_bounces(spec, edit, None, own, entry)


def _own_bounces(spec: SceneSpec, edit: Any, answer: Any, own: Any, entry: dict[str, Any]) -> None:
    from attnwarp_eval.scene.edits import apply

    number = likely_bounces(apply(spec, edit, answer))
    if number != own:
        entry["bounces"] = number


def _reach(shapes: Sequence[dict[str, Any]]) -> tuple[float, float]:
    """Radius of the circle around the vertical axis that encloses bodies, and their height."""
    boxes = [
        reach(part)
        for shape in shapes
        for part in BodySpec.model_validate(shape).solid()
        if not part.carve
    ]
    corners = max(float(np.hypot(*np.abs(box[:, :2]).max(0))) for box in boxes)
    return corners, max(float(box[1, 2]) for box in boxes)


def _move(shapes: Sequence[dict[str, Any]], x: float, y: float) -> None:
    for shape in shapes:
        if shape["type"] in ("body", "mesh"):
            own = shape.get("position", (0.0, 0.0, 0.0))
            digits = 3 if shape["type"] == "body" else 7
            shape["position"] = [
                round(a + b, digits) for a, b in zip(own, (x, y, 0.0), strict=True)
            ]
        else:
            shape["center"] = [round(x, 3), round(y, 3), shape["center"][2]]


def _clear(
    middle: tuple[float, float], along: tuple[float, float], half: float, place: Sequence[float]
) -> bool:
    """True if a straight fence stays out of a circle."""
    x, y = place[0] - middle[0], place[1] - middle[1]
    t = min(max(x * along[0] + y * along[1], -half), half)
    return math.hypot(x - t * along[0], y - t * along[1]) > place[2] + 0.05
