"""Six drawn things whose outlines are known: horses with thin parts, and castles on a lawn.

    python reports/photographs/click/draw.py CAPTURES

Writes CAPTURES/NAME, each a scene's file and its export; masks/thing of the export is exact.
"""

# ruff: noqa: E501
from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.splats.export import export

VIEWS, SIZE = 36, 192
HORSES, CASTLES = (1, 2, 3), (4, 5, 6)
"""Seeds."""

LAWN = ["#4a5a2c", "#6f8040", "#93995a"]
STONE = {
    4: ["#8d8778", "#a39c8a", "#b9b3a2"],
    5: ["#6f7a4a", "#858d5c", "#9aa070"],  # as green as the lawn
    6: ["#7d7a63", "#94917a", "#aaa890"],
}


def horse(draw: np.random.Generator) -> list[dict]:
    """A trunk on four thin legs, a neck and a tail, in up to four colours."""
    coat = str(draw.choice(["#7a4a25", "#a8743c", "#8f8a82"]))
    socks, hair = draw.permutation(["#e3dccd", "#2a2522"]).tolist()
    long, high, thin = draw.uniform(0.75, 0.95), draw.uniform(0.9, 1.15), draw.uniform(0.06, 0.09)
    legs = [
        {
            "type": "tube",
            "points": [[x, y, high - 0.1], [x + bend, y, high / 2], [x + bend / 2, y, 0.02]],
            "radii": [0.15, thin, thin],
            "color": socks,
        }
        for x in (-0.75 * long, 0.7 * long)
        for y in (-0.2, 0.2)
        for bend in [draw.uniform(-0.15, 0.15)]
    ]
    return [
        {"type": "ellipsoid", "center": [0, 0, high], "radii": [long, 0.32, 0.34], "color": coat},
        *legs,
        {"type": "capsule", "start": [0.75 * long, 0, high + 0.1], "end": [long + 0.25, 0, high + 0.7],
         "radii": [0.22, 0.14], "color": coat},
        {"type": "capsule", "start": [long + 0.2, 0, high + 0.7], "end": [long + 0.65, 0, high + 0.5],
         "radii": [0.15, 0.09], "color": coat},
        {"type": "tube", "points": [[-0.9 * long, 0, high + 0.1], [-long - 0.25, 0, high - 0.1],
                                    [-long - 0.3, 0, draw.uniform(0.05, 0.5)]],
         "radii": [0.08, 0.09, 0.05], "color": hair},
    ]  # fmt: skip


def castle(draw: np.random.Generator) -> list[dict]:
    """A keep between four round towers and walls."""
    wide, tall = draw.uniform(0.9, 1.2), draw.uniform(0.7, 1.0)
    towers = [
        {"type": "disc", "center": [x * wide, y * wide, h / 2 - 0.05],
         "radius": draw.uniform(0.22, 0.32), "height": h + 0.1, "round": 0.02, "blend": False}
        for x in (-1, 1) for y in (-1, 1) for h in [draw.uniform(1.2, 1.9)]
    ]  # fmt: skip
    walls = [
        {"type": "block", "center": [x, y, tall / 2 - 0.05], "size": size, "round": 0.02,
         "blend": False}
        for x, y, size in (
            (wide, 0, [0.2, 2 * wide, tall + 0.1]), (-wide, 0, [0.2, 2 * wide, tall + 0.1]),
            (0, wide, [2 * wide, 0.2, tall + 0.1]), (0, -wide, [2 * wide, 0.2, tall + 0.1]),
        )
    ]  # fmt: skip
    keep = {"type": "block", "center": [0, 0, 0.85], "size": [0.9, 0.9, 1.9], "round": 0.03}
    return [keep, *walls, *towers]


def scene(name: str, seed: int) -> dict:
    """Scene of a thing on a lawn, which of even seeds is hilly, between four hedges."""
    draw = np.random.default_rng(seed)
    parts = horse(draw) if name.startswith("horse") else castle(draw)
    tops = ["#a19a90", "#dcd6cc", "#ffffff"] if name.startswith("horse") else STONE[seed]
    grass = {
        "type": "noise",
        "colors": LAWN,
        "size": 0.6,
        "octaves": 5,
        "variation": 0.4,
        "grain": 0.07,
    }
    level = {"type": "rectangle", "center": [0, 0, 0], "size": [16, 16], "facing": [0, 0, 1]}
    hills = {"type": "terrain", "center": [0, 0, 0], "size": [16, 16], "height": 0.6, "feature": 2.5,
             "octaves": 2, "level": [1.0, 4.0], "seed": seed, "resolution": 96}  # fmt: skip
    hedges = [
        {"name": f"hedge{k}",
         "shape": {"type": "rectangle", "center": [8 * x, 8 * y, 1.5], "size": [16, 3.4],
                   "facing": [-x, -y, 0]},
         "texture": {"type": "noise", "colors": colors, "size": 0.5, "octaves": 5, "variation": 0.4,
                     "grain": 0.1}}
        for k, (x, y, colors) in enumerate([
            (1, 0, ["#1f3318", "#41662d", "#7fa04e"]), (-1, 0, ["#6b5138", "#8c6e4e", "#b99a70"]),
            (0, 1, ["#5b5f60", "#8d8f8c", "#c0c0ba"]), (0, -1, ["#7a4436", "#a2604d", "#c99078"]),
        ])
    ]  # fmt: skip
    crate = {
        "name": "crate",
        "shape": {"type": "box", "center": [-1.2, -2.6, 0.3], "size": [0.7, 0.7, 0.8], "yaw": 20},
        "texture": {"type": "stripes", "colors": ["#c79a5b", "#a97c42"], "size": 0.12},
    }
    return {
        "name": name,
        "title": name,
        "objects": [
            {"name": "lawn", "shape": level if seed % 2 else hills, "texture": grass},
            {"name": "thing",
             "shape": {"type": "body", "resolution": 144, "blend": 0.06, "parts": parts},
             "texture": {"type": "noise", "colors": tops, "size": 0.25, "octaves": 5,
                         "variation": 0.4, "grain": 0.05}},
            crate, *hedges,
        ],
        "lights": [
            {"type": "sun", "elevation": 50, "azimuth": -35, "irradiance": 2.6, "color": "#fff0d8"},
            {"type": "sky", "horizon": "#d3e0ec", "zenith": "#6c9fdb", "radiance": 0.8},
        ],
        "appearance": {"bounces": 1, "spp": 8},
        "cameras": {
            "look_at": [0, 0, 0.8], "radius": 4.6 if name.startswith("horse") else 6.6, "fov": 46, "size": [SIZE, SIZE],
            "source": {"yaw": -70, "height": 1.3}, "targets": [{"yaw": 60, "height": 2.9}],
        },
    }  # fmt: skip


if __name__ == "__main__":
    for kind, seeds in (("horse", HORSES), ("castle", CASTLES)):
        for seed in seeds:
            folder = Path(sys.argv[1], f"{kind}{seed}")
            folder.mkdir(parents=True, exist_ok=True)
            file = folder / f"{kind}{seed}.yaml"
            file.write_text(json.dumps(scene(f"{kind}{seed}", seed)))  # JSON is YAML
            export(load_scene(file), folder, views=VIEWS, size=SIZE, spp=8, points=4000, seed=seed)
