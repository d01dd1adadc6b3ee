"""Mistakes planted in a manifest and its folders: each is refused by name, before anything runs."""

import copy
import json
import shutil

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from reproduction import save, write_small
from tiny_editors import pix2pix, unet
from tiny_models import save_clip, save_dino
from typer.testing import CliRunner

from attnwarp.errors import InputError
from attnwarp.io import read_ply, write_ply
from attnwarp_eval.cli.main import app
from attnwarp_eval.reproduce.check import check, pattern
from attnwarp_eval.reproduce.manifest import load_manifest, shipped


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reproduction")
    return folder, write_small(folder)


@pytest.fixture
def copied(made, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(made[0], folder)
    return folder, copy.deepcopy(made[1])


def told(folder, manifest):
    return check(load_manifest(str(save(folder, manifest))), folder / "run")


def rms(values):
    return float(np.sqrt(np.mean(np.square(values.double().numpy()))))


def test_a_right_manifest_has_no_problem_and_its_probe_values_are_the_models_own(made):
    """Oracle: diffusers' and transformers' own classes on the same input, without this package's loading."""
    folder, manifest = made
    done = told(folder, manifest)
    assert done.problems == []
    assert set(done.captures) == {"one", "two"} and done.views == {"one": 3, "two": 3}
    pipe = pix2pix()
    words = pipe.tokenizer(
        "a photo of a bear", padding="max_length", max_length=24, return_tensors="pt"
    ).input_ids
    picture = 0.5 + 0.5 * pattern(1, 3, 32, 32).float()
    with torch.no_grad():
        text = pipe.text_encoder(words)[0]
        x = pattern(1, 8, 16, 16).float()
        out = pipe.unet(x, torch.tensor(500), encoder_hidden_states=text).sample
        latents = pipe.vae.encode(2 * picture - 1).latent_dist.mode()
    assert done.weights["editors.pix2pix"][1] == pytest.approx(rms(out) + rms(latents), rel=1e-5)


def test_probe_values_are_written_into_the_manifest_and_hold_other_weights_off(copied):
    """Oracle: the manifest as it was but for the values, which the check computes on its own."""
    folder, manifest = copied
    weights = told(folder, manifest).weights
    path = save(folder, manifest)
    flow = (
        "  dino: {folder: weights/dino, shapes: {embeddings.register_tokens: [1, 4, 32]}} # ours\n"
    )
    start, rest = path.read_text().split("  dino:\n")
    path.write_text(f"{start}{flow}{rest[rest.index('methods:') :]}")
    expected = yaml.safe_load(path.read_text())
    for place, (_, value) in weights.items():
        part, key = place.split(".")
        if key != "perceptual":  # left out of the manifest: the bundled one
            expected[part][key]["probe"] = pytest.approx(value, rel=1e-5)
    shutil.rmtree(folder / "captures")  # not needed

    def call():
        return CliRunner().invoke(app, ["reproduce", str(path), "--write-probes"])

    done = call()
    assert done.exit_code == 0, done.output
    assert yaml.safe_load(path.read_text()) == expected and "} # ours" in path.read_text()
    assert "has a probe value" in call().stdout
    unet(8, seed=5).save_pretrained(folder / "weights/pix2pix/unet")
    other = call()
    assert other.exit_code == 2 and "editors.pix2pix.probe" in other.stderr


def two_names(folder, manifest):
    path = save(folder, manifest)
    first, rest = path.read_text().split("  two:\n")
    path.write_text(f"{first}  one:\n{rest}")


def other_version(folder, manifest):
    manifest["format"] = 2


def no_prompt(folder, manifest):
    del manifest["captures"]["two"]["edits"]["red"]["source"]


def outside(folder, manifest):
    manifest["captures"]["../../evil"] = manifest["captures"].pop("two")


def empty_prompt(folder, manifest):
    manifest["captures"]["two"]["edits"]["red"]["target"] = None


def other_checkpoint(folder, manifest):
    manifest["editors"]["pix2pix"]["probe"] = told(folder, manifest).weights["editors.pix2pix"][1]
    unet(8, seed=5).save_pretrained(folder / "weights/pix2pix/unet")


def other_shapes(folder, manifest):
    manifest["editors"]["controlnet"]["shapes"]["unet.conv_in.weight"] = [320, 4, 3, 3]


def other_scheduler(folder, manifest):
    path = folder / "weights/pix2pix/scheduler/scheduler_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"beta_schedule": "linear"}))


def other_clip(folder, manifest):
    shutil.rmtree(folder / "weights/clip")
    (folder / "weights/clip").mkdir()
    save_clip(folder / "weights/clip", side=40)


def no_registers(folder, manifest):
    shutil.rmtree(folder / "weights/dino")
    (folder / "weights/dino").mkdir()
    save_dino(folder / "weights/dino", registers=False)


def moved_splats(folder, manifest):
    path = folder / "captures/two/scene.ply"
    splats = read_ply(path)
    splats.means[:, 0] += 5
    write_ply(path, splats)


def small_mask(folder, manifest):
    Image.new("RGB", (16, 16), "white").save(folder / "captures/two/masks/1.png")


def no_folder(folder, manifest):
    manifest["captures"]["two"]["data"] = "captures/three"


def wrong_editor(folder, manifest):
    manifest["methods"]["IGS2GS"]["editor"] = "controlnet"


MISTAKES = {
    two_names: "the key 'one' stands here and on line 5; keep one",
    other_version: "format: got 2, expected 1: the manifest is of another version",
    outside: "captures.../../evil.[key]: got the name '../../evil', expected one that a file can have",
    no_prompt: "captures.two.edits.red.source: is missing, expected the words",
    empty_prompt: "captures.two.edits.red.target: is empty, expected the words",
    other_checkpoint: "editors.pix2pix.probe: weights/pix2pix gives",
    other_shapes: "unet.conv_in.weight has shape [16, 4, 3, 3], expected [320, 4, 3, 3]",
    other_scheduler: "editors.pix2pix: its scheduler leaves",
    other_clip: "vision_model.embeddings.position_embedding.weight has shape [26, 32], expected [17, 32]",
    no_registers: "encoders.dino: weights/dino has no tensor embeddings.register_tokens",
    moved_splats: "captures.two.splats.2d: renders of its splats are",
    small_mask: "1.png is 16 x 16 px, expected 32 x 32",
    no_folder: "captures.two: ",
    wrong_editor: "methods.IGS2GS: igs2gs takes an editor guided by a picture",
}


@pytest.mark.parametrize(
    "mistake",
    [
        pytest.param(m, marks=() if m in (other_checkpoint, outside) else pytest.mark.door)
        for m in MISTAKES
    ],
)
def test_a_planted_mistake_is_refused_by_name_before_anything_runs(copied, mistake):
    folder, manifest = copied
    mistake(folder, manifest)
    path = folder / "manifest.yaml"
    if mistake is not two_names:
        save(folder, manifest)
    run = folder / "run"
    done = CliRunner().invoke(app, ["reproduce", str(path), "--out", str(run), "--dry-run"])
    assert done.exit_code == 2, done.output
    assert MISTAKES[mistake] in done.stderr
    assert not (run / "cells").exists()
    with pytest.raises(InputError):
        check(load_manifest(str(path)), run).refuse()


def test_the_shipped_manifest_has_the_published_numbers():
    """Oracle: the paper's settings, and means of its columns."""
    loaded = load_manifest("paper")
    manifest = loaded.manifest
    assert list(shipped()) == ["paper"] and manifest.size == 512 and len(manifest.captures) == 6
    from attnwarp_eval.reproduce.cells import settings_of

    settings = settings_of(
        loaded, manifest.methods["attention warp, ControlNet random"], 0, "a cat"
    )
    assert (settings["stages"], settings["views_per_stage"], settings["iterations"]) == (3, 40, 960)
    assert settings["suffix"] == ", best quality, extremely detailed"
    assert settings["negative_prompt"].startswith("longbody, lowres")
    assert (settings["source_text_guidance"], settings["text_guidance"]) == (7.5, 12.5)
    assert settings["source_prompt"] == "a cat"
    ip2p = settings_of(loaded, manifest.methods["attention warp, IP2P"], 0, "")
    assert ip2p["guidance_drop"] == 1.5 and ip2p["start"] == [700, 980]
