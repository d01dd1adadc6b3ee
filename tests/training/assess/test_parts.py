"""The questions about parts, put to encoders whose answers are known: one that reads every word, one that guesses."""

import re

import numpy as np
import pytest
from scipy.stats import binom

from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, STATUES
from training.assess import parts as part_assess
from training.worlds.assemblies import WHOLE_NOUNS
from training.worlds.part_captions import SOME_HUES
from training.worlds.part_pictures import LOOKS, PARTS, PartPictures
from training.worlds.words import HUES

ADJECTIVES = {
    **{word: color for color, words in HUES.items() for word in words},
    **{word: key.split()[0] for key, words in SOME_HUES.items() for word in words},
    **{"golden": "golden", "gold": "golden", "silver": "silver", "steel": "silver", "chrome": "silver", "bronze": "bronze", "copper": "bronze"},
    **{"wooden": "wooden", "stone": "stone", "marble": "marble", "white marble": "marble"},
}  # fmt: skip
NOUNS = sorted({n for nouns in PART_NOUNS.values() for n in nouns}, key=len, reverse=True)
WHOLES = {noun: kind for kind, nouns in WHOLE_NOUNS.items() for noun in nouns}
SHINY = re.compile(r"^(shiny|glossy|polished) | plastic$")
LATER = r"(?= with| in | beside| of (?:a|an) |$)"


def drawn(worlds=40, seed=0):
    """Pictures that show the number of their row alone; one part changes in looks 1 and 2."""
    rng = np.random.default_rng(seed)

    def surface():
        finish = FINISHES.index(("plain", "shiny", *STATUES)[int(rng.integers(8))])
        return (finish, int(rng.integers(len(COLORS))) if finish < 2 else -1, -1)

    rows, kinds = [], []
    for world in range(worlds):
        first = np.full((len(PARTS), 3), -2)
        parts = rng.choice(len(PARTS), 4, replace=False)
        for p in parts:
            first[p] = surface()
        looks = [first.copy() for _ in range(LOOKS)]
        for look in (1, 2):
            while (looks[look] == first).all():
                looks[look][parts[look]] = surface()
        kinds.append(world % len(KINDS))
        rows += [looks, looks]
    surfaces = np.array(rows).reshape(-1, len(PARTS), 3)
    world, view, look = (v.ravel() for v in np.indices((worlds, 2, LOOKS)))
    images = np.zeros((len(world), 2, 2, 3), np.uint8)
    images[..., 0], images[..., 1] = (
        v[:, None, None] for v in np.divmod(np.arange(len(world)), 256)
    )
    shares = np.where(surfaces[look == 0, :, 0] >= 0, 0.1, 0.0)
    zeros = np.zeros_like(world)
    ids = np.zeros((2 * worlds, 2, 2), np.uint8)
    return PartPictures(
        images,
        surfaces,
        np.array(kinds)[world],
        zeros,
        zeros,
        world,
        view,
        look,
        world * 2 + view,
        ids,
        shares,
    )


def vector(features):
    """A direction of its own for each feature, added up."""
    return sum(
        (np.random.default_rng([1, *f.encode()]).normal(size=4000) for f in sorted(features)),
        np.zeros(4000),
    )


class Reading:
    """An encoder that is told what a picture shows, and reads sentences."""

    def __init__(self, pictures):
        self.pictures = pictures

    def images(self, images):
        rows = [
            round(255 * float(i[0, 0, 0])) * 256 + round(255 * float(i[0, 0, 1])) for i in images
        ]
        return np.array([self.one(row) for row in rows])

    def one(self, row):
        features = {f"a {KINDS[self.pictures.kind[row]]}"}
        for part, (finish, color, _) in zip(PARTS, self.pictures.surfaces[row], strict=True):
            if finish >= 0:
                name = FINISHES[finish] if color < 0 else COLORS[color]
                features |= {f"{name} {noun}" for noun in PART_NOUNS[part]}
                features |= {
                    f"shiny {name} {noun}"
                    for noun in PART_NOUNS[part]
                    if FINISHES[finish] == "shiny"
                }
        return vector(features)

    def texts(self, texts):
        return np.array([vector(self.read(text)) for text in texts])

    @staticmethod
    def read(text):
        features = {f"a {kind}" for noun, kind in WHOLES.items() if re.search(rf"\b{noun}\b", text)}
        for noun in NOUNS:
            for found in re.finditer(
                rf"(?:^|of |with |in |a |an )((?:\w+ ){{1,4}}){noun}{LATER}", text
            ):
                words = re.sub(r".*\b(of|with|in|a|an) ", "", found[1]).strip()
                plain = SHINY.sub("", words)
                meaning = ADJECTIVES.get(plain, plain)
                features.add(f"{'shiny ' * (plain != words)}{meaning} {noun}")
        return features


class Guessing(Reading):
    """A direction of its own for every picture and every sentence."""

    def one(self, row):
        return np.random.default_rng([2, row]).normal(size=32)

    def texts(self, texts):
        return np.array([np.random.default_rng([3, *t.encode()]).normal(size=32) for t in texts])


@pytest.fixture(scope="module")
def pictures():
    return drawn()


@pytest.mark.slow
def test_who_reads_everything_is_right_and_who_guesses_is_right_by_chance(pictures):
    for f in part_assess.part_figures(Reading(pictures), pictures):
        # Now and then two directions of many features are alike, or two words for a part meet.
        assert f.value > 0.93, f
    for f in part_assess.part_figures(Guessing(pictures), pictures):
        low, high = binom.ppf([5e-5, 1 - 5e-5], f.count, f.chance)
        assert low <= round(f.value * f.count) <= high, f


def test_every_seen_part_of_every_picture_is_asked_about(pictures):
    found = {f.what: f for f in part_assess.part_figures(Guessing(pictures), pictures)}
    assert found["name the thing with parts, new shapes"].count == len(pictures)
    assert found["name a part's colour or material, new shapes"].count == 4 * len(pictures)
    assert found["the edit of a part among 8, by directional similarity"].count == 40 * 2 * 2
