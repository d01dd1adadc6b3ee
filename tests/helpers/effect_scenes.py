"""Small scenes that each call for one effect, shared by the tests of planning and of proof."""

from dataclasses import replace

from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import SceneSpec, SkySpec

PLAIN = {"type": "plain", "color": "#c0b090"}
FLOOR = {
    "name": "floor",
    "shape": {"type": "rectangle", "center": [0, 0, 0], "size": [6, 6]},
    "texture": PLAIN,
}
WALL = {
    "name": "wall",
    "shape": {"type": "rectangle", "center": [-1.5, 0, 1], "size": [6, 4], "facing": [1, 0, 0]},
    "texture": {"type": "plain", "color": "#d04020"},
}
SUN = {"type": "sun", "elevation": 50, "azimuth": 30, "irradiance": 2.0}
SKY = {"type": "sky", "horizon": "#c0d0e0", "zenith": "#80a0e0", "radiance": 0.5}
POINT = {"type": "point", "position": [0.4, 0.3, 2.8], "intensity": 4.0}
LAMP = {
    "name": "lamp",
    "shape": {"type": "rectangle", "center": [0, 0, 3], "size": [1.5, 1.5], "facing": [0, 0, -1]},
    "emission": {"radiance": 4.0},
}


def ball(material=None, center=(0, 0, 0.7), radius=0.6, name="ball"):
    shape = {"type": "sphere", "center": list(center), "radius": radius}
    said = {"name": name, "shape": shape}
    if material is None or material["type"] in ("diffuse", "plastic"):
        said["texture"] = PLAIN
    return said | ({} if material is None else {"material": material})


def make(objects, lights, bounces=1, spp=16, size=32, **rest):
    cameras = {
        "look_at": [0, 0, 0.4],
        "radius": 3,
        "size": [size, size],
        "source": {"yaw": 10, "height": 2.0},
        "targets": [{"yaw": 60, "height": 1.5}],
    } | rest.pop("cameras", {})
    said = {
        "name": "test", "title": "t", "objects": objects, "lights": lights, "cameras": cameras,
        "appearance": {"bounces": bounces, "spp": spp},
    } | rest  # fmt: skip
    return Scene(SceneSpec.model_validate(said))


GLASS = {"type": "glass", "ior": 1.5}
MIRROR = {"type": "mirror"}

SCENES = {
    "diffuse": lambda: make([FLOOR, ball()], [SUN, SKY]),
    "interreflection": lambda: make([FLOOR, WALL, ball()], [SKY], 4),
    "specular": lambda: make([FLOOR, WALL, ball(MIRROR)], [SKY], 4),
    "refraction": lambda: make([FLOOR, WALL, ball(GLASS)], [SKY], 8),
    "medium": lambda: make([FLOOR, ball()], [SKY], 4, medium={"sigma_t": 0.4, "albedo": 0.8}),
    "subsurface": lambda: make(
        [FLOOR, ball(GLASS | {"interior": {"sigma_t": 4.0, "albedo": 0.9, "tint": "#ffc080"}})],
        [SKY],
        16,
    ),
    "caustics": lambda: make([FLOOR, ball(GLASS)], [POINT], 8),
    "environment": lambda: make([FLOOR, ball()], [SUN, SKY]),
    "depth_of_field": lambda: make(
        [FLOOR, WALL, ball()], [SUN], cameras={"lens": {"aperture": 0.3, "focus": 2.0}}
    ),
}
"""Effect -> a scene that needs it. "diffuse" needs none that a plan could leave out but its sky."""


DROPPABLE = (
    "interreflection", "specular", "refraction", "medium", "subsurface", "caustics", "environment",
    "depth_of_field",
)  # fmt: skip
"""Effects that a plan can leave out. The others come free with any picture: what shades a point has
its texture.
"""


def without(scene, ours, effect):
    """A plan with one of :data:`DROPPABLE` left out: what a careless planner would do, for negative
    controls.
    """
    passes = ours.passes
    match effect:
        case "interreflection" | "specular" | "refraction":
            passes = tuple(replace(step, max_depth=2) for step in passes)
        case "medium" | "subsurface":
            passes = tuple(
                replace(s, integrator="path" if s.integrator == "volpath" else s.integrator)
                for s in passes
            )
            return replace(ours, passes=passes, media=False)
        case "caustics":
            remaining = (step for step in passes if step.integrator != "ptracer" and step.sign > 0)
            passes = tuple(replace(step, first="any") for step in remaining)
        case "environment":
            skies = [k for k, light in enumerate(scene.spec.lights) if isinstance(light, SkySpec)]
            passes = tuple(
                replace(step, lights=tuple(k for k in step.lights if k not in skies))
                for step in passes
            )
            passes = tuple(step for step in passes if step.lights or step.lamps)
        case "depth_of_field":
            return replace(ours, lens=None)
    assert passes != ours.passes, f"{effect} is not in this plan ({ours.integrator})"
    return replace(ours, passes=passes)
