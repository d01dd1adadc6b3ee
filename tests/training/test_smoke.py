"""The recipe of small-plain, from pictures to the exported file. Oracles: diffusers' own pipelines, the
networks that were trained, a run that was not stopped.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from diffusers import StableDiffusionInstructPix2PixPipeline
from small_trainings import stopped_at
from typer.testing import CliRunner

from attnwarp.editing.editor import edit
from attnwarp.editing.small import load_editor
from attnwarp.errors import InputError
from training import steps
from training.editors import draws
from training.editors.__main__ import app
from training.editors.export import export_editor
from training.editors.pool import PairPool
from training.editors.recipe import Stage, make_tokenizer, train_stage
from training.worlds.editing_pairs import LOOKS, PAIR_SPLITS, SIZE, THING, Worlds, edit_looks

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")


@pytest.fixture(scope="module")
def worlds():
    """Two worlds with the looks of real ones, each a square of one colour before a slope."""
    drawn = [edit_looks(index, PAIR_SPLITS["edit-test"]) for index in range(2)]
    looks = [[(k.finish, k.color, k.second, k.ground, k.time) for k in one] for one, _ in drawn]
    images = np.zeros((2, 2, LOOKS, SIZE, SIZE, 3), np.uint8)
    ids = np.ones((2, 2, SIZE, SIZE), np.uint8)
    for world, low in enumerate((16, 48)):
        ids[world, :, low : low + 56, low : low + 56] = THING
        for look in range(LOOKS):
            rng = np.random.default_rng([world, look])
            images[world, :, look] = rng.integers(0, 256, 3)
            images[world, :, look, low : low + 56, low : low + 56] = rng.integers(0, 256, 3)
    return Worlds(
        images, np.array([valid for _, valid in drawn]), np.arange(2), np.array(looks), ids
    )


@pytest.fixture
def out(tmp_path, monkeypatch):
    """A folder of checkpoints, with a tokenizer; an epoch has one step."""
    monkeypatch.setattr(steps, "STEPS_AN_EPOCH", 1)
    monkeypatch.setattr(steps, "SAVE_SECONDS", 0.0)
    monkeypatch.setattr(draws, "TEXTS", 4)
    monkeypatch.setattr(draws.teach_draws, "__kwdefaults__", {"steps": 4})
    make_tokenizer(400, worlds=10).save(str(tmp_path / "tokenizer.json"))
    return tmp_path


def tokenizer_in(folder):
    from tokenizers import Tokenizer

    return Tokenizer.from_file(str(folder / "tokenizer.json"))


def test_small_plain_is_trained_stopped_gone_on_with_and_edits_in_diffusers(
    out, worlds, monkeypatch
):
    from training.editors import recipe

    pool = PairPool(worlds, tokenizer_in(out), sentences=4)
    plain = Stage(64, 1, 1e-3, 2, batch=2, draws=False, large=0.5)
    drawn = Stage(64, 2, 1e-3, 2, batch=2, start="plain", composed=0.5)
    with pytest.raises(InputError, match=r"plain\.pt: no such file; train the stage plain first"):
        train_stage("drawn", out, out, stage=drawn, pool=pool)
    train_stage("plain", out, out, stage=plain, pool=pool)
    train_stage("drawn", out, out, stage=drawn, pool=pool)
    whole = torch.load(out / "drawn.pt", weights_only=True)["average"]
    (out / "drawn.pt").unlink()
    with stopped_at(steps, "falling_rate", 1):
        train_stage("drawn", out, out, stage=drawn, pool=pool)
    train_stage("drawn", out, out, stage=drawn, pool=pool)
    again = torch.load(out / "drawn.pt", weights_only=True)["average"]
    assert all(torch.equal(value, again[key]) for key, value in whole.items())
    with pytest.raises(InputError, match=r"was made with other peak; remove it to train from the"):
        train_stage("drawn", out, out, stage=replace(drawn, peak=1.0), pool=pool)

    monkeypatch.setitem(recipe.STAGES, "drawn", drawn)
    folder = export_editor("drawn", out, out / "exported")
    pipe = StableDiffusionInstructPix2PixPipeline.from_pretrained(folder, torch_dtype=torch.float64)
    pipe.set_progress_bar_config(disable=True)
    # In double precision: guidance amplifies what vector units of processors round differently.
    ours = load_editor(str(folder), text_guidance=2.0, image_guidance=1.2)
    for net in (ours.unet, ours.vae, ours.text_encoder):
        net.double()
    picture = np.random.default_rng(0).uniform(0.3, 0.7, size=(32, 48, 3)).astype(np.float32)
    noise = torch.randn((1, 48, 8, 12), generator=torch.Generator().manual_seed(3)).double()
    theirs = pipe(
        "make it red", image=torch.from_numpy(picture).permute(2, 0, 1)[None], num_inference_steps=4, latents=noise,
        guidance_scale=2.0, image_guidance_scale=1.2, output_type="np",
    ).images[0]  # fmt: skip
    mine = edit(ours, [picture], "make it red", steps=4, noise=noise).images[0]
    assert np.abs(mine - theirs).max() < 1e-6


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["train", "plain", "--device", "tpu"], "expected cpu or cuda"),
        (["train", "drawn-64"], "expected one of plain, drawn"),
    ],
)
def test_an_unknown_stage_or_device_is_refused_by_name(words, reason):
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert reason in " ".join(result.output.replace("│", " ").split())
