"""The questions of the model cards, put to encoders whose answers are known: perfect, blind,
random, made by hand.
"""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from attnwarp_eval.drawn import worlds
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, GROUNDS, OBJECTS, TIMES, TWO_COLORED
from training.assess import figures as assess
from training.assess.figures import figure
from training.encoders.perceptual import triple
from training.worlds import render, words
from training.worlds.data import SIZE, Pictures
from training.worlds.draw import COLORED

SETS = ("test", "test-new-pairs", "test-rendered")


def chance_like(value, count, chance):
    """Return True if a share of answers can come from guessing: within the 99.99 % interval of the
    binomial distribution.
    """
    low, high = binom.ppf([5e-5, 1 - 5e-5], count, chance)
    return low <= round(value * count) <= high


# figure
# --------------------------------------------------------------------------------------------------


def test_a_balanced_figure_has_the_interval_of_the_central_limit():
    random = np.random.default_rng(0)
    count, answers = 400, 5
    shares = random.choice([0.2, 0.6, 1.0], count)
    right = np.concatenate([np.arange(answers) < round(share * answers) for share in shares])
    found = figure("?", right, np.repeat(np.arange(count), answers), chance=0.5, asked=0.9)
    assert (found.count, found.chance, found.asked) == (count * answers, 0.5, 0.9)
    assert found.value == pytest.approx(shares.mean())
    half = 1.96 * shares.std() / np.sqrt(count)
    assert found.high - found.value == pytest.approx(half, rel=0.1)
    assert found.value - found.low == pytest.approx(half, rel=0.1)


def test_an_unbalanced_figure_is_that_of_a_bootstrap_written_out():
    random = np.random.default_rng(2)
    groups = [
        list(random.uniform(size=int(random.integers(1, 12))) < random.uniform()) for _ in range(40)
    ]
    means = []
    for _ in range(4000):
        drawn = [answer for _ in groups for answer in groups[int(random.integers(len(groups)))]]
        means.append(sum(drawn) / len(drawn))
    means.sort()
    right = [answer for group in groups for answer in group]
    found = figure("?", right, [k for k, group in enumerate(groups) for _ in group])
    assert found.value == sum(right) / len(right)
    assert found.low == pytest.approx(means[100], abs=0.02)
    assert found.high == pytest.approx(means[3899], abs=0.02)


@pytest.mark.parametrize("answer", [0, 1])
def test_answers_that_are_all_alike_have_the_binomial_interval_of_their_worlds(answer):
    found = figure("?", np.full(60, answer), np.repeat(np.arange(20), 3))
    exact = binomtest(20 * answer, 20).proportion_ci(0.95, "exact")
    assert found.value == answer
    assert (found.low, found.high) == pytest.approx((exact.low, exact.high))


def test_a_figure_of_nothing_is_refused():
    with pytest.raises(
        ValueError, match="the colour: got 0 answers and 0 worlds, expected one world for each"
    ):
        figure("the colour", [], [])


# clip-small
# --------------------------------------------------------------------------------------------------


def any_attributes(random, thing):
    finish = int(random.integers(len(FINISHES)))
    one, two = (int(c) for c in random.choice(len(COLORS), 2, replace=False))
    return (
        thing,
        finish,
        one if FINISHES[finish] in COLORED else -1,
        two if FINISHES[finish] in TWO_COLORED else -1,
        int(random.integers(len(GROUNDS))),
        int(random.integers(len(TIMES))),
    )


def numbered(name, count=100, views=2, looks=3):
    """Pictures that show nothing but the number of their set and row, for encoders that know the
    rest.
    """
    random = np.random.default_rng([7, SETS.index(name) if name in SETS else 9])
    rows = []
    for world in range(count):
        first = any_attributes(random, world % len(OBJECTS))
        part = 4 + int(random.integers(2))
        second = list(first)
        second[part] = (first[part] + 1) % len(GROUNDS if part == 4 else TIMES)
        said = (first, tuple(second), any_attributes(random, first[0]))
        rows += [(said[look], world, view, look) for view in range(views) for look in range(looks)]
    images = np.zeros((len(rows), 2, 2, 3), np.uint8)
    images[..., 0] = SETS.index(name) if name in SETS else 9
    images[..., 1], images[..., 2] = (
        part[:, None, None] for part in np.divmod(np.arange(len(rows)), 256)
    )
    said, world, view, look = (np.array(column) for column in zip(*rows, strict=True))
    return Pictures(images, said, world, view, look)


def three_sets():
    return {
        name: numbered(name, **({"views": 1, "looks": 1} if name == "test-rendered" else {}))
        for name in SETS
    }


def number(image):
    kind, high, low = (int(v) for v in np.rint(255 * image[0, 0]))
    return kind, 256 * high + low


WORDS = {
    **{phrase: ("ground", g) for g, said in worlds.PLACES.items() for phrase in said},
    **{phrase: ("time", t) for t, said in worlds.HOURS.items() for phrase in said},
    **{phrase: ("object", o) for o, said in words.NOUNS.items() for phrase in said},
    **{phrase: ("color", c) for c, said in words.HUES.items() for phrase in said},
    **{"polar": ("color", "white"), "grizzly": ("color", "brown")},
    **{f: ("finish", f) for f in FINISHES if f != "plain"},
    **{f: ("finish", "shiny") for f in ("glossy", "plastic", "polished")},
    **{"gold": ("finish", "golden"), "steel": ("finish", "silver"), "chrome": ("finish", "silver")},
    **{
        "copper": ("finish", "bronze"),
        "white marble": ("finish", "marble"),
        "chequered": ("finish", "checked"),
    },
}
READ = re.compile(r"\b(" + "|".join(sorted(WORDS, key=len, reverse=True)) + r")\b")
PLACE = {
    (kind, word): k
    for k, (kind, word) in enumerate(
        (kind, word)
        for kind, words in (
            ("object", OBJECTS),
            ("finish", FINISHES),
            ("color", COLORS),
            ("ground", GROUNDS),
            ("time", TIMES),
        )
        for word in words
    )
}


def vector(meanings):
    found = np.zeros(len(PLACE))
    found[[PLACE[meaning] for meaning in meanings]] = 1
    return found


class Knowing:
    """An encoder that is told what a picture shows, and reads sentences word by word."""

    def __init__(self, sets):
        self.sets = sets

    def images(self, images):
        return np.array([self.one(*number(image)) for image in images])

    def one(self, kind, row):
        thing, finish, color, second, ground, time = self.sets[SETS[kind]].attributes[row]
        shown = {("object", OBJECTS[thing]), ("ground", GROUNDS[ground]), ("time", TIMES[time])}
        shown |= {("color", COLORS[c]) for c in (color, second) if c >= 0}
        return vector(
            shown | ({("finish", FINISHES[finish])} if FINISHES[finish] != "plain" else set())
        )

    def texts(self, texts):
        return np.array([vector({WORDS[found] for found in READ.findall(text)}) for text in texts])


class Guessing(Knowing):
    """A direction of its own for every picture and every sentence."""

    def one(self, kind, row):
        return np.random.default_rng([1, kind, row]).normal(size=32)

    def texts(self, texts):
        return np.array(
            [np.random.default_rng([2, *text.encode()]).normal(size=32) for text in texts]
        )


class Blind(Knowing):
    """An encoder that gives one vector for everything."""

    def one(self, kind, row):
        return np.ones(32)

    def texts(self, texts):
        return np.ones((len(texts), 32))


@pytest.fixture(scope="module")
def sets():
    return three_sets()


def test_who_knows_everything_has_every_answer_of_clip_right(sets):
    found = {f.what: f for f in assess.clip_figures(Knowing(sets), sets)}
    assert {name: f.value for name, f in found.items()} == dict.fromkeys(found, 1.0)
    parts = ("object", "color", "material", "ground", "time")
    titles = ("new shapes", "new pairs of colour and object", "path-traced")
    asked = {f"name the {part}, {title}" for part in parts for title in titles}
    asked |= {f"the caption among 64, {title}" for title in titles}
    asked |= {
        "the edit among 8, by directional similarity",
        "the same name for two views of a thing",
    }
    assert set(found) == asked
    assert found["name the object, new shapes"].count == len(sets["test"])
    assert found["the caption among 64, new shapes"].count == 100
    assert found["the edit among 8, by directional similarity"].count == 200


@pytest.mark.parametrize("encoder", [Guessing, Blind])
def test_who_guesses_or_is_blind_is_right_by_chance_at_most(sets, encoder):
    for f in assess.clip_figures(encoder(sets), sets):
        if f.chance is None:
            continue
        blind = encoder is Blind and not f.what.startswith("name")
        # All alike is a tie, and a tie is no find; among names it is always the same name.
        assert f.value == 0 if blind else chance_like(f.value, f.count, f.chance), f


def test_one_answer_spoilt_is_one_answer_missed(sets):
    class Once(Knowing):
        def one(self, kind, row):
            if (kind, row) != (0, 17):
                return super().one(kind, row)
            return vector(
                {("object", "snowman" if self.sets["test"].attributes[row, 0] == 0 else OBJECTS[0])}
            )

    found = {f.what: f for f in assess.clip_figures(Once(sets), sets)}
    assert found["name the object, new shapes"].value == pytest.approx(1 - 1 / len(sets["test"]))
    assert found["name the object, path-traced"].value == 1


def test_a_caption_that_is_true_too_is_no_error(sets):
    rows = np.flatnonzero((sets["test"].view == 0) & (sets["test"].look == 0))
    shown = sets["test"].attributes.copy()
    shown[rows] = shown[rows[0]]
    alike = Pictures(
        sets["test"].images, shown, sets["test"].world, sets["test"].view, sets["test"].look
    )
    found = assess._retrieval(Blind(sets), np.ones((len(shown), 32)), alike, "?")
    assert found.value == 1


def test_two_views_of_a_thing_share_a_name_as_often_as_counted_by_hand(sets):
    pictures = sets["test"]
    names = pictures.attributes[:, 0].copy()
    turned = (pictures.view == 1) & (pictures.world % 4 == 0)
    names[turned] = (names[turned] + 1) % len(OBJECTS)
    found = assess._viewpoint(
        np.eye(len(OBJECTS))[names], pictures, {"object": np.eye(len(OBJECTS))}
    )
    assert (found.value, found.count) == (0.75, 300)


def test_a_change_that_is_not_in_the_picture_is_not_asked(sets):
    pictures = sets["test"]
    index = {
        (w, v, k): i
        for i, (w, v, k) in enumerate(
            zip(pictures.world, pictures.view, pictures.look, strict=True)
        )
    }
    images = pictures.images.copy()
    for world in range(30):
        images[index[world, 0, 1]] = images[index[world, 0, 0]]
    some = Pictures(images, pictures.attributes, pictures.world, pictures.view, pictures.look)
    knowing = Knowing(sets)
    embedded = assess.unit(knowing.images(assess.as_float(pictures.images)))
    found = assess._direction(knowing, embedded, some)
    assert (found.value, found.count) == (1.0, 170)


# dino-small
# --------------------------------------------------------------------------------------------------


def test_the_other_side_is_found_by_who_knows_the_thing_and_by_chance_else():
    pictures = numbered("dino", count=150, looks=2)
    known = np.eye(150)[pictures.world]
    for look in (0, 1):
        right, seeds = assess.nearest(known, pictures, look=look)
        assert right == [True] * 150 and seeds == list(range(150))
    blind, _ = assess.nearest(np.ones((len(pictures), 4)), pictures)
    assert blind == [False] * 150  # a tie is no find
    guessed, _ = assess.nearest(np.random.default_rng(3).normal(size=(len(pictures), 16)), pictures)
    assert chance_like(np.mean(guessed), 150, 1 / 64)


def test_the_query_is_of_the_look_that_is_asked_and_the_gallery_of_the_first():
    pictures = numbered("dino", count=64, looks=2)
    # In its second look each thing is taken for the next one; among all 64 that one is always
    # there.
    taken = np.where(pictures.look == 1, (pictures.world + 1) % 64, pictures.world)
    assert np.mean(assess.nearest(np.eye(64)[taken], pictures, look=0)[0]) == 1
    assert np.mean(assess.nearest(np.eye(64)[taken], pictures, look=1)[0]) == 0


def test_histograms_and_pixels_see_what_their_names_say():
    random = np.random.default_rng(4)
    image = random.integers(0, 256, (1, 32, 32, 3), dtype=np.uint8)
    shuffled = random.permutation(image.reshape(-1, 3)).reshape(image.shape)
    one, other = assess.histograms(image)[0], assess.histograms(shuffled)[0]
    np.testing.assert_array_equal(one, other)
    assert one @ one == pytest.approx(1)
    counted = np.zeros((8, 8, 8))
    for r, g, b in image.reshape(-1, 3) // 32:
        counted[r, g, b] += 1 / 1024
    np.testing.assert_allclose(one**2, counted.ravel(), atol=1e-12)
    a, b, c = assess.unit(assess.raw_pixels(np.concatenate([image, image // 2, shuffled])))
    assert (
        a @ b == pytest.approx(1, abs=1e-3) and abs(a @ c) < 0.1
    )  # half as bright is alike, another place is not


class Tokens:
    """Class tokens by the number of the picture, patches by a table."""

    def __init__(self, pictures, tokens):
        self.pictures, self.table = pictures, tokens

    def images(self, images):
        return np.eye(self.pictures.world.max() + 1)[
            [self.pictures.world[number(image)[1]] for image in images]
        ]

    def tokens(self, images):
        assert len(images) == 2 and images[0].shape == (SIZE, SIZE, 3)
        return self.table


def test_the_figures_of_dino_put_each_method_to_the_same_question(monkeypatch):
    pictures = numbered("dino", count=70, looks=2)
    asked = []
    monkeypatch.setattr(assess, "part_figures", lambda encoder, count: asked.append(count) or [])
    sets = dict.fromkeys(("test-bare", "test", "test-moved"), pictures)
    found = assess.dino_figures(Tokens(pictures, None), sets, parts=5)
    assert asked == [5] and len(found) == 9
    assert [f.value for f in found if f.what.endswith("class token")] == [1, 1, 1]
    assert [f.asked for f in found].count(0.85) == 1 and found[0].asked == 0.85
    # Of numbers alone, pixels and colours know little.
    assert all(f.value < 0.3 and f.count == 70 for f in found if not f.what.endswith("class token"))


def test_pck_is_the_share_counted_by_hand(monkeypatch):
    """A flat world seen by a second camera 20 px further left: 8 patches of the thing, 2 of them
    hidden there, 1 out of it.

    Of the five that count three are matched to where they are, one to its right neighbour, 20 px
    off, one to the far
    corner: 3 of 5.
    """
    side, step = 8, SIZE // 8
    y, x = np.mgrid[:SIZE, :SIZE] + 0.0
    thing = np.full((SIZE, SIZE), 3)
    patches = [(0, 7), (1, 1), (2, 2), (3, 3), (4, 4), (5, 5), (6, 1), (6, 2)]  # row, column
    for row, column in patches:
        thing[row * step : (row + 1) * step, column * step : (column + 1) * step] = 0
    first = SimpleNamespace(object_id=thing, point=np.dstack([x + step, y, np.full_like(x, 4.0)]))
    depth = np.full((SIZE, SIZE), 4.0)
    for row, column in ((6, 1), (6, 2)):  # something stands before them
        depth[row * step : (row + 1) * step, (column + 1) * step : (column + 2) * step] = 3.0
    second = SimpleNamespace(object_id=np.roll(thing, step, axis=1), depth=depth)
    camera = SimpleNamespace(project=lambda points: (points[:, :2], points[:, 2]))
    world = SimpleNamespace(
        seed=11, thing=0, scene=lambda look, size: SimpleNamespace(cameras=[None, camera])
    )
    grey = np.full((SIZE, SIZE, 3), 90, np.uint8)
    monkeypatch.setattr(assess, "draw_world", lambda seed, **how: world)
    monkeypatch.setattr(
        render, "pictures", lambda world, looks, size, view: ([grey], second if view else first)
    )
    names = np.arange(side * side).reshape(side, side)
    there = names + 1000
    for row, column in patches[1:]:
        there[row, column + 1] = names[row, column]
    there[4, 5], there[4, 6] = 2000, names[4, 4]  # matched 20 px off
    there[5, 6], there[7, 0] = 2001, names[5, 5]  # matched far away
    table = np.stack([names, there])[..., None] == np.concatenate([names.ravel(), [2000]])
    found = {
        f.what.rpartition(": ")[2]: f
        for f in assess.part_figures(Tokens(None, table.astype(float)), 1)
    }
    assert {f.count for f in found.values()} == {5}
    assert found["patch tokens"].value == 3 / 5
    assert found["raw patches"].value == 0  # all grey alike: the first, which is far from all
    # The middle of the thing in the second view; its pixels, and distances, by hand.
    middle = np.argwhere(second.object_id == 0).mean(axis=0)[::-1]
    kept = np.array([[(column + 1) * step + 10, row * step + 10] for row, column in patches[1:6]])
    near = np.linalg.norm(kept - middle, axis=1) < 16
    assert found["middle of the thing"].value == near.mean()


@pytest.mark.slow
def test_parts_of_rendered_worlds_are_found_by_who_knows_their_points_and_by_chance_else(
    monkeypatch,
):
    """Tokens that say where on the thing a patch's middle lies, by waves of many lengths, from the
    rays themselves.
    """
    shown = []
    waves = np.random.default_rng(5).normal(0, 8, (3, 256))
    original = render.pictures

    def kept(*arguments, **options):
        made, hits = original(*arguments, **options)
        shown.append(hits)
        return made, hits

    class Rays(Tokens):
        def tokens(self, images):
            middle = np.arange(8) * 20 + 10
            points = np.stack(
                [np.nan_to_num(h.point[np.ix_(middle, middle)], posinf=99) for h in shown[-2:]]
            )
            return np.concatenate([np.cos(points @ waves), np.sin(points @ waves)], axis=-1)

    class Noise(Tokens):
        def tokens(self, images):
            return np.random.default_rng(len(shown)).normal(size=(2, 8, 8, 32))

    monkeypatch.setattr(render, "pictures", kept)
    knowing, guessing = (assess.part_figures(kind(None, None), 3)[0] for kind in (Rays, Noise))
    assert knowing.count == guessing.count > 10
    # A disc of 16 px is 3 % of the picture; what is seen at a slant has no patch whose middle is
    # near.
    assert knowing.value > 0.7 > 0.2 > guessing.value


# perceptual-small
# --------------------------------------------------------------------------------------------------


class Distances:
    """A distance given by a function of two pictures."""

    def __init__(self, one):
        self.one = one

    def distance(self, a, b):
        return np.array([self.one(x, y) for x, y in zip(a, b, strict=True)])


def test_who_knows_the_strengths_puts_them_in_order_and_the_others_do_not(monkeypatch):
    strengths = {}  # of the two pictures that are being asked about; of a grey one both may look alike

    def noted(*arguments, **options):
        x, weak, strong, a, b = triple(*arguments, **options)
        assert a < b
        strengths.clear()
        strengths.update({id(weak): a, id(strong): b})
        return x, weak, strong, a, b

    monkeypatch.setattr(assess, "triple", noted)
    renders = np.random.default_rng(6).integers(0, 256, (4, SIZE, SIZE, 3), dtype=np.uint8)
    random = np.random.default_rng(8)
    values = {}
    for name, one in {
        "knows": lambda x, y: strengths[id(y)], "wrong way": lambda x, y: -strengths[id(y)],
        "blind": lambda x, y: 1.0, "guesses": lambda x, y: random.uniform(),
    }.items():  # fmt: skip
        found = assess.perceptual_figures(Distances(one), renders, pairs=24)
        assert [f.asked for f in found].count(0.95) == 1 and len(found) == 12
        values[name] = [f.value for f in found if f.what.endswith(": perceptual")]
        # The pictures are the same whoever is asked.
        values.setdefault("psnr", [f.value for f in found if f.what.endswith(": PSNR")])
        assert values["psnr"] == [f.value for f in found if f.what.endswith(": PSNR")]
    assert values["knows"] == [1, 1, 1, 1]
    assert values["wrong way"] == values["blind"] == [0, 0, 0, 0]
    assert all(chance_like(value, 24, 0.5) for value in values["guesses"])


def test_the_contestants_are_what_their_names_say():
    random = np.random.default_rng(9)
    a, b = random.uniform(size=(2, 40, 40, 3)).astype(np.float32)
    assert assess.psnr_distance(a, b) == pytest.approx(
        float(np.mean((a.astype(float) - b) ** 2)), rel=1e-5
    )
    assert (
        assess.ssim_distance(a, a) == pytest.approx(0, abs=1e-7)
        and assess.ssim_distance(a, b) > 0.5
    )
