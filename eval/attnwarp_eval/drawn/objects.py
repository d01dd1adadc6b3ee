"""Things of random scenes: each word has a recipe for a body, drawn separately for every instance.

A recipe gives parts about one unit tall that stand on z = 0 and look along +x. Parts without a
colour take the object's; details (eyes, leaves, wheels) keep theirs, unless the whole is of one
material (a statue).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Part = dict[str, Any]
DARK, CREAM, LEAF, WOOD = "#1c1714", "#efe4cc", "#4f8a35", "#6b4a2c"


class Dice:
    """Uniform draws, rounded so that a body's description stays short and its cache key is the same everywhere."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def __call__(self, low: float, high: float) -> float:
        """A number from low to high."""
        return round(float(self.rng.uniform(low, high)), 3)

    def pick(self, choices: list[str]) -> str:
        """One of the choices."""
        return choices[int(self.rng.integers(len(choices)))]


def ellipsoid(x: float, y: float, z: float, *radii: float, **more: Any) -> Part:
    """An ellipsoid, or a ball of one radius."""
    rx, ry, rz = radii if len(radii) == 3 else radii * 3
    return {"type": "ellipsoid", "center": [x, y, z], "radii": [rx, ry, rz], **more}


def rod(start: list[float], end: list[float], first: float, last: float | None = None, **more: Any) -> Part:
    """A rod with round ends."""
    return {"type": "capsule", "start": start, "end": end, "radii": [first, first if last is None else last], **more}


def block(x: float, y: float, z: float, sx: float, sy: float, sz: float, rounded: float = 0.02, **more: Any) -> Part:
    """A box with rounded edges."""
    rounded = min(rounded, 0.49 * min(sx, sy, sz))
    return {"type": "block", "center": [x, y, z], "size": [sx, sy, sz], "round": rounded, **more}


def disc(
    z: float, radius: float, height: float, rounded: float = 0.02, x: float = 0, y: float = 0, **more: Any
) -> Part:
    """A flat cylinder with rounded edges."""
    rounded = min(rounded, 0.49 * height, 0.9 * radius)
    return {"type": "disc", "center": [x, y, z], "radius": radius, "height": height, "round": rounded, **more}


def torus(x: float, y: float, z: float, ring: float, thick: float, **more: Any) -> Part:
    """A ring."""
    return {"type": "torus", "center": [x, y, z], "radii": [ring, thick], **more}


def tube(points: list[list[float]], radii: list[float], **more: Any) -> Part:
    """A tube through points."""
    return {"type": "tube", "points": points, "radii": radii, **more}


def both(part: Part) -> Part:
    """The part and its mirror image across y = 0."""
    return {**part, "mirror": True}


def _ball(u: Dice) -> list[Part]:
    r = u(0.42, 0.5)
    return [ellipsoid(0, 0, r, r, r, r)]


def _cube(u: Dice) -> list[Part]:
    s = u(0.7, 0.9)
    return [block(0, 0, s / 2, s * u(0.9, 1.1), s * u(0.9, 1.1), s, u(0.01, 0.08))]


def _cone(u: Dice) -> list[Part]:
    r, h, n = u(0.36, 0.5), u(0.9, 1.2), 14
    return [disc(h * (k + 0.5) / n, r * (1 - (k + 0.5) / n) + 0.01, 1.25 * h / n, 0.01) for k in range(n)]


def _cylinder(u: Dice) -> list[Part]:
    h = u(0.7, 1.1)
    return [disc(h / 2, u(0.3, 0.42), h, u(0.01, 0.05))]


def _ring(u: Dice) -> list[Part]:
    r, t = u(0.36, 0.42), u(0.09, 0.16)
    if u(0, 1) < 0.5:
        return [torus(0, 0, t, r, t)]
    return [torus(0, 0, r + t, r, t, pitch=90)]


def _mug(u: Dice) -> list[Part]:
    h, r = u(0.7, 0.9), u(0.3, 0.38)
    return [
        disc(h / 2, r, h, 0.03),
        disc(h / 2 + 0.08, r - 0.06, h, 0.01, carve=True, blend=0.0),
        torus(0, r + 0.02, h * u(0.45, 0.55), h * u(0.24, 0.3), u(0.045, 0.06), roll=0, pitch=90, blend=False),
        disc(h / 2 + 0.08, r - 0.06, h, 0.01, carve=True, blend=0.0),
    ]


def _bottle(u: Dice) -> list[Part]:
    r, h, neck = u(0.2, 0.28), u(0.55, 0.7), u(0.06, 0.09)
    return [
        disc(h / 2, r, h, 0.05),
        rod([0, 0, h - 0.06], [0, 0, h + 0.16], r * 0.9, neck, blend=0.06),
        disc(h + 0.3, neck, u(0.3, 0.4), 0.01, blend=0.05),
        disc(h + 0.5, neck * 1.3, 0.09, 0.02, blend=0.0, color=u.pick([DARK, CREAM, "#b88a50"])),
    ]


def _vase(u: Dice) -> list[Part]:
    belly, neck, top, h = u(0.3, 0.4), u(0.11, 0.16), u(0.18, 0.28), u(0.95, 1.15)
    low = u(0.3, 0.5)
    parts = []
    for k in range(16):
        t = (k + 0.5) / 16
        if t < low:
            r = 0.2 + (belly - 0.2) * np.sin(np.pi / 2 * t / low)
        elif t < 0.8:
            r = neck + (belly - neck) * 0.5 * (1 + np.cos(np.pi * (t - low) / (0.8 - low)))
        else:
            r = neck + (top - neck) * ((t - 0.8) / 0.2) ** 2
        parts.append(disc(h * t, float(r), 1.5 * h / 16, 0.02))
    return [*parts, disc(h, neck * 0.75, 0.5, 0.01, carve=True, blend=0.02, color="#3a3028")]


def _chair(u: Dice) -> list[Part]:
    w, seat, leg, back = u(0.5, 0.62), u(0.42, 0.5), u(0.025, 0.045), u(0.95, 1.15)
    parts = [block(0, 0, seat, w, w, u(0.05, 0.09), 0.02)]
    for x in (-1, 1):
        parts.append(both(rod([x * (w / 2 - 0.05), w / 2 - 0.05, 0], [x * (w / 2 - 0.05), w / 2 - 0.05, seat], leg)))
    if u(0, 1) < 0.5:
        parts.append(block(-w / 2 + 0.03, 0, (seat + back) / 2, 0.05, w, back - seat, 0.02))
    else:
        parts.append(both(rod([-w / 2 + 0.03, w / 2 - 0.03, seat], [-w / 2 - 0.02, w / 2 - 0.03, back], 0.03)))
        for k in range(3):
            z = seat + (back - seat) * (0.45 + 0.25 * k)
            parts.append(block(-w / 2 + 0.01, 0, z, 0.03, w - 0.04, 0.09, 0.01))
    return parts


def _table(u: Dice) -> list[Part]:
    h, w, d, t = u(0.6, 0.75), u(1.0, 1.3), u(0.7, 0.95), u(0.05, 0.08)
    if u(0, 1) < 0.35:
        return [disc(h, w / 2, t, 0.02), disc(h / 2, 0.07, h, 0.02), disc(0.03, 0.28, 0.06, 0.02)]
    leg = u(0.035, 0.06)
    legs = [
        both(rod([x * (w / 2 - 0.08), d / 2 - 0.08, 0], [x * (w / 2 - 0.08), d / 2 - 0.08, h], leg)) for x in (-1, 1)
    ]
    return [block(0, 0, h, w, d, t, 0.02), *legs]


def _lamp(u: Dice) -> list[Part]:
    h, r = u(0.85, 1.05), u(0.26, 0.34)
    shade = [disc(h - 0.14 + 0.28 * k / 6, r * (1 - 0.5 * k / 6), 0.07, 0.01) for k in range(7)]
    return [
        disc(0.03, u(0.18, 0.24), 0.06, 0.02, color="#4a4440"),
        rod([0, 0, 0], [0, 0, h], 0.025, color="#4a4440"),
        *shade,
    ]


def _tree(u: Dice) -> list[Part]:
    h = u(0.4, 0.55)
    trunk = rod([0, 0, 0], [u(-0.05, 0.05), 0, h + 0.2], u(0.06, 0.09), 0.04, color=WOOD)
    if u(0, 1) < 0.4:  # a fir
        tiers = [ellipsoid(0, 0, h * 0.6 + 0.22 * k, 0.42 - 0.09 * k, 0.42 - 0.09 * k, 0.16) for k in range(4)]
        return [trunk, *tiers]
    crown = [
        ellipsoid(u(-0.25, 0.25), u(-0.25, 0.25), h + u(0.25, 0.55), u(0.24, 0.34), u(0.24, 0.34), u(0.2, 0.3))
        for _ in range(5)
    ]
    return [trunk, ellipsoid(0, 0, h + 0.4, 0.34, 0.34, 0.3), *crown]


def _mushroom(u: Dice) -> list[Part]:
    h, r = u(0.5, 0.7), u(0.36, 0.5)
    cap = ellipsoid(0, 0, h, r, r, u(0.22, 0.32))
    return [
        rod([0, 0, 0], [u(-0.04, 0.04), 0, h], u(0.1, 0.14), u(0.07, 0.1), color=CREAM),
        {**cap, "blend": 0.0},
        block(0, 0, h - 0.25, 1.2, 1.2, 0.4, 0.01, carve=True, blend=0.02),
        rod([0, 0, 0], [u(-0.04, 0.04), 0, h], u(0.1, 0.14), u(0.07, 0.1), color=CREAM, blend=0.01),
    ]


def _cactus(u: Dice) -> list[Part]:
    h, r = u(0.95, 1.2), u(0.13, 0.18)
    a, b, s = u(0.35, 0.5), u(0.5, 0.7), u(0.06, 0.09)
    return [
        rod([0, 0, 0], [0, 0, h], r),
        tube([[0, 0, a], [0, 0.32, a + 0.02], [0, 0.34, a + u(0.25, 0.4)]], [s, s, s], blend=0.04),
        tube([[0, 0, b], [0, -0.3, b + 0.02], [0, -0.32, b + u(0.2, 0.3)]], [s, s, s], blend=0.04),
    ]


def _house(u: Dice) -> list[Part]:
    w, d, h, roof = u(0.7, 0.9), u(0.6, 0.8), u(0.42, 0.55), u(0.3, 0.42)
    gable = [
        block(
            0,
            0,
            h + roof * (k + 0.5) / 9,
            w * 1.06,
            d * 1.12 * (1 - (k + 0.5) / 9),
            1.3 * roof / 9,
            0.005,
            color="#7c3f30",
        )
        for k in range(9)
    ]
    return [
        block(0, 0, h / 2, w, d, h, 0.01),
        *gable,
        block(w / 2, 0, 0.14, 0.03, 0.16, 0.28, 0.005, color="#4a3020", blend=False),
        both(block(w / 2, d * 0.3, h * 0.6, 0.03, 0.13, 0.13, 0.005, color="#bcd6e6", blend=False)),
        both(block(-w * 0.0, d / 2, h * 0.6, 0.16, 0.03, 0.14, 0.005, color="#bcd6e6", blend=False)),
        block(-w * 0.25, d * 0.2, h + roof * 0.9, 0.1, 0.1, 0.3, 0.01, color="#8c5a48", blend=False),
    ]


def _car(u: Dice) -> list[Part]:
    long, wide, low = u(1.25, 1.5), u(0.55, 0.65), u(0.24, 0.3)
    cabin, r, center = u(0.22, 0.28), u(0.13, 0.16), u(-0.15, 0.05)
    parts = [
        block(0, 0, r + low / 2, long, wide, low, 0.07),
        block(center, 0, r + low + cabin / 2 - 0.02, long * u(0.45, 0.55), wide * 0.88, cabin, 0.08, blend=0.04),
        both(
            block(
                center,
                wide * 0.44,
                r + low + cabin / 2,
                long * 0.36,
                0.02,
                cabin * 0.5,
                0.005,
                color="#22303c",
                blend=False,
            )
        ),
        block(
            center + long * 0.255, 0, r + low + cabin / 2, 0.06, wide * 0.7, cabin * 0.5, 0.01, color="#22303c", blend=False
        ),
        both(ellipsoid(long / 2, wide * 0.33, r + low * 0.55, 0.04, 0.06, 0.05, color="#f5f0d0", blend=False)),
    ]
    for x in (-0.3, 0.3):
        wheel = {"type": "disc", "center": [x * long, wide / 2 - 0.02, r], "radius": r, "height": 0.12, "round": 0.03}
        parts.append(both({**wheel, "roll": 90, "color": DARK, "blend": False}))
    return parts


def _eyes(x: float, y: float, z: float, r: float) -> Part:
    return both(ellipsoid(x, y, z, r, r, r, color=DARK, blend=False))


def _bear(u: Dice) -> list[Part]:
    fat = u(0.9, 1.12)
    if u(0, 1) < 0.5:  # it sits
        return [
            ellipsoid(0, 0, 0.36, 0.26 * fat, 0.29 * fat, 0.36),
            ellipsoid(0.05, 0, 0.82, 0.23, 0.25, 0.22),
            both(ellipsoid(0.02, 0.2, 1.02, 0.05, 0.09, 0.09)),
            ellipsoid(0.25, 0, 0.76, 0.12, 0.12, 0.09),
            ellipsoid(0.36, 0, 0.81, 0.04, 0.05, 0.035, color=DARK, blend=False),
            _eyes(0.25, 0.1, 0.89, 0.028),
            both(rod([0.05, 0.26, 0.56], [0.28, 0.32, u(0.3, 0.45)], 0.11, 0.09)),
            both(rod([0.1, 0.2, 0.12], [0.46, 0.3, 0.12], 0.14, 0.11)),
        ]
    return [  # it walks
        ellipsoid(-0.05, 0, 0.5, 0.46, 0.25 * fat, 0.28 * fat),
        ellipsoid(0.48, 0, 0.66, 0.19, 0.18, 0.17),
        both(ellipsoid(0.45, 0.14, 0.82, 0.04, 0.06, 0.06)),
        ellipsoid(0.64, 0, 0.61, 0.11, 0.09, 0.08),
        ellipsoid(0.74, 0, 0.64, 0.035, 0.04, 0.03, color=DARK, blend=False),
        _eyes(0.6, 0.09, 0.72, 0.022),
        both(rod([0.28, 0.15, 0.4], [0.32, 0.16, 0.07], 0.13, 0.09)),
        both(rod([-0.34, 0.15, 0.4], [-0.34, 0.17, 0.07], 0.14, 0.1)),
    ]


def _dinosaur(u: Dice) -> list[Part]:
    high = u(0.95, 1.1)
    if u(0, 1) < 0.55:  # with plates on its back
        plates = [
            ellipsoid(
                0.42 - 0.2 * k,
                0.03 * (-1) ** k,
                0.82 + 0.16 * np.sin(np.pi * (k + 0.5) / 6),
                0.11,
                0.02,
                0.16,
                blend=False,
                color="#b5683a",
            )
            for k in range(6)
        ]
        return [
            ellipsoid(0, 0, 0.55, 0.48, 0.22, 0.26),
            tube([[0.35, 0, 0.52], [0.6, 0, 0.45], [0.78, 0, 0.48]], [0.15, 0.1, 0.08]),
            ellipsoid(0.84, 0, 0.47, 0.13, 0.07, 0.065),
            _eyes(0.88, 0.055, 0.5, 0.02),
            tube([[-0.38, 0, 0.56], [-0.75, 0.03, 0.48], [-1.1, 0.12, 0.46]], [0.18, 0.1, 0.03]),
            both(rod([-0.24, 0.14, 0.45], [-0.24, 0.18, 0.06], 0.13, 0.08)),
            both(rod([0.28, 0.12, 0.4], [0.3, 0.16, 0.05], 0.1, 0.06)),
            *plates,
        ]
    return [  # with a long neck
        ellipsoid(0, 0, 0.5 * high, 0.42, 0.24, 0.25),
        tube([[0.3, 0, 0.55], [0.55, 0, 0.85], [0.66, 0, 1.15]], [0.16, 0.1, 0.07]),
        ellipsoid(0.74, 0, 1.19, 0.12, 0.07, 0.07),
        _eyes(0.78, 0.055, 1.22, 0.018),
        tube([[-0.3, 0, 0.5], [-0.7, 0, 0.36], [-1.15, u(-0.2, 0.2), 0.3]], [0.19, 0.1, 0.03]),
        both(rod([-0.22, 0.15, 0.4], [-0.22, 0.17, 0.05], 0.11, 0.09)),
        both(rod([0.24, 0.15, 0.4], [0.24, 0.17, 0.05], 0.1, 0.08)),
    ]


def _person(u: Dice) -> list[Part]:
    skin = u.pick(["#d9a684", "#c48a68", "#8a5a3c", "#5a3a28"])
    hair = u.pick(["#2a1c14", "#5b3a1f", "#8a6234", "#b9a27a"])
    lift = u(-0.1, 0.5)
    return [
        rod([0, 0, 0.6], [0, 0, 0.92], 0.12, 0.13),
        both(rod([0, 0.07, 0.58], [u(-0.04, 0.04), 0.1, 0.07], 0.08, 0.055)),
        both(ellipsoid(0.05, 0.1, 0.04, 0.1, 0.05, 0.04, color=DARK)),
        rod([0, 0.14, 0.94], [0.06, 0.3, 0.64], 0.05, 0.04),
        rod([0, -0.14, 0.94], [0.06, -0.34, 0.64 + lift], 0.05, 0.04),
        ellipsoid(0.07, 0.31, 0.6, 0.04, color=skin),
        ellipsoid(0.07, -0.36, 0.6 + 1.1 * lift, 0.04, color=skin),
        ellipsoid(0.01, 0, 1.14, 0.095, 0.085, 0.115, color=skin, blend=0.02),
        ellipsoid(-0.03, 0, 1.18, 0.095, 0.1, 0.1, color=hair, blend=False),
        _eyes(0.1, 0.035, 1.15, 0.014),
    ]


def _bust(u: Dice) -> list[Part]:
    wide = u(0.95, 1.1)
    return [
        ellipsoid(0, 0, 0.2, 0.22, 0.46 * wide, 0.24),
        disc(0.03, 0.3, 0.08, 0.02),
        rod([0, 0, 0.3], [0.03, 0, 0.55], 0.14, 0.12),
        ellipsoid(0.03, 0, 0.78, 0.23, 0.19, 0.26),
        ellipsoid(0.09, 0, 0.64, 0.15, 0.14, 0.13),
        rod([0.25, 0, 0.78], [0.29, 0, 0.68], 0.025, 0.04, blend=0.03),
        both(ellipsoid(0.02, 0.19, 0.74, 0.045, 0.025, 0.07, blend=0.02)),
        both(ellipsoid(0.225, 0.075, 0.79, 0.03, 0.04, 0.025, color="#f4f0e8", blend=False)),
        _eyes(0.248, 0.075, 0.79, 0.014),
        ellipsoid(0.225, 0, 0.585, 0.03, 0.07, 0.02, color="#8c463c", blend=False),
        ellipsoid(-0.03, 0, 0.87, 0.235, 0.205, 0.21, color=u.pick(["#2a1c14", "#5b3a1f", "#8a8580"]), blend=False),
        ellipsoid(0.3, 0, 0.72, 0.2, 0.16, 0.22, carve=True, blend=False),
        ellipsoid(0.03, 0, 0.77, 0.225, 0.185, 0.245, blend=0.0),
        both(ellipsoid(0.215, 0.075, 0.79, 0.03, 0.04, 0.025, color="#f4f0e8", blend=False)),
        _eyes(0.24, 0.075, 0.79, 0.014),
        rod([0.23, 0, 0.79], [0.27, 0, 0.69], 0.022, 0.036, blend=0.03),
    ]


def _rabbit(u: Dice) -> list[Part]:
    ear = u(0.3, 0.42)
    return [
        ellipsoid(-0.05, 0, 0.3, 0.34, 0.25, 0.3),
        ellipsoid(0.26, 0, 0.58, 0.18, 0.16, 0.17),
        both(rod([0.2, 0.06, 0.7], [0.1, u(0.1, 0.18), 0.7 + ear], 0.05, 0.035)),
        ellipsoid(-0.4, 0, 0.3, 0.11, 0.11, 0.11, color="#f4f0e8"),
        _eyes(0.37, 0.1, 0.62, 0.028),
        ellipsoid(0.43, 0, 0.56, 0.03, 0.03, 0.025, color="#c47a78", blend=False),
        both(rod([0.2, 0.12, 0.2], [0.34, 0.13, 0.05], 0.08, 0.06)),
        both(ellipsoid(-0.05, 0.2, 0.1, 0.22, 0.09, 0.1)),
    ]


def _duck(u: Dice) -> list[Part]:
    h = u(0.62, 0.75)
    beak = "#e8922a"
    return [
        ellipsoid(0, 0, 0.3, 0.42, 0.28, 0.28),
        rod([0.26, 0, 0.4], [0.32, 0, h], 0.13, 0.12),
        ellipsoid(0.33, 0, h + 0.06, 0.17, 0.155, 0.16),
        ellipsoid(0.52, 0, h + 0.03, 0.12, 0.08, 0.03, color=beak, blend=False),
        _eyes(0.42, 0.11, h + 0.11, 0.026),
        rod([-0.34, 0, 0.38], [-0.52, 0, 0.52], 0.12, 0.03),
        both(ellipsoid(-0.04, 0.26, 0.34, 0.24, 0.05, 0.15, pitch=12)),
    ]


def _snowman(u: Dice) -> list[Part]:
    a, b, c = u(0.3, 0.35), u(0.21, 0.25), u(0.15, 0.18)
    top = 2 * a * 0.9 + 2 * b * 0.85 + c * 0.8
    z = a * 1.8 + b * 0.75
    return [
        ellipsoid(0, 0, a * 0.95, a),
        ellipsoid(0, 0, z, b),
        ellipsoid(0, 0, top, c),
        rod([c * 0.9, 0, top], [c + u(0.12, 0.2), 0, top], 0.035, 0.008, color="#e07a28", blend=False),
        _eyes(c * 0.88, 0.06, top + 0.05, 0.022),
        *[ellipsoid(b * 0.97, 0, z + d, 0.025, color=DARK, blend=False) for d in (-0.08, 0.04)],
        both(rod([0, b * 0.8, z], [0, b + u(0.2, 0.3), z + 0.14], 0.02, 0.012, color=WOOD, blend=False)),
        *(
            [
                disc(top + c * 0.8, c * 1.1, 0.03, 0.01, color=DARK, blend=False),
                disc(top + c * 1.3, c * 0.75, 0.2, 0.01, color=DARK, blend=False),
            ]
            if u(0, 1) < 0.6
            else []
        ),
    ]


def _stump(u: Dice) -> list[Part]:
    r, h = u(0.32, 0.42), u(0.42, 0.6)
    root = tube([[r * 0.6, 0, 0.14], [r * 1.25, 0.04, 0.05], [r * 1.9, -0.04, -0.05]], [0.14, 0.09, 0.03])
    return [
        rod([0, 0, 0], [0.01, 0, h], r * 1.1, r * 0.95),
        {**root, "ring": {"count": int(u(5, 8)), "jitter": 0.6, "seed": int(u(0, 99))}},
        block(0, 0, h + 0.45, 2, 2, 0.9, 0.01, carve=True, blend=0.02, pitch=u(-4, 4)),
        disc(h + 0.005, r * 0.82, 0.03, 0.01, color="#e0bf8c", blend=False),
    ]


def _plant(u: Dice) -> list[Part]:
    r, h, n = u(0.2, 0.27), u(0.34, 0.44), int(u(6, 10))
    top, tall = u(0.3, 0.42), u(0.3, 0.5)
    pot = [disc(h * (k + 0.5) / 6, r * (0.72 + 0.28 * (k + 0.5) / 6), 1.3 * h / 6, 0.01) for k in range(6)]
    stem = tube([[0, 0, h], [0.1, 0, h + 0.6 * tall], [top, 0, h + tall]], [0.02, 0.018, 0.01], color=LEAF)
    leaf = ellipsoid(top * 0.8, 0, h + tall * 0.85, 0.19, 0.08, 0.02, pitch=-20, color=LEAF, blend=False)
    ring = {"count": n, "jitter": 0.5, "seed": int(u(0, 99))}
    return [*pot, disc(h, r * 1.08, 0.07, 0.02), {**stem, "ring": ring, "blend": False}, {**leaf, "ring": ring}]


RECIPES: dict[str, Callable[[Dice], list[Part]]] = {
    "ball": _ball, "cube": _cube, "cone": _cone, "cylinder": _cylinder, "ring": _ring, "mug": _mug, "bottle": _bottle,
    "vase": _vase, "chair": _chair, "table": _table, "lamp": _lamp, "tree": _tree, "mushroom": _mushroom,
    "cactus": _cactus, "house": _house, "car": _car, "bear": _bear, "dinosaur": _dinosaur, "person": _person,
    "bust": _bust, "rabbit": _rabbit, "duck": _duck, "snowman": _snowman, "stump": _stump, "plant": _plant,
}  # fmt: skip
"""Every word for an object, with its recipe."""

SHARP = {"cube", "cone", "cylinder", "mug", "chair", "table", "lamp", "house", "vase"}
"""Objects whose parts meet in edges rather than in fillets."""


def body(word: str, instance: int, *, plain: bool = False, resolution: int = 64) -> dict[str, Any]:
    """The shape of one instance of ``word``, in the format of a scene file, at the origin.

    Args:
        word: a key of :data:`RECIPES`.
        instance: the same number gives the same shape.
        plain: without the details' colours, as for a statue.
    """
    rng = np.random.default_rng([instance, *word.encode()])
    parts = RECIPES[word](Dice(rng))
    if plain:
        parts = [{k: v for k, v in part.items() if k != "color"} for part in parts]
    return {
        "type": "body",
        "parts": plain_numbers(parts),
        "blend": 0.0 if word in SHARP else 0.05,
        "resolution": resolution,
    }


def plain_numbers(value: Any) -> Any:
    """A description with Python numbers, rounded except for the position of a mesh of any size."""
    if isinstance(value, dict) and value.get("type") == "mesh":
        return value
    if isinstance(value, dict):
        return {k: plain_numbers(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain_numbers(v) for v in value]
    return round(float(value), 4) if isinstance(value, np.floating | float) else value
