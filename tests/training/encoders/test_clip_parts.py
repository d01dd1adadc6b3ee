"""The recipe of clip-parts. Oracles: loops over places, float64 formulas, a run that was not stopped."""

import numpy as np
import pytest
import torch
from small_trainings import stopped_at

from attnwarp.encoders.nets import ClipSmall
from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, GROUNDS, OBJECTS
from training.encoders import clip, clip_parts
from training.encoders.clip_parts import (
    draw_phrases,
    focal,
    place_targets,
    places,
    surface_choices,
    surface_number,
)
from training.worlds import part_pictures
from training.worlds.assemblies import WHOLE_NOUNS
from training.worlds.data import Pictures
from training.worlds.part_pictures import (
    GROUND,
    LOOKS,
    OTHER,
    PARTS,
    SKY,
    PartPictures,
    shares_of,
)


def noun(text):
    """Noun of a phrase, without the words before it."""
    for start in ("a photo of ", "a picture of "):
        text = text.removeprefix(start)
    return text if text == "the sky" else text.removeprefix("a ").removeprefix("an ")


def test_places_are_asked_what_a_loop_over_them_says():
    rng = np.random.default_rng(0)
    phrases = draw_phrases(rng)
    words = [noun(t) for t in phrases.texts]
    ids = rng.choice([*range(len(PARTS)), GROUND, OTHER, SKY], size=(5, 9, 7)).astype(np.uint8)
    kind, ground = rng.integers(len(KINDS), size=5), rng.integers(len(GROUNDS), size=5)
    true, counts = place_targets(phrases, ids, kind, ground)
    part_names = {n for nouns in PART_NOUNS.values() for n in nouns}
    for (n, y, x), shown in np.ndenumerate(ids):
        for k, word in enumerate(words):
            whole = word in WHOLE_NOUNS[KINDS[kind[n]]]
            if shown < len(PARTS):
                own = word in PART_NOUNS[PARTS[shown]]
                # "table" is a part and a whole: of the plates on it, it says nothing.
                assert counts[n, y, x, k] == (own or not (whole and word in part_names))
                if counts[n, y, x, k]:
                    assert true[n, y, x, k] == (own or whole)
            elif shown == GROUND:
                assert true[n, y, x, k] == (word in clip_parts.GROUND_NOUNS[GROUNDS[ground[n]]])
            else:
                assert true[n, y, x, k] == (shown == SKY and word == "the sky")
    assert true.any() and not counts.all()
    around = counts[ids == OTHER]
    assert {w for w, c in zip(words, around[0], strict=True) if not c} == {
        w for w in words if set(w.split()) & set(clip_parts.CLUTTER)
    }
    assert counts[(ids == GROUND) | (ids == SKY)].all()


def test_every_part_kind_and_ground_has_a_phrase():
    phrases = draw_phrases(np.random.default_rng(1))
    assert phrases.by_part.any(axis=1).all()
    assert phrases.by_kind.any(axis=1).all()
    assert phrases.by_ground.any(axis=1).all()
    assert phrases.sky.sum() == 1
    assert len(set(phrases.texts)) == len(phrases.texts)


def test_the_focal_loss_is_its_formula():
    rng = np.random.default_rng(2)
    logits, true = rng.normal(size=(4, 6)) * 3, rng.uniform(size=(4, 6)) < 0.3
    counts = rng.uniform(size=(4, 6)) < 0.8
    p = 1 / (1 + np.exp(-logits))
    right = np.where(true, p, 1 - p)
    expected = (-((1 - right) ** 2) * np.log(right))[counts].sum() / true.sum()
    found = focal(*(torch.from_numpy(x) for x in (logits, true, counts)))
    assert float(found) == pytest.approx(expected, rel=1e-6)


def test_places_of_a_crop_are_where_the_crop_is():
    ids = np.arange(64, dtype=np.uint8).reshape(1, 8, 8)
    whole = torch.tensor([[[1.0, 0, 0], [0, 1, 0]]])
    assert (places(ids, whole, 8) == ids).all()
    mirrored = torch.tensor([[[-1.0, 0, 0], [0, 1, 0]]])
    assert (places(ids, mirrored, 8) == ids[:, :, ::-1]).all()
    # The right upper quarter.
    quarter = torch.tensor([[[0.5, 0, 0.5], [0, 0.5, -0.5]]])
    assert (places(ids, quarter, 4)[0] == ids[0, :4, 4:]).all()
    beyond = torch.tensor([[[1.0, 0, 1.0], [0, 1, 0]]])
    assert (places(ids, beyond, 8)[0, :, 4:] == OTHER).all()
    assert shares_of(places(ids, quarter, 4))[0, :8].tolist() == [0, 0, 0, 0, *[1 / 16] * 4]


def test_surfaces_that_are_asked_have_their_number():
    choices = surface_choices()
    assert len(choices) == 17
    for k, (finish, color, _) in enumerate(choices):
        for name in ("plain", "shiny") if finish < 0 else (FINISHES[finish],):
            shown = np.array([FINISHES.index(name), color, -1])
            assert surface_number(shown) == k
    assert surface_number(np.array([FINISHES.index("striped"), 1, 2])) == -1
    assert surface_number(np.array([-2, -2, -2])) == -1


def drawn(worlds):
    """Pictures of noise, with parts in two halves."""
    rng = np.random.default_rng(3)
    world, view, look = (v.ravel() for v in np.indices((worlds, 2, LOOKS)))
    surfaces = np.full((len(world), len(PARTS), 3), -2)
    for p in (0, 5):
        surfaces[:, p] = [0, 0, -1]
        surfaces[:, p, 1] = rng.integers(len(COLORS), size=len(world))
    ids = np.full((2 * worlds, 32, 32), GROUND, np.uint8)
    ids[:, :, :16], ids[:, :8, 16:], ids[:, 8:16, 16:] = 0, 5, SKY
    shares = np.zeros((2 * worlds, len(PARTS)))
    shares[:, 0], shares[:, 5] = 0.5, 0.125
    return PartPictures(
        rng.integers(256, size=(len(world), 32, 32, 3), dtype=np.uint8), surfaces, world % len(KINDS), world % len(GROUNDS),
        world % 4, world, view, look, world * 2 + view, ids, shares,
    )  # fmt: skip


@pytest.fixture
def small(monkeypatch, tmp_path):
    """The recipe on a few pictures of noise; clip-small is an untrained network."""
    rng = np.random.default_rng(4)
    zeros = np.zeros(12, np.int64)
    attributes = np.stack(
        [np.arange(12) % len(OBJECTS), zeros, zeros, zeros - 1, zeros, zeros], axis=1
    )
    singles = Pictures(
        rng.integers(256, size=(12, 32, 32, 3), dtype=np.uint8), attributes, zeros, zeros, zeros
    )
    monkeypatch.setattr(part_pictures, "load", lambda *_: drawn(5))
    monkeypatch.setattr(clip_parts, "load_pictures", lambda *_, **__: singles)
    for name, value in {
        "STEPS": 1,
        "UNITS": 1,
        "SINGLE": 4,
        "CROP": 32,
        "KEPT": 1,
        "NOUNS_EACH": 1,
    }.items():
        monkeypatch.setattr(clip_parts, name, value)

    def clip_small(_, out):
        tokenizer = clip.make_tokenizer(300)
        tokenizer.save(str(out / "clip-small.tokenizer.json"))
        torch.manual_seed(0)
        torch.save(
            {"model": ClipSmall(tokenizer.get_vocab_size()).state_dict()}, out / "clip-small.pt"
        )
        return out / "clip-small.pt"

    monkeypatch.setattr(clip, "train", clip_small)
    return tmp_path


def test_a_training_that_was_stopped_gives_the_bits_of_one_that_was_not(small):
    for name in ("whole", "halves"):
        (small / name).mkdir()
    clip_parts.train(small, small / "whole", epochs=2)
    with stopped_at(clip_parts, "learning_rate", 1):
        clip_parts.train(small, small / "halves", epochs=2)
    clip_parts.train(small, small / "halves", epochs=2)
    one, other = (
        torch.load(small / n / "clip-parts.pt", weights_only=True)["model"]
        for n in ("whole", "halves")
    )
    assert all(torch.equal(value, other[key]) for key, value in one.items())
    start = torch.load(small / "whole" / "clip-small.pt", weights_only=True)["model"]
    changed = {
        key.split(".")[0]
        for key, value in one.items()
        if key not in start or not torch.equal(value, start[key])
    }
    assert changed >= {"vision", "pool", "text", "patches", "scale"}
    assert all(torch.isfinite(value.float()).all() for value in one.values())
