"""Recipe of clip-small: pictures and sentences in one space, by contrast.

A batch holds all looks of a world, which differ in one attribute, and for every sentence another
with one wrong attribute. Pairs of a picture and another picture's sentence that is true of it are
left out of the sum. The image tower starts from :mod:`training.encoders.naming`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from tokenizers import Tokenizer
from torch.nn import functional

from attnwarp.encoders.nets import ClipSmall
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, GROUNDS, OBJECTS, TIMES, TWO_COLORED
from training.common import Run, channels_last, crops, descend, groups, rate, settings
from training.encoders import naming
from training.encoders.byte_pairs import learn_byte_pairs, tokens_of
from training.encoders.naming import Heads, pictures_of, scrambled, warm_start
from training.worlds.draw import COLORED
from training.worlds.words import captioned, sentence

SEED = 1
EPOCHS = 8
BATCH = 128
CROP = 96
SCALE = (0.6, 0.95)
"""Shares of a picture's side that a crop of 96 px shows. Things are on average as large in it as in
the whole picture at the encoder's size; the crop saves the time for background."""
PEAK = 1e-3
SCRAMBLED = 0.25
"""Share of pictures with scrambled colours: they are left out of the contrast, and only their thing is
a target. Without them, things in colours new to them were named in 88.8 % (95.7 % over all)."""
VISION = 0.4
"""Share of the learning rate for the image tower, which has learned much already."""
VOCABULARY = 1024

Ints = npt.NDArray[np.int64]


def make_tokenizer(sentences: int = 30_000) -> Tokenizer:
    """Byte-level byte pairs learned from captions: any text can be encoded, and a word of the captions
    takes a token or two.
    """
    rng = np.random.default_rng([SEED, 10])
    corpus = []
    for _ in range(sentences):
        drawn = _any_attributes(rng)
        corpus.append(sentence(captioned(drawn, rng), rng, fillers=True))
    return learn_byte_pairs(corpus, vocabulary=VOCABULARY, most_tokens=ClipSmall.length)


def _any_attributes(rng: np.random.Generator) -> tuple[int, ...]:
    finish = int(rng.integers(len(FINISHES)))
    color, second = rng.choice(len(COLORS), 2, replace=False)
    return (
        int(rng.integers(len(OBJECTS))), finish, int(color) if FINISHES[finish] in COLORED else -1,
        int(second) if FINISHES[finish] in TWO_COLORED else -1, int(rng.integers(len(GROUNDS))), int(rng.integers(len(TIMES))),
    )  # fmt: skip


def true_of(captions: Ints, images: Ints) -> npt.NDArray[np.bool_]:
    """(N images, M captions) whether each caption is true of each picture; colours of a pair have
    no order.
    """
    a, b = images[:, None], captions[None]
    same = (b == -1) | (a == b)
    swapped = (a[..., 2] == b[..., 3]) & (a[..., 3] == b[..., 2])
    colors = (same[..., 2] & same[..., 3]) | swapped
    # "a red ball" means a single colour; a red and white one has another caption.
    single = (b[..., 1] == -1) & (b[..., 2] >= 0)
    finish = np.where(
        single, np.isin(a[..., 1], [FINISHES.index("plain"), FINISHES.index("shiny")]), same[..., 1]
    )
    return same[..., 0] & finish & colors & same[..., 4] & same[..., 5]


def wrong(caption: tuple[int, ...], rng: np.random.Generator) -> tuple[int, ...]:
    """The caption with one of its attributes replaced."""
    thing, finish, color, second, ground, time = caption
    ways = [k for k, v in (("thing", thing), ("ground", ground), ("time", time)) if v >= 0]
    if finish >= 0 or color >= 0:
        ways += ["surface"]
    if thing >= 0:
        ways += ["thing"]
    if second >= 0:
        ways.append("swap")
    way = ways[int(rng.integers(len(ways)))] if ways else "thing"
    changed: tuple[int, ...]
    while True:
        drawn = _any_attributes(rng)
        match way:
            case "thing":
                changed = (drawn[0], finish, color, second, ground, time)
            case "ground":
                changed = (thing, finish, color, second, drawn[4], time)
            case "time":
                changed = (thing, finish, color, second, ground, drawn[5])
            case _ if finish == -1 or FINISHES[finish] == "shiny":
                changed = (thing, finish, int(rng.integers(len(COLORS))), second, ground, time)
                if rng.uniform() < 0.3:
                    changed = (thing, *drawn[1:4], ground, time)
            case _:
                changed = (thing, *drawn[1:4], ground, time)
        if changed != caption:
            return changed


def pseudo_word(rng: np.random.Generator) -> str:
    """A word without meaning, so that the text tower learns to ignore unknown words."""
    starts, ends = (
        ("b", "br", "cl", "d", "fl", "gr", "k", "l", "m", "pr", "s", "st", "t", "v", "z"),
        ("ck", "l", "m", "n", "rd", "sh", "t", "x", ""),
    )
    vowels = "aeiou"
    return "".join(
        starts[int(rng.integers(len(starts)))]
        + vowels[int(rng.integers(5))]
        + ends[int(rng.integers(len(ends)))]
        for _ in range(int(rng.integers(1, 4)))
    )


def _scattered(text: str, rng: np.random.Generator) -> str:
    if rng.uniform() > 0.1:
        return text
    words = text.split()
    words.insert(int(rng.integers(1, len(words) + 1)), pseudo_word(rng))
    return " ".join(words)


def contrast(
    model: ClipSmall, i: torch.Tensor, t: torch.Tensor, truth: torch.Tensor
) -> torch.Tensor:
    """Symmetric contrast of N pictures and 2 N texts, the first N of which are theirs.

    Args:
        i: (N, D) unit embeddings of the pictures.
        t: (2 N, D) unit embeddings of the texts.
        truth: (N, 2 N) bool, which texts are true of which pictures.
    """
    n = len(i)
    logits = model.scale.clamp(max=4.6).exp() * i @ t.T
    diagonal = torch.arange(n)
    also_true = truth.clone()
    also_true[diagonal, diagonal] = False
    logits = logits.masked_fill(also_true, -torch.inf)
    by_image = functional.cross_entropy(logits, diagonal)
    by_text = functional.cross_entropy(logits[:, :n].T, diagonal)
    return 0.5 * (by_image + by_text)


def naming_loss(
    model: ClipSmall,
    images: torch.Tensor,
    attributes: Ints,
    tokenizer: Tokenizer,
    rng: np.random.Generator,
) -> torch.Tensor:
    """Contrast of pictures with the words for one attribute at a time: each thing, each colour,
    each ground, ...

    In whole sentences a colour and a ground nearly tell a batch's pictures apart, and shapes, which
    are harder, go unlearned for long.

    Args:
        images: (N, D) unit embeddings.
        shown: (N, 6) attributes.
    """
    texts: list[str] = []
    spans: list[tuple[int, int, int]] = []
    for column, count in (
        (0, len(OBJECTS)),
        (1, len(FINISHES)),
        (2, len(COLORS)),
        (4, len(GROUNDS)),
        (5, len(TIMES)),
    ):
        spans.append((column, len(texts), len(texts) + count))
        for value in range(count):
            caption = [-1] * 6
            caption[column] = value
            if column == 1 and FINISHES[value] in COLORED:
                caption[2], caption[3] = rng.choice(len(COLORS), 2, replace=False)
                caption[3] = caption[3] if FINISHES[value] in TWO_COLORED else -1
            texts.append(sentence(tuple(int(v) for v in caption), rng))
    with torch.autocast("cpu", torch.bfloat16):
        words = model.texts(tokens_of(tokenizer, texts))
    words = functional.normalize(words.float(), dim=-1)
    logits = model.scale.clamp(max=4.6).exp() * images @ words.T
    total = torch.zeros(())
    for column, low, high in spans:
        counted = attributes[:, column] >= 0
        if (
            column == 1
        ):  # without its colour, a coloured finish cannot be told from pattern or shine
            counted &= ~np.isin(attributes[:, 1], [FINISHES.index(f) for f in COLORED])
        if column == 2:
            counted &= np.isin(attributes[:, 1], [FINISHES.index("plain"), FINISHES.index("shiny")])
        if counted.any():
            rows = torch.from_numpy(np.flatnonzero(counted))
            loss = functional.cross_entropy(
                logits[rows, low:high], torch.from_numpy(attributes[counted, column])
            )
            total = total + (2 if column == 0 else 1) * loss
    return total / (len(spans) + 1)


def train(data: Path, out: Path, *, epochs: int = EPOCHS) -> Path:
    """Train clip-small; the checkpoint's path."""
    out.mkdir(parents=True, exist_ok=True)
    sets = pictures_of(data)
    warm = warm_start(sets, out)
    torch.manual_seed(SEED)
    tokenizer = make_tokenizer()
    tokenizer.save(str(out / "clip-small.tokenizer.json"))
    model = channels_last(ClipSmall(tokenizer.get_vocab_size()))
    heads = Heads(model.pool.project.in_features)
    stored = torch.load(warm, weights_only=True)
    model.vision.load_state_dict(stored["vision"])
    model.pool.norm.load_state_dict(stored["norm"])
    heads.load_state_dict(stored["heads"])
    units = [
        (k, rows) for k, part in enumerate(sets) for rows in part.views for _ in range(part.times)
    ]
    each = sum(len(rows) for _, rows in units) // BATCH
    pretrained = [*groups(model.vision, 0.05), *groups(heads, 0.05)]
    optimizer = torch.optim.AdamW(
        [
            *pretrained,
            *groups(model.pool, 0.05),
            *groups(model.text, 0.05),
            {"params": [model.scale], "weight_decay": 0.0},
        ],
        betas=(0.9, 0.98),
    )
    peaks = [PEAK * VISION] * len(pretrained) + [PEAK] * (
        len(optimizer.param_groups) - len(pretrained)
    )

    def epoch(number: int) -> dict[str, float]:
        rng = np.random.default_rng([SEED, number])
        order = rng.permutation(len(units))
        flat = [(k, row) for u in order for k, rows in [units[u]] for row in rows]
        model.train()
        sums = np.zeros(3)
        for step in range(each):
            for group, peak in zip(optimizer.param_groups, peaks, strict=True):
                group["lr"] = rate(number * each + step, epochs * each, peak, 200)
            rows = flat[step * BATCH : (step + 1) * BATCH]
            images = crops(
                np.stack([sets[k].pictures.images[r] for k, r in rows]), CROP, rng, scale=SCALE
            )
            attributes = np.stack([sets[k].pictures.attributes[r] for k, r in rows])
            is_scrambled = rng.uniform(size=BATCH) < SCRAMBLED
            images = scrambled(images, is_scrambled, rng)
            attributes[is_scrambled, 1:] = -1
            whole = np.flatnonzero(~is_scrambled)
            captions = [captioned(tuple(int(v) for v in row), rng) for row in attributes[whole]]
            false_captions = [wrong(s, rng) for s in captions]
            texts = [
                _scattered(sentence(s, rng, fillers=True), rng)
                for s in [*captions, *false_captions]
            ]
            truth = torch.from_numpy(
                true_of(np.array([*captions, *false_captions]), attributes[whole])
            )
            with torch.autocast("cpu", torch.bfloat16):
                features = model.pool.features(model.vision(images)[-1])
                embedded = model.pool.project(features)
                guessed = heads(features, attributes)
                sentences = model.texts(tokens_of(tokenizer, texts))
            embedded = functional.normalize(embedded.float(), dim=-1)
            sentences = functional.normalize(sentences.float(), dim=-1)
            apart = contrast(model, embedded[torch.from_numpy(whole)], sentences, truth)
            named = naming_loss(model, embedded, attributes, tokenizer, rng)
            descend(optimizer, model, apart + named + guessed)
            sums += [float(part.detach()) for part in (apart, named, guessed)]
        return dict(zip(("contrast", "names", "heads"), sums / each, strict=True))

    checkpoint = out / "clip-small.pt"
    # The checkpoint depends on the first stage's settings too.
    recipe = settings(globals()) | {"naming": naming.recipe()}
    Run(checkpoint, {"model": model, "heads": heads, "optimizer": optimizer}, epochs, recipe).train(
        epoch
    )
    return checkpoint
