"""Oracles: pictures cut one by one in numpy, loops over single pairs, exact geometry, counts."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from picked_answers import picked
from small_trainings import draw_pairs

from training.assess.pictures import Pictures, Row
from training.editors.answers import KIND_NAMES, codes, settled
from training.editors.pool import PairPool, cut_regions
from training.editors.recipe import make_tokenizer
from training.worlds import editing_pairs
from training.worlds.editing_pairs import AMBIGUOUS, GROUPS, load_pairs

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")


@pytest.fixture(scope="module")
def pool(tmp_path_factory):
    folder = draw_pairs(tmp_path_factory.mktemp("pairs"))
    return PairPool(
        load_pairs(folder, "edit-train", count=2), make_tokenizer(400, worlds=10), sentences=4
    )


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@dataclass(frozen=True)
class Asked(Row):
    """A row with what an instruction asks of it."""

    kind: str = ""
    unclear: bool = False


def one_by_one(rows):
    return [
        Asked(
            int(rows.world[k]), int(rows.view[k]), int(rows.source[k]), int(rows.target[k]),
            (int(rows.y[k]), int(rows.x[k]), int(rows.zoom[k])), bool(rows.flip[k]), KIND_NAMES[rows.kind[k]],
            bool(rows.unclear[k]),
        )
        for k in range(len(rows))
    ]  # fmt: skip


@pytest.mark.parametrize("size", [64, 128])
def test_pictures_and_things_are_those_cut_one_by_one(pool, size):
    rows = pool.rows(40, generator(), size=size, kinds={"color": 0.5, "ground": 0.5}, unclear=0.5)
    images, things = pool.pictures(rows, rows.target, size), pool.thing(rows, size)
    weights = pool.weight(rows, size)
    alone = Pictures(pool.worlds, size)
    singles = one_by_one(rows)
    for k, row in enumerate(singles):
        assert (
            np.abs(images[k].permute(1, 2, 0).numpy() - alone.picture(row, row.target)).max() < 1e-5
        )
        thing = alone.thing(row)
        assert np.array_equal(things[k].numpy(), thing)
        touched = thing.reshape(size // 4, 4, size // 4, 4).mean(axis=(1, 3)) > 0
        gain = np.clip(0.25 / max(thing.mean(), 1e-3), 1, 8) if row.kind == "color" else 1
        assert np.allclose(weights[k, 0].numpy(), np.where(touched, gain, 1), rtol=1e-5)
    assert {r.corner[2] for r in singles} == ({1, 2} if size == 64 else {1})
    assert {r.flip for r in singles} == {True, False}


def test_pairs_lead_from_a_look_to_one_that_differs_in_what_the_kind_names(pool):
    rows = pool.rows(4000, generator(), size=64, kinds=dict.fromkeys(GROUPS, 1.0), unclear=0.5)
    valid, looks = pool.worlds.valid, pool.worlds.looks
    seen = set()
    for row in one_by_one(rows):
        assert valid[row.world, row.source] and valid[row.world, row.target]
        assert row.target in GROUPS[row.kind]
        assert row.source in pool.worlds.sources(row.world, row.kind)
        assert not np.array_equal(looks[row.world, row.source], looks[row.world, row.target])
        assert row.kind in AMBIGUOUS or not row.unclear
        seen.add((row.world, row.kind, row.target))
    # 4,000 draws of about 60 results: one is left out with a chance below 1e-20.
    results = {
        (w, kind, j) for w in range(2) for kind in GROUPS for j in GROUPS[kind]
        if valid[w, j] and any(
            k != j and not np.array_equal(looks[w, k], looks[w, j]) for k in pool.worlds.sources(w, kind)
        )
    }  # fmt: skip
    assert seen == results
    kinds = np.bincount(rows.kind.numpy(), minlength=5)
    # Binomial with p = 1/5: a standard deviation of 25; five of them.
    assert np.abs(kinds - 800).max() < 127
    share = rows.unclear[pool.open_kinds[rows.kind]].float().mean()
    assert float(share) == pytest.approx(0.5, abs=0.05)


def test_sentences_name_the_result_or_leave_it_open(pool):
    kinds = {"color": 1.0}
    rows = pool.rows(200, generator(), size=64, kinds=kinds, unclear=0.5)
    tokens = pool.text(rows, generator())
    tokenizer = make_tokenizer(400, worlds=10)
    for row, line in zip(one_by_one(rows), tokens.tolist(), strict=True):
        text = tokenizer.decode(line)
        if row.unclear:
            assert any(word in text for word in ("color", "different", "new", "other")), text
        else:
            color = editing_pairs.COLORS[int(pool.worlds.looks[row.world, row.target, 1])]
            hues = " ".join(editing_pairs.HUES[color]).split()
            assert any(hue in text.split() for hue in hues), (text, color)


def test_an_unclear_pair_ends_in_the_answer_that_its_noise_picks(pool):
    t = torch.full((60,), 999)
    batch = pool.batch(
        60, generator(), size=64, t=t, kinds={"color": 1.0, "time": 1.0}, unclear=1.0
    )
    for row, noise in zip(one_by_one(batch.rows), batch.noise, strict=True):
        assert picked(noise, GROUPS[row.kind]) == row.target


def test_noise_that_got_its_answer_is_as_white_as_before():
    noise = torch.randn((4000, 48, 2, 2), generator=generator())
    answers = torch.randint(len(GROUPS["color"]), (4000,), generator=generator(1))
    kinds = torch.full((4000,), KIND_NAMES.index("color"))
    given = settled(noise, answers, kinds)
    assert torch.allclose(
        given - given.mean((2, 3), True), noise - noise.mean((2, 3), True), atol=1e-5
    )
    flat = given.flatten(1).double().numpy()
    # Means and covariances of 4,000 normals have standard deviations of about 1 / sqrt(4000); six of them.
    assert np.abs(flat.mean(axis=0)).max() < 6 / 4000**0.5
    assert np.abs(np.cov(flat.T) - np.eye(192)).max() < 6 * (2 / 4000) ** 0.5
    mean = given.mean(dim=(2, 3)) @ codes()[list(GROUPS["color"])].T
    assert mean.argmax(dim=1).tolist() == answers.tolist()
    # The shares that the noise has of the answers are the same numbers, two of them exchanged.
    own = noise.mean(dim=(2, 3)) @ codes()[list(GROUPS["color"])].T
    assert torch.allclose(mean.sort(dim=1).values, own.sort(dim=1).values, atol=1e-5)


def answers_of(pool, row, size=64):
    """Pictures of all answers that a row may have, by look."""
    alone, valid = Pictures(pool.worlds, size), pool.worlds.valid[row.world]
    return {k: alone.picture(row, k) for k in GROUPS[row.kind] if valid[k] and k != row.source}


def test_a_composed_result_has_one_answer_in_a_region_and_its_own_elsewhere(pool):
    t = torch.tensor([300, 849, 850, 999] * 8)
    batch = pool.batch(
        32, generator(1), size=64, t=t, kinds={"color": 0.6, "ground": 0.4}, unclear=0.8, composed=1.0
    )  # fmt: skip
    results = pool.coder.decode(batch.after).sample.permute(0, 2, 3, 1).numpy()
    shared, settled_pairs = 0, 0
    for row, step, result in zip(one_by_one(batch.rows), t.tolist(), results, strict=True):
        pictures = answers_of(pool, row)
        own = np.abs(result - pictures[row.target]).max(axis=2) < 1e-4
        if step >= 850 or not row.unclear:  # the noise is still to choose, or nothing is open
            assert own.all()
            continue
        settled_pairs += 1
        other = [np.abs(result - p).max(axis=2) < 1e-4 for p in pictures.values()]
        assert any((own | o).all() for o in other)
        shared += not own.all()
    # A few have an edge beside what changes.
    assert settled_pairs >= 8
    assert shared >= 0.6 * settled_pairs


def test_regions_cut_the_thing_and_take_half_of_it_on_average(pool):
    thing = torch.zeros((400, 64, 64), dtype=torch.bool)
    thing[:, 20:50, 10:40] = True
    regions = cut_regions(thing, pool, generator())
    shares = ((regions & thing).sum(dim=(1, 2)) / thing.sum(dim=(1, 2))).numpy()
    # A half-plane and its complement are as likely; boxes are smaller than their complements.
    assert 0.3 < shares.mean() < 0.5
    assert ((shares > 0) & (shares < 1)).mean() > 0.95
