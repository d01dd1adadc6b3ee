"""The recipe of the editor that answers in parts. Oracles: the text shifted as a whole, pictures by rays, a run that was not stopped."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from small_trainings import stopped_at
from tokenizers import Tokenizer

from attnwarp_eval.colors import to_srgb
from attnwarp_eval.drawn.worlds import COLORS, FINISHES
from attnwarp_eval.scene.base import linear_rgb
from training import steps
from training.assess.part_answers import Cases, share_of_gain
from training.editors import parts
from training.editors.parts import PALETTE, START, PartsNet, PartsPool, Plan
from training.worlds import recolors, render
from training.worlds.draw import draw_look, draw_world


def halves_table(worlds: int = 2) -> dict[str, np.ndarray]:
    """Views whose left half is one part and whose right half, but for a margin, another, in even light."""
    size = recolors.SIZE
    divisions = np.zeros((worlds, 2, 3, size, size), dtype=np.uint8)
    divisions[..., 16:-16, 16 : size // 2] = 1
    divisions[..., 16:-16, size // 2 : -16] = 2
    light = np.full((worlds, 2, size, size, 3), 0.5, dtype=np.float16)
    return {"light": light, "parts": divisions}


@pytest.fixture(scope="module")
def tokenizer() -> Tokenizer:
    """The tokenizer of small-plain."""
    return Tokenizer.from_file(str(START / "tokenizer" / "tokenizer.json"))


@pytest.fixture(scope="module")
def net(tokenizer: Tokenizer) -> PartsNet:
    """The network before it is taught."""
    torch.manual_seed(0)
    return PartsNet(tokenizer.get_vocab_size()).eval()


def test_a_vector_drawn_at_every_place_equals_the_same_vector_added_to_the_text(net):
    generator = torch.Generator().manual_seed(1)
    sample = torch.randn((1, 96, 16, 16), generator=generator)
    text, vector = (torch.randn(shape, generator=generator) for shape in ((1, 24, 128), (128,)))
    unet, time = net.unet, torch.tensor([999])
    with torch.no_grad():
        unet.pick[2].weight.zero_()
        unet.pick[2].bias.copy_(vector)
        drawn = unet(sample, time, text, return_dict=False)[0]
        unet.pick[2].bias.zero_()
        added = unet(sample, time, text + vector, return_dict=False)[0]
        silent = unet(sample, time, text, return_dict=False)[0]
    torch.testing.assert_close(drawn, added, atol=1e-4, rtol=1e-4)
    assert (drawn - silent).abs().max() > 0.1


def test_parts_get_the_answer_that_their_own_noise_points_at(net, tokenizer):
    pool = PartsPool(halves_table(1), tokenizer)
    cut = pool.cut(64, torch.Generator(), number=0)
    shares = pool.shares([cut], 16)
    evidence = torch.zeros(1, 16, 16, 48 + len(PALETTE))
    evidence[:, :, :8, :48] = pool.directions[PALETTE.index("blue")]
    evidence[:, :, 8:, :48] = pool.directions[PALETTE.index("pink")]
    answers = pool.answers(evidence.flatten(1, 2), shares)[0]
    assert [PALETTE[k] for k in answers[:2]] == ["blue", "pink"]
    evidence[..., 48 + PALETTE.index("pink")] = 1  # the parts are pink before the edit
    evidence[:, :, 8:, :48] += 0.5 * pool.directions[PALETTE.index("green")]
    answers = pool.answers(evidence.flatten(1, 2), shares)[0]
    assert [PALETTE[k] for k in answers[:2]] == ["blue", "green"]


def test_light_times_colour_is_the_picture_that_rays_give():
    split = recolors.RECOLOR_SPLITS["test"]
    made = recolors.render_world(0, split)
    rng = np.random.default_rng([split.first, 40])
    world = draw_world(split.first, new_shapes=True, thing=0, views=2)
    look = draw_look(0, rng, pairs="any")
    values = {"finish": FINISHES.index("plain"), "color": COLORS.index("white"), "second": -1}
    look = type(look)(**{**look.__dict__, **values})
    picture = render.pictures(world, [look], recolors.SIZE)[0][0]
    white = linear_rgb(look.surface["texture"]["color"])
    color = np.where(made["parts"][0, 0, ..., None] > 0, white, 1.0)
    product = np.rint(255 * to_srgb(made["light"][0].astype(float) * color))
    assert np.abs(product - picture).max() <= 1


def test_the_judge_names_the_answers_that_are_painted_and_the_picture_before(tokenizer):
    pool = PartsPool(halves_table(1), tokenizer)
    cases = Cases({}, pool)
    assert cases.touching(0) == [(1, 2)]
    for painted in ([0, 7], [6, 2]):
        colors = pool.palette[painted + [0] * 14][None]
        image = cases.picture(pool.colored(cases.cuts[:1], colors, 64)[0])
        assert [cases.answer(image, 0, part) for part in (1, 2)] == painted
    assert [cases.answer(cases.before[0], 0, part) for part in (1, 2)] == [len(PALETTE)] * 2


def test_a_control_that_turns_one_of_two_parts_of_every_world_has_half_of_the_gain():
    worlds = [w for w in range(5) for _ in range(2)]
    marks = {
        "alone": [(0.0, w) for w in worlds],
        "carried": [(1.0, w) for w in worlds],
        "control": [(float(k % 2), w) for k, w in enumerate(worlds)],
    }
    share = share_of_gain(marks, "control", "carried", "alone")
    assert (share.value, share.low, share.high, share.count) == (0.5, 0.5, 0.5, 10)


def test_the_card_of_small_parts_says_what_its_answers_say():
    folder = Path(__file__).parents[3]
    batches = json.loads((folder / "reports" / "editor" / "parts.json").read_text()).values()
    card = (folder / "attnwarp" / "editing" / "weights" / "small-parts" / "card.md").read_text()
    means = {}
    for key in next(iter(batches)):
        right = [value for batch in batches for value, _ in batch[key]]
        means[key] = sum(right) / len(right)
        shown = rf"^\| {re.escape(key)} \| \*\*{100 * means[key]:.0f} %\*\* .* \| {len(right)} \|$"
        assert re.search(shown, card, re.MULTILINE), key
    arms = (f"other view, {arm}: the source's answer" for arm in ("alone", "mirrored", "by kind"))
    alone, mirrored, carried = (means[arm] for arm in arms)
    share = 100 * (mirrored - alone) / (carried - alone)
    assert f'over "alone" | **{share:.0f} %**' in card
    readme = " ".join((folder / "README.md").read_text().split())
    for arm, told in (
        ("alone", "in {} of the cases alone"),
        ("alone, noise on the surface", "in {} with noise on the surface alone"),
        ("by kind, noise on the surface", "in {} carried by the default's weights with that noise"),
        ("by kind", "it is {} carried"),
        ("mirrored", "{} carried from mirrored places"),
    ):
        share = means[f"other view, {arm}: the source's answer"]
        assert told.format(f"{100 * share:.0f} %") in readme


@pytest.mark.slow
def test_a_stopped_training_goes_on_to_the_same_weights(tmp_path, monkeypatch):
    monkeypatch.setattr(recolors, "load", lambda *_: halves_table())
    monkeypatch.setattr(parts, "TEACH_BATCH", 2)
    monkeypatch.setattr(steps, "STEPS_AN_EPOCH", 1)
    monkeypatch.setattr(steps, "DRAWN", 1)
    monkeypatch.setattr(steps, "SAVE_SECONDS", 0)
    plan, found = Plan(steps=2, batch=2, worlds=2), []
    for name in ("whole", "cut"):
        (tmp_path / name).mkdir()
        if name == "cut":
            with stopped_at(steps.Stepper, "step", 1):
                parts.train_parts(tmp_path / name, plan, teach_steps=2)
        found.append(parts.train_parts(tmp_path / name, plan, teach_steps=2).state_dict())
    assert all(torch.equal(value, found[1][key]) for key, value in found[0].items())
