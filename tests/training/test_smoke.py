"""Each recipe of a bundled weight file, from pictures to the exported file. Oracles: diffusers' own pipelines, the
networks that were trained, a run that was not stopped.
"""

import numpy as np
import pytest
import torch
from diffusers import StableDiffusionInstructPix2PixPipeline
from small_trainings import stopped_at
from typer.testing import CliRunner

from attnwarp.editing.editor import edit
from attnwarp.editing.small import load_editor
from attnwarp.encoders import bundled
from attnwarp.encoders.nets import ClipParts, ClipSmall, PerceptualSmall
from attnwarp.errors import InputError
from attnwarp_eval.drawn.assemblies import KINDS
from attnwarp_eval.drawn.worlds import COLORS, GROUNDS, OBJECTS
from attnwarp_eval.encoders import dino_small
from training import steps
from training.editors import draws
from training.editors.__main__ import app
from training.editors.export import export_editor
from training.editors.pool import PairPool
from training.editors.recipe import Stage, make_tokenizer, train_stage
from training.encoders import clip, clip_parts, dino, naming, perceptual
from training.encoders.__main__ import export
from training.worlds import part_pictures
from training.worlds.data import Pictures
from training.worlds.editing_pairs import LOOKS, PAIR_SPLITS, SIZE, THING, Worlds, edit_looks
from training.worlds.part_pictures import GROUND, PARTS, SKY, PartPictures

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")


# Editors --------------------------------------------------------------------------------------------------------------


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


# Encoders -------------------------------------------------------------------------------------------------------------


def noise_pictures(*_, **__):
    """Four worlds of noise in two views and two looks."""
    rng = np.random.default_rng(4)
    world, view, look = (v.ravel() for v in np.indices((4, 2, 2)))
    zeros = np.zeros(len(world), np.int64)
    columns = [world % len(OBJECTS), zeros, look, zeros - 1, look, zeros]
    images = rng.integers(256, size=(len(world), 40, 40, 3), dtype=np.uint8)
    return Pictures(images, np.stack(columns, axis=1), world, view, look)


def dressed_pictures(*_):
    """Five worlds of noise with parts in two halves."""
    rng = np.random.default_rng(3)
    world, view, look = (v.ravel() for v in np.indices((5, 2, part_pictures.LOOKS)))
    surfaces = np.full((len(world), len(PARTS), 3), -2)
    for p in (0, 5):
        surfaces[:, p] = [0, 0, -1]
        surfaces[:, p, 1] = rng.integers(len(COLORS), size=len(world))
    ids = np.full((10, 32, 32), GROUND, np.uint8)
    ids[:, :, :16], ids[:, :8, 16:], ids[:, 8:16, 16:] = 0, 5, SKY
    return PartPictures(
        rng.integers(256, size=(len(world), 32, 32, 3), dtype=np.uint8), surfaces, world % len(KINDS), world % len(GROUNDS),
        world % 4, world, view, look, world * 2 + view, ids, part_pictures.shares_of(ids),
    )  # fmt: skip


@pytest.fixture
def small(monkeypatch, tmp_path):
    """The recipes of encoders on a few pictures of noise."""
    for module in (naming, dino, perceptual):
        monkeypatch.setattr(module, "load", noise_pictures)
    for module in (naming, clip, dino, perceptual):
        monkeypatch.setattr(module, "BATCH", 4)
    monkeypatch.setattr(naming, "KEPT", 1)
    monkeypatch.setattr(naming.warm_start, "__kwdefaults__", {"epochs": 1})
    monkeypatch.setattr(clip.train, "__kwdefaults__", {"epochs": 1})
    monkeypatch.setattr(clip.make_tokenizer, "__defaults__", (300,))
    monkeypatch.setattr(perceptual, "STEPS", 1)
    monkeypatch.setattr(part_pictures, "load", dressed_pictures)
    monkeypatch.setattr(clip_parts, "load_pictures", noise_pictures)
    sizes = {"STEPS": 1, "UNITS": 1, "SINGLE": 4, "CROP": 32, "KEPT": 1, "NOUNS_EACH": 1}
    for name, value in sizes.items():
        monkeypatch.setattr(clip_parts, name, value)
    return tmp_path


def exported(folder, name, net, part="model", prefix=""):
    """The loaded encoder of a checkpoint's exported file; its weights are the checkpoint's in half precision."""
    export(name, folder, folder / "weights")
    load = dino_small.load if name == "dino-small" else bundled.load
    encoder = load(name, folder / "weights")
    stored = torch.load(folder / f"{name}.pt", weights_only=True)[part]
    assert type(encoder.net) is net
    for key, value in encoder.net.state_dict().items():
        assert torch.equal(value, stored[prefix + key].half().to(value.dtype)), key
        assert torch.isfinite(value.float()).all()
    return encoder


def test_clip_small_and_clip_parts_are_trained_and_loaded(small):
    clip_parts.train(small, small, epochs=1)  # after clip-small, which starts from names
    picture = np.random.default_rng(0).uniform(size=(40, 40, 3)).astype(np.float32)
    for name, net in (("clip-small", ClipSmall), ("clip-parts", ClipParts)):
        encoder = exported(small, name, net)
        assert np.isfinite(encoder.images([picture])).all()
        assert np.isfinite(encoder.texts(["a red ball"])).all()


def test_dino_small_is_trained_and_loaded(small):
    dino.train(small, small, epochs=1)
    encoder = exported(small, "dino-small", dino_small.DinoSmall, "teacher", "net.")
    assert encoder.tokens([np.zeros((40, 40, 3), np.float32)]).shape == (1, 8, 8, 192)


def test_perceptual_small_is_trained_and_loaded(small):
    perceptual.train(small, small, epochs=1)
    encoder = exported(small, "perceptual-small", PerceptualSmall)
    picture = np.random.default_rng(0).uniform(size=(40, 40, 3)).astype(np.float32)
    assert encoder.distance([picture, picture], [picture, 1 - picture])[0] == 0


def test_a_stopped_training_gives_the_same_bits_and_another_recipe_is_refused(small, monkeypatch):
    for name in ("whole", "halves"):
        (small / name).mkdir()
    perceptual.train(small, small / "whole", epochs=2)
    with stopped_at(perceptual, "rate", 1):
        perceptual.train(small, small / "halves", epochs=2)
    perceptual.train(small, small / "halves", epochs=2)
    one, other = (
        torch.load(small / name / "perceptual-small.pt", weights_only=True)["model"]
        for name in ("whole", "halves")
    )
    assert all(torch.equal(value, other[key]) for key, value in one.items())
    monkeypatch.setattr(perceptual, "PEAK", 1.0)
    with pytest.raises(InputError, match=r"was made with other PEAK; remove it to train from the"):
        perceptual.train(small, small / "halves", epochs=2)
