"""Oracles: what Python's zip archives and pickles hold."""

import io
import pickle
import tracemalloc
import zipfile

import pytest
import torch
from tiny_editors import pix2pix
from tiny_models import save_backbone

from attnwarp.editing.small import load_editor
from attnwarp.encoders import load_encoder
from attnwarp.encoders._weights import state_of
from attnwarp.encoders.lpips import BACKBONES
from attnwarp.errors import InputError

ADVICE = ("weights_only", "trust", "torch.load", "allowlist", "safe_globals")


class Evil:
    def __reduce__(self):
        return (print, ("ran",))


def test_objects_that_could_run_code_are_refused_without_advice_to_run_them(tmp_path, capfd):
    for name, obj in (("evil.pth", {"w": Evil()}), ("class.pt", torch.nn.Linear(1, 1))):
        torch.save(obj, tmp_path / name)
        with pytest.raises(
            InputError, match=f"{name}: cannot be read as weights .*run code"
        ) as got:
            state_of(tmp_path / name)
        assert not any(advice in str(got.value) for advice in ADVICE)
    (tmp_path / "plain.bin").write_bytes(pickle.dumps({"w": Evil()}))
    with pytest.raises(InputError, match="plain.bin: cannot be read as weights") as got:
        state_of(tmp_path / "plain.bin")
    assert not any(advice in str(got.value) for advice in ADVICE)
    assert "ran" not in capfd.readouterr().out


@pytest.mark.door
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.99])
def test_a_cut_file_of_lpips_is_named(kept, tmp_path):
    path = tmp_path / BACKBONES["squeeze"].file
    save_backbone(path, "squeeze")
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=f"{path.name}: cannot be read as weights"):
        load_encoder(f"lpips:{tmp_path}", "perceptual")


def bomb(path):
    """A few kB that would be 400 MB of zeros."""
    buffer = io.BytesIO()
    torch.save({"w": torch.zeros(100_000_000)}, buffer)
    with zipfile.ZipFile(buffer) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for part in old.namelist():
            new.writestr(part, old.read(part))
    assert path.stat().st_size < 1_000_000


@pytest.mark.door
def test_compressed_weights_are_refused_before_they_fill_the_memory(tmp_path):
    bomb(tmp_path / "a.pth")
    pix2pix().save_pretrained(tmp_path / "editor", safe_serialization=False)
    unet = next((tmp_path / "editor" / "unet").glob("*.bin"))
    unet.write_bytes((tmp_path / "a.pth").read_bytes())
    for read, named in (
        (lambda: state_of(tmp_path / "a.pth"), "a.pth"),
        (lambda: load_encoder(f"lpips:{tmp_path / 'a.pth'}", "perceptual"), "a.pth"),
        (lambda: load_editor(str(tmp_path / "editor")), unet.name),
    ):
        tracemalloc.start()
        with pytest.raises(InputError, match=f"{named}: its parts are compressed"):
            read()
        assert tracemalloc.get_traced_memory()[1] < 50e6
        tracemalloc.stop()
