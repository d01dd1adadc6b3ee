"""Recipe of clip-parts: clip-small, taught things with parts and what each place of a picture shows.

Pictures and sentences by contrast, as in :mod:`training.encoders.clip`, now with sentences about parts. Beside it each place
of a picture has to say which of many words are true of it, which makes masks by words. All but the names of things of one piece is in
float32: in bfloat16 a step took twice as long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tokenizers import Tokenizer
from torch.nn import functional

from attnwarp.encoders.nets import ClipParts
from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, GROUNDS, HOURS, PLACES, STATUES, TIMES
from training.common import Run, channels_last, descend, groups, placed_crops, rate, settings
from training.encoders import clip, naming
from training.encoders.byte_pairs import tokens_of
from training.encoders.clip import contrast, naming_loss
from training.worlds import part_captions, part_pictures
from training.worlds.assemblies import WHOLE_NOUNS
from training.worlds.data import load as load_pictures
from training.worlds.part_captions import caption_of, part_words, true_of, with_article, wrong
from training.worlds.part_pictures import GROUND, OTHER, PARTS, SHARD, SKY, PartPictures, shares_of
from training.worlds.words import captioned, one_of, sentence

SEED = 7
EPOCHS = 36
STEPS = 50
"""Steps in an epoch."""
UNITS = 10
"""Views of worlds in a batch, each in all its looks."""
SINGLE = 48
"""Pictures of things of one piece in a batch, so that little is forgotten."""
CROP = 112
SCALE = (0.42, 1.0)
SINGLE_SCALE = (0.6, 0.95)
PEAK = 1e-3
COSINE = 60
"""Epochs of the half cosine by which the learning rate falls; a shorter training ends before it does."""
COOLING = 16
"""Last epochs, in which the rate falls linearly beside that."""
VISION = 0.5
"""Share of the learning rate for the towers, which have learned much already."""
NOUNS_EACH = 10
"""Parts whose colour is asked in a batch."""
KEPT = 3 * SHARD
"""Last worlds of the training split: constants are chosen on them, not on the test sets."""
OLD_WORLDS = {"train": 500, "train-rendered": 200}
"""Worlds of things of one piece, by split."""
CELL = 8
"""Pixels along a place's side."""
FOCUS = 2.0
"""Exponent of the focal loss (Lin et al. 2017, eq. 4)."""
DENSE = 1.0
GROUND_NOUNS = {"grass": ("grass", "lawn"), "sand": ("sand",), "snow": ("snow",), "boards": ("wooden floor", "wooden boards"),
                "tiles": ("tiled floor", "tiles"), "road": ("road", "asphalt"), "earth": ("bare earth", "soil")}  # fmt: skip
MASS = (
    "grass",
    "sand",
    "snow",
    "asphalt",
    "bare earth",
    "soil",
    "tiles",
    "wooden boards",
    "the sky",
)
"""Words that take no article, or have one."""
BARE = 0.3
"""Share of nouns that are said without their article."""
CLUTTER = ("leaves", "trunk", "bark", "wood", "stump", "tree")
"""Words that may be true of what stands around."""

Ints = npt.NDArray[np.int64]
Tensor = torch.Tensor


@dataclass(frozen=True)
class Phrases:
    """Texts that places are asked about.

    Attributes:
        texts: K of them.
        by_part: (P, K) whether each is a name of the part.
        by_kind: (kinds, K).
        by_ground: (grounds, K).
        sky: (K,).
        clutter: (K,) whether it may be true of what stands around.
    """

    texts: list[str]
    by_part: npt.NDArray[np.bool_]
    by_kind: npt.NDArray[np.bool_]
    by_ground: npt.NDArray[np.bool_]
    sky: npt.NDArray[np.bool_]
    clutter: npt.NDArray[np.bool_]


def draw_phrases(rng: np.random.Generator) -> Phrases:
    """One name of every part, kind and ground, and the sky."""
    whole = [WHOLE_NOUNS[k] for k in KINDS]
    grounds = [GROUND_NOUNS[g] for g in GROUNDS]
    words = sorted({one_of(c, rng) for c in (*PART_NOUNS.values(), *whole, *grounds)})
    words.append("the sky")
    prefix = ("a photo of ", "", "a picture of ")

    def text(word: str) -> str:
        # People who want a mask often write the noun alone.
        plain = word in MASS or rng.uniform() < BARE
        return prefix[int(rng.integers(3))] + (word if plain else with_article(word))

    return Phrases(
        [text(w) for w in words],
        np.array([[w in PART_NOUNS[p] for w in words] for p in PARTS]),
        np.array([[w in choices for w in words] for choices in whole]),
        np.array([[w in choices for w in words] for choices in grounds]),
        np.array([w == "the sky" for w in words]),
        np.array([any(c in w.split() for c in CLUTTER) for w in words]),
    )


def place_targets(
    phrases: Phrases, ids: npt.NDArray[np.uint8], kind: Ints, ground: Ints
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """(N, h, w, K) whether a phrase is true of a place, and whether that counts.

    A word for a part and for a whole ("table") says nothing about the other parts of that whole.
    """
    n, h, w = ids.shape
    k = len(phrases.texts)
    true = np.zeros((n, h, w, k), dtype=bool)
    counts = np.ones((n, h, w, k), dtype=bool)
    on_part = ids < len(PARTS)
    picture = np.broadcast_to(np.arange(n)[:, None, None], ids.shape)
    by_part = phrases.by_part[ids[on_part]]
    by_kind = phrases.by_kind[kind[picture[on_part]]]
    a_part = phrases.by_part.any(axis=0)
    true[on_part] = by_part | (by_kind & ~a_part)
    counts[on_part] = ~(by_kind & a_part & ~by_part)
    on_ground = ids == GROUND
    true[on_ground] = phrases.by_ground[ground[picture[on_ground]]]
    true[ids == SKY] = phrases.sky
    counts[ids == OTHER] = ~phrases.clutter
    return true, counts


def focal(logits: Tensor, true: Tensor, counts: Tensor) -> Tensor:
    """Focal loss, over the number of places of which something is true (Lin et al. 2017, section 4)."""
    loss = functional.binary_cross_entropy_with_logits(logits, true.float(), reduction="none")
    probability = torch.sigmoid(logits)
    missed = torch.where(true, 1 - probability, probability)
    return (loss * missed**FOCUS * counts).sum() / true.sum().clamp(min=1)


def places(ids: npt.NDArray[np.uint8], theta: Tensor, side: int) -> npt.NDArray[np.uint8]:
    """(N, side, side) of (N, S, S) in the crops that ``theta`` places; :data:`OTHER` outside of the picture."""
    grid = functional.affine_grid(theta, [len(ids), 1, side, side], align_corners=False)
    x = torch.from_numpy(ids[:, None].astype(np.float32) + 1)
    sampled = functional.grid_sample(
        x, grid, mode="nearest", padding_mode="zeros", align_corners=False
    )[:, 0].numpy()
    return np.where(sampled == 0, OTHER, sampled - 1).astype(np.uint8)


def surface_choices() -> list[tuple[int, int, int]]:
    """Choices for a part: its colour, or its material."""
    plain = [(-1, c, -1) for c in range(len(COLORS))]
    return plain + [(FINISHES.index(m), -1, -1) for m in STATUES]


def surface_number(surfaces: Ints) -> Ints:
    """(...,) index into :func:`surface_choices` of (..., 3); -1 for patterns and where there is none."""
    finish, color = surfaces[..., 0], surfaces[..., 1]
    result = np.where(
        np.isin(finish, [FINISHES.index("plain"), FINISHES.index("shiny")]), color, -1
    )
    for k, name in enumerate(STATUES):
        result = np.where(finish == FINISHES.index(name), len(COLORS) + k, result)
    return result


def part_losses(
    model: ClipParts, pooled: Tensor, dense: Tensor, ids: npt.NDArray[np.uint8], surfaces: Ints, tokenizer: Tokenizer,
    rng: np.random.Generator,
) -> Tensor:  # fmt: skip
    """Losses of a part's surface, among all colours and materials: asked of the picture and of the
    part's places.

    Args:
        pooled: (N, D) unit embeddings of the pictures.
        dense: (N, h, w, D) unit vectors of places.
        ids: (N, h, w).
        surfaces: (N, P, 3).
    """
    numbers = surface_number(surfaces)
    seen = np.stack([(ids == p).sum(axis=(1, 2)) for p in range(len(PARTS))], axis=1)
    usable = (seen >= 2) & (numbers >= 0)
    candidates = np.flatnonzero(usable.any(axis=0))
    if not len(candidates):
        return torch.zeros(())
    asked = rng.permutation(candidates)[:NOUNS_EACH]
    choices = surface_choices()
    texts = []
    for p in asked:
        bare = rng.uniform() < BARE
        for surface in choices:
            words = part_words(int(p), surface, rng)
            texts.append(
                f"a photo of {words.removeprefix('a ').removeprefix('an ') if bare else words}"
            )
    units = _texts(model, tokenizer, texts).view(len(asked), len(choices), -1)
    scale, place_scale = model.scale.clamp(max=4.6).exp(), model.patches.scale.exp()
    total, count = torch.zeros(()), 0
    for k, p in enumerate(asked):
        rows = np.flatnonzero(usable[:, p])
        target = torch.from_numpy(numbers[rows, p])
        mask = torch.from_numpy((ids[rows] == p).astype(np.float32))[..., None]
        mean = (dense[rows] * mask).sum((1, 2)) / mask.sum((1, 2))
        mean = functional.normalize(mean, dim=-1)
        total = total + functional.cross_entropy(
            place_scale * mean @ units[k].T, target, reduction="sum"
        )
        total = total + functional.cross_entropy(
            scale * pooled[rows] @ units[k].T, target, reduction="sum"
        )
        count += 2 * len(rows)
    return total / count


def whole_losses(
    model: ClipParts,
    pooled: Tensor,
    kind: Ints,
    ground: Ints,
    time: Ints,
    tokenizer: Tokenizer,
    rng: np.random.Generator,
) -> Tensor:
    """Losses of what a picture shows, on which ground and at what time, each by its words alone."""
    columns = [
        (kind, [f"a photo of {with_article(one_of(WHOLE_NOUNS[k], rng))}" for k in KINDS]),
        (ground, [f"something {one_of(PLACES[g], rng)}" for g in GROUNDS]),
        (time, [f"something {one_of(HOURS[t], rng)}" for t in TIMES]),
    ]
    words = _texts(model, tokenizer, [t for _, texts in columns for t in texts])
    logits = model.scale.clamp(max=4.6).exp() * pooled @ words.T
    total, start = torch.zeros(()), 0
    for target, texts in columns:
        total = total + functional.cross_entropy(
            logits[:, start : start + len(texts)], torch.from_numpy(target)
        )
        start += len(texts)
    return total / len(columns)


def _texts(model: ClipParts, tokenizer: Tokenizer, texts: Sequence[str]) -> Tensor:
    """(N, D) unit embeddings."""
    return functional.normalize(model.texts(tokens_of(tokenizer, texts)), dim=-1)


def recipe() -> dict[str, Any]:
    """Settings and data that a checkpoint depends on, those of the stages before included."""
    own = settings(globals()) | {
        "parts": {"protocol": part_pictures.PARTS_PROTOCOL, "looks": part_pictures.LOOKS}
    }
    own["data"] = {**own["data"], **OLD_WORLDS}
    own["naming"] = naming.recipe()
    return own | {"captions": settings(vars(part_captions)), "contrast": settings(vars(clip))}


def train(data: Path, out: Path, *, epochs: int = EPOCHS) -> Path:
    """Train clip-parts on the checkpoint of clip-small; the checkpoint's path."""
    before = clip.train(data, out)
    tokenizer = Tokenizer.from_file(str(out / "clip-small.tokenizer.json"))
    pictures = part_pictures.load(data, "parts-train")
    singles = [load_pictures(data, name, worlds=n) for name, n in OLD_WORLDS.items()]
    torch.manual_seed(SEED)
    model = channels_last(ClipParts(tokenizer.get_vocab_size()))
    # As published, in half precision.
    stored = torch.load(before, weights_only=True)["model"]
    start = {k: v.half().float() if v.is_floating_point() else v for k, v in stored.items()}
    model.load_state_dict(model.state_dict() | start)
    tokenizer.save(str(out / "clip-parts.tokenizer.json"))
    towers = [*groups(model.vision, 0.05), *groups(model.pool, 0.05), *groups(model.text, 0.05)]
    optimizer = torch.optim.AdamW(
        [*towers, *groups(model.patches, 0.05), {"params": [model.scale], "weight_decay": 0.0}],
        betas=(0.9, 0.98),
    )
    peaks = [PEAK * VISION] * len(towers) + [PEAK] * (len(optimizer.param_groups) - len(towers))
    worlds = int(pictures.world.max()) + 1 - KEPT
    units = np.flatnonzero(pictures.look == 0)
    units = units[pictures.world[units] < worlds]
    looks = np.arange(part_pictures.LOOKS)
    flat = [(k, row) for k, part in enumerate(singles) for row in range(len(part))]

    def epoch(number: int) -> dict[str, float]:
        rng = np.random.default_rng([SEED, number])
        model.train()
        sums = np.zeros(5)
        for step in range(STEPS):
            for group, peak in zip(optimizer.param_groups, peaks, strict=True):
                group["lr"] = learning_rate(number * STEPS + step, epochs * STEPS, peak)
            rows = (rng.choice(units, UNITS, replace=False)[:, None] + looks).ravel()
            chosen = [flat[k] for k in rng.choice(len(flat), SINGLE, replace=False)]
            losses = batch_losses(model, pictures, rows, singles, chosen, tokenizer, rng)
            loss = losses[0] + losses[1] + losses[2] + losses[3] + DENSE * losses[4]
            descend(optimizer, model, loss)
            sums += [float(part.detach()) for part in losses]
        names = ("contrast", "single", "whole", "parts", "places")
        return dict(zip(names, sums / STEPS, strict=True))

    checkpoint = out / "clip-parts.pt"
    Run(checkpoint, {"model": model, "optimizer": optimizer}, epochs, recipe()).train(epoch)
    return checkpoint


def learning_rate(step: int, total: int, peak: float) -> float:
    """The cosine of :data:`COSINE` epochs, times the share of the last :data:`COOLING` that is left."""
    left = (total - step) / (COOLING * STEPS)
    return rate(step, COSINE * STEPS, peak, 100) * max(0.01, min(1.0, left))


def batch_losses(
    model: ClipParts, pictures: PartPictures, rows: Ints, singles: Sequence[Any], chosen: Sequence[tuple[int, int]],
    tokenizer: Tokenizer, rng: np.random.Generator,
) -> list[Tensor]:  # fmt: skip
    """Contrast, the same and names for things of one piece, names of wholes, surfaces of parts, places."""
    images, theta = placed_crops(pictures.images[rows], CROP, rng, scale=SCALE)
    ids = places(pictures.ids[pictures.place[rows]], theta, CROP // CELL)
    shares = shares_of(places(pictures.ids[pictures.place[rows]], theta, CROP // 2))
    old = np.stack([singles[k].images[row] for k, row in chosen])
    old_attributes = np.stack([singles[k].attributes[row] for k, row in chosen])
    old_images, _ = placed_crops(old, CROP, rng, scale=SINGLE_SCALE)
    stages = model.vision(torch.cat([images, old_images]).to(memory_format=torch.channels_last))
    pooled = functional.normalize(model.pool(stages[-1]), dim=-1)
    dense = model.patches([stage[: len(rows)] for stage in stages[1:]])
    dense = functional.normalize(dense.permute(0, 2, 3, 1), dim=-1)
    new, single = pooled[: len(rows)], pooled[len(rows) :]

    captions = [
        caption_of(pictures, int(row), share, rng) for row, share in zip(rows, shares, strict=True)
    ]
    captions += [wrong(c, rng) for c in captions]
    texts = [part_captions.sentence(c, rng, fillers=True) for c in captions]
    truth = torch.from_numpy(true_of(captions, pictures, rows))
    apart = contrast(model, new, _texts(model, tokenizer, texts), truth)

    old_captions = [captioned(tuple(int(v) for v in row), rng) for row in old_attributes]
    old_captions += [clip.wrong(c, rng) for c in old_captions]
    old_texts = [sentence(c, rng, fillers=True) for c in old_captions]
    old_truth = torch.from_numpy(clip.true_of(np.array(old_captions), old_attributes))
    kept = contrast(model, single, _texts(model, tokenizer, old_texts), old_truth)
    kept = kept + naming_loss(model, single, old_attributes, tokenizer, rng)

    kind, ground, time = pictures.kind[rows], pictures.ground[rows], pictures.time[rows]
    named = whole_losses(model, new, kind, ground, time, tokenizer, rng)
    surfaces = part_losses(model, new, dense, ids, pictures.surfaces[rows], tokenizer, rng)

    phrases = draw_phrases(rng)
    true, counts = place_targets(phrases, ids, kind, ground)
    words = _texts(model, tokenizer, phrases.texts)
    logits = model.patches.scale.exp() * dense @ words.T + model.patches.bias
    shown = focal(logits, torch.from_numpy(true), torch.from_numpy(counts))
    return [apart, kept, named, surfaces, shown]
