"""Memory of an editor. Oracles: files of weights, the same editor without switches, diffusers' own tiles."""

import json
import struct

import numpy as np
import pytest
import torch
from tiny_editors import controlnet, pix2pix
from typer.testing import CliRunner

from attnwarp.cli.main import app
from attnwarp.editing.editor import edit
from attnwarp.editing.memory import weight_bytes
from attnwarp.editing.small import load_editor


@pytest.fixture(scope="module", params=[pix2pix, controlnet])
def folder(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("editor")
    request.param().save_pretrained(path)
    return path


def test_the_weights_take_what_their_files_hold(folder):
    """Oracle: the last offset in the header of each safetensors file."""
    expected = 0
    for path in folder.rglob("*.safetensors"):
        data = path.read_bytes()
        (length,) = struct.unpack("<Q", data[:8])
        header = json.loads(data[8 : 8 + length])
        expected += max(v["data_offsets"][1] for k, v in header.items() if k != "__metadata__")
    editor = load_editor(str(folder))
    assert weight_bytes(editor) == expected
    assert weight_bytes(load_editor(str(folder), dtype=torch.float16)) == expected // 2


def test_blocks_that_are_moved_and_pictures_of_one_tile_give_the_same_bits(folder):
    pytest.importorskip("accelerate")
    guides = [np.full((32, 32, 3), 0.25, np.float32), np.full((32, 32, 3), 0.75, np.float32)]
    plain = load_editor(str(folder))
    if plain.guide == "depth":
        guides = [guide[..., 0] + 1 for guide in guides]
    low = load_editor(str(folder), low_memory=True)
    one, two = (edit(editor, guides, "make it red", steps=2).images for editor in (plain, low))
    assert all((a == b).all() for a, b in zip(one, two, strict=True))
    # Larger than the autoencoder was made for.
    latents = torch.randn(1, 4, 32, 32, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        tiled = plain.vae.tiled_decode(latents / plain.vae.config.scaling_factor).sample
    assert torch.equal(low.pixels(latents), tiled / 2 + 0.5)
    assert not torch.equal(plain.pixels(latents), tiled / 2 + 0.5)


def test_the_option_reaches_the_editor(tmp_path):
    pytest.importorskip("accelerate")
    from PIL import Image

    Image.new("RGB", (32, 32), (90, 60, 30)).save(tmp_path / "a.png")
    made = []
    for name, more in (("plain", []), ("low", ["--low-memory"])):
        out = tmp_path / f"{name}.png"
        done = CliRunner().invoke(app, [
            "edit-image", str(tmp_path / "a.png"), "--instruction", "make it red", "--steps", "2",
            "--size", "32", "--out", str(out), *more,
        ])  # fmt: skip
        assert done.exit_code == 0, done.output
        made.append(out.read_bytes())
    assert made[0] == made[1]
