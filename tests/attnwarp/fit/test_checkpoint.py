"""A checkpoint is what was written, to the bit, or it is refused."""

import hashlib
import io
import pickle
import random
import zipfile

import pytest
import torch

from attnwarp.fit import FitSettings, checkpoint, fit, from_points
from attnwarp.fit.loop import CHECKPOINT
from attnwarp.io import FileFormatError


def state():
    random = torch.Generator().manual_seed(0)
    return {
        "tensors": {"means": torch.randn(5, 3, generator=random), "empty": torch.zeros(0, 3)},
        "queue": [3, 1, 2],
        "settings": {"kind": "2d", "ssim": 0.2, "normal": None},
    }


def refused(path, part="remove it to begin again"):
    with pytest.raises(FileFormatError) as caught:
        checkpoint.load(path)
    assert str(path) in str(caught.value) and part in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_was_saved_is_loaded(tmp_path):
    checkpoint.save(tmp_path / "c.pt", state())
    back = checkpoint.load(tmp_path / "c.pt")
    assert torch.equal(back["tensors"]["means"], state()["tensors"]["means"])
    assert (back["queue"], back["settings"]) == (state()["queue"], state()["settings"])


def test_every_flipped_bit_and_every_end_is_refused(tmp_path):
    path = tmp_path / "c.pt"
    checkpoint.save(path, state())
    whole = path.read_bytes()
    draw = random.Random(0)
    positions = [*range(110), *draw.sample(range(110, len(whole)), 300)]
    for position in positions:
        damaged = bytearray(whole)
        damaged[position] ^= 1 << draw.randrange(8)
        path.write_bytes(damaged)
        refused(path)
    for end in range(0, len(whole), 61):
        path.write_bytes(whole[:end])
        refused(path)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 half a zip", b"\n" * 9])
def test_what_is_no_checkpoint_is_refused_by_a_fit_by_path(scene, tmp_path, content):
    (tmp_path / CHECKPOINT).write_bytes(content)
    start = from_points(scene[2], scene[3], kind="2d", sh_degree=0)
    with pytest.raises(
        FileFormatError, match=r"checkpoint\.pt: .*remove it and splats.ply to begin"
    ):
        fit(start, scene[0], FitSettings(iterations=5, sh_degree=0), folder=tmp_path)


def test_a_checkpoint_of_an_earlier_version_is_refused(tmp_path):
    torch.save({"format": 1, **state()}, tmp_path / "c.pt")
    refused(tmp_path / "c.pt", "not a checkpoint of this version")


class Evil:
    def __reduce__(self):
        return (print, ("run",))


def test_code_is_not_run_and_nobody_is_advised_to_run_it(tmp_path, capfd):
    """With a right checksum: made on purpose."""
    buffer = io.BytesIO()
    torch.save(state(), buffer)
    made = io.BytesIO()
    with zipfile.ZipFile(buffer) as old, zipfile.ZipFile(made, "w") as new:
        for name in old.namelist():
            evil = name.endswith("data.pkl")
            new.writestr(name, pickle.dumps(Evil(), protocol=2) if evil else old.read(name))
    data = made.getvalue()
    head = f"attnwarp checkpoint {checkpoint.FORMAT} {hashlib.sha256(data).hexdigest()}\n"
    (tmp_path / "c.pt").write_bytes(head.encode() + data)
    message = refused(tmp_path / "c.pt", "do not use it")
    for advice in ("weights_only", "trust", "torch.load", "allowlist"):
        assert advice not in message
    assert "run" not in capfd.readouterr().out
