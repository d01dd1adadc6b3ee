"""Oracles: diffusers' own pipeline, worlds of plain colours, closed forms, a run that was not stopped."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import StableDiffusionControlNetPipeline

from attnwarp.editing.editor import edit
from attnwarp.editing.editors.controlnet import DepthControlNet, control_image
from attnwarp.editing.small import DEPTH_GUIDANCE, load_editor
from attnwarp_eval.drawn.worlds import COLORS
from training import steps
from training.assess.depth import assess_depth, depth_card, separation
from training.assess.pictures import Row
from training.editors import depth as depth_editor
from training.editors.depth import (
    DepthStage,
    PromptPool,
    Prompts,
    attributes_of,
    draw_prompt,
    reserved_prompts,
    train_depth_stage,
)
from training.editors.export import export_depth_editor
from training.editors.net import EditorNet
from training.editors.recipe import make_tokenizer
from training.worlds.editing_pairs import LOOKS, PAIR_SPLITS, SIZE, THING, Worlds, edit_looks
from training.worlds.words import HUES

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")

TINY = DepthStage(64, 2, 1e-3, 2, start="first", batch=2)


@pytest.fixture(scope="module")
def worlds():
    """Two worlds with the looks of real ones, each a square of one colour before a slope."""
    split = PAIR_SPLITS["edit-test"]
    drawn = [edit_looks(index, split) for index in range(2)]
    looks = np.array(
        [[(k.finish, k.color, k.second, k.ground, k.time) for k in one] for one, _, _ in drawn]
    )
    images = np.zeros((2, 2, LOOKS, SIZE, SIZE, 3), np.uint8)
    ids = np.ones((2, 2, SIZE, SIZE), np.uint8)
    depth = np.broadcast_to(np.linspace(9, 3, SIZE)[:, None], (2, 2, SIZE, SIZE)).copy()
    for world, low in enumerate((16, 48)):
        ids[world, :, low : low + 56, low : low + 56] = THING
        depth[world, :, low : low + 56, low : low + 56] = 2
        for look in range(LOOKS):
            rng = np.random.default_rng([world, look])
            images[world, :, look] = rng.integers(0, 256, 3)
            images[world, :, look, low : low + 56, low : low + 56] = rng.integers(0, 256, 3)
    matrices = np.broadcast_to(np.eye(4), (2, 2, 4, 4))
    return Worlds(
        images, np.array([valid for _, valid, _ in drawn]), np.arange(2), looks,
        np.array([base for _, _, base in drawn]), ids, depth.astype(np.float32), matrices[..., :3, :3], matrices,
    )  # fmt: skip


@pytest.fixture(scope="module")
def tokenizer():
    return make_tokenizer(400, worlds=10)


@pytest.fixture(scope="module")
def trained(tmp_path_factory, worlds, tokenizer):
    """A folder with a tiny stage that ran through, and the stage."""
    folder = tmp_path_factory.mktemp("depth")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(depth_editor, "load_pairs", lambda *args, **more: worlds)
        patch.setattr(steps, "STEPS_AN_EPOCH", 1)
        patch.setattr(steps, "SAVE_SECONDS", 0.0)
        prepare(folder, tokenizer)
        train_depth_stage("depth", folder, folder, stage=TINY)
        yield folder


def prepare(folder, tokenizer):
    torch.manual_seed(0)
    folder.mkdir(exist_ok=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    net = EditorNet(tokenizer.get_vocab_size(), 64)
    torch.save({"average": {**net.state_dict(), "n_averaged": 0}}, folder / "first.pt")


def test_prompts_are_true_of_the_picture_and_none_of_a_scene_is_drawn(worlds, tokenizer):
    pool = PromptPool(worlds, tokenizer, prompts=20)
    generator = torch.Generator().manual_seed(0)
    assert len(reserved_prompts()) >= 30
    noise = torch.randn((200, 48, 16, 16), generator=generator)
    rows, tokens = pool.prompted(noise, generator, size=64)
    for k in range(len(rows)):
        text = tokenizer.decode(tokens[k].tolist())
        assert text.lower() not in reserved_prompts()
        look = attributes_of(worlds, int(rows.world[k]))[int(rows.target[k])]
        assert worlds.valid[int(rows.world[k]), int(rows.target[k])]
        named = {
            color
            for color in COLORS
            if set(text.split()) & {w for h in HUES[color] for w in h.split()}
        }
        of_look = {COLORS[c] for c in look[2:4] if c >= 0}
        surface = {"wooden", "boards", "earth", "marble", "sky", "grey", "white", "gold", "golden"}
        assert named <= of_look or surface & set(text.split()), (text, look)


def test_a_prompt_of_a_reserved_sentence_is_drawn_again(monkeypatch):
    look = (0, 0, 0, -1, 0, 0)
    first, _ = draw_prompt(look, np.random.default_rng(3))
    monkeypatch.setattr(depth_editor, "reserved_prompts", lambda: frozenset({first.lower()}))
    second, values = draw_prompt(look, np.random.default_rng(3))
    assert second.lower() != first.lower()
    assert values[0] == 0


def test_the_control_picture_is_the_inverse_depth_of_the_cut(worlds, tokenizer):
    row = Row(0, 1, 0, 0, (32, 8, 1), True)
    expected = 1 / worlds.depth[0, 1, 32:96, 8:72][:, ::-1]
    alone = Prompts(worlds, 64).control(row)
    np.testing.assert_allclose(alone[..., 1], expected / expected.max(), rtol=1e-5)
    # Many at once are the same pictures, also where nothing is near and where a pixel stands for a block.
    pool = PromptPool(worlds, tokenizer, prompts=4)
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn((12, 48, 16, 16), generator=generator)
    rows, _ = pool.prompted(noise, generator, size=64)
    assert len(set(rows.zoom.tolist())) == 2
    for k, image in enumerate(pool.control(rows, 64)):
        corner = (int(rows.y[k]), int(rows.x[k]), int(rows.zoom[k]))
        one = Row(int(rows.world[k]), int(rows.view[k]), 0, 0, corner, bool(rows.flip[k]))
        np.testing.assert_allclose(
            image.permute(1, 2, 0), Prompts(worlds, 64).control(one), rtol=1e-6
        )


def test_variance_explained_by_a_mask_is_the_closed_form():
    mask = np.zeros((8, 8), bool)
    mask[:4] = True
    image = np.where(mask[..., None], 0.75, 0.25).repeat(3, axis=2)
    assert separation(image, mask) == pytest.approx(1)
    # Sides of means 0 and with a variance of 1 each: nothing is explained.
    waves = np.tile([1.0, -1.0], (8, 4))[..., None].repeat(3, axis=2)
    assert separation(waves, mask) == pytest.approx(0)
    # Means differ by 1, variance within is 1/4: the two are equal parts.
    assert separation(image * 2 + waves / 2, mask) == pytest.approx(0.5)
    assert separation(image, np.ones((8, 8), bool)) == 0


def test_diffusers_own_pipeline_draws_the_same_picture(trained, worlds, tmp_path):
    folder = export_depth_editor("depth", trained, tmp_path / "small-depth")
    pipe = StableDiffusionControlNetPipeline.from_pretrained(folder, torch_dtype=torch.float32)
    pipe.set_progress_bar_config(disable=True)
    ours = load_editor(str(folder), text_guidance=2.0)
    assert isinstance(ours, DepthControlNet)
    depth = worlds.depth[0, 0, ::2, ::2]
    noise = torch.randn((1, 48, 16, 16), generator=torch.Generator().manual_seed(0))
    control = torch.from_numpy(control_image(depth)).permute(2, 0, 1)[None]
    theirs = pipe(
        "a red ball on grass", image=control, height=64, width=64, num_inference_steps=4, guidance_scale=2.0,
        latents=noise, output_type="np",
    ).images[0]  # fmt: skip
    picture = edit(ours, [depth], "a red ball on grass", steps=4, noise=noise).images[0]
    np.testing.assert_allclose(picture, theirs, atol=1e-4)


def test_an_editor_that_knows_every_answer_gets_all(worlds, monkeypatch):
    """Also the parts of a picture that the depth map decides."""
    prompts = Prompts(worlds, 64)

    def knows(editor, prompts, row, prompt, *, seed):
        return prompts.shown(row, row.target)

    monkeypatch.setattr("training.assess.depth.draw", knows)
    monkeypatch.setattr("training.assess.depth.SHAPES", 2)
    words = SimpleNamespace(tokenizer=lambda text: SimpleNamespace(input_ids=text.split()))
    results = assess_depth(words, prompts)
    assert all(own.value == 1 for own, _ in results)
    assert all(control.value == 0 for _, control in results)
    facts = {
        "size": 64, "device": "one CPU core", "steps": 2, "planned": 2, "batch": 2, "minutes": 0, "start": "first", "worlds": 2,
        "state": "The stage is complete.", "guidance": DEPTH_GUIDANCE,
    }  # fmt: skip
    card = depth_card("small-depth", results, facts)
    assert card.count("**100 %**") == len(results) == 5
