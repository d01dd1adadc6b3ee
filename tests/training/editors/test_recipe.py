"""Oracles: the scenes' own files, orthogonality, exact geometry, diffusers' own pipeline, a run that was not stopped."""

import dataclasses
import functools
import types

import numpy as np
import pytest
import torch
from diffusers import StableDiffusionInstructPix2PixPipeline
from picked_answers import picked
from small_trainings import draw_pairs, stopped_at
from typer.testing import CliRunner

import attnwarp_eval
from attnwarp.editing.editor import edit
from attnwarp.editing.latents import HaarLatents, haar_basis
from attnwarp.editing.small import load_editor
from attnwarp.errors import InputError
from attnwarp_eval.drawn.worlds import COLORS, held_out
from attnwarp_eval.scene.yaml import read_yaml
from training import steps
from training.assess.pictures import Pictures, Row
from training.editors import draws as editor_draws
from training.editors import net as editor_net
from training.editors import recipe as editor
from training.editors.__main__ import app
from training.editors.answers import codes
from training.editors.export import export_editor, facts_of
from training.editors.pool import PairPool
from training.editors.recipe import Stage, make_tokenizer, train_stage
from training.worlds import editing_pairs
from training.worlds.data import SPLITS
from training.worlds.editing_pairs import (
    AMBIGUOUS,
    GROUPS,
    PAIR_SPLITS,
    SURFACES,
    ambiguous_instruction,
    edit_looks,
    instruction,
    load_pairs,
    reserved,
)

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")

TINY = Stage(64, 4, 1e-3, 2, batch=2)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return draw_pairs(tmp_path_factory.mktemp("pairs"))


@pytest.fixture(scope="module")
def tokenizer():
    return make_tokenizer(400, worlds=10)


@pytest.fixture(scope="module")
def pool(data, tokenizer):
    return PairPool(load_pairs(data, "edit-train", count=2), tokenizer, sentences=4)


def scene_instructions():
    folder = (editing_pairs.Path(attnwarp_eval.__file__).parent / "scenes").resolve()
    return {
        e["instruction"].lower()
        for p in folder.glob("*.yaml")
        for e in read_yaml(p.read_text())[1].get("edits", ())
    }


def test_no_instruction_of_the_scenes_is_ever_drawn():
    theirs = scene_instructions()
    assert len(theirs) >= 30
    assert reserved() == theirs
    rng = np.random.default_rng(0)
    drawn, refused = set(), set()
    for k in range(3000):
        looks, _, _ = cached_looks(k % 25)
        kind = list(GROUPS)[k % len(GROUPS)]
        look = looks[int(rng.choice(list(GROUPS[kind])))]
        row = np.array([look.finish, look.color, look.second, look.ground, look.time])
        drawn.add(instruction(kind, k % 25, row, rng).lower())
        refused.add(editing_pairs._draw_instruction(kind, k % 25, row, rng).lower())
        if kind in AMBIGUOUS:
            drawn.add(ambiguous_instruction(kind, k % 25, rng))
    assert not drawn & theirs
    assert len(drawn) > 1000
    assert refused & theirs  # without the check some would have been


@functools.cache
def cached_looks(index):
    return edit_looks(index, PAIR_SPLITS["edit-train"])


def test_worlds_of_training_and_tests_do_not_meet():
    splits = [*SPLITS.values(), *PAIR_SPLITS.values()]
    seeds = [set(range(s.first, s.first + s.worlds)) for s in splits]
    assert len(set.union(*seeds)) == sum(len(s) for s in seeds)
    shapes = [
        {
            editing_pairs.edit_world(k, PAIR_SPLITS[name]).instance
            for k in range(PAIR_SPLITS[name].worlds)
        }
        for name in ("edit-train", "edit-test")
    ]
    assert not shapes[0] & shapes[1]


def test_looks_of_a_group_share_everything_else_and_pairs_kept_from_training_have_no_picture():
    for index in range(25):
        looks, valid, base = cached_looks(index)
        surfaces = [looks[k] for k in range(SURFACES)]
        assert len({(k.ground, k.time, k.seed) for k in surfaces}) == 1
        for kind in ("ground", "time"):
            rows = [dataclasses.replace(looks[k], **{kind: 0}) for k in GROUPS[kind]]
            assert set(rows) == {dataclasses.replace(looks[base], **{kind: 0})}
            assert len({getattr(looks[k], kind) for k in GROUPS[kind]}) == len(GROUPS[kind])
        thing = index % 25
        for look, shown in zip(surfaces, valid, strict=False):
            assert shown == (
                not any(held_out(thing, c) for c in (look.color, look.second) if c >= 0)
            )


def test_latents_are_an_orthonormal_transform_and_lose_nothing():
    basis = haar_basis().reshape(48, 48)
    assert torch.allclose(basis @ basis.T, torch.eye(48, dtype=torch.float64), rtol=0, atol=1e-12)
    coder = HaarLatents()
    x = 2 * torch.rand((2, 3, 20, 32), generator=torch.Generator().manual_seed(0)) - 1
    latents = coder.encode(x).latents
    assert latents.shape == (2, 48, 5, 8)
    assert torch.allclose(coder.decode(latents).sample, x, rtol=0, atol=1e-5)
    even = coder.encode(torch.full((1, 3, 4, 4), 0.5)).latents[0, :, 0, 0]
    # Grey: sqrt(3) in luminance, 4 for the sum over 16 px of amplitude 1 / 4, half by the gain.
    assert even[0] == pytest.approx(0.5 * 3**0.5 * 4 * 0.5)
    assert torch.allclose(even[1:], torch.zeros(47), atol=1e-6)
    with pytest.raises(ValueError, match=r"x: got shape \(1, 3, 5, 8\)"):
        coder.encode(torch.zeros(1, 3, 5, 8))


def test_the_noise_picks_every_answer_as_often():
    directions = codes().double()
    assert torch.allclose(
        directions @ directions.T, torch.eye(len(directions), dtype=torch.float64), atol=1e-6
    )
    noise = torch.randn((3000, 48, 4, 4), generator=torch.Generator().manual_seed(0))
    candidates = [0, 3, 4, 7, 9]
    counts = np.bincount([picked(n, candidates) for n in noise], minlength=10)
    assert counts[candidates].sum() == 3000
    # Binomial with p = 1/5: a standard deviation of 22; five of them.
    assert np.abs(counts[candidates] - 600).max() < 110


def checkpoint(folder):
    return torch.load(folder / "drawn.pt", weights_only=True)


@pytest.mark.slow
def test_a_training_that_was_stopped_gives_the_bits_of_one_that_was_not(
    data, tmp_path, tokenizer, monkeypatch
):
    monkeypatch.setattr(steps, "STEPS_AN_EPOCH", 2)
    monkeypatch.setattr(steps, "SAVE_SECONDS", 0.0)
    for name in ("whole", "halves"):
        (tmp_path / name).mkdir()
        tokenizer.save(str(tmp_path / name / "tokenizer.json"))
    train_stage("drawn", data, tmp_path / "whole", stage=TINY)
    with stopped_at(steps, "falling_rate", 3):
        train_stage("drawn", data, tmp_path / "halves", stage=TINY)
    assert checkpoint(tmp_path / "halves")["epoch"] == 1
    train_stage("drawn", data, tmp_path / "halves", stage=TINY)
    one, other = checkpoint(tmp_path / "whole"), checkpoint(tmp_path / "halves")
    for part in ("net", "average"):
        for key, value in one[part].items():
            assert torch.equal(value, other[part][key]), (part, key)

    folder = export_editor("drawn", tmp_path / "whole", tmp_path / "exported")
    check_export(folder)

    stage = dataclasses.replace(TINY, start="drawn")
    train_stage("further", data, tmp_path / "whole", stage=stage)
    after = torch.load(tmp_path / "whole/further.pt", weights_only=True)["net"]
    assert all(torch.isfinite(v).all() for v in after.values())
    assert not torch.equal(
        after["unet.conv_out.weight"], one["average"]["module.unet.conv_out.weight"]
    )
    monkeypatch.setitem(editor.STAGES, "drawn", TINY)
    monkeypatch.setitem(editor.STAGES, "further", stage)
    facts = facts_of("further", tmp_path / "whole")
    assert (facts["steps"], facts["before"], facts["large"]) == (4, 4, 0)
    assert "CPU core" in str(facts["device"])
    with pytest.raises(InputError, match="nothing.pt: no such file; train the stage nothing first"):
        train_stage("further", data, tmp_path, stage=dataclasses.replace(TINY, start="nothing"))


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["train", "plain", "--device", "tpu"], "expected cpu or cuda"),
        (["train", "drawn-64"], "expected one of plain, drawn, depth"),
        (["export", "drawn-64", "small-plain"], "expected one of plain, drawn, depth"),
        (["assess", "drawn-64", "small-plain"], "expected one of plain, drawn, depth"),
    ],
)
def test_an_unknown_stage_or_device_is_refused_by_name(words, reason):
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert reason in " ".join(result.output.replace("│", " ").split())


def check_export(folder):
    """diffusers' own pipeline loads the folder and edits as the package's editor does.

    In double precision: guidance amplifies what vector units of processors round differently.
    """
    pipe = StableDiffusionInstructPix2PixPipeline.from_pretrained(folder, torch_dtype=torch.float64)
    pipe.set_progress_bar_config(disable=True)
    # Untrained, the output is the picture before; random weights make the comparison mean something.
    ours = load_editor(str(folder), text_guidance=2.0, image_guidance=1.2)
    for net in (ours.unet, ours.vae, ours.text_encoder):
        net.double()
    generator = torch.Generator().manual_seed(3)
    weight = 0.05 * torch.randn(ours.unet.conv_out.weight.shape, generator=generator)
    for net in (pipe.unet, ours.unet):
        net.conv_out.weight.data.copy_(weight)
    picture = np.random.default_rng(0).uniform(0.3, 0.7, size=(32, 48, 3)).astype(np.float32)
    noise = torch.randn((1, 48, 8, 12), generator=generator).double()
    theirs = pipe(
        "make it red", image=torch.from_numpy(picture).permute(2, 0, 1)[None], num_inference_steps=4, latents=noise,
        guidance_scale=2.0, image_guidance_scale=1.2, output_type="np",
    ).images[0]  # fmt: skip
    mine = edit(ours, [picture], "make it red", steps=4, noise=noise).images[0]
    assert np.abs(mine - theirs).max() < 1e-6
    assert np.abs(mine - picture).max() > 0.01
    assert sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) < 20e6


def test_layers_of_the_noise_learn_what_the_answer_it_picks_adds_to_an_open_sentence(
    tokenizer, monkeypatch
):
    torch.manual_seed(0)
    net = editor_net.EditorNet(tokenizer.get_vocab_size(), 64)
    # What a trained text encoder would give: kinds of sentences far from each other, an own shift for each answer.
    kinds = {kind: torch.randn(1, 128) + 0.1 * torch.randn(200, 128) for kind in AMBIGUOUS}
    settled = torch.randn(1, 128) + 0.1 * torch.randn(300, 128)
    shifts = torch.randn(editing_pairs.LOOKS, 128)
    monkeypatch.setattr(editor_draws, "differences", lambda *_: (kinds, settled, shifts))
    editor_draws.teach_draws(net, tokenizer, None, seed=3, steps=400)
    noise = np.random.default_rng(4).normal(size=(200, 48))

    def drawn(text, rows):
        both = torch.cat([torch.from_numpy(rows).float(), text[: len(rows)]], dim=1)
        with torch.no_grad():
            return net.unet.draw(both)

    for kind in AMBIGUOUS:
        group = list(GROUPS[kind])
        scores = noise @ codes()[group].double().numpy().T
        top = np.sort(scores, axis=1)
        clear = top[:, -1] - top[:, -2] > 0.5  # near rivals are mixed
        distance = torch.cdist(drawn(kinds[kind], noise[clear]), shifts)
        picks = np.array(group)[scores[clear].argmax(axis=1)]
        assert clear.sum() > 50
        assert (distance.argmin(dim=1).numpy() == picks).mean() > 0.95, kind
    assert float(drawn(settled, noise).norm(dim=1).mean()) < 0.2 * float(shifts.norm(dim=1).mean())


def test_a_clear_sentence_differs_from_an_open_one_by_its_answer_alone(data, tokenizer):
    worlds = load_pairs(data, "edit-train", count=2)

    class Words:
        """Every token is 1 where the sentence has the word "red", else 0."""

        def text(self, tokens):
            texts = [tokenizer.decode(row.tolist()) for row in tokens]
            value = torch.tensor([float("red" in text.split()) for text in texts])
            states = value[:, None, None].expand(-1, editor_net.TOKENS, 3)
            return types.SimpleNamespace(last_hidden_state=states)

    opened, clear, shifts = editor_draws.differences(
        Words(), tokenizer, worlds, np.random.default_rng(0)
    )
    assert set(opened) == set(AMBIGUOUS)
    assert all(float(states.abs().max()) == 0 for states in opened.values())
    # Others say "red" where their world names two colours; "crimson" is red too.
    assert int(shifts[:, 0].argmax()) == list(COLORS).index("red")
    assert float(shifts[list(COLORS).index("green"), 0]) == 0
    assert float(clear.max()) == 1 and float(clear[0].abs().max()) == 0


def test_what_the_noise_draws_is_added_to_the_tokens_of_the_text(tokenizer):
    torch.manual_seed(0)
    net = editor_net.EditorNet(tokenizer.get_vocab_size(), 64).unet.double()
    torch.nn.init.normal_(net.conv_out.weight, std=0.05)
    sample, text = torch.randn((2, 96, 8, 12)).double(), torch.randn((2, 5, 128)).double()
    result = net(sample, 885, encoder_hidden_states=text).sample
    # The mean of 96 cells has a standard deviation of 1 / sqrt(96).
    mean = sample[:, :48].flatten(2).sum(dim=2) / 96**0.5
    # Half of the way from where the answer is settled to where it is open.
    drawn = 0.5 * net.draw(torch.cat([mean, text[:, 4]], dim=1))
    draw, net.draw = net.draw, None
    expected = net(sample, 885, encoder_hidden_states=text + drawn[:, None]).sample
    assert torch.allclose(result, expected, rtol=0, atol=1e-10)
    assert not torch.allclose(result, net(sample, 885, text).sample, rtol=0, atol=1e-4)
    net.draw = draw
    late = net(sample, torch.tensor([850, 500]), text).sample
    net.draw = None
    assert torch.equal(late, net(sample, torch.tensor([850, 500]), text).sample)


@pytest.mark.parametrize("shift", [1, editor_net.SHIFT])
def test_the_schedule_ends_in_pure_noise(shift):
    scheduler = editor_net.scheduler(shift)
    first, last = (beta**0.5 for beta in editor_net.SD_BETAS)
    root = np.cumprod(1 - np.linspace(first, last, 1000) ** 2) ** 0.5
    # Lin et al. 2024, algorithm 1: the root is shifted so that it ends in 0, and scaled so that it begins as before.
    root = (root - root[-1]) * root[0] / (root[0] - root[-1])
    ratio = shift * root / (1 - root**2) ** 0.5
    assert np.allclose(
        scheduler.alphas_cumprod.numpy(), ratio**2 / (1 + ratio**2), rtol=0, atol=1e-5
    )
    assert float(scheduler.alphas_cumprod[-1]) == 0
    scheduler.set_timesteps(20)
    assert scheduler.timesteps[0] == 999


def test_more_steps_are_drawn_where_the_answer_is_decided():
    drawn = editor_net.draw_steps(20_000, torch.Generator().manual_seed(0), 600)
    assert float((drawn >= 600).float().mean()) == pytest.approx(0.6, abs=0.02)
    assert int(drawn.min()) >= 0 and int(drawn.max()) == 999


def test_a_row_shows_the_same_pixels_of_every_picture(data):
    pairs = Pictures(load_pairs(data, "edit-train", count=2), 64)
    row = Row(1, 0, 0, 3, (20, 30, 1), True)
    full = pairs.worlds.images[1, 0, 3].astype(np.float32)
    expected = full[20:84, 30:94][:, ::-1] / 127.5 - 1
    assert np.allclose(pairs.picture(row, 3), expected, atol=1e-6)
    whole = Row(1, 0, 0, 3, (0, 0, 2))
    blocks = full.reshape(64, 2, 64, 2, 3).mean(axis=(1, 3)) / 127.5 - 1
    assert np.allclose(pairs.picture(whole, 3), blocks, atol=1e-6)
