"""A scene as its file has it: a ball on chequered ground under an even sky, to be edited."""


def ball_scene(title, radius, colors, cameras, edits, *, objects=()):
    """The content of a scene's file.

    Args:
        title: in words.
        radius: radius of the ball, which lies on the ground at the origin.
        colors: two, of its squares.
        cameras: entries besides the field of view and the size, 32 x 32 px; ``targets`` as yaws.
        edits: as a scene's file has them.
        objects: more of them.
    """
    targets = [{"yaw": yaw, "height": 1.5} for yaw in cameras["targets"]]
    views = {"fov": 50, "size": [32, 32], "source": {"yaw": 0, "height": 1.5}}
    return {
        "name": "ball",
        "title": title,
        "objects": [
            {
                "name": "ground",
                "shape": {
                    "type": "rectangle",
                    "center": [0, 0, 0],
                    "size": [8, 8],
                    "facing": [0, 0, 1],
                },
                "texture": {"type": "checker", "colors": ["#808080", "#909090"], "size": 1.0},
            },
            {
                "name": "ball",
                "shape": {"type": "sphere", "center": [0, 0, radius], "radius": radius},
                "texture": {"type": "checker", "colors": list(colors), "size": 0.5},
            },
            *objects,
        ],
        "lights": [{"type": "sky", "horizon": "#ffffff", "zenith": "#ffffff", "radiance": 0.8}],
        "appearance": {"bounces": 1},
        "cameras": {**cameras, **views, "targets": targets},
        "edits": edits,
    }


COLORS = {"red": "#d03020", "green": "#209030", "blue": "#2040d0"}
SCENE = ball_scene(
    "A ball on the ground",
    0.9,
    ("#c0c0c0", "#d0d0d0"),
    {"look_at": [0, 0, 0.8], "radius": 3.5, "targets": (15, 30, 120)},
    [
        {
            "name": "some_colour",
            "instruction": "Paint the ball in some colour",
            "source": "a ball",
            "target": "a ball of some colour",
            "answers": [
                {
                    "name": name,
                    "target": f"a {name} ball",
                    "changes": [{"object": "ball", "paint": value}],
                }
                for name, value in COLORS.items()
            ],
        }
    ],
)
"""A ball that an ambiguous edit paints in one of :data:`COLORS`."""
