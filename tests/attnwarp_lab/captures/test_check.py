"""Mistakes planted in a manifest and its folders: each is refused by name, before anything runs."""

import copy
import shutil

import pytest
from few_splats import few_splats
from PIL import Image
from small_manifest import EDIT, save, write_capture
from typer.testing import CliRunner

from attnwarp.io import read_ply, write_ply
from attnwarp_eval.cli.main import app
from attnwarp_lab.captures.capture import ready
from attnwarp_lab.captures.cells import settings_of
from attnwarp_lab.captures.manifest import load_manifest, shipped

MANIFEST = {
    "format": 1,
    "title": "Two captures",
    "captures": {
        name: {
            "data": f"captures/{name}",
            "splats": {few_splats().kind: f"captures/{name}/scene.ply"},
            "mask": {"folder": f"captures/{name}/masks"},
            "edits": {"red": dict(EDIT)},
        }
        for name in ("one", "two")
    },
    "editors": {"picture": "small-plain", "depth": "small-depth"},
    "variants": {"IGS2GS": {"method": "igs2gs", "editor": "picture"}},
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    for name, turn in (("one", 0.0), ("two", 0.3)):
        write_capture(folder / "captures" / name, turn)
    return folder


def two_names(folder, manifest):
    path = save(folder, manifest)
    first, rest = path.read_text().split("  two:\n")
    path.write_text(f"{first}  one:\n{rest}")


def other_version(folder, manifest):
    manifest["format"] = 2


def outside(folder, manifest):
    manifest["captures"]["../../evil"] = manifest["captures"].pop("two")


def same_capture(folder, manifest):
    manifest["captures"]["two"]["data"] = "captures/one"


def moved_splats(folder, manifest):
    path = folder / "captures/two/scene.ply"
    splats = read_ply(path)
    splats.means[:, 0] += 5
    write_ply(path, splats)


def small_mask(folder, manifest):
    Image.new("RGB", (32, 16), "white").save(folder / "captures/two/masks/1.png")


def half_a_point(folder, manifest):
    manifest["captures"]["two"]["mask"] = {"at": [8, 8, 20]}


def no_folder(folder, manifest):
    manifest["captures"]["two"]["data"] = "captures/three"


def no_encoder(folder, manifest):
    manifest["encoders"] = {"clip": "weights/clip"}


def wrong_editor(folder, manifest):
    manifest["variants"]["IGS2GS"]["editor"] = "depth"


MISTAKES = {
    two_names: "the key 'one' stands here and on line 4; keep one",
    other_version: "format: got 2, but input should be 1",
    outside: "captures.../../evil.[key]: got the name '../../evil', expected one that a file can have",
    same_capture: "captures.two: has the pictures and cameras of 'one'; name a capture once",
    moved_splats: "captures.two.splats.2d: ",
    small_mask: "1.png: got 16 x 32 (height x width), expected the aspect ratio of 32 x 32",
    half_a_point: "--at: got 3 numbers, expected X,Y of each point",
    no_folder: "captures.two: ",
    no_encoder: "encoders.clip: ",
    wrong_editor: "variants.IGS2GS: igs2gs takes an editor guided by a picture",
}


@pytest.mark.parametrize(
    "mistake",
    [
        pytest.param(
            m, marks=() if m in (outside, wrong_editor, half_a_point) else pytest.mark.door
        )
        for m in MISTAKES
    ],
)
def test_a_planted_mistake_is_refused_by_name_before_anything_runs(made, tmp_path, mistake):
    folder, manifest = tmp_path / "copy", copy.deepcopy(MANIFEST)
    shutil.copytree(made, folder)
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
    settings = settings_of(loaded, manifest.variants["attention warp, ControlNet random"], 0, 512)
    assert (settings["stages"], settings["views_per_stage"], settings["iterations"]) == (3, 40, 960)
    assert settings["suffix"] == ", best quality, extremely detailed"
    assert settings["negative_prompt"].startswith("longbody, lowres")
    assert (settings["source_text_guidance"], settings["text_guidance"]) == (7.5, 12.5)
    assert settings["source_prompt"] == "{source}"
    ip2p = settings_of(loaded, manifest.variants["attention warp, IP2P"], 0, 512)
    assert ip2p["guidance_drop"] == 1.5 and ip2p["start"] == [700, 980]


def test_smaller_copies_of_the_pictures_are_read_by_the_scale_of_a_capture(made, tmp_path):
    folder, manifest = tmp_path / "copy", copy.deepcopy(MANIFEST)
    shutil.copytree(made, folder)
    (folder / "captures/one/images_2").mkdir()
    for file in (folder / "captures/one/images").iterdir():
        Image.open(file).resize((16, 16)).save(folder / "captures/one/images_2" / file.name)
    manifest["captures"]["one"]["scale"] = 2
    loaded = load_manifest(str(save(folder, manifest)))
    sizes = [{c.width for c in ready(loaded, name).views.cameras} for name in ("one", "two")]
    assert sizes == [{16}, {32}]
