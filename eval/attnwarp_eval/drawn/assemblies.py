"""Things with named parts: people in garments, plants in pots, stumps with mushrooms, laid tables.

Each part is a separate object with a surface, words and exact pixels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from attnwarp_eval.drawn.objects import (
    Dice,
    Part,
    block,
    both,
    disc,
    ellipsoid,
    rod,
    torus,
    tube,
)

Pieces = dict[str, list[Part]]


def _person(u: Dice) -> Pieces:
    lift, width = u(-0.1, 0.5), u(0.9, 1.15)
    pieces: Pieces = {
        "trousers": [
            both(rod([0, 0.07, 0.6], [u(-0.04, 0.04), 0.1, 0.1], 0.085 * width, 0.06)),
            ellipsoid(0, 0, 0.62, 0.13 * width, 0.14 * width, 0.1),
        ],
        "jacket": [
            rod([0, 0, 0.68], [0, 0, 0.94], 0.135 * width, 0.14 * width),
            rod([0, 0.15, 0.95], [0.06, 0.3, 0.66], 0.06, 0.05),
            rod([0, -0.15, 0.95], [0.06, -0.34, 0.66 + lift], 0.06, 0.05),
        ],
        "skin": [
            ellipsoid(0.01, 0, 1.16, 0.095, 0.085, 0.115),
            rod([0, 0, 1.0], [0, 0, 1.1], 0.05),
            ellipsoid(0.07, 0.31, 0.61, 0.045),
            ellipsoid(0.07, -0.36, 0.61 + 1.1 * lift, 0.045),
        ],
        "hair": [ellipsoid(-0.03, 0, 1.2, 0.1, 0.105, 0.1)],
        "shoes": [both(ellipsoid(0.05, 0.1, 0.05, 0.12, 0.06, 0.05))],
    }
    draw = u(0, 1)
    if draw < 0.3:
        pieces["hat"] = [disc(1.24, 0.19, 0.03, 0.01), disc(1.31, 0.11, 0.14, 0.03)]
    elif draw < 0.5:
        pieces["scarf"] = [
            torus(0, 0, 1.02, 0.1, 0.045),
            rod([0.12, 0.05, 1.0], [0.15, 0.07, 0.8], 0.035),
        ]
    elif draw < 0.7:
        pieces["backpack"] = [block(-0.2, 0, 0.84, 0.14, 0.24, 0.3, 0.05)]
    if u(0, 1) < 0.3:
        del pieces["trousers"]
        pieces["skirt"] = [disc(0.52 + 0.03 * k, 0.2 - 0.012 * k, 0.05, 0.01) for k in range(6)]
        pieces["skin"].append(both(rod([0, 0.07, 0.5], [0, 0.09, 0.1], 0.05, 0.04)))
    return pieces


def _bust(u: Dice) -> Pieces:
    wide = u(0.92, 1.12)
    pieces: Pieces = {
        "shirt": [ellipsoid(0, 0, 0.2, 0.23, 0.46 * wide, 0.25), disc(0.03, 0.3, 0.08, 0.02)],
        "skin": [
            rod([0, 0, 0.36], [0.03, 0, 0.55], 0.12, 0.11),
            ellipsoid(0.03, 0, 0.78, 0.22, 0.185, 0.26),
            ellipsoid(0.09, 0, 0.64, 0.15, 0.14, 0.13),
            rod([0.25, 0, 0.78], [0.29, 0, 0.68], 0.025, 0.04),
            both(ellipsoid(0.02, 0.19, 0.74, 0.045, 0.03, 0.07)),
        ],
        "hair": [
            ellipsoid(-0.07, 0, 0.86, 0.22, 0.215, 0.22),
            ellipsoid(0.02, 0, 0.98, 0.2, 0.17, 0.08),
            *([both(ellipsoid(-0.08, 0.17, 0.66, 0.1, 0.05, 0.2))] if u(0, 1) < 0.4 else []),
        ],
        "eyes": [both(ellipsoid(0.235, 0.075, 0.8, 0.025))],
        "lips": [ellipsoid(0.225, 0, 0.585, 0.035, 0.07, 0.022)],
    }
    draw = u(0, 1)
    if draw < 0.3:
        pieces["beard"] = [
            ellipsoid(0.13, 0, 0.55, 0.15, 0.15, 0.11),
            ellipsoid(0.24, 0, 0.63, 0.04, 0.1, 0.02),
        ]
    elif draw < 0.55:
        pieces["hat"] = [disc(0.97, 0.36, 0.03, 0.01), disc(1.08, 0.2, 0.2, 0.04)]
    elif draw < 0.75:
        pieces["scarf"] = [torus(0.02, 0, 0.45, 0.15, 0.065)]
    return pieces


def _potted(u: Dice, x: float = 0, y: float = 0, z: float = 0, size: float = 1) -> Pieces:
    """A plant in a pot, alone or on a table."""
    r, h, n = u(0.2, 0.28), u(0.32, 0.44), int(u(5, 9))
    tall = u(0.25, 0.5)
    pot = [
        disc(h * (k + 0.5) / 6, r * (0.72 + 0.28 * (k + 0.5) / 6), 1.3 * h / 6, 0.01)
        for k in range(6)
    ]
    pot.append(disc(h, r * 1.08, 0.07, 0.02))
    leaves, flowers = [], []
    for k in range(n):
        angle, far = 2 * np.pi * (k + u(-0.3, 0.3)) / n, u(0.12, 0.34)
        px, py, top = far * np.cos(angle), far * np.sin(angle), h + tall * u(0.7, 1.1)
        leaves.append(
            tube(
                [[0, 0, h], [0.4 * px, 0.4 * py, h + 0.6 * tall], [px, py, top]],
                [0.025, 0.022, 0.015],
            )
        )
        leaves.append(ellipsoid(0.8 * px, 0.8 * py, top - 0.06, 0.13, 0.13, 0.035))
        flowers.append(ellipsoid(px, py, top + 0.03, 0.085, 0.085, 0.06))
    pieces: Pieces = {"pot": pot, "leaves": leaves}
    if u(0, 1) < 0.6:
        pieces["flowers"] = flowers[: max(1, int(u(1, n + 0.99)))]
    return {name: [_moved(part, x, y, z, size) for part in parts] for name, parts in pieces.items()}


def _plant(u: Dice) -> Pieces:
    if u(0, 1) < 0.35:  # on a stool
        stool = [disc(0.4, 0.3, 0.05, 0.02)]
        stool += [both(rod([x, 0.18, 0], [x * 0.7, 0.14, 0.4], 0.025)) for x in (-0.2, 0.2)]
        return {"stool": stool, **_potted(u, z=0.42, size=0.75)}
    return _potted(u)


def _table(u: Dice) -> Pieces:
    h, w, d, t = u(0.5, 0.65), u(1.0, 1.3), u(0.75, 1.0), u(0.05, 0.08)
    leg = u(0.035, 0.06)
    if u(0, 1) < 0.35:
        table = [disc(h, w / 2, t, 0.02), disc(h / 2, 0.07, h, 0.02), disc(0.03, 0.28, 0.06, 0.02)]
    else:
        table = [block(0, 0, h, w, d, t, 0.02)]
        for x in (-1, 1):
            corner = [x * (w / 2 - 0.08), d / 2 - 0.08]
            table.append(both(rod([*corner, 0], [*corner, h], leg)))
    top = h + t / 2
    pieces: Pieces = {"table": table}
    draw = u(0, 1)
    if draw < 0.55:
        pieces |= _potted(u, u(-0.15, 0.15), u(-0.12, 0.12), top, u(0.5, 0.75))
    elif draw < 0.75:
        pieces["vase"] = [
            disc(top + 0.04 * k, 0.06 + 0.05 * np.sin(0.5 * k), 0.05, 0.01) for k in range(8)
        ]
    if u(0, 1) < 0.5:
        pieces["plates"] = [both(disc(top + 0.015, 0.13, 0.03, 0.01, x=u(-0.1, 0.3), y=0.24))]
    if u(0, 1) < 0.5:
        pieces["cup"] = [disc(top + 0.07, 0.06, 0.14, 0.02, x=-0.3, y=u(-0.2, 0.2))]
    if u(0, 1) < 0.4:
        pieces["tablecloth"] = [block(0, 0, h + 0.005, 0.55 * w, 0.72 * d, t + 0.015, 0.01)]
    if len(pieces) == 1:
        pieces["bowl"] = [ellipsoid(0, 0, top + 0.08, 0.2, 0.2, 0.09)]
    return pieces


def _stump(u: Dice) -> Pieces:
    r, h = u(0.32, 0.42), u(0.4, 0.6)
    root = tube(
        [[r * 0.6, 0, 0.14], [r * 1.25, 0.04, 0.05], [r * 1.9, -0.04, -0.05]], [0.14, 0.09, 0.03]
    )
    pieces: Pieces = {
        "bark": [
            rod([0, 0, 0], [0.01, 0, h - r], r * 1.1, r * 1.02),
            disc(h - 0.13, r, 0.26, 0.02),
            {**root, "ring": {"count": int(u(5, 8)), "jitter": 0.6, "seed": int(u(0, 99))}},
            block(0, 0, h + 0.75, 2, 2, 1.5, 0.01, carve=True, blend=0.0),
        ],
        "wood": [disc(h + 0.005, r * 0.85, 0.03, 0.01)],
    }
    if u(0, 1) < 0.65:
        count = int(u(3, 7))
        caps, stems = [], []
        for k in range(count):
            angle, far, size = u(-1.2, 1.2) + 3.1 * (k % 2), r * u(1.25, 1.7), u(0.6, 1.2)
            x, y, z = far * np.cos(angle), far * np.sin(angle), 0.17 * size
            stems.append(rod([x, y, 0], [x, y, z], 0.035 * size))
            caps.append(ellipsoid(x, y, z + 0.03, 0.12 * size, 0.12 * size, 0.075 * size))
        pieces |= {"mushrooms": caps, "stems": stems}
    if u(0, 1) < 0.5 or len(pieces) == 2:
        pieces["axe handle"] = [rod([0.05, 0, h + 0.06], [-0.32, 0.05, h + u(0.35, 0.5)], 0.028)]
        pieces["axe blade"] = [block(0.08, 0, h + 0.06, 0.2, 0.05, 0.16, 0.01)]
    return pieces


def _axe(u: Dice) -> Pieces:
    long, lean = u(0.85, 1.05), u(-0.2, 0.2)
    top = [lean, 0, long]
    head = [block(lean + 0.12, 0, long - 0.1, u(0.24, 0.34), 0.07, u(0.2, 0.28), 0.02)]
    if u(0, 1) < 0.3:
        head.append(block(lean - 0.1, 0, long - 0.1, 0.2, 0.09, 0.11, 0.02))
    stand = [disc(0.06, u(0.25, 0.35), 0.12, 0.02)]
    return {"axe handle": [rod([0, 0, 0.1], top, u(0.03, 0.05))], "axe blade": head, "stand": stand}


def _shovel(u: Dice) -> Pieces:
    long = u(0.9, 1.1)
    return {
        "shovel handle": [
            rod([0, 0, 0.35], [-0.1, 0, long], 0.032),
            rod([-0.1, -0.1, long], [-0.1, 0.1, long], 0.032),
        ],
        "shovel blade": [block(0.02, 0, 0.22, 0.05, u(0.22, 0.3), 0.36, 0.02)],
        "bucket": [disc(0.15, 0.14, 0.3, 0.02, x=0.35, y=u(-0.2, 0.2))],
    }


def _dinosaur(u: Dice) -> Pieces:
    count = int(u(5, 9))
    plates = [
        ellipsoid(
            0.45 - 1.05 * (k + 0.5) / count, 0.03 * (-1) ** k, 0.74 + 0.2 * np.sin(np.pi * (k + 0.5) / count),
            0.12, 0.025, u(0.13, 0.19),
        ) for k in range(count)
    ]  # fmt: skip
    body = [
        ellipsoid(0, 0, 0.55, 0.48, u(0.2, 0.25), 0.27),
        tube([[0.35, 0, 0.52], [0.6, 0, 0.45], [0.78, 0, 0.48]], [0.15, 0.1, 0.08]),
        ellipsoid(0.84, 0, 0.47, 0.13, 0.07, 0.065),
        tube([[-0.38, 0, 0.56], [-0.75, 0.03, 0.48], [-1.1, 0.12, 0.46]], [0.18, 0.1, 0.03]),
        both(rod([-0.24, 0.14, 0.45], [-0.24, 0.18, 0.06], 0.13, 0.08)),
        both(rod([0.28, 0.12, 0.4], [0.3, 0.16, 0.05], 0.1, 0.06)),
    ]
    return {
        "body": body,
        "plates of the back": plates,
        "eyes": [both(ellipsoid(0.89, 0.055, 0.5, 0.025))],
    }


def _bear(u: Dice) -> Pieces:
    fat = u(0.9, 1.12)
    pieces: Pieces = {
        "fur": [
            ellipsoid(0, 0, 0.36, 0.26 * fat, 0.29 * fat, 0.36),
            ellipsoid(0.05, 0, 0.82, 0.23, 0.25, 0.22),
            both(ellipsoid(0.02, 0.2, 1.02, 0.05, 0.09, 0.09)),
            both(rod([0.05, 0.26, 0.56], [0.28, 0.32, u(0.3, 0.45)], 0.11, 0.09)),
            both(rod([0.1, 0.2, 0.12], [0.46, 0.3, 0.12], 0.14, 0.11)),
        ],
        "snout": [ellipsoid(0.25, 0, 0.76, 0.12, 0.12, 0.09)],
        "nose": [
            ellipsoid(0.36, 0, 0.81, 0.04, 0.05, 0.035),
            both(ellipsoid(0.25, 0.1, 0.89, 0.03)),
        ],
    }
    draw = u(0, 1)
    if draw < 0.4:
        pieces["scarf"] = [
            torus(0.03, 0, 0.63, 0.17, 0.06),
            rod([0.22, 0.06, 0.6], [0.3, 0.08, 0.36], 0.045),
        ]
    elif draw < 0.7:
        pieces["hat"] = [disc(1.02, 0.22, 0.03, 0.01), disc(1.11, 0.13, 0.18, 0.02)]
    else:
        pieces["belly"] = [ellipsoid(0.13, 0, 0.36, 0.17 * fat, 0.2 * fat, 0.26)]
    return pieces


def _house(u: Dice) -> Pieces:
    w, d, h, roof = u(0.7, 0.9), u(0.6, 0.8), u(0.42, 0.55), u(0.3, 0.42)
    gable = [
        block(
            0,
            0,
            h + roof * (k + 0.5) / 9,
            w * 1.08,
            d * 1.14 * (1 - (k + 0.5) / 9),
            1.3 * roof / 9,
            0.005,
        )
        for k in range(9)
    ]
    return {
        "walls": [block(0, 0, h / 2, w, d, h, 0.01)],
        "roof": gable,
        "door": [
            block(w / 2, 0, 0.15, 0.05, 0.18, 0.3, 0.005),
            block(-w / 2, 0, 0.15, 0.05, 0.18, 0.3, 0.005),
        ],
        "windows": [
            both(block(x * w / 2, d * 0.3, h * 0.6, 0.05, 0.14, 0.14, 0.005)) for x in (-1, 1)
        ],
        "chimney": [block(-w * 0.25, d * 0.2, h + roof * 0.9, 0.12, 0.12, 0.34, 0.01)],
    }


def _car(u: Dice) -> Pieces:
    long, wide, low = u(1.25, 1.5), u(0.55, 0.65), u(0.24, 0.3)
    cabin, r, center = u(0.22, 0.28), u(0.13, 0.16), u(-0.15, 0.05)
    wheels = [
        both({"type": "disc", "center": [x * long, wide / 2 - 0.02, r], "radius": r, "height": 0.12, "round": 0.03, "roll": 90})
        for x in (-0.3, 0.3)
    ]  # fmt: skip
    return {
        "car body": [block(0, 0, r + low / 2, long, wide, low, 0.07)],
        "car roof": [
            block(
                center,
                0,
                r + low + cabin / 2 - 0.02,
                long * u(0.45, 0.55),
                wide * 0.88,
                cabin,
                0.08,
            )
        ],
        "wheels": wheels,
    }


def _snowman(u: Dice) -> Pieces:
    a, b, c = u(0.3, 0.35), u(0.21, 0.25), u(0.15, 0.18)
    z, top = a * 1.8 + b * 0.75, 2 * a * 0.9 + 2 * b * 0.85 + c * 0.8
    return {
        "body": [ellipsoid(0, 0, a * 0.95, a), ellipsoid(0, 0, z, b), ellipsoid(0, 0, top, c)],
        "hat": [disc(top + c * 0.8, c * 1.2, 0.03, 0.01), disc(top + c * 1.35, c * 0.8, 0.22, 0.01)],
        "nose": [rod([c * 0.9, 0, top], [c + u(0.12, 0.2), 0, top], 0.04, 0.012)],
        "scarf": [torus(0, 0, z + b * 0.85, b * 0.6, 0.055), rod([b * 0.7, 0.05, z + 0.16], [b + 0.06, 0.08, z - 0.1], 0.045)],
    }  # fmt: skip


def _chair(u: Dice) -> Pieces:
    w, seat, leg, back = u(0.5, 0.62), u(0.42, 0.5), u(0.03, 0.045), u(0.95, 1.15)
    frame = [
        both(
            rod(
                [x * (w / 2 - 0.05), w / 2 - 0.05, 0], [x * (w / 2 - 0.05), w / 2 - 0.05, seat], leg
            )
        )
        for x in (-1, 1)
    ]
    frame += [
        block(0, 0, seat, w, w, 0.06, 0.02),
        block(-w / 2 + 0.03, 0, (seat + back) / 2, 0.05, w, back - seat, 0.02),
    ]
    return {"chair": frame, "cushion": [block(0.03, 0, seat + 0.07, w * 0.82, w * 0.86, 0.1, 0.04)]}


def _lamp(u: Dice) -> Pieces:
    h, r = u(0.85, 1.05), u(0.26, 0.34)
    return {
        "lampshade": [
            disc(h - 0.14 + 0.28 * k / 6, r * (1 - 0.5 * k / 6), 0.07, 0.01) for k in range(7)
        ],
        "lamp foot": [
            disc(0.04, u(0.18, 0.26), 0.08, 0.02),
            rod([0, 0, 0], [0, 0, h], u(0.03, 0.06)),
        ],
    }


def _tree(u: Dice) -> Pieces:
    h = u(0.4, 0.55)
    crown = [
        ellipsoid(
            u(-0.25, 0.25),
            u(-0.25, 0.25),
            h + u(0.25, 0.55),
            u(0.24, 0.34),
            u(0.24, 0.34),
            u(0.2, 0.3),
        )
        for _ in range(5)
    ]
    fruit = []
    for part in crown:
        x, y, z = part["center"]
        rx, ry, rz = part["radii"]
        for _ in range(2):
            angle, rise = u(0, 6.28), u(-0.4, 0.7)
            flat = (1 - rise**2) ** 0.5
            fruit.append(
                ellipsoid(
                    x + rx * flat * np.cos(angle),
                    y + ry * flat * np.sin(angle),
                    z + rz * rise,
                    0.065,
                )
            )
    return {
        "trunk": [rod([0, 0, 0], [u(-0.05, 0.05), 0, h + 0.2], u(0.07, 0.1), 0.05)],
        "leaves": [ellipsoid(0, 0, h + 0.4, 0.34, 0.34, 0.3), *crown],
        "apples": fruit,
    }


def _mushroom(u: Dice) -> Pieces:
    h, r = u(0.5, 0.7), u(0.36, 0.5)
    stem = rod([0, 0, 0], [u(-0.04, 0.04), 0, h], u(0.1, 0.14), u(0.07, 0.1))
    return {
        "cap": [
            ellipsoid(0, 0, h, r, r, u(0.22, 0.32)),
            block(0, 0, h - 0.25, 1.2, 1.2, 0.4, 0.01, carve=True, blend=0.0),
        ],
        "stem": [stem],
    }


def _bowl(u: Dice) -> Pieces:
    apples, bananas = [], []
    for k in range(4):
        angle = 1.57 * k + u(-0.3, 0.3)
        apples.append(ellipsoid(0.17 * np.cos(angle), 0.17 * np.sin(angle), 0.52, 0.12))
    for k in (-1, 1):
        bananas.append(
            tube(
                [[-0.28, 0.07 * k, 0.62], [0, 0.09 * k, 0.7], [0.28, 0.07 * k, 0.6]],
                [0.03, 0.055, 0.03],
            )
        )
    return {
        "bowl": [ellipsoid(0, 0, 0.42, 0.4, 0.4, 0.2), block(0, 0, 0.95, 1, 1, 0.9, 0.01, carve=True, blend=0.0)],
        "apples": apples,
        "bananas": bananas,
        "stand": [disc(0.12, u(0.2, 0.34), 0.24, 0.02)],
    }  # fmt: skip


RECIPES: dict[str, Callable[[Dice], Pieces]] = {
    "person": _person, "bust": _bust, "plant": _plant, "table": _table, "stump": _stump, "axe": _axe, "shovel": _shovel,
    "dinosaur": _dinosaur, "bear": _bear, "house": _house, "car": _car, "snowman": _snowman, "chair": _chair, "lamp": _lamp,
    "tree": _tree, "mushroom": _mushroom, "bowl": _bowl,
}  # fmt: skip
"""Every thing with parts, with its recipe."""

KINDS = tuple(RECIPES)

PART_NOUNS: dict[str, tuple[str, ...]] = {
    "jacket": ("jacket", "coat", "shirt", "sweater"), "trousers": ("trousers", "pants", "jeans"), "skirt": ("skirt", "dress"),
    "hair": ("hair",), "shoes": ("shoes", "boots"), "hat": ("hat", "cap"), "scarf": ("scarf",), "backpack": ("backpack", "bag"),
    "shirt": ("shirt", "clothes", "suit"), "lips": ("lips", "mouth"), "beard": ("beard",), "eyes": ("eyes",), "skin": ("face", "skin"),
    "pot": ("pot", "flower pot", "planter"), "leaves": ("leaves", "foliage"), "flowers": ("flowers", "flower", "blossoms"),
    "stool": ("stool",), "table": ("table", "desk"), "vase": ("vase",), "plates": ("plates", "dishes"), "cup": ("cup", "mug"),
    "tablecloth": ("tablecloth", "cloth"), "bowl": ("bowl",), "bark": ("bark", "trunk"), "wood": ("wood", "top"),
    "mushrooms": ("mushrooms", "mushroom caps", "toadstools"), "stems": ("stems",), "axe handle": ("axe handle", "handle"),
    "axe blade": ("axe blade", "axe head", "blade"), "stand": ("stand", "pedestal", "base"), "shovel handle": ("shovel handle", "handle"),
    "shovel blade": ("shovel blade", "blade"), "bucket": ("bucket",), "body": ("body",), "plates of the back": ("plates",),
    "fur": ("fur",), "snout": ("snout",), "nose": ("nose",), "belly": ("belly",), "walls": ("walls", "wall"), "roof": ("roof",),
    "door": ("door",), "windows": ("windows",), "chimney": ("chimney",), "car body": ("body of the car", "car body"),
    "car roof": ("roof of the car", "car roof"), "wheels": ("wheels", "tyres"), "chair": ("chair", "frame of the chair"),
    "cushion": ("cushion", "seat"), "lampshade": ("lampshade", "shade"), "lamp foot": ("foot of the lamp", "lamp stand"),
    "trunk": ("trunk",), "apples": ("apples", "fruit"), "bananas": ("bananas",), "cap": ("cap", "mushroom cap"), "stem": ("stem",),
}  # fmt: skip
"""Nouns of each part in sentences."""

USUAL: dict[str, tuple[str, ...]] = {
    "skin": ("pink", "brown", "orange"), "hair": ("brown", "black", "yellow", "grey"), "beard": ("brown", "black", "grey"),
    "eyes": ("black",), "lips": ("red", "pink"), "leaves": ("green",), "flowers": ("pink", "red", "yellow", "white", "purple"),
    "bark": ("brown", "grey"), "wood": ("orange", "brown"), "trunk": ("brown",), "mushrooms": ("red", "brown", "orange"),
    "stems": ("white",), "stem": ("white",), "cap": ("red", "brown"), "axe handle": ("brown", "orange"), "axe blade": ("grey",),
    "shovel handle": ("brown",), "shovel blade": ("grey",), "plates": ("white",), "plates of the back": ("orange", "brown"), "fur": ("brown", "black"),
    "snout": ("orange", "brown"), "nose": ("black",), "roof": ("red", "brown"), "wheels": ("black",), "apples": ("red", "green"),
    "bananas": ("yellow",), "body": ("white", "green", "grey"), "pot": ("orange", "blue", "white"), "table": ("brown", "orange"),
    "shoes": ("black", "brown"),
}  # fmt: skip
"""Colours of a part before an edit in six of ten worlds; in the others any colour."""


def _moved(part: Part, x: float, y: float, z: float, size: float) -> Part:
    """A part scaled about the origin, then moved."""
    offset = np.array([x, y, z])
    new = dict(part)
    for key in ("center", "start", "end"):
        if key in part:
            new[key] = [float(v) for v in size * np.array(part[key]) + offset]
    if "points" in part:
        new["points"] = [[float(v) for v in size * np.array(p) + offset] for p in part["points"]]
    for key in ("radius", "height", "round"):
        if key in part:
            new[key] = size * part[key]
    for key in ("radii", "size"):
        if key in part:
            new[key] = [size * v for v in part[key]]
    return new


def pieces(kind: str, instance: int) -> Pieces:
    """Shapes of the parts of a thing, in their order.

    Args:
        kind: name of the thing, one of :data:`KINDS`.
        instance: decides the shapes.

    Example:
        >>> list(pieces("mushroom", 3))
        ['cap', 'stem']
    """
    rng = np.random.default_rng([instance, *b"parts", *kind.encode()])
    return RECIPES[kind](Dice(rng))
