"""Words of things and surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from attnwarp_eval.drawn.worlds import (
    COLORS,
    FINISHES,
)

NOUNS: dict[str, tuple[str, ...]] = {
    "ball": ("ball", "sphere"), "cube": ("cube", "box", "block"), "cone": ("cone",), "cylinder": ("cylinder", "drum"),
    "ring": ("ring", "torus", "donut"), "mug": ("mug", "cup"), "bottle": ("bottle",), "vase": ("vase",), "chair": ("chair", "seat"),
    "table": ("table", "desk"), "lamp": ("lamp",), "tree": ("tree",), "mushroom": ("mushroom", "toadstool"), "cactus": ("cactus",),
    "house": ("house", "cottage", "hut"), "car": ("car", "automobile"), "bear": ("bear", "teddy bear"), "dinosaur": ("dinosaur", "stegosaurus"),
    "person": ("person", "man", "human figure"), "bust": ("bust of a man", "bust", "head of a man", "face"), "rabbit": ("rabbit", "bunny"),
    "duck": ("duck", "bird"), "snowman": ("snowman",), "stump": ("tree stump", "stump"), "plant": ("plant in a pot", "potted plant", "plant"),
}  # fmt: skip
HUES: dict[str, tuple[str, ...]] = {
    "red": ("red", "crimson", "scarlet"), "orange": ("orange",), "yellow": ("yellow",), "green": ("green",), "blue": ("blue",),
    "purple": ("purple", "violet"), "pink": ("pink",), "brown": ("brown",), "black": ("black",), "white": ("white",), "grey": ("grey", "gray"),
}  # fmt: skip


def surface_words(
    finish: int, color: int, second: int, rng: np.random.Generator
) -> tuple[str, bool]:
    """The adjective of a surface, and whether it names a statue ("bronze statue of a bear")."""
    kind = FINISHES[finish]
    hue = one_of(HUES[COLORS[color]], rng) if color >= 0 else ""
    match kind:
        case "plain":
            return hue, False
        case "shiny":
            return one_of(
                (f"shiny {hue}", f"glossy {hue}", f"{hue} plastic", f"polished {hue}"), rng
            ), False
        case "striped" | "checked":
            other = one_of(HUES[COLORS[second]], rng)
            one, two = (hue, other) if rng.uniform() < 0.5 else (other, hue)
            word = {"striped": "striped", "checked": one_of(("checked", "chequered"), rng)}[kind]
            return f"{one} and {two} {word}", False
    words = {
        "golden": ("golden", "gold"), "silver": ("silver", "steel", "chrome"), "bronze": ("bronze", "copper"),
        "wooden": ("wooden",), "stone": ("stone",), "marble": ("marble", "white marble"),
    }[kind]  # fmt: skip
    return one_of(words, rng), bool(rng.uniform() < 0.4)


def one_of(choices: Sequence[str], rng: np.random.Generator) -> str:
    """One of some words, each as likely."""
    return choices[int(rng.integers(len(choices)))]
