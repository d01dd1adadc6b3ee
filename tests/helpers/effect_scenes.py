"""Small scenes that each call for one effect, shared by the tests of planning and of proof."""

from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import SceneSpec

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
