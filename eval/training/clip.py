"""Recipe of clip-small: pictures and sentences in one space, by contrast.

A batch holds the looks of a world side by side, which differ in one attribute, and for every
sentence another with one attribute wrong. A sentence that happens to be true of another picture of
the batch is no negative: both know what they show, so such pairs are left out of the sum. The image
tower comes from :mod:`training.naming`, which taught it shapes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from tokenizers import (
    Tokenizer,
    decoders,
    models,
    normalizers,
    pre_tokenizers,
    processors,
    trainers,
)

from attnwarp.encoders.nets import ClipSmall
from training import naming
from training.common import Run, channels_last, crops, groups, rate, settings
from training.naming import Heads, pictures_of, scrambled, warm_start
from training.worlds import (
    COLORED,
    COLORS,
    FINISHES,
    GROUNDS,
    OBJECTS,
    TIMES,
    TWO_COLORED,
    sentence,
    told,
)

SEED = 1
EPOCHS = 8
BATCH = 128
CROP = 96
SCALE = (0.6, 0.95)
"""Shares of a picture's side that a crop of 96 px shows: things are as large in it, on average, as
in the whole picture at the encoder's size, of which the crop leaves out background that costs
time."""
PEAK = 1e-3
SCRAMBLED = 0.25
"""Share of pictures whose colours are scrambled: they have no part in the contrast, and their thing
alone is asked by name. Without them things in colours that training never showed them in were named
in 88.8 %, and 95.7 % over all."""
VISION = 0.4
"""Share of the learning rate for the image tower, which has learned much already."""
VOCABULARY = 1024

Ints = npt.NDArray[np.int64]


def make_tokenizer(sentences: int = 30_000) -> Tokenizer:
    """Byte-level byte pairs learned from captions: any text can be written with it, known words in
    a token or two.
    """
    rng = np.random.default_rng([SEED, 10])
    corpus = []
    for _ in range(sentences):
        shown = _any_attributes(rng)
        corpus.append(sentence(told(shown, rng), rng, fillers=True))
    tokenizer = Tokenizer(models.BPE())
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFKC(), normalizers.Lowercase()])
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=True)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=VOCABULARY, special_tokens=["<pad>", "<end>"], initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )  # fmt: skip
    tokenizer.train_from_iterator(corpus, trainer)
    tokenizer.post_processor = processors.TemplateProcessing(
        single="$A <end>", special_tokens=[("<end>", 1)]
    )
    tokenizer.enable_padding(pad_id=0, pad_token="<pad>")
    tokenizer.enable_truncation(ClipSmall.length)
    return tokenizer


def _any_attributes(rng: np.random.Generator) -> tuple[int, ...]:
    finish = int(rng.integers(len(FINISHES)))
    color, second = rng.choice(len(COLORS), 2, replace=False)
    return (
        int(rng.integers(len(OBJECTS))), finish, int(color) if FINISHES[finish] in COLORED else -1,
        int(second) if FINISHES[finish] in TWO_COLORED else -1, int(rng.integers(len(GROUNDS))), int(rng.integers(len(TIMES))),
    )  # fmt: skip


def tokens(tokenizer: Tokenizer, sentences: list[str]) -> torch.Tensor:
    """(N, L) int64, padded with 0."""
    return torch.tensor([code.ids for code in tokenizer.encode_batch(sentences)], dtype=torch.int64)


def true_of(said: Ints, shown: Ints) -> npt.NDArray[np.bool_]:
    """(N images, M captions) whether each caption is true of each picture; colours of a pair have
    no order.
    """
    a, b = shown[:, None], said[None]
    same = (b == -1) | (a == b)
    swapped = (a[..., 2] == b[..., 3]) & (a[..., 3] == b[..., 2])
    colors = (same[..., 2] & same[..., 3]) | swapped
    # "a red ball" is said of a single colour; a red and white one is another thing.
    single = (b[..., 1] == -1) & (b[..., 2] >= 0)
    finish = np.where(
        single, np.isin(a[..., 1], [FINISHES.index("plain"), FINISHES.index("shiny")]), same[..., 1]
    )
    return same[..., 0] & finish & colors & same[..., 4] & same[..., 5]


def wrong(said: tuple[int, ...], rng: np.random.Generator) -> tuple[int, ...]:
    """The caption with one of the attributes that it says replaced."""
    thing, finish, color, second, ground, time = said
    ways = [k for k, v in (("thing", thing), ("ground", ground), ("time", time)) if v >= 0]
    if finish >= 0 or color >= 0:
        ways += ["surface"]
    if thing >= 0:
        ways += ["thing"]
    if second >= 0:
        ways.append("swap")
    way = ways[int(rng.integers(len(ways)))] if ways else "thing"
    made: tuple[int, ...]
    while True:
        other = _any_attributes(rng)
        match way:
            case "thing":
                made = (other[0], finish, color, second, ground, time)
            case "ground":
                made = (thing, finish, color, second, other[4], time)
            case "time":
                made = (thing, finish, color, second, ground, other[5])
            case _ if finish == -1 or FINISHES[finish] == "shiny":
                made = (thing, finish, int(rng.integers(len(COLORS))), second, ground, time)
                if rng.uniform() < 0.3:
                    made = (thing, *other[1:4], ground, time)
            case _:
                made = (thing, *other[1:4], ground, time)
        if made != said:
            return made


def pseudo_word(rng: np.random.Generator) -> str:
    """A word that nobody knows, so that the text tower learns to read past those it does not
    know."""
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
    model: ClipSmall, i: torch.Tensor, texts: torch.Tensor, truth: torch.Tensor
) -> torch.Tensor:
    """Symmetric contrast of N pictures and 2 N texts, the first N of which are theirs.

    Args:
        model: the two towers.
        i: (N, D) unit embeddings of the pictures.
        texts: (2 N, L) tokens.
        truth: (N, 2 N) bool, which texts are true of which pictures.
    """
    n = len(i)
    with torch.autocast("cpu", torch.bfloat16):
        t = model.texts(texts)
    t = F.normalize(t.float(), dim=-1)
    logits = model.scale.clamp(max=4.6).exp() * i @ t.T
    mine = torch.arange(n)
    also = truth.clone()
    also[mine, mine] = False
    logits = logits.masked_fill(also, -torch.inf)
    by_image = F.cross_entropy(logits, mine)
    by_text = F.cross_entropy(logits[:, :n].T, mine)
    return 0.5 * (by_image + by_text)


def naming_loss(
    model: ClipSmall,
    images: torch.Tensor,
    shown: Ints,
    tokenizer: Tokenizer,
    rng: np.random.Generator,
) -> torch.Tensor:
    """Contrast of pictures with the words for one attribute at a time: each thing, each colour,
    each ground, ...

    In whole sentences a colour and a ground nearly tell a batch's pictures apart, and shapes, which
    are harder, go unlearned for long.

    Args:
        model: the two towers.
        images: (N, D) unit embeddings.
        shown: (N, 6) attributes.
        tokenizer: of the text tower.
        rng: picks one way to say each.
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
            said = [-1] * 6
            said[column] = value
            if column == 1 and FINISHES[value] in COLORED:
                said[2], said[3] = rng.choice(len(COLORS), 2, replace=False)
                said[3] = said[3] if FINISHES[value] in TWO_COLORED else -1
            texts.append(sentence(tuple(int(v) for v in said), rng))
    with torch.autocast("cpu", torch.bfloat16):
        words = model.texts(tokens(tokenizer, texts))
    words = F.normalize(words.float(), dim=-1)
    logits = model.scale.clamp(max=4.6).exp() * images @ words.T
    total = torch.zeros(())
    for column, low, high in spans:
        asked = shown[:, column] >= 0
        if (
            column == 1
        ):  # what a colour is said of is told from its pattern or its shine alone only by chance
            asked &= ~np.isin(shown[:, 1], [FINISHES.index(f) for f in COLORED])
        if column == 2:
            asked &= np.isin(shown[:, 1], [FINISHES.index("plain"), FINISHES.index("shiny")])
        if asked.any():
            rows = torch.from_numpy(np.flatnonzero(asked))
            loss = F.cross_entropy(logits[rows, low:high], torch.from_numpy(shown[asked, column]))
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
    seen = [*groups(model.vision, 0.05), *groups(heads, 0.05)]
    optimizer = torch.optim.AdamW(
        [
            *seen,
            *groups(model.pool, 0.05),
            *groups(model.text, 0.05),
            {"params": [model.scale], "weight_decay": 0.0},
        ],
        betas=(0.9, 0.98),
    )
    peaks = [PEAK * VISION] * len(seen) + [PEAK] * (len(optimizer.param_groups) - len(seen))

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
            shown = np.stack([sets[k].pictures.attributes[r] for k, r in rows])
            which = rng.uniform(size=BATCH) < SCRAMBLED
            images = scrambled(images, which, rng)
            shown[which, 1:] = -1
            kept = np.flatnonzero(~which)
            said = [told(tuple(int(v) for v in row), rng) for row in shown[kept]]
            false = [wrong(s, rng) for s in said]
            texts = [_scattered(sentence(s, rng, fillers=True), rng) for s in [*said, *false]]
            truth = torch.from_numpy(true_of(np.array([*said, *false]), shown[kept]))
            with torch.autocast("cpu", torch.bfloat16):
                features = model.pool.features(model.vision(images)[-1])
                embedded = model.pool.project(features)
                guessed = heads(features, shown)
            embedded = F.normalize(embedded.float(), dim=-1)
            apart = contrast(
                model, embedded[torch.from_numpy(kept)], tokens(tokenizer, texts), truth
            )
            named = naming_loss(model, embedded, shown, tokenizer, rng)
            loss = apart + named + guessed
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
            sums += [float(part.detach()) for part in (apart, named, guessed)]
        return dict(zip(("contrast", "names", "heads"), sums / each, strict=True))

    checkpoint = out / "clip-small.pt"
    # The image tower's start is part of what this comes from.
    recipe = settings(globals()) | {"naming": naming.recipe()}
    Run(checkpoint, {"model": model, "heads": heads, "optimizer": optimizer}, epochs, recipe).train(
        epoch
    )
    return checkpoint
