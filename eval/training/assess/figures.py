"""Accuracy of the encoders on unseen data: the figures of the model cards, each with an interval.

Every figure is given for the trained network and for one of the same shape with random weights; some
also for raw pixels and colour histograms.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.encoders.base import Image, PerceptualDistance, TextImageEncoder
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, GROUNDS, HOURS, OBJECTS, PLACES, TIMES
from attnwarp_eval.encoders import TokenEncoder
from training.encoders.clip import true_of
from training.encoders.distort import HELD_OUT_KINDS, TRAIN_KINDS
from training.encoders.perceptual import HELD_OUT_PHOTOS, Sources, photographs, triple
from training.worlds.data import SIZE, SPLITS, Pictures, load, looks_of
from training.worlds.draw import attributes, draw_look, draw_world
from training.worlds.words import NOUNS, sentence

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """A share of right answers, or a mean.

    Attributes:
        what: the question.
        value: the share.
        low, high: 95 % interval, bootstrapped over worlds: pictures of one world are not
            independent. Where all answers are right or all wrong, no bootstrap shows what could
            have been: then the binomial interval of as many answers as worlds (Clopper-Pearson).
        count: answers.
        chance: value of guessing; None if that says nothing.
        asked: the required share; None if none is required.
        at_most: the share that is not to be exceeded; None if there is none.
    """

    what: str
    value: float
    low: float
    high: float
    count: int
    chance: float | None = None
    asked: float | None = None
    at_most: float | None = None

    @property
    def short(self) -> bool:
        """True if it misses what was asked for."""
        return (self.asked is not None and self.value < self.asked) or (
            self.at_most is not None and self.value > self.at_most
        )

    def to_dict(self) -> dict[str, Any]:
        """Fields for JSON."""
        return asdict(self)


def figure(what: str, right: npt.ArrayLike, worlds: npt.ArrayLike, **more: float | None) -> Figure:
    """A figure from one answer a question, grouped by world.

    Raises:
        ValueError: no answers, or another number of worlds.
    """
    values, groups = np.asarray(right, dtype=np.float64), np.asarray(worlds)
    if not len(values) or values.shape != groups.shape:
        raise ValueError(
            f"{what}: got {len(values)} answers and {len(groups)} worlds, expected one world for each of at least one answer"
        )
    sums = {g: (values[groups == g].sum(), int((groups == g).sum())) for g in np.unique(groups)}
    table = np.array(list(sums.values()))
    rng = np.random.default_rng(0)
    drawn = table[rng.integers(len(table), size=(2000, len(table)))].sum(axis=1)
    low, high = np.quantile(drawn[:, 0] / drawn[:, 1], [0.025, 0.975])
    tail = 0.025 ** (1 / len(table))
    if (values == 0).all():
        high = 1 - tail
    elif (values == 1).all():
        low = tail
    return Figure(what, float(values.mean()), float(low), float(high), len(values), **more)


def as_float(images: npt.NDArray[np.uint8]) -> list[Image]:
    """Pictures as encoders take them."""
    return list(images.astype(np.float32) / 255)


def unit(x: npt.ArrayLike) -> Array:
    """Rows of length 1."""
    x = np.asarray(x, dtype=np.float64)
    # A vector without length has no direction: it stays zero, with cosine 0 to everything.
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)


def _rows_of(pictures: Pictures) -> dict[tuple[int, int, int], int]:
    """(world, view, look) -> the picture's row."""
    columns = (column.tolist() for column in (pictures.world, pictures.view, pictures.look))
    return {key: row for row, key in enumerate(zip(*columns, strict=True))}


# clip-small
# --------------------------------------------------------------------------------------------------

TEMPLATES = ("a photo of {}", "a picture of {}", "an image of {}", "{}")


def word_embeddings(encoder: TextImageEncoder, phrases: Sequence[Sequence[str]]) -> Array:
    """(K, D) unit embeddings of K meanings, each the mean over its phrases in several sentences."""
    rows = []
    for choices in phrases:
        rows.append(
            unit(encoder.texts([t.format(c) for t in TEMPLATES for c in choices])).mean(axis=0)
        )
    return unit(rows)


def _a(words: str) -> str:
    return f"{'an' if words[0] in 'aeiou' else 'a'} {words}"


def _phrases(what: str) -> list[list[str]]:
    match what:
        case "object":
            return [[_a(n) for n in NOUNS[o]] for o in OBJECTS]
        case "color":
            return [[_a(f"{c} thing"), _a(f"{c} object")] for c in COLORS]
        case "material":
            return [[_a(f"{m} object"), _a(f"{m} statue"), _a(f"{m} thing")] for m in MATERIALS]
        case "ground":
            return [[f"something {p}" for p in PLACES[g]] for g in GROUNDS]
    return [[f"something {h}" for h in HOURS[t]] for t in TIMES]


MATERIALS = ("golden", "silver", "bronze", "wooden", "stone", "marble")


def clip_figures(encoder: TextImageEncoder, sets: dict[str, Pictures]) -> list[Figure]:
    """Naming, retrieval and direction on shapes, worlds and pairs that training never saw.

    Args:
        sets: "test" (new shapes), "test-new-pairs" (colours an object never had), "test-rendered"
            (by Mitsuba).
    """
    figures = []
    titles = {
        "test": "new shapes",
        "test-new-pairs": "new pairs of colour and object",
        "test-rendered": "path-traced",
    }
    sets = {name: sets[name] for name in titles}
    embedded = {name: unit(encoder.images(as_float(p.images))) for name, p in sets.items()}
    labels = {
        what: word_embeddings(encoder, _phrases(what))
        for what in ("object", "color", "material", "ground", "time")
    }
    for name, pictures in sets.items():
        images, true_attributes = embedded[name], pictures.attributes
        kinds = np.array(FINISHES)[true_attributes[:, 1]]
        material = np.array([MATERIALS.index(k) if k in MATERIALS else -1 for k in kinds])
        one_colored = np.isin(kinds, ["plain", "shiny"])
        questions: list[tuple[str, npt.NDArray[np.int64], npt.NDArray[np.bool_], float | None]] = [
            ("object", true_attributes[:, 0], np.ones(len(true_attributes), bool), 0.9),
            ("color", true_attributes[:, 2], one_colored, 0.9),
            ("material", material, material >= 0, 0.9),
            ("ground", true_attributes[:, 4], np.ones(len(true_attributes), bool), None),
            ("time", true_attributes[:, 5], np.ones(len(true_attributes), bool), None),
        ]
        for what, truth, applies, asked in questions:
            if not applies.any():
                continue
            guess = (images[applies] @ labels[what].T).argmax(axis=1)
            chance = 1 / len(labels[what])
            figures.append(
                figure(
                    f"name the {what}, {titles[name]}",
                    guess == truth[applies],
                    pictures.world[applies],
                    chance=chance,
                    asked=asked,
                )
            )
        if len(np.unique(pictures.world)) >= 64:
            figures.append(
                _retrieval(encoder, images, pictures, f"the caption among 64, {titles[name]}")
            )
    figures.append(_direction(encoder, embedded["test"], sets["test"]))
    figures.append(_viewpoint(embedded["test"], sets["test"], labels))
    return figures


def _retrieval(encoder: TextImageEncoder, images: Array, pictures: Pictures, what: str) -> Figure:
    """Rank 1 of a picture's own caption among 63 captions of other worlds; another true caption is no
    error.
    """
    rng = np.random.default_rng(1)
    first = np.flatnonzero((pictures.view == 0) & (pictures.look == 0))
    true_attributes = pictures.attributes
    texts = unit(
        encoder.texts([sentence(tuple(int(v) for v in true_attributes[k]), rng) for k in first])
    )
    right = []
    for place, k in enumerate(first):
        others = rng.choice(np.delete(np.arange(len(first)), place), 63, replace=False)
        choice = np.array(
            [*others, place]
        )  # the right one last: the first of equals wins, so a tie is no find
        best = choice[(images[k] @ texts[choice].T).argmax()]
        right.append(
            bool(true_of(true_attributes[first[best]][None], true_attributes[k][None])[0, 0])
        )
    return figure(what, right, pictures.world[first], chance=1 / 64, asked=0.6)


def _direction(encoder: TextImageEncoder, images: Array, pictures: Pictures) -> Figure:
    """Choice of the edit that was made among 8, by the cosine of the change of pictures and of
    captions, as directional similarity.
    """
    rng = np.random.default_rng(2)
    index = _rows_of(pictures)
    right, worlds = [], []
    for (world, view, look), before in index.items():
        if look != 0:
            continue
        after = index[world, view, 1]
        old, new = (tuple(int(v) for v in pictures.attributes[k]) for k in (before, after))
        targets = [new]
        while len(targets) < 8:
            # Others change one attribute of the same picture too: surface, ground or time.
            part = int(rng.integers(3))
            drawn = attributes(old[0], draw_look(old[0], rng, pairs="any"))
            candidate = (
                (old[0], *drawn[1:4], *old[4:])
                if part == 0
                else (*old[:4], drawn[4], old[5])
                if part == 1
                else (*old[:5], drawn[5])
            )
            if (
                candidate != old
                and candidate not in targets
                and not true_of(np.array([candidate]), np.array([new]))[0, 0]
            ):
                targets.append(candidate)
        seed = int(rng.integers(2**31))
        # One seed for all sentences: they differ in attributes, not in wording.
        texts = encoder.texts(
            [sentence(words, np.random.default_rng(seed)) for words in (old, *targets)]
        )
        away = unit(unit(texts[1:]) - unit(texts[:1]))
        if np.array_equal(pictures.images[after], pictures.images[before]):
            continue  # the change is out of sight: there is no direction
        likeness = away @ unit(images[after] - images[before])
        right.append(bool(likeness[0] > likeness[1:].max()))  # a tie is no find
        worlds.append(world)
    return figure(
        "the edit among 8, by directional similarity", right, worlds, chance=1 / 8, asked=0.8
    )


def _viewpoint(images: Array, pictures: Pictures, labels: dict[str, Array]) -> Figure:
    """Share of things whose two views get the same name."""
    guess = (images @ labels["object"].T).argmax(axis=1)
    index = _rows_of(pictures)
    pairs = [(i, index[w, 1, k], w) for (w, v, k), i in index.items() if v == 0]
    same = [guess[i] == guess[j] for i, j, _ in pairs]
    return figure("the same name for two views of a thing", same, [w for *_, w in pairs])


# dino-small
# --------------------------------------------------------------------------------------------------


def nearest(
    features: Array, pictures: Pictures, *, look: int = 0, seed: int = 3
) -> tuple[list[bool], list[int]]:
    """Nearest neighbour among one view each of 64 things, for the other view of one of them.

    Args:
        features: (N, D); compared by their cosine.
        look: look of the query; the 64 are seen in look 0.
        seed: seed of the galleries.

    Returns:
        Whether the nearest is the thing itself, and the thing's world, for every world.
    """
    rng = np.random.default_rng(seed)
    rows = unit(features)
    index = _rows_of(pictures)
    worlds = sorted({w for w, _, _ in index})
    right = []
    for world in worlds:
        others = rng.choice([w for w in worlds if w != world], 63, replace=False)
        # The right one last: the first of equals wins, so a tie is no find.
        gallery = [*(index[int(w), 0, 0] for w in others), index[world, 0, 0]]
        right.append(bool((rows[gallery] @ rows[index[world, 1, look]]).argmax() == 63))
    return right, worlds


def histograms(images: npt.NDArray[np.uint8]) -> Array:
    """(N, 512) colour histograms of 8 x 8 x 8 bins, the square root of which makes cosines
    Bhattacharyya's.
    """
    bins = images.astype(np.int64) // 32
    flat = (bins[..., 0] * 64 + bins[..., 1] * 8 + bins[..., 2]).reshape(len(images), -1)
    return np.sqrt(np.stack([np.bincount(row, minlength=512) for row in flat]) / flat.shape[1])


def raw_pixels(images: npt.NDArray[np.uint8]) -> Array:
    """(N, 3072) pictures of 32 x 32, centred."""
    import cv2

    small = np.stack(
        [cv2.resize(i, (32, 32), interpolation=cv2.INTER_AREA) for i in images]
    ).reshape(len(images), -1)
    return small - small.mean(axis=1, keepdims=True, dtype=np.float64)


def dino_figures(
    encoder: TokenEncoder, sets: dict[str, Pictures], *, parts: int = 60
) -> list[Figure]:
    """Finding a thing from another side, and parts of it; beside raw pixels and colour histograms.

    Args:
        sets: "test-bare" (things alone, all on the same grass in the same light), "test" (each in
            its own place) and "test-moved" (each on another ground at another time).
        parts: worlds for the correspondence of parts.
    """
    figures = []
    places = {
        "test-bare": "all on the same grass",
        "test": "each in its own place",
        "test-moved": "moved to another ground and time",
    }
    for name, words in places.items():
        pictures = sets[name]
        features = {"class token": encoder.images(as_float(pictures.images))}
        features |= {
            "raw pixels": raw_pixels(pictures.images),
            "colour histogram": histograms(pictures.images),
        }
        for what, values in features.items():
            right, worlds = nearest(values, pictures, look=1 if name == "test-moved" else 0)
            asked = 0.85 if what == "class token" and name == "test-bare" else None
            title = f"the thing from another side among 64, {words}: {what}"
            figures.append(figure(title, right, worlds, chance=1 / 64, asked=asked))
    return figures + part_figures(encoder, parts)


def part_figures(encoder: TokenEncoder, count: int, *, first: int = 5_000_000) -> list[Figure]:
    """PCK: a patch of the thing in one view, its best match in the other, right within a tenth of
    the picture of where it is.

    Exact correspondences come from rays: a surface point of one view, projected into the other,
    where it must be the point seen. Only patches of the thing itself count, and only ones that both
    views show.
    """
    from training.worlds.render import pictures

    side = 8  # DinoSmall's patches
    rows: dict[str, list[bool]] = {"patch tokens": [], "raw patches": [], "middle of the thing": []}
    worlds: list[int] = []
    for k in range(count):
        world = draw_world(first + k, new_shapes=True, thing=k % len(OBJECTS))
        look = looks_of(world.seed, world.thing, SPLITS["test"])[0]
        (first_image,), first_hits = pictures(world, [look], SIZE, view=0)
        (second_image,), second_hits = pictures(world, [look], SIZE, view=1)
        camera = world.scene(look, SIZE).cameras[1]
        place = np.arange(side) * (SIZE // side) + SIZE // side // 2
        y, x = np.meshgrid(place, place, indexing="ij")
        on_thing = (first_hits.object_id[y, x] == 0).ravel()
        points = first_hits.point[y, x].reshape(-1, 3)[on_thing]
        if not len(points):
            continue
        xy, depth = camera.project(points)
        inside = np.isfinite(xy).all(axis=1) & (xy > 0).all(axis=1) & (xy < SIZE).all(axis=1)
        px = np.floor(np.nan_to_num(xy)).astype(int).clip(0, SIZE - 1)
        depth_of_second = second_hits.depth[px[:, 1], px[:, 0]]
        visible = inside & (np.abs(depth_of_second - depth) < 0.02 * depth)
        if not visible.any():
            continue
        tokens = encoder.tokens(as_float(np.stack([first_image, second_image])))
        means = (
            np.stack([first_image, second_image])
            .reshape(2, side, SIZE // side, side, SIZE // side, 3)
            .transpose(0, 1, 3, 2, 4, 5)
        )
        patches = means.reshape(2, side, side, -1).astype(np.float64)
        centers = np.stack([x, y], axis=-1).reshape(-1, 2) + 0.0
        truth = xy[visible]
        for name, grid in (("patch tokens", tokens), ("raw patches", patches)):
            flat = unit(
                grid.reshape(2, side * side, -1)
                - grid.reshape(2, side * side, -1).mean(axis=1, keepdims=True)
            )
            match = (flat[0][on_thing][visible] @ flat[1].T).argmax(axis=1)
            rows[name] += list(np.linalg.norm(centers[match] - truth, axis=1) < 0.1 * SIZE)
        thing = np.argwhere(second_hits.object_id == 0)[:, ::-1].mean(axis=0)
        rows["middle of the thing"] += list(np.linalg.norm(thing - truth, axis=1) < 0.1 * SIZE)
        worlds += [world.seed] * int(visible.sum())
    return [
        figure(f"parts from another side, within a tenth of the picture: {name}", right, worlds)
        for name, right in rows.items()
    ]


# perceptual-small
# --------------------------------------------------------------------------------------------------

Distance = Callable[[Image, Image], float]


def psnr_distance(a: Image, b: Image) -> float:
    """Mean squared error: in the order of PSNR."""
    return float(((a - b) ** 2).mean())


def ssim_distance(a: Image, b: Image) -> float:
    """1 - SSIM, by scikit-image."""
    from skimage.metrics import structural_similarity

    options: dict[str, Any] = {
        "channel_axis": 2,
        "data_range": 1.0,
        "gaussian_weights": True,
        "sigma": 1.5,
    }
    return 1 - float(structural_similarity(a, b, use_sample_covariance=False, **options))


def perceptual_figures(
    encoder: PerceptualDistance, renders: npt.NDArray[np.uint8], *, pairs: int = 600
) -> list[Figure]:
    """Choice of the stronger of two distortions: on photographs and worlds that training never
    saw.
    """
    sources = Sources(photographs(HELD_OUT_PHOTOS), renders)
    distances: dict[str, Distance] = {
        "perceptual": lambda a, b: float(encoder.distance([a], [b])[0]),
        "PSNR": psnr_distance,
        "SSIM": ssim_distance,
    }
    families: dict[str, tuple[tuple[str, ...], float]] = {
        "all kinds": (TRAIN_KINDS, 0.5),
        "shifts and blurs": (("shift", "turn", "blur", "motion"), 0.5),
        "one kind": (TRAIN_KINDS, 0.0),
        "kinds never seen": (HELD_OUT_KINDS, 0.0),
    }
    figures = []
    for what, (kinds, across) in families.items():
        rng = np.random.default_rng([4, len(what)])
        right: dict[str, list[bool]] = {name: [] for name in distances}
        for _ in range(pairs):
            x, weak, strong, _, _ = triple(sources, rng, kinds, across=across)
            for name, distance in distances.items():
                right[name].append(distance(x, weak) < distance(x, strong))
        for name, answers in right.items():
            asked = 0.95 if name == "perceptual" and what == "all kinds" else None
            figures.append(
                figure(
                    f"the stronger of two distortions, {what}: {name}",
                    answers,
                    np.arange(pairs),
                    chance=0.5,
                    asked=asked,
                )
            )
    return figures


def test_sets(data: Path) -> dict[str, Pictures]:
    """The held-out pictures, rendered where they are missing."""
    return {name: load(data, name) for name in SPLITS if name.startswith("test")}
