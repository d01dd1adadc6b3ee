"""Mistakes planted in a manifest and its folders: each is refused by name, before anything runs."""

import copy
import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from small_manifest import save, write_small
from tiny_editors import pix2pix, unet
from tiny_models import save_clip, save_dino
from typer.testing import CliRunner

from attnwarp.editing.small import load_editor
from attnwarp.io import read_ply, write_ply
from attnwarp_eval.cli.main import app
from attnwarp_lab.captures.check import check, pattern
from attnwarp_lab.captures.manifest import load_manifest, shipped


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    return folder, write_small(folder)


@pytest.fixture
def copied(made, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(made[0], folder)
    return folder, copy.deepcopy(made[1])


@pytest.fixture(scope="module")
def right(made):
    return told(*made)


def told(folder, manifest):
    return check(load_manifest(str(save(folder, manifest))), folder / "run", "cpu")


def rms(values):
    return float(np.sqrt(np.mean(np.square(values.double().numpy()))))


def test_a_right_manifest_has_no_problem_and_its_probe_values_are_the_models_own(made, right):
    """Oracle: diffusers' and transformers' own classes on the same input, without this package's loading."""
    folder, done = made[0], right
    assert done.problems == []
    assert {name: len(views) for name, views in done.views.items()} == {"one": 3, "two": 3}
    pipe, editor = pix2pix(), load_editor(str(folder / "weights/pix2pix"))
    side = 128  # a multiple of what the editor takes
    picture = (0.5 + 0.5 * pattern(side, side, 3)).float().permute(2, 0, 1)[None]
    with torch.no_grad():
        text, plain = (
            pipe.text_encoder(
                pipe.tokenizer(
                    words, padding="max_length", max_length=24, return_tensors="pt"
                ).input_ids
            )[0]
            for words in ("a photo of a bear", "")
        )
        view = pipe.vae.encode(2 * picture - 1).latent_dist.mode()
        x = pattern(*view.shape).float()
        step = torch.tensor(int(editor.schedule.timesteps(2, view.shape[2:])[1]))

        def noise(before, words):
            both = torch.cat([x, before], 1)
            return pipe.unet(both, step, encoder_hidden_states=words).sample

        both, image, none = noise(view, text), noise(view, plain), noise(0 * view, plain)
    guided = none + editor.image_guidance * (image - none) + editor.text_guidance * (both - image)
    expected = rms(guided) + rms(view * pipe.vae.config.scaling_factor)
    assert done.weights["editors.pix2pix"][1] == pytest.approx(expected, rel=1e-4)


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
    Image.new("RGB", (32, 16), "white").save(folder / "captures/two/masks/1.png")


def no_folder(folder, manifest):
    manifest["captures"]["two"]["data"] = "captures/three"


def wrong_editor(folder, manifest):
    manifest["variants"]["IGS2GS"]["editor"] = "controlnet"


MISTAKES = {
    two_names: "the key 'one' stands here and on line 5; keep one",
    other_version: "format: got 2, but input should be 1",
    outside: "captures.../../evil.[key]: got the name '../../evil', expected one that a file can have",
    no_prompt: "captures.two.edits.red.source: is missing, expected the words",
    empty_prompt: "captures.two.edits.red.target: is missing, expected the words",
    other_checkpoint: "editors.pix2pix.probe: weights/pix2pix gives",
    other_shapes: "unet.conv_in.weight has shape [16, 4, 3, 3], expected [320, 4, 3, 3]",
    other_scheduler: "editors.pix2pix: its scheduler leaves",
    other_clip: "vision_model.embeddings.position_embedding.weight has shape [26, 32], expected [17, 32]",
    no_registers: "encoders.dino: weights/dino has no tensor embeddings.register_tokens",
    moved_splats: "captures.two.splats.2d: ",
    small_mask: "1.png: got 16 x 32 (height x width), expected the aspect ratio of 32 x 32",
    no_folder: "captures.two: ",
    wrong_editor: "variants.IGS2GS: igs2gs takes an editor guided by a picture",
}


@pytest.mark.parametrize(
    "mistake",
    [
        pytest.param(m, marks=() if m in (other_checkpoint, outside) else pytest.mark.door)
        for m in MISTAKES
    ],
)
def test_a_planted_mistake_is_refused_by_name_before_anything_runs(copied, right, mistake):
    folder, manifest = copied
    manifest["editors"]["pix2pix"]["probe"] = right.weights["editors.pix2pix"][1]
    mistake(folder, manifest)
    path = folder / "manifest.yaml"
    if mistake is not two_names:
        save(folder, manifest)
    run = folder / "run"
    done = CliRunner().invoke(app, ["captures", str(path), "--out", str(run), "--dry-run"])
    assert done.exit_code == 2, done.output
    assert MISTAKES[mistake] in done.stderr
    assert not (run / "cells").exists()


def test_the_shipped_manifest_has_the_published_numbers():
    """Oracle: the paper's settings, and means of its columns."""
    loaded = load_manifest("paper")
    manifest = loaded.manifest
    assert (
        list(shipped()) == ["one", "paper"] and manifest.size == 512 and len(manifest.captures) == 6
    )
    from attnwarp_lab.captures.cells import settings_of

    settings = settings_of(loaded, manifest.variants["attention warp, ControlNet random"], 0, 512)
    assert (settings["stages"], settings["views_per_stage"], settings["iterations"]) == (3, 40, 960)
    assert settings["suffix"] == ", best quality, extremely detailed"
    assert settings["negative_prompt"].startswith("longbody, lowres")
    assert (settings["source_text_guidance"], settings["text_guidance"]) == (7.5, 12.5)
    assert settings["source_prompt"] == "{source}"
    ip2p = settings_of(loaded, manifest.variants["attention warp, IP2P"], 0, 512)
    assert ip2p["guidance_drop"] == 1.5 and ip2p["start"] == [700, 980]


def test_a_quick_look_keeps_the_seeds_of_the_command_line():
    loaded = load_manifest("paper")
    for given, expected in (
        (loaded.with_rows(seeds=[7, 8]), 7),
        (loaded, loaded.manifest.seeds[0]),
    ):
        rows = given.quick().manifest.variants.values()
        assert [row.seeds for row in rows] == [[expected], [expected]]
