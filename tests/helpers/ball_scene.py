"""A ball on the ground that an ambiguous edit paints, as plain data."""

COLORS = {"red": "#d03020", "green": "#209030", "blue": "#2040d0"}
SCENE = {
    "name": "ball",
    "title": "A ball on the ground",
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
            "shape": {"type": "sphere", "center": [0, 0, 0.9], "radius": 0.9},
            "texture": {"type": "checker", "colors": ["#c0c0c0", "#d0d0d0"], "size": 0.5},
        },
    ],
    "lights": [{"type": "sky", "horizon": "#ffffff", "zenith": "#ffffff", "radiance": 0.8}],
    "cameras": {
        "look_at": [0, 0, 0.8],
        "radius": 3.5,
        "fov": 50,
        "size": [32, 32],
        "source": {"yaw": 0, "height": 1.5},
        "targets": [{"yaw": yaw, "height": 1.5} for yaw in (15, 30, 120)],
    },
    "edits": [
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
}
