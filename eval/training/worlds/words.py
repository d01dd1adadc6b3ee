"""Words of things and surfaces, and captions that are true of a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from attnwarp_eval.drawn.worlds import (
    COLORS,
    FINISHES,
    GROUNDS,
    HOURS,
    OBJECTS,
    PLACES,
    TIMES,
    with_article,
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
OPENINGS = ("a photo of", "a picture of", "a rendering of", "an image of", "a close view of", "")
FILLERS = (
    "nice", "old", "new", "small", "large", "little", "pretty", "strange", "lovely", "simple", "single", "typical", "famous", "real", "tiny",
    "heavy", "clean", "fine", "good", "great", "funny", "quiet", "lonely", "standing", "detailed", "beautiful", "ordinary", "interesting",
)  # fmt: skip


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


def sentence(values: tuple[int, ...], rng: np.random.Generator, *, fillers: bool = False) -> str:
    """A caption of the attributes that are not -1; ``values`` in the order of :func:`attributes`."""
    thing, finish, color, second, ground, time = values
    noun = (
        one_of(NOUNS[OBJECTS[thing]], rng)
        if thing >= 0
        else one_of(("thing", "object", "something"), rng)
    )
    statue = False
    words = ""
    if finish >= 0:
        words, statue = surface_words(finish, color, second, rng)
    elif color >= 0:
        words = one_of(HUES[COLORS[color]], rng)
    if fillers and rng.uniform() < 0.35:
        words = f"{one_of(FILLERS, rng)} {words}"
    if statue:
        described = f"{words} {one_of(('statue', 'sculpture'), rng)} of {with_article(noun)}"
    elif noun in ("bust of a man", "head of a man"):
        described = f"{words} {noun}"
    else:
        described = f"{words} {noun}"
    if noun == "bear" and not statue and rng.uniform() < 0.5 and color >= 0 and finish in (-1, 0):
        named = {"white": "polar bear", "brown": "grizzly bear"}.get(COLORS[color])
        described = named or described
    parts = [one_of(OPENINGS, rng), with_article(" ".join(described.split()))]
    tail = [one_of(PLACES[GROUNDS[ground]], rng)] if ground >= 0 else []
    if time >= 0:
        tail.insert(int(rng.uniform() < 0.8) * len(tail), one_of(HOURS[TIMES[time]], rng))
    return " ".join(" ".join(parts + tail).split())


def captioned(pictured: tuple[int, ...], rng: np.random.Generator) -> tuple[int, ...]:
    """Attributes that a caption names: object and surface nearly always, ground and time half of the time."""
    thing, finish, color, second, ground, time = pictured
    if rng.uniform() < 0.2:
        return thing, -1, -1, -1, -1, -1
    if rng.uniform() < 0.06:
        thing = -1
    if rng.uniform() < 0.15:
        finish = color = second = -1
    elif FINISHES[finish] == "plain" or (FINISHES[finish] == "shiny" and rng.uniform() < 0.25):
        finish = -1  # "a red ball" is true of matte and of shiny ones
    if rng.uniform() < 0.5:
        ground = -1
    if rng.uniform() < 0.5:
        time = -1
    return thing, finish, color, second, ground, time


def one_of(choices: Sequence[str], rng: np.random.Generator) -> str:
    """One of some words, each as likely."""
    return choices[int(rng.integers(len(choices)))]
